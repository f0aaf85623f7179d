"""Rendering with the neural material: one ray a pixel, a query for each light, one answer of a small network.

Chen et al. 2024, section 4.3. Direct light only, as there: no light between surfaces, and light does not pass through
gaps. A picture has no noise at one sample; more samples smooth edges, add places on lights, and share the footprint.

A ``Buffer`` keeps what pixels see, so that pictures with other lights or other materials need no more camera rays.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.neural.gbuffer import NUMBERS, TAGS
from usdfab.neural.lighting import QUERY, add_answers, sort_pixels
from usdfab.neural.stage_scene import NeuralScene
from usdfab.neural.strips import answer_strip, light_strip, pixels_of, put_strip, see_strip
from usdfab.tracer.render import pack_view
from usdfab.tracer.schedule import Window
from usdfab.tracer.world import View
from usdfab.usd.scene import Camera

STRIP = 8
"""Rows of pixels that a thread takes at a time: their buffers stay in a core's own cache."""

_R2 = (0.7548776662466927, 0.5698402909980532)
"""Of the R2 sequence (Roberts 2018)."""

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class NeuralRender:
    """Linear pixels (H, W, 3) of ``region`` of a picture of ``size``, with the camera's exposure; decoder answers."""

    pixels: Floats
    region: Window
    size: tuple[int, int]
    spp: int
    seconds: float
    decodes: int


@dataclass(eq=False)
class Buffer:
    """What the pixels of a picture see, by strip: tags, numbers, and radiance of lights and glowing surfaces.

    Good for one camera, size, region and geometry, one sample a pixel.
    """

    strips: dict[Window, tuple[NDArray[np.int32], Floats, Floats]] = field(default_factory=dict)


def render(
    scene: NeuralScene,
    camera: Camera,
    size: tuple[int, int],
    region: Window,
    spp: int = 1,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    buffer: Buffer | None = None,
) -> NeuralRender:
    """What a camera sees; the same on any number of threads. A pinhole, and the shutter opens for no time.

    Parameters
    ----------
    buffer:
        What pixels see is kept there, or taken from there if it is known; with one sample only.
    """
    began = time.perf_counter()
    view = pack_view(camera, *size, False)
    x0, y0, x1, y1 = region
    picture = np.zeros((y1 - y0, x1 - x0, 3), dtype=np.float32)
    strips = [(x0, row, x1, min(row + STRIP, y1)) for row in range(y0, y1, STRIP)]
    gain = 2.0**camera.exposure / spp
    kept = buffer if spp == 1 else None

    def shade(window: Window) -> int:
        asked = 0
        for sample in range(spp):
            radiance, count = shade_strip(scene, view, spp, sample, window, kept)
            put_strip(radiance, window[0], window[2], window[1], window[3], gain, picture, x0, y0)
            asked += count
        return asked

    count = 0
    with ThreadPoolExecutor(threads) as pool:
        for done, asked in enumerate(pool.map(shade, strips)):
            count += asked
            if progress:
                progress(done + 1, len(strips))
    return NeuralRender(picture, region, size, spp, time.perf_counter() - began, count)


def places_of(sample: int, count: int) -> NDArray[np.float64]:
    """Numbers (count, 2) in [0, 1)^2 for sample ``sample``: the R2 sequence goes on from sample to sample."""
    index = sample * count + np.arange(count) + 1
    if count == 1 and sample == 0:
        return np.array([[0.5, 0.5]])
    return np.stack([(0.5 + index * r) % 1.0 for r in _R2], axis=1)


def shade_strip(
    scene: NeuralScene, view: View, spp: int, sample: int, window: Window, kept: Buffer | None = None
) -> tuple[Floats, int]:
    """Radiance (3 P,) of a window for one sample of each pixel, in tiles, and how many queries were asked."""
    count = pixels_of(window)
    tags, numbers, seen = see(scene, view, spp, sample, window, kept)
    radiance = seen.copy() if kept else seen
    group = np.empty(count, dtype=np.int32)
    queries, weights = np.empty(QUERY * count, dtype=np.float32), np.empty(3 * count, dtype=np.float32)
    order, answers = np.empty(count, dtype=np.int32), np.empty((count, 4), dtype=np.float32)
    starts = np.zeros(4 * len(scene.albedo) + 1, dtype=np.int32)
    asked = 0
    for light, u1, u2 in _places(scene, sample):
        light_strip(
            scene.world, scene.cloth, light.lights, u1, u2, 1.0 / light.places, tags, numbers, group, queries, weights,
            radiance,
        )  # fmt: skip
        if scene.decoders is not None:
            asked += answer_strip(
                scene.decoders, scene.albedo, scene.tinted, count, numbers, group, queries, weights, starts, order,
                answers, radiance,
            )  # fmt: skip
        else:
            sort_pixels(group, starts, order)
            for number in np.flatnonzero(np.diff(starts)):
                first, last = starts[number], starts[number + 1]
                those = queries.reshape(QUERY, count)[:, order[first:last]].T
                answers[first:last] = scene.plans[number].decode(those)
                albedo = scene.albedo[number // 4, number % 2]
                tinted = scene.tinted[number // 4]
                add_answers(order, first, last, answers, albedo, tinted, weights, numbers, count, radiance)
            asked += int(starts[-1])
    return radiance, asked


def see(
    scene: NeuralScene, view: View, spp: int, sample: int, window: Window, kept: Buffer | None = None
) -> tuple[NDArray[np.int32], Floats, Floats]:
    """Tags, numbers and radiance of a window's pixels (``gbuffer.fill``), from the buffer if they are known."""
    if kept is not None and window in kept.strips:
        return kept.strips[window]
    count = pixels_of(window)
    tags = np.zeros(TAGS * count, dtype=np.int32)
    numbers, radiance = np.zeros(NUMBERS * count, dtype=np.float32), np.zeros(3 * count, dtype=np.float32)
    jitter = (0.5, 0.5) if spp == 1 else ((sample + 1) * _R2[0] % 1.0, (sample + 1) * _R2[1] % 1.0)
    x0, y0, x1, y1 = window
    see_strip(scene.world, scene.cloth, view, jitter, 1.0 / math.sqrt(spp), x0, x1, y0, y1, tags, numbers, radiance)
    if kept is not None:
        kept.strips[window] = (tags, numbers, radiance)
    return tags, numbers, radiance


def _places(scene: NeuralScene, sample: int) -> Iterator[tuple[Any, float, float]]:
    """Each light with each place on it that this sample looks at."""
    for light in scene.lights:
        for u1, u2 in places_of(sample, light.places):
            yield light, float(u1), float(u2)
