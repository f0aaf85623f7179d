"""Rendering with the neural material: one ray a pixel, a query for each light, one answer of a small network.

Chen et al. 2024, section 4.3. Direct light only, as there: no light between surfaces, and light does not pass through
gaps. A picture has no noise at one sample; more samples smooth edges, add places on lights, and share the footprint.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.neural.gbuffer import NUMBERS, TAGS, TINT, fill
from usdfab.neural.lighting import light_pixels
from usdfab.neural.stage_scene import NeuralScene
from usdfab.tracer.render import pack_view
from usdfab.tracer.schedule import Window
from usdfab.tracer.world import View
from usdfab.usd.scene import Camera

BAND = 16
"""Rows of pixels that a thread takes at a time."""

_R2 = (0.7548776662466927, 0.5698402909980532)
"""Of the R2 sequence (Roberts 2018)."""


@dataclass(frozen=True, eq=False)
class NeuralRender:
    """Linear pixels (H, W, 3) of ``region`` of a picture of ``size``, with the camera's exposure; decoder answers."""

    pixels: NDArray[np.float32]
    region: Window
    size: tuple[int, int]
    spp: int
    seconds: float
    decodes: int


def render(
    scene: NeuralScene,
    camera: Camera,
    size: tuple[int, int],
    region: Window,
    spp: int = 1,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> NeuralRender:
    """What a camera sees; the same on any number of threads. A pinhole, and the shutter opens for no time."""
    began = time.perf_counter()
    view = pack_view(camera, *size, False)
    x0, y0, x1, y1 = region
    total = np.zeros((y1 - y0, x1 - x0, 3))
    bands = [(sample, row, min(row + BAND, y1)) for sample in range(spp) for row in range(y0, y1, BAND)]
    count = 0
    with ThreadPoolExecutor(threads) as pool:
        rows = pool.map(lambda band: shade_band(scene, view, spp, band[0], (x0, band[1], x1, band[2])), bands)
        for done, ((_, low, high), (found, asked)) in enumerate(zip(bands, rows, strict=True)):
            total[low - y0 : high - y0] += found
            count += asked
            if progress:
                progress(done + 1, len(bands))
    pixels = (2.0**camera.exposure / spp * total).astype(np.float32)
    return NeuralRender(pixels, region, size, spp, time.perf_counter() - began, count)


def places_of(sample: int, count: int) -> NDArray[np.float64]:
    """Numbers (count, 2) in [0, 1)^2 for sample ``sample``: the R2 sequence goes on from sample to sample."""
    index = sample * count + np.arange(count) + 1
    if count == 1 and sample == 0:
        return np.array([[0.5, 0.5]])
    return np.stack([(0.5 + index * r) % 1.0 for r in _R2], axis=1)


def shade_band(
    scene: NeuralScene, view: View, spp: int, sample: int, window: Window
) -> tuple[NDArray[np.float64], int]:
    """Radiance (h, w, 3) of a window for one sample of each pixel, and how many queries were asked."""
    x0, y0, x1, y1 = window
    count = (x1 - x0) * (y1 - y0)
    tags = np.zeros((count, TAGS), dtype=np.int32)
    numbers = np.zeros((count, NUMBERS))
    radiance = np.zeros((count, 3))
    jitter = (0.5, 0.5) if spp == 1 else tuple((sample + 1) * r % 1.0 for r in _R2)
    shrink = 1.0 / math.sqrt(spp)
    fill(
        scene.world, view, scene.mips, scene.repeats, jitter[0], jitter[1], shrink, x0, x1, y0, y1, tags, numbers,
        radiance,
    )  # fmt: skip
    group = np.empty(count, dtype=np.int32)
    queries = np.empty((count, 8), dtype=np.float32)
    weights = np.empty((count, 3))
    asked = 0
    for light in scene.lights:
        for u1, u2 in places_of(sample, light.places):
            light_pixels(
                scene.world, light.lights, u1, u2, 1.0 / light.places, tags, numbers, group, queries, weights, radiance
            )
            for number in np.unique(group[group >= 0]):
                those = np.flatnonzero(group == number)
                found = scene.plans[number].decode(queries[those])
                albedo = scene.albedo[number // 4, number % 2]
                # A print colours what goes through fibers, not what they mirror.
                tinted = scene.tinted[number // 4][:, None] * albedo
                value = numbers[those, TINT : TINT + 3] * (found @ tinted) + found @ (albedo - tinted)
                radiance[those] += weights[those] * value
                asked += len(those)
    return radiance.reshape(y1 - y0, x1 - x0, 3), asked
