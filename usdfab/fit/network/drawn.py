"""Cloth drawn by shaded height fields: no fibers, no light transport, but any number of lattices in no time.

The parts of the network that read lattices, counts and weave, learn from these beside the renders, so that they know
far more weaves, scales and colours than can be rendered. Nothing else is learned from them: they have no fibers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.sampling_wide import sample_class, sample_wide

Floats = NDArray[np.float64]

REVISION = 1
"""Raised whenever the same random numbers give another picture."""

MAX_ROTATION = math.radians(5.0)


@dataclass(frozen=True)
class _Look:
    """Of one yarn system: half widths and heights in spacings, fibers across it, their contrast, its colours."""

    width: float
    height: float
    crimp: float
    angle: float
    fibers: float
    contrast: float
    shine: float
    colors: Floats


def drawn_cloth(rng: np.random.Generator, size: int = 256) -> tuple[NDArray[np.float32], FabricParameters]:
    """A random fabric of the wide prior as a linear picture (size, size, 3), and the fabric."""
    fabric = sample_wide(sample_class(rng), rng)
    angle = float(np.clip(rng.normal(0.0, math.radians(2.5)), -MAX_ROTATION, MAX_ROTATION))
    steps = (np.arange(size) + 0.5) / size - 0.5
    x, y = steps[None, :], -steps[:, None]
    across = (math.cos(angle) * x + math.sin(angle) * y) * fabric.warp.count + rng.uniform(0.0, 1000.0)
    up = (-math.sin(angle) * x + math.cos(angle) * y) * fabric.weft.count + rng.uniform(0.0, 1000.0)
    light = _direction(rng)
    warp = _look(fabric.warp, fabric.cover("warp"), fabric.cell[1] / fabric.cell[0], rng)
    weft = _look(fabric.weft, fabric.cover("weft"), fabric.cell[0] / fabric.cell[1], rng)
    end, pick = np.floor(across).astype(int), np.floor(up).astype(int)
    u, v = across - end - 0.5, up - pick - 0.5
    matrix = fabric.weave.matrix.astype(bool)

    def weft_up(i: NDArray, j: NDArray) -> NDArray[np.bool_]:
        return matrix[i % matrix.shape[0], j % matrix.shape[1]]

    here = weft_up(pick, end)
    parts = []
    for look, offset, along, next_up, is_weft, number in (
        (warp, u, v, weft_up(pick + np.where(v > 0, 1, -1), end), False, end),
        (weft, v, u, weft_up(pick, end + np.where(u > 0, 1, -1)), True, pick),
    ):
        own, neighbour = (np.where(m == is_weft, 1.0, -1.0) for m in (here, next_up))
        parts.append(_yarn(look, offset, along, own, neighbour, number, is_weft, light, rng))
    (warp_height, warp_color), (weft_height, weft_color) = parts
    top = np.maximum(warp_height, weft_height)
    pixels = np.where((warp_height > weft_height)[..., None], warp_color, weft_color)
    shade = 1.0 - rng.uniform(0.2, 0.9) * np.clip(0.4 - top, 0.0, 1.0)
    pixels = np.where(np.isfinite(top)[..., None], pixels * np.maximum(shade, 0.05)[..., None], rng.uniform(0.0, 0.15))
    blur = rng.uniform(0.3, 1.2)
    return ndimage.gaussian_filter(pixels, (blur, blur, 0.0), mode="reflect").astype(np.float32), fabric


def _look(yarn: YarnParameters, cover: float, other: float, rng: np.random.Generator) -> _Look:
    return _Look(
        width=0.5 * min(cover, 1.0),
        height=float(rng.uniform(0.2, 0.5)),
        crimp=float(rng.uniform(0.1, 0.4)),
        # As on top of the yarn: across by 2 pi alpha times half the width, along by the other spacing.
        angle=math.atan(2.0 * math.pi * yarn.twist * 0.5 * min(cover, 1.0) / other),
        fibers=float(rng.uniform(6.0, 24.0)),
        contrast=float(rng.uniform(0.0, 0.4)),
        shine=float(rng.uniform(0.0, 1.0)),
        colors=np.array(yarn.colors()) ** 1.5,
    )


def _yarn(
    look: _Look, offset: Floats, along: Floats, own: Floats, neighbour: Floats, number: NDArray, is_weft: bool,
    light: Floats, rng: np.random.Generator,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Height (H, W), minus infinity beside the yarns, and colour (H, W, 3) of one system."""
    share = np.clip(offset / look.width, -1.0, 1.0)
    near = np.cos(0.5 * math.pi * np.abs(along)) ** 2
    centre = look.crimp * (near * own + (1.0 - near) * neighbour)
    slope = look.crimp * (own - neighbour) * 0.5 * math.pi * np.sin(math.pi * np.abs(along)) * np.sign(along)
    height = np.where(np.abs(offset) <= look.width, centre + look.height * np.sqrt(1.0 - share**2), -np.inf)
    # Normal and fiber direction, across and along the yarn and up; the slope falls where the normal leans.
    rise = np.sqrt(np.maximum(1.0 - 0.9 * share**2, 0.05))
    normal = np.stack([0.95 * share, slope, rise])
    normal /= np.linalg.norm(normal, axis=0)
    turned = light[[1, 0, 2]] if is_weft else light
    diffuse = np.maximum(np.tensordot(turned, normal, axes=1), 0.0)
    # Seen from above, Z twist rises to the right along the yarn whichever way the yarn runs.
    lean = look.angle if not is_weft else -look.angle
    tangent = np.stack([np.full_like(slope, math.sin(lean)), np.full_like(slope, math.cos(lean)), -slope])
    tangent /= np.linalg.norm(tangent, axis=0)
    half = turned + np.array([0.0, 0.0, 1.0])
    along_half = np.tensordot(half / np.linalg.norm(half), tangent, axes=1)
    shine = look.shine * np.sqrt(np.maximum(1.0 - along_half**2, 0.0)) ** rng.integers(4, 40)
    noise = ndimage.gaussian_filter(rng.standard_normal((128, 128)), 0.7, mode="wrap")
    strand = look.fibers * (offset - along * math.tan(lean)) + 7.3 * number
    sampled = ndimage.map_coordinates(noise, [strand % 128, (along + 3.1 * number) * 1.5 % 128], order=1, mode="wrap")
    bright = np.exp(look.contrast * sampled / noise.std())
    color = look.colors[number % len(look.colors)] * (0.15 + diffuse)[..., None] + 0.3 * shine[..., None]
    return height, color * bright[..., None]


def _direction(rng: np.random.Generator) -> Floats:
    """Where a lamp is: a unit vector, up to 50 degrees from straight above."""
    tilt, around = rng.uniform(0.0, math.radians(50.0)), rng.uniform(0.0, 2.0 * math.pi)
    return np.array([math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)])
