"""What a network is told of a query: the footprint as one-blobs or as a level of detail, and the directions.

A query is a row of eight numbers: footprint u, v in [0, 1)^2 and its side, all in tiles; incoming direction x, y, z in
the cloth's frame (z > 0 reflection, z < 0 transmission); outgoing direction x, y (its z is positive).
"""

from __future__ import annotations

import torch
from torch import Tensor

QUERY_COLUMNS = 8
BLOBS = 8
"""Kernels for each of u, v and size: 24 in all (paper B, section 4.2)."""

LARGEST = 5.0
"""Sides in tiles beyond which a footprint looks like this one: the end of paper B's Table 2."""


def size_coordinate(size: Tensor) -> Tensor:
    """Sides (...,) in tiles to [0, 1]: a square root, so that small footprints, which show most, are told apart best.

    Paper B does not say how it brings sizes to the encoding's range.
    """
    return (size.clamp(0.0, LARGEST) / LARGEST).sqrt()


def one_blob(x: Tensor, bins: int = BLOBS, *, periodic: bool) -> Tensor:
    """Numbers (...,) in [0, 1] as (..., bins): a Gaussian about each, at the bins' middles.

    Müller et al. 2021, section 3.3 (one-blob, after Müller et al. 2019): deviation 1 / bins. ``periodic``: 0 and 1 are
    the same place, as the two sides of a tile are.
    """
    middles = (torch.arange(bins, dtype=x.dtype, device=x.device) + 0.5) / bins
    away = x[..., None] - middles
    if periodic:
        away = away - away.round()
    return torch.exp(-0.5 * (away * bins).square())


def encoded_footprint(queries: Tensor) -> Tensor:
    """Footprints of queries (..., 8) as (..., 24): one-blobs of u, v and size."""
    u, v = (one_blob(queries[..., k], periodic=True) for k in (0, 1))
    return torch.cat([u, v, one_blob(size_coordinate(queries[..., 2]), periodic=False)], dim=-1)


def angles(queries: Tensor) -> Tensor:
    """(..., 8) from queries (..., 8): incoming x, y, z, outgoing x, y, and the unit half vector.

    The flake distribution (MODEL 13, D) is a function of the half vector, which a small network had better not learn.
    """
    incoming, xy = queries[..., 3:6], queries[..., 6:8]
    z = (1.0 - xy.square().sum(dim=-1, keepdim=True)).clamp(min=0.0).sqrt()
    half = incoming + torch.cat([xy, z], dim=-1)
    # Opposite directions, light straight through, have none.
    half = half / half.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.cat([incoming, xy, half], dim=-1)
