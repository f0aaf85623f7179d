"""A picture of how a surface stretches its cloth: colours for the stretch, lines along warp and weft, a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging import srgb_to_linear, write_image
from usdfab.usd.stretch import Surface
from usdfab.view.gl import check_off_screen, pyvista, quiet_vtk

LINES = 24
"""About so many lines of each system are drawn across the largest piece of cloth."""
COLORS = "YlOrRd"
WITHOUT_UV = (0.45, 0.2, 0.6)
"""Colour of what has no area in uv."""
WARP_INK, WEFT_INK = (0.05, 0.05, 0.05), (0.0, 0.35, 0.75)
AZIMUTH, ELEVATION = 28.0, 32.0
"""Degrees by which the camera stands beside and above the direction in which the cloth faces."""
Array = NDArray[np.float64]


def screenshot(
    path: str | Path,
    surfaces: Sequence[Surface],
    *,
    limit: float = 1.25,
    up_axis: str = "Y",
    resolution: tuple[int, int] = (1280, 960),
    overwrite: bool = False,
) -> Path:
    """Draw the stretch of surfaces into a picture file, without a display; returns the path.

    The redder, the more yarns are drawn out or pushed together; the colours end at ``limit`` or, where that is wider,
    at the stretch of 98 % of the area. Black lines run along the warp, blue ones along the weft, at a round distance.

    Raises
    ------
    UsdfabError
        As ``usdfab.imaging.write_image``; where there is no surface, VTK finds no OpenGL or pyvista is missing.
    """
    pixels = render(surfaces, limit=limit, up_axis=up_axis, resolution=resolution)
    return write_image(path, srgb_to_linear(pixels / 255.0), overwrite=overwrite)


def render(
    surfaces: Sequence[Surface], *, limit: float = 1.25, up_axis: str = "Y", resolution: tuple[int, int] = (1280, 960)
) -> NDArray[np.uint8]:
    """Like ``screenshot``, but gives the picture, (H, W, 3) sRGB codes."""
    if len(resolution) != 2 or any(not 16 <= n <= 8192 for n in resolution):
        raise UsdfabError(f"{resolution!r} is no resolution", place="resolution", remedy="use 16 to 8192 pixels a side")
    if not surfaces:
        raise UsdfabError("there is no surface to draw")
    pv = pyvista()
    check_off_screen()
    with quiet_vtk():
        plotter = pv.Plotter(off_screen=True, window_size=list(resolution), lighting="none")
    try:
        _draw(pv, plotter, surfaces, limit, up_axis)
        with quiet_vtk():
            return np.asarray(plotter.screenshot(return_img=True))[..., :3].copy()
    finally:
        plotter.close()


def color_limit(surfaces: Sequence[Surface], limit: float) -> float:
    """The stretch at which the colours end: ``limit``, or that of 98 % of the area, at most 4."""
    area = np.concatenate([s.stretch.area for s in surfaces])
    stretch = np.concatenate([s.stretch.stretch for s in surfaces])
    order = np.argsort(stretch)
    share = np.cumsum(area[order]) / area.sum()
    outer = float(stretch[order][min(int(np.searchsorted(share, 0.98)), len(order) - 1)])
    return float(min(max(limit, outer, 1.01), 4.0))


def line_step(surfaces: Sequence[Surface]) -> float:
    """Distance of the lines in metres of cloth: 1, 2 or 5 times a power of ten, for about ``LINES`` across."""
    extent = max(float(np.ptp(s.cloth.reshape(-1, 2), axis=0).max()) for s in surfaces)
    wanted = max(extent, 1e-9) / LINES
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * min((1.0, 2.0, 5.0, 10.0), key=lambda k: abs(math.log(k * power / wanted)))


def _draw(pv: Any, plotter: Any, surfaces: Sequence[Surface], limit: float, up_axis: str) -> None:
    plotter.set_background((1.0, 1.0, 1.0))
    outer, step = color_limit(surfaces, limit), line_step(surfaces)
    size = float(np.ptp(np.concatenate([s.points.reshape(-1, 3) for s in surfaces]), axis=0).max())
    actor = None
    for surface in surfaces:
        mesh = _poly(pv, surface)
        stretch = surface.stretch.stretch
        mesh.cell_data["stretch"] = np.log2(np.where(np.isfinite(stretch), np.clip(stretch, 1.0, outer), np.nan))
        actor = plotter.add_mesh(
            mesh, scalars="stretch", cmap=COLORS, clim=(0.0, math.log2(outer)), nan_color=WITHOUT_UV,
            show_scalar_bar=False, ambient=0.35, diffuse=0.7, specular=0.0,
        )  # fmt: skip
        # Behind the lines that lie in it.
        actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
        actor.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(2.0, 2.0)
        for axis, ink in ((0, WARP_INK), (1, WEFT_INK)):
            lines = _lines(mesh, surface, axis, step)
            if lines.n_points:
                plotter.add_mesh(lines, color=ink, line_width=1.5, lighting=False)
    _camera(pv, plotter, surfaces, up_axis, size)
    _legend(plotter, actor, surfaces, outer, step, limit)
    plotter.enable_anti_aliasing("ssaa")


def _poly(pv: Any, surface: Surface) -> Any:
    """Triangles that share no points: the cloth has seams."""
    number = len(surface.points)
    faces = np.column_stack([np.full(number, 3), np.arange(3 * number).reshape(-1, 3)])
    mesh = pv.PolyData(surface.points.reshape(-1, 3), faces.ravel())
    mesh.point_data["weft"], mesh.point_data["warp"] = surface.cloth.reshape(-1, 2).T
    return mesh


def _lines(mesh: Any, surface: Surface, axis: int, step: float) -> Any:
    """Where the cloth's x (axis 0: a line along the warp) or y (1) is a multiple of ``step``."""
    values = surface.cloth[..., axis]
    # Half a step off: the lines at 0 and at the border would flicker along the edges of the mesh.
    first, last = math.ceil(values.min() / step - 0.5), math.floor(values.max() / step - 0.5)
    levels = (np.arange(first, min(last, first + 4000) + 1) + 0.5) * step
    if len(levels) == 0:
        return mesh.extract_cells([])
    return mesh.contour(levels, scalars="weft" if axis == 0 else "warp")


def _camera(pv: Any, plotter: Any, surfaces: Sequence[Surface], up_axis: str, size: float) -> None:
    """A view from the side to which the cloth faces, from above, and light from that side."""
    up = np.array([0.0, 0.0, 1.0] if up_axis == "Z" else [0.0, 1.0, 0.0])
    corners = np.concatenate([s.points for s in surfaces])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # The mean direction: of length 1 for a flat cloth, 0 for a closed surface.
    facing = normals.sum(axis=0) / np.linalg.norm(normals, axis=1).sum()
    front = facing - (facing @ up) * up
    if np.linalg.norm(front) <= 0.1:
        # Cloth that lies flat, or faces all around, is seen from the front of the stage.
        front = np.array([0.0, -1.0, 0.0] if up_axis == "Z" else [0.0, 0.0, 1.0])
    front = front / np.linalg.norm(front)
    below = -1.0 if facing @ up < -0.5 else 1.0
    side = np.cross(up, front)
    a, e = math.radians(AZIMUTH), below * math.radians(ELEVATION)
    back = math.cos(e) * (math.cos(a) * front + math.sin(a) * side) + math.sin(e) * up
    center = 0.5 * (corners.reshape(-1, 3).min(axis=0) + corners.reshape(-1, 3).max(axis=0))
    plotter.camera.position = tuple(center + 4.0 * size * back)
    plotter.camera.focal_point = tuple(center)
    plotter.camera.up = tuple(up)
    plotter.camera.view_angle = 24.0
    plotter.reset_camera()
    plotter.camera.zoom(1.3)
    for direction, strength in ((back + 0.5 * side + 0.6 * up, 0.8), (back - side, 0.35)):
        plotter.add_light(
            pv.Light(position=tuple(center + 10.0 * size * direction), focal_point=tuple(center), intensity=strength)
        )


def _legend(plotter: Any, actor: Any, surfaces: Sequence[Surface], outer: float, step: float, limit: float) -> None:
    """The colour bar with stretches instead of logarithms, and what the lines are."""
    width, height = plotter.window_size
    font = max(8, round(height / 60))
    bar = plotter.add_scalar_bar(
        "", mapper=actor.mapper, color="black", vertical=True, position_x=0.905, position_y=0.25, width=0.06,
        height=0.5, n_labels=0, title_font_size=font, label_font_size=font,
    )  # fmt: skip
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        plotter.add_text(
            f"{outer**share:.3g}", position=(0.945 * width, (0.25 + 0.5 * share) * height - 0.7 * font),
            font_size=0.6 * font, color="black",
        )  # fmt: skip
    bar.SetDrawTickLabels(False)
    plotter.add_text("stretch", position=(0.905 * width, 0.775 * height), font_size=0.6 * font, color="black")
    area = np.concatenate([s.stretch.area for s in surfaces])
    above = area[np.concatenate([s.stretch.stretch for s in surfaces]) > limit].sum() / area.sum()
    text = (
        f"yarns drawn out or pushed together, in times; {100 * above:.3g} % of the area beyond {limit:g}\n"
        f"black lines: warp, blue lines: weft, every {1e3 * step:g} mm of cloth"
    )
    plotter.add_text(text, position=(0.02 * width, 0.02 * height), font_size=0.7 * font, color="black")
