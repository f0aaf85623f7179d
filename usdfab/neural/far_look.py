"""Colours with which the neural cloth is as bright as the fibers are, and which pixels may show it instead of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import scipy  # its parts are loaded when they are first used
from numpy.typing import NDArray

from usdfab.neural.gbuffer import CLOTH, FABRIC, KIND, NUMBERS, SIDE, SIZE, TAGS
from usdfab.neural.render import STRIP, render, see
from usdfab.neural.simd import LANES
from usdfab.neural.stage_scene import NeuralScene
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.render import pack_view
from usdfab.tracer.schedule import Window
from usdfab.usd.scene import Camera, Scene

Floats = NDArray[np.float64]

PIXELS, SAMPLES = 6144, 32
"""Of the small traced picture by which colours are matched: a fabric's mean is then good to about 1 %. Smaller ones
have more samples."""

NEAR, FAR = 0.5, 1.0
"""Yarns per pixel up to which pixels show fibers alone, and from which on the neural cloth alone."""

TRUST = 0.03
"""How much a pixel of the traced picture is trusted less than the first guess of a component's albedo, per pixel."""


def matched_scene(
    ready: NeuralScene, scene: Scene, camera: Camera, size: tuple[int, int], tracer: Tracer, *, seed: int = 0,
    threads: int = 1,
) -> NeuralScene:  # fmt: skip
    """The scene with its fabrics' albedos matched to their fibers, as a camera sees them in their place and light.

    A small picture is traced, light between surfaces and through cloth included, and the albedos of all components are
    fitted to it by least squares, none below 0, with the mean of each fabric kept; what is hardly seen keeps its first
    guess. Good for this view, and for others of the same cloth in the same light.
    """
    scale = min(math.sqrt(PIXELS / (size[0] * size[1])), 1.0)
    small = (max(round(size[0] * scale), 1), max(round(size[1] * scale), 1))
    window = (0, 0, *small)
    spp = SAMPLES * max(PIXELS // (small[0] * small[1]), 1)
    settings = RenderSettings(small, spp=spp, seed=seed, threads=threads)
    traced = tracer.render(camera, settings).pixels.astype(float)
    kind, fabric, _ = _seen(ready, camera, small, window)
    inner = _surrounded(kind == CLOTH)
    parts = np.zeros((2, 4, *traced.shape))
    for side in range(2):
        for k in range(4):
            only = np.zeros_like(ready.albedo)
            only[:, side, k] = 1.0
            parts[side, k] = render(replace(ready, albedo=only), camera, small, window, 4, threads).pixels
    parts -= render(replace(ready, albedo=np.zeros_like(ready.albedo)), camera, small, window, 4, threads).pixels
    albedo = ready.albedo.copy()
    for number in range(len(scene.fabrics)):
        those = inner & (fabric == number)
        if those.any():
            for c in range(3):
                first = ready.albedo[number, :, :, c].ravel().astype(float)
                found = fitted_albedo(parts[:, :, those, c].reshape(8, -1).T, traced[those, c], first)
                albedo[number, :, :, c] = found.reshape(2, 4)
    return replace(ready, albedo=albedo)


def fitted_albedo(parts: Floats, seen: Floats, first: Floats) -> Floats:
    """Numbers (K,) >= 0 near ``first`` with parts (N, K) times them near ``seen`` (N,), and the mean the same."""
    lengths = np.linalg.norm(parts, axis=0)
    pull = np.diag(math.sqrt(TRUST) * np.maximum(lengths, 1e-9 * max(lengths.max(), 1e-30)))
    mean = 10.0 * math.sqrt(len(parts)) * parts.mean(axis=0)
    matrix = np.concatenate([parts, pull, mean[None]])
    target = np.concatenate([seen, pull @ first, [10.0 * math.sqrt(len(parts)) * seen.mean()]])
    return scipy.optimize.nnls(matrix, target)[0]


def far_share(ready: NeuralScene, scene: Scene, camera: Camera, size: tuple[int, int], region: Window) -> Floats:
    """How much each pixel (H, W) of a region may show the neural cloth, from 0 to 1, the rest being fibers.

    By the side of its footprint in yarns: none up to ``NEAR``, all from ``FAR`` on, smooth over the logarithm between.
    Pixels that do not see cloth in their middle have none, nor do their neighbours: edges are the tracer's.
    """
    yarns = ready.crossings.max(axis=1) if len(ready.crossings) else np.ones(1)
    kind, fabric, side = _seen(ready, camera, size, region)
    level = np.log(np.maximum(side * yarns[fabric], 1e-9) / NEAR) / math.log(FAR / NEAR)
    t = np.clip(level, 0.0, 1.0)
    return np.where(_surrounded(kind == CLOTH), t * t * (3.0 - 2.0 * t), 0.0)


def _seen(
    ready: NeuralScene, camera: Camera, size: tuple[int, int], region: Window
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Kind, fabric and footprint's side in repeats of a region's pixels, (H, W) each; fabric 0 where there is none."""
    view = pack_view(camera, *size, False)
    x0, y0, x1, y1 = region
    found: list[list[NDArray]] = [[], [], []]
    for row in range(y0, y1, STRIP):
        window = (x0, row, x1, min(row + STRIP, y1))
        tags, numbers, _ = see(ready, view, 1, 0, window)
        columns = (*tags.reshape(TAGS, -1)[[KIND, FABRIC]], numbers.reshape(NUMBERS, -1)[SIZE])
        for rows, column in zip(found, columns, strict=True):
            rows.append(_rows(column, window))
    kind, fabric, side = (np.concatenate(rows) for rows in found)
    return kind, np.where(kind == CLOTH, fabric, 0), side


def _surrounded(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels that are set and whose eight neighbours are."""
    around, (height, width) = np.pad(mask, 1, mode="edge"), mask.shape
    return np.all([around[r : r + height, c : c + width] for r in range(3) for c in range(3)], axis=0)


def _rows(values: NDArray, window: Window) -> NDArray:
    """Values of pixels in tiles as rows of a window (h, w)."""
    x0, y0, x1, y1 = window
    down, across = -(-(y1 - y0) // SIDE), -(-(x1 - x0) // SIDE)
    tiles = values.reshape(down, across, SIDE, LANES // SIDE)
    return tiles.transpose(0, 2, 1, 3).reshape(SIDE * down, SIDE * across)[: y1 - y0, : x1 - x0]
