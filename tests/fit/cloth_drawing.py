"""Woven cloth drawn by shaded cylinders: ground truth for the analysis, nothing of the product's code in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cloth:
    """What to draw. Angles in radians; ``matrix`` row 0 at the bottom, 1 = weft on top.

    ``rotation`` turns the cloth counter-clockwise as seen; ``twist`` is the fiber angle of warp and weft, positive Z.
    """

    matrix: NDArray[np.uint8]
    warp_count: float = 12.0
    weft_count: float = 12.0
    warp_colours: tuple[tuple[float, float, float], ...] = ((0.6, 0.55, 0.5),)
    weft_colours: tuple[tuple[float, float, float], ...] = ((0.6, 0.55, 0.5),)
    width: float = 0.9
    rotation: float = 0.0
    twist: tuple[float, float] = (0.35, 0.35)
    phase: tuple[float, float] = (0.3, 0.4)
    noise: float = 0.01
    wobble: float = 0.06
    seed: int = 0
    size: int = 480


def draw(cloth: Cloth) -> Array:
    """Linear RGB (size, size, 3) in [0, 1], row 0 at the top."""
    rng = np.random.default_rng(cloth.seed)
    n = cloth.size
    py, px = np.mgrid[0:n, 0:n]
    x, y = (px + 0.5) / n - 0.5, 0.5 - (py + 0.5) / n
    c, s = np.cos(cloth.rotation), np.sin(cloth.rotation)
    xr, yr = c * x + s * y, -s * x + c * y
    u = xr * cloth.warp_count + 50 + cloth.phase[0]
    v = yr * cloth.weft_count + 50 + cloth.phase[1]
    u = u + cloth.wobble * _smooth(rng, n)
    v = v + cloth.wobble * _smooth(rng, n)
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    rows, cols = cloth.matrix.shape
    uf, vf = u - j - 0.5, v - i - 0.5
    layers = []
    for weft in (True, False):
        across, along = (vf, uf) if weft else (uf, vf)
        yarn = i if weft else j
        colours = np.array(cloth.weft_colours if weft else cloth.warp_colours)
        on_top = cloth.matrix[i % rows, j % cols] == (1 if weft else 0)
        # Height along the yarn: up on its own crossings, falling towards a neighbour where it is down.
        step_i, step_j = (0, np.where(along > 0, 1, -1)) if weft else (np.where(along > 0, 1, -1), 0)
        next_top = cloth.matrix[(i + step_i) % rows, (j + step_j) % cols] == (1 if weft else 0)
        here, there = np.where(on_top, 1.0, -1.0), np.where(next_top, 1.0, -1.0)
        t = np.clip(np.abs(along) * 2, 0, 1) ** 2
        height = here * (1 - t) + (here + there) / 2 * t
        r = np.clip(2 * across / cloth.width, -1, 1)
        inside = np.abs(2 * across / cloth.width) < 1
        bulge = np.sqrt(1 - r**2)
        angle = cloth.twist[1 if weft else 0]
        # Fibers: stripes whose lines run at the twist angle to the yarn axis; Z = clockwise from the axis.
        size = n / (cloth.weft_count if weft else cloth.warp_count)
        a, b = (yr, xr) if weft else (xr, yr)
        sign = 1.0 if weft else -1.0
        phase = 2 * np.pi * n / max(4.0, size / 6) * (a * np.cos(angle) + sign * b * np.sin(angle))
        stripes = 1 + 0.18 * np.sin(phase + 2 * np.sin(7 * yarn))
        colour = colours[yarn % len(colours)]
        shade = (0.35 + 0.65 * bulge) * (0.75 + 0.25 * height) * stripes
        layers.append((np.where(inside, height + 0.3 * bulge, -9.0), colour * shade[..., None]))
    (hw, cw), (ha, ca) = layers
    image = np.where((hw > ha)[..., None], cw, ca)
    image[(hw < -5) & (ha < -5)] = 0.01
    image = image * (1 + 0.1 * x[..., None])
    return np.clip(image + cloth.noise * rng.standard_normal((n, n, 1)), 0, 1)


def _smooth(rng: np.random.Generator, n: int) -> Array:
    """A slow random field of deviation about 1, zero mean, so that counts stay exact on average."""
    y, x = np.mgrid[0:n, 0:n] / n * 2 * np.pi
    total = np.zeros((n, n))
    for a in range(4):
        for b in range(4):
            if a or b:
                total += rng.standard_normal() * np.cos(a * x + b * y + rng.uniform(0, 2 * np.pi))
    return total / total.std()
