"""Uneven yarns for pictures of cloth that is too regular: real yarns lie and look a little different one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import CubicSpline

from usdfab.fabric import FabricParameters


@dataclass(frozen=True)
class Unevenness:
    """How far real cloth is from a render's perfect lattice, for warp (x) and weft (y).

    Parameters
    ----------
    shift:
        Standard deviation of each yarn's place, in spacings.
    gain:
        Of each yarn's brightness, as a logarithm.
    bend:
        Of a smooth displacement over many yarns, in spacings.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    gain: tuple[float, float] = (0.0, 0.0)
    bend: float = 0.0


def sample_unevenness(rng: np.random.Generator) -> Unevenness:
    """From even cloth to handspun."""
    strength = rng.uniform(0.0, 1.0)
    x, y, dark, bright, bend = (strength * rng.uniform(0.0, high) for high in (0.12, 0.12, 0.25, 0.25, 0.5))
    return Unevenness((float(x), float(y)), (float(dark), float(bright)), float(bend))


def uneven(pixels: NDArray, fabric: FabricParameters, how: Unevenness, rng: np.random.Generator) -> NDArray[np.float32]:
    """A picture (H, W, 3) of ``fabric`` with its yarns moved and their brightness changed at random.

    Yarns are taken to run along the picture's sides. The mean spacing stays.
    """
    height, width = pixels.shape[:2]
    x = np.arange(width) + _yarn_noise(width, fabric.warp.count, rng) * (how.shift[0] * width / fabric.warp.count)
    y = np.arange(height) + _yarn_noise(height, fabric.weft.count, rng) * (how.shift[1] * height / fabric.weft.count)
    rows, columns = np.meshgrid(y, x, indexing="ij")
    wide = how.bend * min(width / fabric.warp.count, height / fabric.weft.count)
    rows = rows + wide * _smooth_noise(pixels.shape[:2], rng)
    columns = columns + wide * _smooth_noise(pixels.shape[:2], rng)
    moved = [ndimage.map_coordinates(pixels[..., c], [rows, columns], order=1, mode="reflect") for c in range(3)]
    along = how.gain[0] * _yarn_noise(width, fabric.warp.count, rng)
    up = how.gain[1] * _yarn_noise(height, fabric.weft.count, rng)
    return (np.stack(moved, axis=-1) * np.exp(along + up[:, None])[..., None]).astype(np.float32)


def _yarn_noise(size: int, count: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(size,) normal noise of deviation 1 that changes from yarn to yarn, ``count`` yarns long."""
    nodes = rng.standard_normal(int(count) + 4)
    return CubicSpline(np.arange(len(nodes)), nodes)(1.0 + (np.arange(size) + 0.5) / size * count)


def _smooth_noise(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float64]:
    """(H, W) normal noise over a sixth of the picture's side, of deviation about 1 and without slope."""
    noise = ndimage.gaussian_filter(rng.standard_normal(shape), [n / 6.0 for n in shape], mode="reflect")
    noise /= max(float(noise.std()), 1e-12)
    # A slope is another count and another angle: where few yarns are seen a wrong label.
    for k, n in enumerate(shape):
        ramp = np.expand_dims(np.arange(n) - 0.5 * (n - 1), 1 - k)
        noise -= ramp * ((noise * ramp).mean() / np.square(ramp).mean())
    return noise
