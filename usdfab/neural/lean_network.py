"""A network without spatial layers: a small convolutional encoder makes a pyramid of feature maps of the tile.

The decoder looks the pyramid up at the footprint's place and size, between texels and levels as with a mip map
(NeuMIP, Kuznetsov et al. 2021; paper B, section 6.5, names it as a way to a smaller decoder), and a narrow angular
network makes four numbers of what it finds. The encoder is convolutional with the tile's periodic borders: shifting
a cloth shifts its maps, and a weave that was not learned is made of crossings that were.

The code of a material is its pyramid: levels of 32, 16, ... 1 texels on a side, one after the other, rows along v.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from usdfab.neural.encoding import angles
from usdfab.neural.network import SLOPE, MaterialNetwork

FEATURES = 16
"""Of each texel."""

SIDES = (32, 16, 8, 4, 2, 1)
FIRST_TEXEL = (0, 1024, 1280, 1344, 1360, 1364)
TEXELS = 1365
ANGLES = 8
_IMAGES = 12
"""Of the encoder's input: normal, normal with the height scale, and the products of the orientation with itself, in
which a fiber has no sign and which may be averaged. Four pixels are taken together, and both parameters added."""

LEVEL_BIAS = 1.0
"""Levels finer than the one whose texels are as large as the footprint, so that neighbours overlap."""


def conv(inputs: int, outputs: int) -> nn.Conv2d:
    """3 x 3 on the torus that a tile is."""
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="circular")


class LeanNetwork(MaterialNetwork):
    """Codes are pyramids (M, TEXELS, FEATURES).

    Parameters
    ----------
    width:
        Of the decoder's hidden layers, a multiple of 4.
    channels:
        Of the encoder's maps.
    """

    architecture = "lean"

    def __init__(self, kind: str, width: int = 32, channels: int = 32) -> None:
        super().__init__(kind)
        self.width, self.channels = width, channels
        self.stem = conv(4 * _IMAGES + 2, channels)
        self.fine = nn.ModuleList(conv(channels, channels) for _ in range(2))
        self.down = nn.ModuleList(conv(channels, channels) for _ in SIDES[1:])
        self.up = nn.ModuleList(nn.Conv2d(channels, channels, 1) for _ in SIDES[1:])
        self.heads = nn.ModuleList(nn.Conv2d(channels, FEATURES, 1) for _ in SIDES)
        self.first = nn.Linear(FEATURES + ANGLES, width)
        self.second = nn.Linear(width, width)
        self.third = nn.Linear(width, width)
        self.last = nn.Linear(width, 4)

    def options(self) -> dict[str, Any]:
        """Widths."""
        return {"width": self.width, "channels": self.channels}

    def encode(self, tiles: Tensor, parameters: Tensor) -> Tensor:
        """Pyramids (M, TEXELS, FEATURES): down to one texel for context, up again for detail."""
        normal, fiber = tiles[:, :3], tiles[:, 3:]
        scaled = torch.cat([normal[:, :2] * parameters[:, 1, None, None, None], normal[:, 2:]], dim=1)
        scaled = scaled / scaled.norm(dim=1, keepdim=True).clamp(min=1e-6)
        products = fiber[:, [0, 1, 2, 0, 0, 1]] * fiber[:, [0, 1, 2, 1, 2, 2]]
        x = F.pixel_unshuffle(torch.cat([normal, scaled, products], dim=1), 2)
        plane = parameters[:, :, None, None].expand(-1, -1, *x.shape[2:])
        x = F.leaky_relu(self.stem(torch.cat([x, plane], dim=1)), SLOPE)
        for layer in self.fine:
            x = x + F.leaky_relu(layer(x), SLOPE)
        maps = [x]
        for layer in self.down:
            x = F.avg_pool2d(x, 2)
            x = x + F.leaky_relu(layer(x), SLOPE)
            maps.append(x)
        levels = [self.heads[-1](x)]
        for k in range(len(SIDES) - 2, -1, -1):
            x = maps[k] + F.leaky_relu(self.up[k](F.interpolate(x, scale_factor=2.0)), SLOPE)
            levels.append(self.heads[k](x))
        return torch.cat([level.flatten(2) for level in reversed(levels)], dim=2).transpose(1, 2)

    def decode(self, codes: Tensor, queries: Tensor) -> Tensor:
        """Outputs (M, Q, 4)."""
        x = torch.cat([lookup(codes, queries), angles(queries)], dim=-1)
        x = F.leaky_relu(self.first(x), SLOPE)
        x = F.leaky_relu(x + self.third(F.leaky_relu(self.second(x), SLOPE)), SLOPE)
        return self.last(x)


def level_of(size: Tensor) -> Tensor:
    """Level of detail (...,), 0 the finest, of footprints with sides (...,) in tiles."""
    level = torch.log2(size.clamp(min=1e-6) * SIDES[0]) - LEVEL_BIAS
    return level.clamp(0.0, len(SIDES) - 1.0)


def lookup(codes: Tensor, queries: Tensor) -> Tensor:
    """Features (M, Q, F) of pyramids (M, TEXELS, F) at footprints of queries (M, Q, 8).

    Linear between the texels' middles, around the tile's borders, and between levels.
    """
    materials, count = queries.shape[:2]
    with torch.no_grad():  # footprints are given: only the maps learn
        level = level_of(queries[..., 2])
        lower = level.floor().clamp(max=len(SIDES) - 2.0)
        between, number = level - lower, lower.long()
        fine, fine_weights = _corners(queries, number)
        coarse, coarse_weights = _corners(queries, number + 1)
        weights = torch.cat([fine_weights * (1.0 - between)[..., None], coarse_weights * between[..., None]], dim=-1)
        base = TEXELS * torch.arange(materials, device=codes.device)[:, None, None]
        texels = torch.cat([fine, coarse], dim=-1) + base
    found = F.embedding_bag(
        texels.flatten(0, 1), codes.flatten(0, 1), mode="sum", per_sample_weights=weights.flatten(0, 1)
    )
    return found.unflatten(0, (materials, count))


def _corners(queries: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
    """The four texels (M, Q, 4) about the footprints' places on levels (M, Q), and their bilinear weights."""
    sides = torch.tensor(SIDES, device=level.device)[level]
    first = torch.tensor(FIRST_TEXEL, device=level.device)[level]
    x, y = (queries[..., k] * sides - 0.5 for k in (0, 1))
    left, low = x.floor(), y.floor()
    fx, fy = x - left, y - low
    columns = [(left.long() + k) % sides for k in (0, 1)]
    rows = [first + (low.long() + k) % sides * sides for k in (0, 1)]
    texels = torch.stack([row + column for row in rows for column in columns], dim=-1)
    weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], dim=-1)
    return texels, weights
