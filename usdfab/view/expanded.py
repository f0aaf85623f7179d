"""Looking at expanded fibers: a close-up of the place where pieces of cloth meet worst."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging import encoded, srgb_to_linear, write_image
from usdfab.view.gl import check_off_screen, pyvista, quiet_vtk

if TYPE_CHECKING:
    from usdfab.usd.expand import Expansion, WorldCurves

FIELD = 8.0
"""Side of what is shown, in widths of a yarn."""

VIEW_ANGLE = 24.0
TILT = 0.5
"""Tangent of the angle at which the cloth is looked at, off its normal."""

BACKGROUND = (0.06, 0.06, 0.07)


def screenshot_of(result: Expansion, path: str | Path, resolution: tuple[int, int], *, overwrite: bool = False) -> Path:
    """Draw what ``usdfab.usd.expand`` wrote, where its pieces meet worst, into a picture file.

    Raises
    ------
    UsdfabError
        Where nothing was measured (baked curves), and as ``close_up``.
    """
    from usdfab.usd.expand import world_curves

    if result.seams is None:
        raise UsdfabError("no seams were measured, so there is none to show", remedy="draw it with `usdfab render`")
    seams = result.seams
    center, normal = np.array(seams.place), np.array(seams.normal)
    field = FIELD * seams.yarn_width
    curves = world_curves(result.path, center, field)
    return close_up(curves, path, center, normal, field, resolution, overwrite=overwrite)


def close_up(
    curves: list[WorldCurves], path: str | Path, center: NDArray[np.float64], normal: NDArray[np.float64],
    field: float, resolution: tuple[int, int], *, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Draw curves as tubes, seen from the side of ``normal``; ``field`` metres high. Returns the path.

    Raises
    ------
    UsdfabError
        Without pyvista or OpenGL, and as ``write_image``.
    """
    check_off_screen()
    pv = pyvista()
    plotter = pv.Plotter(off_screen=True, window_size=list(resolution), lighting="none")
    try:
        plotter.set_background(BACKGROUND)
        # Micrometres: VTK's clipping planes are not made for millionths.
        for group in curves:
            mesh = _tubes(pv, group, center)
            plotter.add_mesh(mesh, scalars="color", rgb=True, smooth_shading=True, specular=0.3, specular_power=20)
        side = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
        side = side / np.linalg.norm(side)
        view = normal + TILT * side
        eye = view / np.linalg.norm(view) * 0.5 * field / np.tan(np.radians(0.5 * VIEW_ANGLE)) * 1e6
        plotter.camera.position, plotter.camera.focal_point = eye, (0.0, 0.0, 0.0)
        plotter.camera.up, plotter.camera.view_angle = np.cross(normal, side), VIEW_ANGLE
        for direction, strength in ((normal + side, 0.9), (normal - 1.5 * np.cross(normal, side), 0.45)):
            plotter.add_light(pv.Light(position=direction * 1e6, light_type="scene light", intensity=strength))
        plotter.reset_camera_clipping_range()
        with quiet_vtk():
            pixels = np.asarray(plotter.screenshot(return_img=True))[..., :3].copy()
    finally:
        plotter.close()
    return write_image(path, srgb_to_linear(pixels / 255.0), overwrite=overwrite)


def _tubes(pv: Any, curves: WorldCurves, center: NDArray[np.float64]) -> Any:
    """Tubes about the splines, micrometres from ``center``."""
    points, counts = _spline_points((curves.points - center) * 1e6, curves.counts)
    lines = pv.PolyData()
    lines.points = points
    starts = np.cumsum(counts) - counts
    lines.lines = np.concatenate([np.r_[n, np.arange(s, s + n)] for s, n in zip(starts, counts, strict=True)])
    lines["color"] = np.repeat(encoded(curves.color), counts, axis=0)
    return lines.tube(radius=curves.radius * 1e6, n_sides=6, capping=True)


def _spline_points(
    points: NDArray[np.float64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Places on the splines at their knots, and how many each has: the first and last control point are spare."""
    weighted = (points[:-2] + 4.0 * points[1:-1] + points[2:]) / 6.0
    keep = np.ones(len(points), dtype=bool)
    ends = np.cumsum(counts)
    keep[ends - counts] = keep[ends - 1] = False
    return weighted[keep[1:-1]], counts - 2
