"""Rendering a scene with Mitsuba: the independent check of the tracer, for swatches and small cloth."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.mi.camera import Window
from usdfab.mi.fibers import MAX_POINTS, FiberBsdf, TextureReader, plugin_bsdf
from usdfab.mi.scene import translate
from usdfab.mi.variant import load, resolve_device
from usdfab.usd.scene import Camera, Scene

PATHS_AT_ONCE = 2_000_000
"""Most paths in a pass: each takes some hundred bytes in the compiled variants."""

DIFFERENTIABLE = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants in which our own fiber BSDF runs."""

FEWEST_PASSES = 4
"""Passes tell the noise; fewer would tell too little of it."""


@dataclass(frozen=True)
class MitsubaSettings:
    """How to render: ``size`` (width, height) of the whole picture and ``region`` (x0, y0, x1, y1) of it in pixels.

    ``max_depth`` counts path vertices (1: lights only, 2: direct light). ``budget`` is the most control points.
    """

    size: tuple[int, int]
    region: Window
    spp: int = 64
    max_depth: int = 64
    seed: int = 0
    device: str = "auto"
    threads: int | None = None
    budget: int = MAX_POINTS


@dataclass(frozen=True)
class MitsubaRender:
    """A picture, linear Rec. 709, rows from the top.

    ``pixels`` (H, W, 3) with the camera's exposure applied; ``variance`` (H, W, 3) of the pixel means, estimated from
    few passes (good on average over many pixels only), NaN with one sample; ``device`` llvm, cuda or scalar;
    ``points`` control points of fibers; ``warnings`` what was left out or approximated.
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
        As ``usdfab.mi.scene.translate``; without ``fiber_bsdf`` our own plugin where the variant can have it (not
        ``scalar``), else Mitsuba's hair.
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
    mi = load(device)
    if fiber_bsdf is None and mi.variant() in DIFFERENTIABLE:
        from usdfab.mi.fiber_bsdf import register_fiber_bsdf

        register_fiber_bsdf()
        fiber_bsdf = plugin_bsdf
    if settings.threads is not None:
        import drjit

        drjit.set_thread_count(settings.threads)
    with tempfile.TemporaryDirectory(prefix="usdfab-") as folder:
        translation = translate(
            mi, scene, camera, settings.size, settings.region, Path(folder), max_depth=settings.max_depth,
            pictures=pictures, textures=textures, fiber_bsdf=fiber_bsdf, budget=settings.budget,
        )  # fmt: skip
        # Plugins written in Python trace Dr.Jit code when they are made: not in several threads at once.
        loaded = mi.load_dict(translation.description, parallel=False)
    x0, y0, x1, y1 = settings.region
    counts = passes(settings.spp, (x1 - x0) * (y1 - y0))
    total, squares = np.zeros((y1 - y0, x1 - x0, 3)), np.zeros((y1 - y0, x1 - x0, 3))
    start = time.perf_counter()
    for number, count in enumerate(counts):
        seed = int(np.random.SeedSequence([settings.seed, number]).generate_state(1)[0])
        image = np.array(mi.render(loaded, spp=count, seed=seed), dtype=np.float64)
        total += count * image
        squares += count * image**2
        progress(number + 1, len(counts))
    mean = total / settings.spp
    # Passes of n samples have variance v / n: their weighted squares have expectation m^2 spp + v (passes - 1) / spp.
    spread = squares / settings.spp - mean**2
    variance = np.maximum(spread, 0.0) / (len(counts) - 1) if len(counts) > 1 else np.full_like(mean, math.nan)
    gain = 2.0**camera.exposure
    return MitsubaRender(
        (gain * mean).astype(np.float32), (gain**2 * variance).astype(np.float32), settings.region, settings.size,
        settings.spp, time.perf_counter() - start, device, translation.points, translation.warnings,
    )  # fmt: skip


def passes(spp: int, pixels: int) -> list[int]:
    """Samples per pixel of each pass: as equal as possible, at least ``FEWEST_PASSES`` where there are so many."""
    number = max(min(FEWEST_PASSES, spp), -(-spp * pixels // PATHS_AT_ONCE))
    number = min(number, spp)
    return [spp * (k + 1) // number - spp * k // number for k in range(number)]
