"""New samples from old: a picture of cloth turned, cropped, recoloured and made uneven, with the fabric that it shows.

The renderer treats the colour channels alike, so a picture whose channels are drawn anew from the three it has is the
picture of a fabric whose fiber colours are drawn likewise (all light is white).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import CubicSpline

from usdfab.fabric import Color, FabricParameters, Weave, YarnParameters

Channels = tuple[int, int, int]


@dataclass(frozen=True)
class Turn:
    """First mirrored left to right, then turned counter-clockwise by quarters."""

    quarters: int = 0
    mirrored: bool = False

    def picture(self, pixels: NDArray) -> NDArray:
        """A picture (H, W, ...), row 0 at the top, after the turn."""
        return np.rot90(pixels[:, ::-1] if self.mirrored else pixels, self.quarters)

    def fabric(self, fabric: FabricParameters) -> FabricParameters:
        """The fabric that the turned picture shows."""
        if self.mirrored:
            weave = Weave(fabric.weave.matrix[:, ::-1], fabric.weave.name)
            fabric = replace(fabric, weave=weave, warp=_mirrored(fabric.warp), weft=_mirrored(fabric.weft))
        weave = fabric.weave.rotated(self.quarters % 4)
        if self.quarters % 2 == 0:
            return replace(fabric, weave=weave)
        size = (fabric.size[1], fabric.size[0])
        return replace(fabric, weave=weave, size=size, warp=fabric.weft, weft=fabric.warp)


TURNS = tuple(Turn(quarters, mirrored) for mirrored in (False, True) for quarters in range(4))
"""All eight."""


def cropped(
    pixels: NDArray, fabric: FabricParameters, share: float, place: tuple[float, float]
) -> tuple[NDArray, FabricParameters]:
    """A part of a picture (H, W, 3) of ``fabric`` whose sides are ``share`` of the whole's, and the fabric of its size.

    ``place``: from 0 (left, top) to 1 (right, bottom). The share is rounded to whole pixels.
    """
    height, width = pixels.shape[:2]
    rows, columns = (max(1, round(share * n)) for n in (height, width))
    top, left = round(place[1] * (height - rows)), round(place[0] * (width - columns))
    part = pixels[top : top + rows, left : left + columns]
    across, up = columns / width, rows / height
    return part, replace(
        fabric,
        size=(fabric.size[0] * across, fabric.size[1] * up),
        warp=replace(fabric.warp, count=fabric.warp.count * across),
        weft=replace(fabric.weft, count=fabric.weft.count * up),
    )


def recolored(pixels: NDArray, fabric: FabricParameters, channels: Channels) -> tuple[NDArray, FabricParameters]:
    """Picture and fabric with the colour channels ``channels`` of the old as red, green and blue."""

    def drawn(color: Color) -> Color:
        return color[channels[0]], color[channels[1]], color[channels[2]]

    def dyed(yarn: YarnParameters) -> YarnParameters:
        return replace(yarn, albedo=drawn(yarn.albedo), yarn_albedo=tuple(drawn(c) for c in yarn.yarn_albedo))

    return pixels[..., list(channels)], replace(fabric, warp=dyed(fabric.warp), weft=dyed(fabric.weft))


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
    """(H, W) normal noise over a sixth of the picture's side, of deviation about 1."""
    noise = ndimage.gaussian_filter(rng.standard_normal(shape), [n / 6.0 for n in shape], mode="reflect")
    return noise / max(float(noise.std()), 1e-12)


def _mirrored(yarn: YarnParameters) -> YarnParameters:
    return replace(yarn, twist=-yarn.twist, ply_twist=-yarn.ply_twist)
