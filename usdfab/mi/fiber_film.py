"""Between pixels and paths: rays of a picture's samples, and sums over them. Paths are in order of their pixels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def camera_rays(scene: Any, size: tuple[int, int], spp: int, seed: int) -> tuple[Any, tuple[Any, Any]]:
    """Rays through random places of all pixels, ``spp`` each, and the seeds of random numbers along their paths."""
    width, height = size
    index = dr.arange(mi.UInt32, width * height * spp)
    opaque = dr.opaque(mi.UInt32, seed)
    state, stream = mi.sample_tea_32(opaque, index)
    rng = mi.PCG32(1, state, stream)
    pixel = index // dr.opaque(mi.UInt32, spp)
    x, y = pixel % width, pixel // width
    film = mi.Point2f((x + rng.next_float32()) / width, (y + rng.next_float32()) / height)
    lens = mi.Point2f(rng.next_float32(), rng.next_float32())
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, film, lens)
    # Another stream of numbers: these were the first of that one.
    return ray, mi.sample_tea_32(state, stream)


def pixel_sums(radiance: Any, spp: int) -> Floats:
    """(pixels, 3) sums of colours over each pixel's paths."""
    dr.eval(radiance)  # in one kernel, where each sum would start its own
    channels = [dr.block_sum(channel, spp) for channel in radiance]
    dr.eval(channels)
    return np.stack([np.array(channel, dtype=np.float64) for channel in channels], axis=-1)


def pixel_values(values: Floats, spp: int) -> Any:
    """A Color3f for each path from (pixels, 3)."""
    pixel = dr.arange(mi.UInt32, len(values) * spp) // dr.opaque(mi.UInt32, spp)
    return dr.gather(mi.Color3f, mi.Float(values.ravel().astype(np.float32)), pixel)


def sums(leaves: list[Any], colors: Any) -> Floats:
    """Sums over all paths of arrays and of the Color3f in a Local: (leaves + 3 colors,)."""
    found = [*leaves]
    for row in range(len(colors)):
        found += list(colors[row])
    dr.eval(found)
    totals = [dr.sum(array) for array in found]
    dr.eval(totals)
    return np.array([total[0] for total in totals], dtype=np.float64)
