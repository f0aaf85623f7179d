"""Rendering a scene: prepare tiles, meshes and lights, then passes of the kernel until it is good enough."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.scattering.fiber_numba import FIBER_SIZE, soften_fiber
from usdfab.tracer import embree
from usdfab.tracer.accumulate import Progress, Sums, ThreadRunner, accumulate
from usdfab.tracer.film import (
    ALBEDO,
    ALPHA,
    CHANNELS,
    DEPTH,
    DIRECT,
    FIBER_ID,
    NORMAL,
    RAYS,
    RGB,
    SAMPLES,
    UV,
    YARN_ID,
)
from usdfab.tracer.intrinsics import filter_address
from usdfab.tracer.kernel import render_tile
from usdfab.tracer.lights import pack_lights
from usdfab.tracer.macro_scene import Tiles, build_macro
from usdfab.tracer.memory import check_memory
from usdfab.tracer.patch_scene import PatchScene, build_tiles
from usdfab.tracer.radiance_cache import RadianceCache
from usdfab.tracer.schedule import Window, Work, bounds, plan_tiles, relative_error
from usdfab.tracer.textures import load_texture_images, pack_materials, pack_textures
from usdfab.tracer.world import MATERIAL, PATCH_COLUMNS, Patches, View, World
from usdfab.usd.scene import Camera, Scene

MAX_PIXELS = 2**28
"""Most pixels in memory at once."""
MAX_SIDE = 2**20


@dataclass(frozen=True)
class RenderSettings:
    """How to render.

    ``resolution`` is (width, height); where one is 0 it follows from the camera's aspect. ``max_depth`` counts path
    vertices as Mitsuba does (1: lights only, 2: direct light). ``time_limit`` in seconds ends the render after the
    pass that exceeds it. ``seed`` fixes every random number, whatever ``threads`` is.

    ``noise`` ends tiles whose estimated relative error (``schedule.relative_error``) is at most this; ``spp`` is then
    the most that a pixel gets. ``region`` (x0, y0, x1, y1) in pixels of the whole picture, upper ends excluded, renders
    only that window. ``part`` (i, n), i from 1, renders only the i-th of n parts of it.
    """

    resolution: tuple[int, int] = (720, 0)
    spp: int = 64
    max_depth: int = 64
    seed: int = 0
    threads: int | None = None
    time_limit: float | None = None
    noise: float | None = None
    region: Window | None = None
    part: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class Shot:
    """All that the sums of a pixel depend on besides the scene: small, and sent to whoever renders tiles."""

    camera: Camera
    width: int
    height: int
    seed: int
    max_depth: int


@dataclass(frozen=True)
class Render:
    """A picture or a region of one, linear Rec. 709, rows from the top.

    ``pixels`` (H, W, 3) with the camera's exposure applied; ``variance`` (H, W, 3) of the pixel means; ``albedo`` and
    ``normal`` (H, W, 3) of what is seen first, ``depth`` (H, W) metres, ``alpha`` (H, W). ``direct`` (H, W, 3): the
    part of ``pixels`` that was scattered at most once; ``uv`` (H, W, 2) of what is seen first; ``fiber_id`` and
    ``yarn_id`` (H, W) int32, 0 where no fiber is; ``samples`` (H, W) taken.

    ``spp`` is the mean of ``samples``, rounded; ``noise`` the relative error reached (``schedule.relative_error``),
    infinite where single samples tell nothing. ``region`` is what part of ``size`` (width, height) is shown.
    """

    pixels: NDArray[np.float32]
    variance: NDArray[np.float32]
    albedo: NDArray[np.float32]
    normal: NDArray[np.float32]
    depth: NDArray[np.float32]
    alpha: NDArray[np.float32]
    direct: NDArray[np.float32]
    uv: NDArray[np.float32]
    fiber_id: NDArray[np.int32]
    yarn_id: NDArray[np.int32]
    samples: NDArray[np.int32]
    spp: int
    seconds: float
    rays: float
    noise: float
    region: Window
    size: tuple[int, int]
    patch_segments: int


class Tracer:
    """A scene made ready for the kernels. Make it once, render it as often as you like."""

    def __init__(
        self,
        scene: Scene,
        textures: Mapping[str, NDArray] | None = None,
        strict: bool = False,
        later_scale: float | None = None,
        build: Callable[[FabricParameters], list[PatchScene]] | None = None,
    ) -> None:
        """Build tiles, meshes, materials and lights.

        Parameters
        ----------
        textures:
            Images of dome lights by path, linear (H, W, 3). Textures of materials are read here.
        strict:
            Whether a texture that cannot be read is an error; else it is one of ``warnings``.
        later_scale:
            Least scale, rad, of the azimuthal lobes of fibers at all bounces but the first (``soften_fiber``): a
            fraction of the noise, and what light does deep in the cloth is a little blurred. None: as they are.
        build:
            What makes the tiles of a fabric; ``build_tiles`` by default.
        """
        glow = any(np.any(m.emissive) or "emissiveColor" in m.textures for m in scene.materials if m.fabric < 0)
        if not scene.lights and not glow:
            raise UsdfabError("the stage has no light", place=scene.path, remedy="add a UsdLux light, e.g. a DomeLight")
        self._tiles: list[PatchScene] = []
        tiles_of: dict[int, Tiles] = {}
        fabrics: list[FabricParameters] = []
        owners: list[FabricParameters] = []
        tiles = []
        for surface in scene.fabrics:
            if surface.fabric not in fabrics:
                fabrics.append(surface.fabric)
                built = (build or build_tiles)(surface.fabric)
                tiles_of[len(fabrics) - 1] = Tiles(len(self._tiles), len(built))
                self._tiles += built
                owners += [surface.fabric] * len(built)
            tiles.append(tiles_of[fabrics.index(surface.fabric)])
        self.tiles: tuple[tuple[FabricParameters, PatchScene], ...] = tuple(zip(owners, self._tiles, strict=True))
        """All tiles in the order of their materials in ``world.patches``, each with its fabric."""
        maps = [surface.albedo_map for surface in scene.fabrics]
        wanted = [t for m in scene.materials if m.fabric < 0 for t in m.textures.values()] + [m for m in maps if m]
        images, warnings = load_texture_images(wanted, strict)
        plain = [m if m.fabric < 0 else replace(m, textures={}) for m in scene.materials]
        materials, used, more = pack_materials(plain, images)
        self.warnings = tuple(warnings + more)
        """What was left out or replaced, one sentence each."""
        numbers = []
        for image in maps:
            known = image is not None and image.file in images
            numbers.append(len(used) if known else -1)
            if image is not None and known:
                used.append(image)
        macro, self._macro_scene = build_macro(scene, tiles, numbers)
        self._moves = macro.corners.shape[0] > 1
        intersect, occluded = embree.function_addresses()
        addresses = tuple(np.uint64(a) for a in (intersect, occluded, filter_address(), self._macro_scene.handle))
        self.world = World(
            macro,
            pack_patches(self._tiles, later_scale),
            materials,
            pack_textures(used, images),
            pack_lights(scene, dict(textures or {})),
            addresses,  # type: ignore[arg-type]
        )

    @property
    def segments(self) -> int:
        """Fiber segments in memory, whatever the cloth's area."""
        return sum(len(s.segments) for s in self._tiles)

    def sample(
        self, shot: Shot, window: Window, first: int, samples: int, sums: Sums, cache: RadianceCache | None = None
    ) -> Sums:
        """The sums (h, w, LAYERS) of a window with samples ``first`` to ``first + samples`` added; ``sums`` is kept.

        A pure function: the same on any machine of the same kind, and the same however samples are divided among calls.
        With a ``cache``, paths end there; one that learns is filled.
        """
        film, squares = sums[..., :CHANNELS].copy(), sums[..., CHANNELS:].copy()
        render_tile(
            self.world, self.view(shot), np.uint64(shot.seed), window, first, samples, shot.max_depth, film, squares,
            cache,
        )  # fmt: skip
        return np.concatenate([film, squares], axis=-1)

    def render(self, camera: Camera, settings: RenderSettings, progress: Progress | None = None) -> Render:
        """Render what a camera sees. An interrupt (Ctrl-C) takes effect within a few tiles."""
        return render_by(self.sample, camera, settings, self.segments, progress)

    def view(self, shot: Shot) -> View:
        """A shot's camera as kernels read it."""
        close = shot.camera.to_world_close
        moves = self._moves or (close is not None and not np.array_equal(close, shot.camera.to_world))
        return pack_view(shot.camera, shot.width, shot.height, moves)


def render_by(
    sample: Callable[[Shot, Window, int, int, Sums], Sums],
    camera: Camera,
    settings: RenderSettings,
    segments: int,
    progress: Progress | None = None,
) -> Render:
    """Render with ``Tracer.sample`` or another like it."""
    shot, work = start(camera, settings)
    with ThreadRunner(partial(sample, shot), thread_count(settings.threads)) as runner:
        seconds = accumulate(
            work, runner, settings.spp, noise=settings.noise, gain=2.0**camera.exposure,
            time_limit=settings.time_limit, progress=progress,
        )  # fmt: skip
    region, size = resolve_region(settings.region, shot.width, shot.height), (shot.width, shot.height)
    return develop(work, region, size, camera.exposure, seconds, segments)


def thread_count(threads: int | None) -> int:
    """Threads to use: those asked for, or all cores that this process may use."""
    if threads is not None:
        if threads < 1:
            raise UsdfabError(f"{threads} threads can do nothing", place="--threads", remedy="give 1 or more")
        return threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start(camera: Camera, settings: RenderSettings) -> tuple[Shot, Work]:
    """The empty sums of a render, after checking all that can be checked beforehand.

    Raises
    ------
    UsdfabError
        For settings that make no sense and pictures that do not fit into memory.
    """
    width, height = resolve_resolution(camera, settings.resolution)
    if settings.spp < 1 or settings.max_depth < 1:
        raise UsdfabError(f"spp {settings.spp} and depth {settings.max_depth} must be at least 1")
    if settings.noise is not None and not 0.0 < settings.noise < math.inf:
        raise UsdfabError(f"{settings.noise} is no relative error", place="--noise", remedy="give e.g. 0.05")
    if settings.time_limit is not None and not settings.time_limit >= 0.0:
        raise UsdfabError(f"{settings.time_limit} is no duration", place="--time", remedy="give seconds")
    i, n = settings.part
    if not 1 <= i <= n:
        raise UsdfabError(f"there is no tile {i} of {n}", place="--tile", remedy="write e.g. 1/4 to 4/4")
    region = resolve_region(settings.region, width, height)
    columns, rows = region[2] - region[0], region[3] - region[1]
    if columns * rows / n > MAX_PIXELS:
        raise UsdfabError(f"{columns} x {rows} pixels are too many", remedy=f"stay below {MAX_PIXELS} pixels")
    tiles = plan_tiles(width, height, region, settings.part, settings.noise is not None)
    x0, y0, x1, y1 = bounds(tiles)
    check_memory(x1 - x0, y1 - y0)
    return Shot(camera, width, height, settings.seed, settings.max_depth), Work(tiles)


def resolve_resolution(camera: Camera, resolution: tuple[int, int]) -> tuple[int, int]:
    """(width, height) in pixels; a 0 follows from the camera's aspect."""
    width, height = resolution
    aspect = float(camera.tan_half[0] / camera.tan_half[1])
    if width <= 0 and height <= 0:
        width = 720
    if height <= 0:
        height = max(1, round(width / aspect))
    elif width <= 0:
        width = max(1, round(height * aspect))
    if max(width, height) > MAX_SIDE:
        raise UsdfabError(f"{width} x {height} pixels are too many", remedy=f"stay below {MAX_SIDE} on a side")
    return width, height


def resolve_region(region: Window | None, width: int, height: int) -> Window:
    """The window of a picture to render; all of it by default."""
    x0, y0, x1, y1 = region or (0, 0, width, height)
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise UsdfabError(
            f"{x0},{y0},{x1},{y1} is no part of {width} x {height} pixels", place="--region", remedy="x0,y0,x1,y1"
        )
    return x0, y0, x1, y1


def pack_view(camera: Camera, width: int, height: int, moves: bool) -> View:
    """A camera as the kernel reads it."""
    close = camera.to_world if camera.to_world_close is None else camera.to_world_close
    return View(
        np.stack([camera.to_world[:3, :4], close[:3, :4]]).astype(float),
        np.r_[camera.tan_half, camera.offset].astype(float),
        np.array([camera.lens_radius, camera.focus_distance], dtype=float),
        width,
        height,
        moves,
    )


def pack_patches(scenes: list[PatchScene], later_scale: float | None = None) -> Patches:
    """Tiles as kernels read them; they hold addresses in the scenes, which the caller keeps."""
    rows, materials, count = [], 0, 0
    curves = []
    for scene in scenes:
        rows.append([*scene.size, *scene.z_range, scene.epsilon, scene.units_per_meter, count])
        curves.append(scene.curves.copy())
        curves[-1][:, MATERIAL] += materials
        materials += len(scene.materials)
        count += len(scene.curves)
    packed = np.concatenate([s.materials for s in scenes] or [np.zeros((1, FIBER_SIZE))])
    later = 0
    if later_scale is not None and scenes:
        later = len(packed)
        packed = np.concatenate([packed, [soften_fiber(row, later_scale) for row in packed]])
    return Patches(
        table=np.array(rows, dtype=float).reshape(-1, PATCH_COLUMNS),
        handles=np.array([s.scene.handle for s in scenes], dtype=np.uint64),
        records=np.array(
            [[a.ctypes.data for a in (s.tangents, s.segments, s.vertices)] for s in scenes], dtype=np.uint64
        ).reshape(-1, 3),
        # Without fabrics one row of each: kernels read it before they know whether they need it.
        materials=packed,
        albedo=np.concatenate([s.albedo for s in scenes] or [np.zeros((1, 4))]),
        curves=np.concatenate(curves or [np.zeros((1, 2), dtype=np.int32)]),
        later=later,
    )


def develop(
    work: Work, region: Window, size: tuple[int, int], exposure: float, seconds: float, segments: int
) -> Render:
    """The picture of ``region``, which the work's window covers, of a whole picture of ``size`` (width, height)."""
    sums = work.part(region)
    gain = 2.0**exposure
    samples = sums[..., SAMPLES]
    n = np.maximum(samples, 1.0)[..., None]
    mean = sums[..., RGB : RGB + 3] / n
    variance = np.maximum(sums[..., CHANNELS:] / n - mean * mean, 0.0) / np.maximum(n - 1, 1)
    seen = np.maximum(sums[..., ALPHA], 1.0)
    normal = sums[..., NORMAL : NORMAL + 3]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return Render(
        pixels=(gain * mean).astype(np.float32),
        variance=(gain * gain * variance).astype(np.float32),
        albedo=(sums[..., ALBEDO : ALBEDO + 3] / n).astype(np.float32),
        normal=(normal / np.maximum(length, 1e-12)).astype(np.float32),
        depth=(sums[..., DEPTH] / seen).astype(np.float32),
        alpha=(sums[..., ALPHA] / n[..., 0]).astype(np.float32),
        direct=(gain * sums[..., DIRECT : DIRECT + 3] / n).astype(np.float32),
        uv=(sums[..., UV : UV + 2] / seen[..., None]).astype(np.float32),
        fiber_id=sums[..., FIBER_ID].astype(np.int32),
        yarn_id=sums[..., YARN_ID].astype(np.int32),
        samples=samples.astype(np.int32),
        spp=round(float(samples.mean())),
        seconds=seconds,
        rays=float(sums[..., RAYS].sum()),
        noise=relative_error(sums, gain),
        region=region,
        size=size,
        patch_segments=segments,
    )
