"""Rendering a scene with Mitsuba: tile by tile with the two-scale integrator, or all fibers bent onto the mesh."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.mi.camera import Window
from usdfab.mi.fibers import MAX_POINTS, FiberBsdf, TextureReader, plugin_bsdf
from usdfab.mi.scene import translate
from usdfab.mi.two_scale_scene import load_two_scale, wears_cloth
from usdfab.mi.variant import load, resolve_device
from usdfab.usd.scene import Camera, Scene

PATHS_AT_ONCE = 2_000_000
"""Most paths in a pass: each takes some hundred bytes in the compiled variants."""

DIFFERENTIABLE = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants in which our own fiber BSDF runs."""

FEWEST_PASSES = 4
"""Passes tell the noise of flattened fibers; fewer would tell too little of it."""

Fibers = Literal["auto", "tiled", "flattened"]
"""How cloth is made: one copy of each tile, which rays find again everywhere (any amount of cloth); or every fiber as a
curve on the mesh, an independent check for close-ups. ``auto``: tiled on LLVM, else flattened."""

_NOT_TILED = {
    "scalar": "tiled fibers need Dr.Jit, which the scalar variant of Mitsuba has not",
    # Mitsuba issue 1349: rays of a second scene with other kinds of shapes are left out of a kernel, with a warning.
    "cuda": "tiled fibers need two scenes in one program, which Mitsuba does not support with OptiX",
}


@dataclass(frozen=True)
class MitsubaSettings:
    """How to render: ``size`` (width, height) of the whole picture and ``region`` (x0, y0, x1, y1) of it in pixels.

    ``max_depth`` counts path vertices (1: lights only, 2: direct light). ``fibers`` is how cloth is made; ``budget``
    the most control points of flattened fibers.
    """

    size: tuple[int, int]
    region: Window
    spp: int = 64
    max_depth: int = 64
    seed: int = 0
    device: str = "auto"
    threads: int | None = None
    budget: int = MAX_POINTS
    fibers: Fibers = "auto"


@dataclass(frozen=True)
class MitsubaRender:
    """A picture, linear Rec. 709, rows from the top.

    ``pixels`` (H, W, 3) with the camera's exposure applied; ``variance`` (H, W, 3) of the pixel means, NaN with one
    sample; of flattened fibers it is estimated from few passes (good on average over many pixels only). ``device``
    llvm, cuda or scalar; ``points`` control points of fibers, in one copy of each tile where they are ``tiled``;
    ``warnings`` what was left out or approximated.
    """

    pixels: NDArray[np.float32]
    variance: NDArray[np.float32]
    region: Window
    size: tuple[int, int]
    spp: int
    seconds: float
    device: str
    points: int
    warnings: tuple[str, ...]
    tiled: bool


@dataclass(frozen=True, eq=False)
class _Loaded:
    """A scene in Mitsuba; ``integrator`` is None where the scene has its own."""

    scene: Any
    integrator: Any
    points: int
    warnings: tuple[str, ...]


def render(
    scene: Scene,
    camera: Camera,
    settings: MitsubaSettings,
    *,
    pictures: Mapping[str, NDArray] | None = None,
    textures: TextureReader | None = None,
    fiber_bsdf: FiberBsdf | None = None,
    progress: Callable[..., None] = lambda done, total: None,
) -> MitsubaRender:
    """Render what a camera sees. The same seed gives the same picture on the same device.

    Parameters
    ----------
    pictures, textures, fiber_bsdf:
        As ``usdfab.mi.scene.translate``; ``fiber_bsdf`` is for flattened fibers, by default our own plugin where the
        variant can have it (not ``scalar``), else Mitsuba's hair.
    progress:
        Called with (passes done, passes).

    Raises
    ------
    UsdfabError
        If Mitsuba cannot be used, for settings that make no sense, and as ``translate``.
    """
    if settings.spp < 1 or settings.max_depth < 1:
        raise UsdfabError(f"spp {settings.spp} and depth {settings.max_depth} must be at least 1")
    device = resolve_device(settings.device)
    tiled = _tiled(settings.fibers, device)
    mi = load(device)
    if settings.threads is not None:
        import drjit

        drjit.set_thread_count(settings.threads)
    tiled = tiled and wears_cloth(scene)
    loaded = _load(mi, scene, camera, settings, tiled, pictures, textures, fiber_bsdf)
    x0, y0, x1, y1 = settings.region
    counts = passes(settings.spp, (x1 - x0) * (y1 - y0))
    total, squares = np.zeros((y1 - y0, x1 - x0, 3)), np.zeros((y1 - y0, x1 - x0, 3))
    start = time.perf_counter()
    for number, count in enumerate(counts):
        seed = int(np.random.SeedSequence([settings.seed, number]).generate_state(1)[0])
        image = mi.render(loaded.scene, integrator=loaded.integrator, spp=count, seed=seed)
        picture = np.array(image, dtype=np.float64)
        total += count * picture[..., :3]
        # Of single samples where the integrator tells them, else of passes.
        squares += count * (picture[..., 3:] if tiled else picture**2)
        progress(number + 1, len(counts))
    mean = total / settings.spp
    # Passes of n samples have variance v / n: their weighted squares have expectation m^2 spp + v (passes - 1) / spp.
    groups = settings.spp if tiled else len(counts)
    spread = np.maximum(squares / settings.spp - mean**2, 0.0)
    variance = spread / (groups - 1) if groups > 1 else np.full_like(mean, math.nan)
    gain = 2.0**camera.exposure
    return MitsubaRender(
        (gain * mean).astype(np.float32), (gain**2 * variance).astype(np.float32), settings.region, settings.size,
        settings.spp, time.perf_counter() - start, device, loaded.points, loaded.warnings, tiled,
    )  # fmt: skip


def _tiled(fibers: str, device: str) -> bool:
    """Whether cloth is made of tiles on a device."""
    if fibers not in get_args(Fibers):
        raise UsdfabError(f"there is no '{fibers}'", place="--fibers", remedy=f"choose {', '.join(get_args(Fibers))}")
    if fibers == "tiled" and device in _NOT_TILED:
        remedy = "use --device llvm, or --fibers flattened"
        raise UsdfabError(_NOT_TILED[device], place="--fibers tiled", remedy=remedy)
    return fibers != "flattened" and device not in _NOT_TILED


def _load(
    mi: Any, scene: Scene, camera: Camera, settings: MitsubaSettings, tiled: bool,
    pictures: Mapping[str, NDArray] | None, textures: TextureReader | None, fiber_bsdf: FiberBsdf | None,
) -> _Loaded:  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="usdfab-") as name:
        folder = Path(name)
        if tiled:
            two_scale = load_two_scale(
                mi, scene, camera, settings.size, settings.region, folder, max_depth=settings.max_depth,
                pictures=pictures, textures=textures,
            )  # fmt: skip
            return _Loaded(two_scale.scene, two_scale.integrator, two_scale.points, two_scale.warnings)
        if fiber_bsdf is None and mi.variant() in DIFFERENTIABLE:
            from usdfab.mi.fiber_bsdf import register_fiber_bsdf

            register_fiber_bsdf()
            fiber_bsdf = plugin_bsdf
        translation = translate(
            mi, scene, camera, settings.size, settings.region, folder, max_depth=settings.max_depth,
            pictures=pictures, textures=textures, fiber_bsdf=fiber_bsdf, budget=settings.budget,
        )  # fmt: skip
        # Plugins written in Python trace Dr.Jit code when they are made: not in several threads at once.
        loaded = mi.load_dict(translation.description, parallel=False)
    return _Loaded(loaded, None, translation.points, translation.warnings)


def passes(spp: int, pixels: int) -> list[int]:
    """Samples per pixel of each pass: as equal as possible, at least ``FEWEST_PASSES`` where there are so many."""
    number = max(min(FEWEST_PASSES, spp), -(-spp * pixels // PATHS_AT_ONCE))
    number = min(number, spp)
    return [spp * (k + 1) // number - spp * k // number for k in range(number)]
