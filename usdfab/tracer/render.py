"""Rendering a scene: prepare tiles, meshes and lights, then passes of the kernel until samples or time are up."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.tracer import embree
from usdfab.tracer.film import CHANNELS
from usdfab.tracer.intrinsics import filter_address
from usdfab.tracer.kernel import Patches, View, World, render_tile
from usdfab.tracer.lights import pack_lights
from usdfab.tracer.macro_scene import build_macro
from usdfab.tracer.patch_scene import PatchScene, build_patch_scene
from usdfab.usd.scene import Camera, Scene

MAX_PIXELS = 2**28
ROWS_PER_TASK = 4
Progress = Callable[[int, int], None]
"""Called with (work done, work to do), in rows times samples per pixel."""


@dataclass(frozen=True)
class RenderSettings:
    """How to render.

    ``resolution`` is (width, height); where one is 0 it follows from the camera's aspect. ``max_depth`` counts path
    vertices as Mitsuba does (1: lights only, 2: direct light). ``time_limit`` in seconds ends the render after the
    pass that exceeds it. ``seed`` fixes every random number, whatever ``threads`` is.
    """

    resolution: tuple[int, int] = (720, 0)
    spp: int = 64
    max_depth: int = 64
    seed: int = 0
    threads: int | None = None
    time_limit: float | None = None


@dataclass(frozen=True)
class Render:
    """A picture, linear Rec. 709, rows from the top.

    ``pixels`` (H, W, 3) with the camera's exposure applied; ``variance`` (H, W, 3) of the pixel means; ``albedo`` and
    ``normal`` (H, W, 3) of what is seen first, ``depth`` (H, W) metres, ``alpha`` (H, W).
    """

    pixels: NDArray[np.float32]
    variance: NDArray[np.float32]
    albedo: NDArray[np.float32]
    normal: NDArray[np.float32]
    depth: NDArray[np.float32]
    alpha: NDArray[np.float32]
    spp: int
    seconds: float
    rays: float
    patch_segments: int


class Tracer:
    """A scene made ready for the kernels. Make it once, render it as often as you like."""

    def __init__(self, scene: Scene, textures: Mapping[str, NDArray] | None = None) -> None:
        if not scene.lights:
            raise UsdfabError("the stage has no light", place=scene.path, remedy="add a UsdLux light, e.g. a DomeLight")
        fabrics: list[FabricParameters] = []
        patch_of_fabric = []
        for surface in scene.fabrics:
            if surface.fabric not in fabrics:
                fabrics.append(surface.fabric)
            patch_of_fabric.append(fabrics.index(surface.fabric))
        self._scenes = [build_patch_scene(fabric) for fabric in fabrics]
        macro, self._macro_scene, (center, extent) = build_macro(scene, patch_of_fabric)
        lights = pack_lights(scene, dict(textures or {}), center, extent)
        intersect, occluded = embree.function_addresses()
        addresses = tuple(np.uint64(a) for a in (intersect, occluded, filter_address(), self._macro_scene.handle))
        self.world = World(macro, _pack_patches(self._scenes), lights, addresses)  # type: ignore[arg-type]

    @property
    def segments(self) -> int:
        """Fiber segments in memory, whatever the cloth's area."""
        return sum(len(s.segment_vertex) for s in self._scenes)

    def render(self, camera: Camera, settings: RenderSettings, progress: Progress | None = None) -> Render:
        """Render what a camera sees. An interrupt (Ctrl-C) takes effect within a few rows."""
        width, height = resolve_resolution(camera, settings.resolution)
        if settings.spp < 1 or settings.max_depth < 1:
            raise UsdfabError(f"spp {settings.spp} and depth {settings.max_depth} must be at least 1")
        film = np.zeros((height, width, CHANNELS))
        squares = np.zeros((height, width, 3))
        view = View(
            np.ascontiguousarray(camera.to_world[:3, :4], dtype=float),
            np.r_[camera.tan_half, camera.offset].astype(float),
            width,
            height,
        )
        threads = settings.threads or os.cpu_count() or 1
        chunks = [(row, min(row + ROWS_PER_TASK, height)) for row in range(0, height, ROWS_PER_TASK)]
        start = time.perf_counter()
        done = 0
        with ThreadPoolExecutor(threads) as pool:
            while done < settings.spp:
                # Passes grow, so that the first picture is there soon and the overhead of passes vanishes.
                samples = min(max(1, done), 16, settings.spp - done)

                def work(rows: tuple[int, int], first: int = done, samples: int = samples) -> None:
                    seed = np.uint64(settings.seed)
                    part = slice(*rows)
                    render_tile(
                        self.world, view, seed, (0, rows[0], width, rows[1]), first, samples, settings.max_depth,
                        film[part], squares[part],
                    )  # fmt: skip

                try:
                    for rows, _ in zip(chunks, pool.map(work, chunks), strict=True):
                        if progress:
                            progress(done * height + samples * rows[1], settings.spp * height)
                except BaseException:  # an interrupt must not wait for the rows that have not begun
                    pool.shutdown(wait=True, cancel_futures=True)
                    raise
                done += samples
                if settings.time_limit is not None and time.perf_counter() - start > settings.time_limit:
                    break
        return _develop(film, squares, done, camera.exposure, time.perf_counter() - start, self.segments)


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
    if width * height > MAX_PIXELS:
        raise UsdfabError(f"{width} x {height} pixels are too many", remedy=f"stay below {MAX_PIXELS} pixels")
    return width, height


def _pack_patches(scenes: list[PatchScene]) -> Patches:
    rows, material_base, segment_base, vertex_base = [], 0, 0, 0
    segment_material = [np.zeros(0, dtype=np.int32)]
    for scene in scenes:
        rows.append([*scene.size, *scene.z_range, scene.epsilon, segment_base, vertex_base, scene.units_per_meter])
        segment_material.append(scene.segment_material + np.int32(material_base))
        material_base += len(scene.materials)
        segment_base += len(scene.segment_vertex)
        vertex_base += len(scene.tangents)

    def join(name: str, empty: NDArray) -> NDArray:
        return np.concatenate([empty, *(getattr(s, name) for s in scenes)])

    columns = scenes[0].materials.shape[1] if scenes else 1
    return Patches(
        table=np.array(rows, dtype=float).reshape(-1, 8),
        handles=np.array([s.scene.handle for s in scenes], dtype=np.uint64),
        tangents=join("tangents", np.zeros((0, 3), dtype=np.float32)),
        segment_vertex=join("segment_vertex", np.zeros(0, dtype=np.int32)),
        segment_material=np.concatenate(segment_material),
        materials=join("materials", np.zeros((0, columns))),
        albedo=join("albedo", np.zeros((0, 3))),
    )


def _develop(film: NDArray, squares: NDArray, spp: int, exposure: float, seconds: float, segments: int) -> Render:
    gain = 2.0**exposure
    mean = film[..., :3] / spp
    variance = np.maximum(squares / spp - mean * mean, 0.0) / max(spp - 1, 1)
    alpha = film[..., 10] / spp
    seen = np.maximum(film[..., 10], 1.0)
    normal = film[..., 6:9]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return Render(
        pixels=(gain * mean).astype(np.float32),
        variance=(gain * gain * variance).astype(np.float32),
        albedo=(film[..., 3:6] / spp).astype(np.float32),
        normal=(normal / np.maximum(length, 1e-12)).astype(np.float32),
        depth=(film[..., 9] / seen).astype(np.float32),
        alpha=alpha.astype(np.float32),
        spp=spp,
        seconds=seconds,
        rays=float(film[..., 11].sum()),
        patch_segments=segments,
    )
