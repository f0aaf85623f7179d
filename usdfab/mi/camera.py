"""A camera as a Mitsuba sensor."""

from __future__ import annotations

from typing import Any

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.mi.space import Space
from usdfab.usd.scene import Camera

Window = tuple[int, int, int, int]

NEAR, FAR = 1e-4, 1e4
"""Metres: nothing nearer or farther is seen."""


def sensor(
    mi: Any, camera: Camera, size: tuple[int, int], region: Window, space: Space
) -> tuple[dict[str, Any], list[str]]:
    """A Mitsuba dictionary of a camera with its film, and what was left out.

    Parameters
    ----------
    size:
        (width, height) of the whole picture in pixels, of which ``region`` (x0, y0, x1, y1) is rendered.

    Raises
    ------
    UsdfabError
        If the picture's shape is not that of the camera's film: Mitsuba's pixels are square.
    """
    width, height = size
    tall = camera.tan_half[0] * height / width
    if abs(tall / camera.tan_half[1] - 1.0) > 1.01 / min(size):
        right = max(1, round(width * camera.tan_half[1] / camera.tan_half[0]))
        raise UsdfabError(
            f"{width}x{height} pixels are not square with this camera, which Mitsuba needs",
            place="--resolution",
            remedy=f"write {width}x{right} or {width}",
        )
    warnings = []
    if camera.to_world_close is not None and not np.array_equal(camera.to_world_close, camera.to_world):
        warnings.append(f"{camera.path}: the Mitsuba backend has no motion blur, the shutter's opening is shown")
    lens = camera.lens_radius > 0.0
    shift = 0.5 * camera.offset * (width, -height)
    # A camera with a lens has no principal point of its own: its picture is cut from a larger one, in whole pixels.
    whole = np.rint(shift).astype(int) if lens else np.zeros(2, dtype=int)
    if lens and np.abs(shift - whole).max() > 0.01:
        warnings.append(f"{camera.path}: with a lens, the film's offset is rounded to whole pixels")
    more = np.abs(whole)
    film = np.array(size) + 2 * more
    found: dict[str, Any] = {
        "type": "thinlens" if lens else "perspective",
        "fov": float(np.degrees(2.0 * np.arctan(camera.tan_half[0] * film[0] / width))),
        "fov_axis": "x",
        "near_clip": NEAR * space.scale,
        "far_clip": FAR * space.scale,
        # Mitsuba's camera looks along +z, with x to the left.
        "to_world": mi.ScalarTransform4f(space.matrix(camera.to_world) @ np.diag([-1.0, 1.0, -1.0, 1.0])),
        "film": {
            "type": "hdrfilm",
            "width": int(film[0]),
            "height": int(film[1]),
            "crop_offset_x": int(more[0] + whole[0] + region[0]),
            "crop_offset_y": int(more[1] + whole[1] + region[1]),
            "crop_width": region[2] - region[0],
            "crop_height": region[3] - region[1],
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }
    if lens:
        found["aperture_radius"] = camera.lens_radius * space.scale
        found["focus_distance"] = camera.focus_distance * space.scale
    else:
        found["principal_point_offset_x"] = 0.5 * float(camera.offset[0])
        found["principal_point_offset_y"] = -0.5 * float(camera.offset[1])
    return found, warnings
