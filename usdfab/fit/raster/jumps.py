"""Which jumps lie between neighbouring pixels, and where: the geometry behind ``edges``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab.fit.raster.edges import Pairs, crossing
from usdfab.fit.raster.hits import Gatherer, Segments, meet, offset
from usdfab.fit.raster.visibility import NOTHING, Seen

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Rays:
    """The camera rays of a picture, row by row: ``start`` (N, 3) metres near the cloth, ``direction`` (N, 3)."""

    start: NDArray[np.float64]
    direction: Tensor


def jumps(gather: Gatherer, seen: Seen, pairs: Pairs) -> Bools:
    """(M,) where two pixels do not show the same piece of fiber, nor two that continue each other."""
    model = gather.model
    a, b = seen.segment[pairs.p].astype(np.int64), seen.segment[pairs.q].astype(np.int64)
    copy_a, copy_b = seen.copy[pairs.p], seen.copy[pairs.q]
    same_copy = (copy_a == copy_b).all(axis=1)
    same = (a == b) & same_copy | (a >= 0) & (b >= 0) & (model.curve[a] == model.curve[b]) & same_copy
    for one, other, of_one, of_other in ((a, b, copy_a, copy_b), (b, a, copy_b, copy_a)):
        next_copy = of_one + model.following_shift[one]
        same |= (one >= 0) & (model.following[one] == other) & (next_copy == of_other).all(axis=1)
    return ~same


@dataclass(frozen=True)
class _Look:
    """h and depth of the fibers that pixels ``of`` see, from the rays of pixels ``at``; no gradients."""

    h: Tensor
    depth: Tensor


def _look(gather: Gatherer, seen: Seen, rays: Rays, of: NDArray, at: NDArray) -> _Look:
    s = gather(seen, rays.start[at], of)
    direction = rays.direction[torch.from_numpy(at)]
    return _Look(offset(s, direction), _from_start(rays, at, meet(s, direction).distance, gather))


def _from_start(rays: Rays, at: NDArray, distance: Tensor, gather: Gatherer) -> Tensor:
    """Heights below the cloth's plane, which rays of different pixels have in common: -z, in units."""
    return -(distance * rays.direction[torch.from_numpy(at), 2])


def visible_edges(
    gather: Gatherer, seen: Seen, rays: Rays, pairs: Pairs, along_row: bool
) -> list[tuple[Pairs, Tensor]]:
    """Silhouettes and crossings between pixels, for ``edges.blended``.

    Parameters
    ----------
    pairs:
        All pairs along the rows or, if not ``along_row``, along the columns.
    """
    pairs = pairs[jumps(gather, seen, pairs)]
    nothing_p, nothing_q = seen.segment[pairs.p] == NOTHING, seen.segment[pairs.q] == NOTHING
    with torch.no_grad():
        # Fiber a is what p sees, b what q sees; where that is nothing, the other one stands in.
        of_a, of_b = np.where(nothing_p, pairs.q, pairs.p), np.where(nothing_q, pairs.p, pairs.q)
        a_p, a_q, a_r = (_look(gather, seen, rays, of_a, at) for at in (pairs.p, pairs.q, pairs.r))
        b_p, b_q, b_r = (_look(gather, seen, rays, of_b, at) for at in (pairs.p, pairs.q, pairs.r))
        a_covers_q, b_covers_p = (a_q.h.abs() < 1.0).numpy(), (b_p.h.abs() < 1.0).numpy()
        a_nearer = (a_p.depth <= b_q.depth).numpy()
        cross = a_covers_q & b_covers_p & ~nothing_p & ~nothing_q
        # Whose silhouette: of the one that misses the other's pixel, the nearer if both do.
        of_q = nothing_p | ~nothing_q & (a_covers_q & ~b_covers_p | ~a_covers_q & ~b_covers_p & ~a_nearer)
        row, column = _steepness(cross, of_q, a_p, a_q, a_r, b_p, b_q, b_r)
        keep = (row >= column if along_row else row > column).numpy()
        sign = torch.sign(torch.where(torch.from_numpy(of_q), b_p.h, a_q.h))
    result = []
    chosen = keep & ~cross
    if chosen.any():
        mine = pairs[chosen]
        owner = np.where(of_q[chosen], mine.q, mine.p)
        result.append((mine, _silhouette(gather, seen, rays, mine, owner, sign[torch.from_numpy(chosen)])))
    chosen = keep & cross
    if chosen.any():
        mine = pairs[chosen]
        gaps = []
        for at in (mine.p, mine.q):
            depth_a, depth_b = (_look(gather, seen, rays, of, at).depth for of in (mine.p, mine.q))
            gaps.append(depth_a - depth_b)
        result.append((mine, crossing(*gaps)))
    return result


def _steepness(cross: Bools, of_q: Bools, a_p: _Look, a_q: _Look, a_r: _Look, b_p: _Look, b_q: _Look, b_r: _Look):  # noqa: ANN202
    """How much the jump function changes towards q and towards r, (M,) each."""
    is_cross, is_b = torch.from_numpy(cross), torch.from_numpy(of_q)

    def change(a_to: _Look, b_to: _Look) -> Tensor:
        gap = (a_to.depth - b_to.depth) - (a_p.depth - b_p.depth)
        return torch.where(is_cross, gap, torch.where(is_b, b_to.h - b_p.h, a_to.h - a_p.h)).abs()

    return change(a_q, b_q), change(a_r, b_r)


def _silhouette(gather: Gatherer, seen: Seen, rays: Rays, pairs: Pairs, owner: NDArray, sign: Tensor) -> Tensor:
    """t at which the side ``sign`` of the fibers that pixels ``owner`` see passes between p and q."""
    at_p, at_q = (
        sign * offset(gather(seen, rays.start[at], owner), rays.direction[torch.from_numpy(at)]) - 1.0
        for at in (pairs.p, pairs.q)
    )
    return crossing(at_p, at_q)


def shadow_edges(
    gather: Gatherer,
    seen: Seen,
    shadow: Seen,
    rays: Rays,
    places: Tensor,
    lamp: NDArray[np.float64],
    pairs: Pairs,
    along_row: bool,
) -> list[tuple[Pairs, Tensor]]:
    """Rims of one lamp's shadows between pixels of the same fiber, for ``edges.blended``.

    Parameters
    ----------
    places: (N, 3)
        Where the camera rays meet fibers, relative to ``rays.start``, in units; any where they do not.
    lamp: (3,) metres
    """
    dark = shadow.segment != NOTHING
    on_fiber = seen.segment[pairs.p] != NOTHING
    pairs = pairs[(dark[pairs.p] != dark[pairs.q]) & on_fiber & ~jumps(gather, seen, pairs)]
    if not len(pairs.p):
        return []
    owner = np.where(dark[pairs.p], pairs.p, pairs.q)
    lit = np.where(dark[pairs.p], pairs.q, pairs.p)

    def cast(at: NDArray[np.int64]) -> Tensor:
        """h of the caster of the shadow, along the ray from what pixel ``at`` sees to the lamp."""
        s = gather(shadow, rays.start[at], owner)
        place = places[torch.from_numpy(at)]
        moved = Segments(s.start - place, s.end - place, s.start_tangent, s.end_tangent, s.radius)
        to_lamp = torch.from_numpy((lamp - rays.start[at]) / gather.scale).to(gather.dtype) - place
        return offset(moved, to_lamp / torch.linalg.norm(to_lamp, dim=-1, keepdim=True))

    with torch.no_grad():
        # At r another fiber may be seen: then nothing tells how the rim runs, and rows take it.
        same = ~jumps(gather, seen, Pairs(pairs.p, pairs.r, pairs.r)) & (seen.segment[pairs.r] != NOTHING)
        here = cast(pairs.p)
        row, column = (cast(pairs.q) - here).abs(), (cast(np.where(same, pairs.r, pairs.p)) - here).abs()
        keep = (row >= column if along_row else row > column).numpy() & (same | along_row)
        sign = torch.sign(cast(lit))[torch.from_numpy(keep)]
    pairs, owner, lit = pairs[keep], owner[keep], lit[keep]
    if not len(pairs.p):
        return []
    return [(pairs, crossing(sign * cast(pairs.p) - 1.0, sign * cast(pairs.q) - 1.0))]
