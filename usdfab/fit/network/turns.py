"""New samples from old: a picture of cloth turned, cropped and recoloured, with the fabric that it then shows.

The renderer treats the colour channels alike, so a picture whose channels are drawn anew from the three it has is the
picture of a fabric whose fiber colours are drawn likewise (all light is white).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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


def _mirrored(yarn: YarnParameters) -> YarnParameters:
    return replace(yarn, twist=-yarn.twist, ply_twist=-yarn.ply_twist)
