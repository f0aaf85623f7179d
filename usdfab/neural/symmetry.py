"""The eight ways to turn and mirror a cloth, which change no physics: more materials from those that there are.

A mirrored or turned cloth is another one (S twist becomes Z, warp becomes weft), whose tile, queries and components
follow exactly from the first one's. A tile also starts anywhere in its repeat.
"""

from __future__ import annotations

import torch
from torch import Tensor

SYMMETRIES = 8


def transformed_tile(tile: Tensor, number: int, shift: tuple[int, int] = (0, 0)) -> Tensor:
    """Tiles (..., 6, P, P), rows along v, columns along u, of the cloth that is mirrored, turned and shifted.

    ``number``: bit 0 mirrors u, bit 1 mirrors v, bit 2 then swaps both; ``shift``: pixels along u and v at the end.
    """
    sign = torch.ones(6, dtype=tile.dtype, device=tile.device)
    if number & 1:
        tile, sign = tile.flip(-1), sign * sign.new_tensor([-1, 1, 1, -1, 1, 1])
    if number & 2:
        tile, sign = tile.flip(-2), sign * sign.new_tensor([1, -1, 1, 1, -1, 1])
    tile = tile * sign[:, None, None]
    if number & 4:
        tile = tile.transpose(-1, -2)[..., [1, 0, 2, 4, 3, 5], :, :]
    normal, fiber = tile.split(3, dim=-3)
    # A fiber has no direction of its own: as ``surface_tile`` has it, wefts point to the right and warps upwards.
    along = torch.where(fiber[..., 0, :, :].abs() > fiber[..., 1, :, :].abs(), fiber[..., 0, :, :], fiber[..., 1, :, :])
    tile = torch.cat([normal, torch.where(along[..., None, :, :] < 0.0, -fiber, fiber)], dim=-3)
    return tile.roll((shift[1], shift[0]), (-2, -1))


def transformed_queries(queries: Tensor, number: int, shift: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """Queries (..., 8) of the transformed cloth that ask what ``queries`` asks of the first; ``shift`` in tiles."""
    u, v, size, ix, iy, iz, ox, oy = queries.unbind(dim=-1)
    if number & 1:
        u, ix, ox = 1.0 - u, -ix, -ox
    if number & 2:
        v, iy, oy = 1.0 - v, -iy, -oy
    if number & 4:
        u, v, ix, iy, ox, oy = v, u, iy, ix, oy, ox
    return torch.stack([(u + shift[0]) % 1.0, (v + shift[1]) % 1.0, size, ix, iy, iz, ox, oy], dim=-1)


def transformed_components(components: Tensor, number: int) -> Tensor:
    """(C_warp, C_weft, S_warp, S_weft) (..., 4) of the transformed cloth: warp and weft change places with the axes."""
    return components[..., [1, 0, 3, 2]] if number & 4 else components
