"""Looking at a fabric's fibers: a scene of tubes, a window, a picture.

The scene is in the patch's frame: metres, x along the weft, y along the warp, z the face normal.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fibers.flyaways import OpenCurves
from usdfab.fibers.patch import FiberSystem, Patch
from usdfab.imaging import encoded, srgb_to_linear, write_image
from usdfab.view.gl import check_display, check_off_screen, pyvista, quiet_vtk

FiberColor = Literal["yarn", "fiber", "height", "albedo"]
Background = Literal["white", "dark"]

MAX_VERTICES = 800_000
"""Fiber vertices that are drawn at most; above, vertices are left out. A vertex costs about 2 kB while it is drawn."""

MAX_DECIMATION = 6
"""Left out are at most all but every so many vertices; what is still too big then is refused."""

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "dark": (0.09, 0.09, 0.10)}
VIEW_ANGLE = 24.0
"""Vertical field of view of the camera, degrees: a short telephoto, as for close-ups."""

AZIMUTH, ELEVATION = -62.0, 38.0
"""Where the camera stands, degrees: turned from +x about z, raised above the cloth."""

SECONDS_A_TURN = 60.0

_log = logging.getLogger(__name__)


def fiber_scene(patch: Patch, color: FiberColor = "yarn", tiles: tuple[int, int] = (1, 1), sides: int = 6) -> Any:
    """The fibers of a patch as tubes.

    Parameters
    ----------
    patch:
        What to show.
    color:
        "yarn": a colour for each yarn, warm for warp and cool for weft. "fiber": a colour for each fiber.
        "height": z in micrometres. "albedo": the fiber albedo, as a display shows it.
    tiles:
        Copies of the patch along x and y.
    sides:
        Sides of a tube, at least 3.

    Returns
    -------
    A pyvista.PolyData in metres with normals. Point data: "color" (N, 3) uint8 sRGB, or "height" (N,) micrometres.

    Raises
    ------
    UsdfabError
        For a colour mode or tile count that does not exist, a scene that is too big, and without pyvista.
    """
    pv = pyvista()
    if color not in get_args(FiberColor):
        raise UsdfabError(
            f"{color!r} is no colour mode", place="color", remedy=f"use {', '.join(get_args(FiberColor))}"
        )
    if len(tiles) != 2 or any(int(n) != n or n < 1 for n in tiles):
        raise UsdfabError(f"{tiles!r} are no tile counts", place="tiles", remedy="use two numbers from 1 up, as 2x2")
    if sides < 3:
        raise UsdfabError(f"a tube with {sides} sides has no inside", place="sides", remedy="use 3 or more")
    step = _decimation(patch, tiles)
    parts = [_lines(system, step) for system in patch.curves]
    points = np.concatenate([part[0] for part in parts])
    lengths = np.concatenate([np.diff(part[1]) for part in parts])
    radius = np.concatenate([np.full(len(p), s.radius) for (p, _), s in zip(parts, patch.curves, strict=True)])
    shifts = [(i * patch.size[0], j * patch.size[1], 0.0) for j in range(tiles[1]) for i in range(tiles[0])]

    lines = pv.PolyData()
    lines.points = (np.array(shifts)[:, None, :] + points).reshape(-1, 3)
    lines.lines = _connectivity(np.tile(lengths, len(shifts)))
    if color == "height":
        lines["height"] = lines.points[:, 2] * 1e6
    else:
        per_curve = np.concatenate([_curve_colors(system, color) for system in patch.curves])
        lines["color"] = np.tile(np.repeat(per_curve, lengths, axis=0), (len(shifts), 1))
    lines["radius"] = np.tile(radius, len(shifts))
    tubes = lines.tube(scalars="radius", absolute=True, n_sides=sides, capping=True)
    del tubes.point_data["radius"]
    tubes.set_active_scalars("height" if color == "height" else "color")
    return tubes


def screenshot(
    path: str | Path,
    patch: Patch,
    *,
    color: FiberColor = "yarn",
    tiles: tuple[int, int] = (2, 2),
    resolution: tuple[int, int] = (1280, 960),
    background: Background = "white",
    overwrite: bool = False,
) -> Path:
    """Draw a patch into a picture file, without a display.

    Parameters
    ----------
    path:
        Where to; see ``usdfab.imaging.write_image`` for the kinds of files.
    patch, color, tiles:
        As in ``fiber_scene``.
    resolution: (width, height) pixels
    background:
        "white" or "dark".
    overwrite:
        Replace an existing file.

    Returns
    -------
    The path.

    Raises
    ------
    UsdfabError
        As ``fiber_scene`` and ``write_image``, and where VTK finds no OpenGL.
    """
    pixels = render(patch, color=color, tiles=tiles, resolution=resolution, background=background)
    return write_image(path, srgb_to_linear(pixels / 255.0), overwrite=overwrite)


def render(
    patch: Patch,
    *,
    color: FiberColor = "yarn",
    tiles: tuple[int, int] = (2, 2),
    resolution: tuple[int, int] = (1280, 960),
    background: Background = "white",
) -> NDArray[np.uint8]:
    """Like ``screenshot``, but gives the picture, (H, W, 3) sRGB codes."""
    if len(resolution) != 2 or any(not 16 <= n <= 8192 for n in resolution):
        raise UsdfabError(f"{resolution!r} is no resolution", place="resolution", remedy="use 16 to 8192 pixels a side")
    check_off_screen()
    plotter = _plotter(patch, color, tiles, background, off_screen=True, window_size=list(resolution))
    try:
        with quiet_vtk():
            return np.asarray(plotter.screenshot(return_img=True))[..., :3].copy()
    finally:
        plotter.close()


def show(
    patch: Patch,
    *,
    color: FiberColor = "yarn",
    tiles: tuple[int, int] = (2, 2),
    background: Background = "white",
    turn: bool = True,
) -> None:
    """Open a window on a patch and wait until it is closed.

    The view turns slowly until the mouse takes over. Parameters as in ``screenshot``.

    Raises
    ------
    UsdfabError
        Without a display, and as ``fiber_scene``.
    """
    check_display()
    plotter = _plotter(patch, color, tiles, background, off_screen=False, title="usdfab inspect")
    if turn:
        _turntable(plotter)
    plotter.show()


# --- Geometry ---


def _decimation(patch: Patch, tiles: tuple[int, int]) -> int:
    """Every which vertex is kept."""
    count = tiles[0] * tiles[1] * sum(len(curves.points) for curves in patch.curves)
    step = math.ceil(count / MAX_VERTICES)
    if step > MAX_DECIMATION:
        raise UsdfabError(
            f"{tiles[0]} x {tiles[1]} tiles have {count:,} fiber vertices, too many to show",
            place="tiles",
            remedy=f"show fewer tiles (up to {MAX_DECIMATION * MAX_VERTICES:,} vertices)",
        )
    if step > 1:
        _log.warning("%s fiber vertices are many: every %d. of them is shown", f"{count:,}", step)
    return step


def _lines(system: FiberSystem | OpenCurves, step: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points and offsets of the curves, thinned out by ``step``; fibers are led on to where the next patch begins."""
    points, offsets = (system.points, system.offsets) if isinstance(system, OpenCurves) else system.extended(0, 1)
    if step == 1:
        return points, offsets
    curve = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    place = np.arange(len(points)) - offsets[curve]
    keep = (place % step == 0) | (place == np.diff(offsets)[curve] - 1)
    return points[keep], np.r_[0, np.cumsum(np.bincount(curve[keep], minlength=len(offsets) - 1))]


def _connectivity(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """VTK's cell array of consecutive polylines: n, first, ..., last, n, first, ..."""
    cells = np.arange(lengths.sum() + len(lengths)) - np.repeat(np.arange(1, len(lengths) + 1), lengths + 1)
    cells[np.r_[0, np.cumsum(lengths + 1)[:-1]]] = lengths
    return cells


def _curve_colors(system: FiberSystem | OpenCurves, color: FiberColor) -> NDArray[np.uint8]:
    """(curves, 3) sRGB codes."""
    if color == "albedo":
        return encoded(system.albedo)
    if color == "yarn":
        # Warm hues for warp, cool ones for weft; neighbours differ by the golden ratio.
        start, shade = (0.02, 0.0) if system.system == "warp" else (0.50, 0.3)
        spread = (system.yarn * 0.618034) % 1.0
        return _hsv(start + 0.13 * spread, 0.45 + 0.3 * ((spread + shade) % 1.0), 0.78 + 0.17 * spread)
    number = np.arange(system.curves) + (0 if system.system == "warp" else 0.5)
    return _hsv(
        (number * 0.618034) % 1.0, 0.35 + 0.4 * ((number * 0.414214) % 1.0), 0.65 + 0.3 * (number * 0.732051 % 1)
    )


def _hsv(hue: NDArray[Any], saturation: NDArray[Any], value: NDArray[Any]) -> NDArray[np.uint8]:
    """Hue, saturation, value, each (n,) in [0, 1], to sRGB codes (n, 3)."""
    k = (np.array([5.0, 3.0, 1.0]) + 6.0 * hue[:, None]) % 6.0
    rgb = value[:, None] * (1.0 - saturation[:, None] * np.clip(np.minimum(k, 4.0 - k), 0.0, 1.0))
    return np.round(rgb * 255).astype(np.uint8)


# --- Camera, light, window ---


def _plotter(patch: Patch, color: FiberColor, tiles: tuple[int, int], background: Background, **options: Any) -> Any:
    """A plotter with everything in its place, not yet shown."""
    pv = pyvista()
    if background not in BACKGROUNDS:
        raise UsdfabError(f"{background!r} is no background", place="background", remedy="use white or dark")
    tubes = fiber_scene(patch, color, tiles)
    with quiet_vtk():
        plotter = pv.Plotter(lighting="none", **options)
    plotter.set_background(BACKGROUNDS[background])
    look = {"specular": 0.12, "specular_power": 18.0, "ambient": 0.1, "diffuse": 0.9, "show_scalar_bar": False}
    if color == "height":
        actor = plotter.add_mesh(tubes, scalars="height", cmap="viridis", **look)
        ink = "black" if background == "white" else "white"
        bar: dict[str, Any] = {"vertical": True, "position_x": 0.91, "position_y": 0.06, "width": 0.04, "height": 0.4}
        bar |= {"title_font_size": 15, "label_font_size": 13, "fmt": "%.0f", "n_labels": 5}
        plotter.add_scalar_bar("height (um)\n", color=ink, mapper=actor.mapper, **bar)
    else:
        actor = plotter.add_mesh(tubes, scalars="color", rgb=True, **look)
    actor.prop.interpolation = "Phong"  # uses the tubes' normals; smooth_shading would compute them once more
    width, height = tiles[0] * patch.size[0], tiles[1] * patch.size[1]
    center = np.array([width / 2, height / 2, 0.5 * sum(patch.z_range)])
    _place_camera(plotter, np.array([width, height]), patch.z_range)
    _light(pv, plotter, center, math.hypot(width, height))
    plotter.enable_ssao(radius=0.12 * min(patch.size), bias=0.4 * patch.warp.radius, kernel_size=64, blur=True)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def _direction(azimuth: float, elevation: float) -> NDArray[np.float64]:
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def _place_camera(plotter: Any, size: NDArray[np.float64], z_range: tuple[float, float]) -> None:
    """A three-quarter view that the cloth's bounding box just fills."""
    back = _direction(AZIMUTH, ELEVATION)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    corners = np.array([(x, y, z) for x in (0.0, size[0]) for y in (0.0, size[1]) for z in z_range])
    slope = math.tan(math.radians(VIEW_ANGLE / 2)) * np.array([plotter.window_size[0] / plotter.window_size[1], 1.0])
    center = corners.mean(axis=0)
    distance = 2.0 * float(np.linalg.norm(size)) / slope.min()
    for _ in range(12):
        # Where the corners land in the picture, from -1 to 1; then move the camera towards filling 92 % of it.
        depth = distance - (corners - center) @ back
        landed = np.stack([(corners - center) @ right, (corners - center) @ up], axis=1) / (depth[:, None] * slope)
        low, high = landed.min(axis=0), landed.max(axis=0)
        middle = 0.5 * (low + high) * distance * slope
        center = center + middle[0] * right + middle[1] * up
        distance *= 0.5 * float((high - low).max()) / 0.92
    plotter.camera.position = tuple(center + distance * back)
    plotter.camera.focal_point = tuple(center)
    plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.camera.view_angle = VIEW_ANGLE
    plotter.reset_camera_clipping_range()


def _light(pv: Any, plotter: Any, center: NDArray[np.float64], size: float) -> None:
    """A raking key from the left, a weak fill from the camera's side, a rim from behind."""
    for azimuth, elevation, strength in ((170.0, 42.0, 1.0), (AZIMUTH + 25.0, 60.0, 0.45), (70.0, 25.0, 0.25)):
        position = center + 10.0 * size * _direction(azimuth, elevation)
        plotter.add_light(pv.Light(position=tuple(position), focal_point=tuple(center), intensity=strength))


def _turntable(plotter: Any) -> None:
    """Turn the camera about z until the mouse is used."""
    interval, turning = 40, [True]

    def stop(*_: Any) -> None:
        turning[0] = False

    def turn(_: int) -> None:
        if turning[0]:
            plotter.camera.azimuth += 360.0 * interval / 1000.0 / SECONDS_A_TURN
            plotter.render()

    plotter.iren.add_observer("StartInteractionEvent", stop)
    plotter.add_timer_event(max_steps=1_000_000, duration=interval, callback=turn)
