"""Which jumps lie between neighbouring pixels, and where: the geometry behind ``edges``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab.fit.raster.edges import Ints, Jumps, Pairs, crossing
from usdfab.fit.raster.hits import Gatherer, Segments, pass_by
from usdfab.fit.raster.visibility import NOTHING, Seen

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Rays:
    """The camera rays of a picture, row by row: ``start`` (N, 3) metres near the cloth, ``direction`` (N, 3)."""

    start: NDArray[np.float64]
    direction: Tensor


def jumps(gather: Gatherer, seen: Seen, p: Ints, q: Ints) -> Bools:
    """(M,) where pixels p and q (M,) do not show the same piece of fiber, nor two that continue each other."""
    model = gather.model
    a, b = seen.segment[p].astype(np.int64), seen.segment[q].astype(np.int64)
    copy_a, copy_b = seen.copy[p], seen.copy[q]
    same_copy = (copy_a == copy_b).all(axis=1)
    same = (a == b) & same_copy | (a >= 0) & (b >= 0) & (model.curve[a] == model.curve[b]) & same_copy
    for one, other, of_one, of_other in ((a, b, copy_a, copy_b), (b, a, copy_b, copy_a)):
        next_copy = of_one + model.following_shift[one]
        same |= (one >= 0) & (model.following[one] == other) & (next_copy == of_other).all(axis=1)
    return ~same


def visible_edges(gather: Gatherer, seen: Seen, rays: Rays, pairs: Pairs, along_row: bool) -> list[Jumps]:
    """Where between pixels one fiber gives way to another, for ``edges.blended``.

    Either the nearer fiber ends, at its silhouette |h| = 1, or two fibers run into each other. Both are one: a fiber
    with its axis at depth a shows in front of a surface at depth d where its half thickness there, sqrt(1 - h^2) radii,
    is more than (a - d) / radius. So the jump function of the fiber is sqrt(h^2 + max(a - d, 0)^2 / radius^2) - 1.

    Parameters
    ----------
    pairs:
        All pairs along the rows or, if not ``along_row``, along the columns.
    """
    pairs = pairs[jumps(gather, seen, pairs.p, pairs.q)]
    if not len(pairs.p):
        return []
    with torch.no_grad():
        ends, other = _ending(gather, seen, rays, pairs)
        at_p, at_q, at_r = (_showing(gather, seen, rays, ends, other, at) for at in (pairs.p, pairs.q, pairs.r))
        row, column = (at_q - at_p).abs(), (at_r - at_p).abs()
        keep = (row >= column if along_row else row > column).numpy()
    if not keep.any():
        return []
    pairs, ends, other = pairs[keep], ends[keep], other[keep]
    t = crossing(*(_showing(gather, seen, rays, ends, other, at) for at in (pairs.p, pairs.q)))
    smooth_p, smooth_q = (
        (near != far) & ~jumps(gather, seen, near, far)
        for near, far in ((pairs.p, pairs.before), (pairs.q, pairs.after))
    )
    return [Jumps(pairs, t, smooth_p, smooth_q)]


def _ending(gather: Gatherer, seen: Seen, rays: Rays, pairs: Pairs) -> tuple[Ints, Ints]:
    """The pixels of each pair that see the fiber which ends between them, and what it ends in front of.

    It is the fiber that is farther out at the other's pixel, and if both are beyond their sides there, the nearer.
    """
    nothing_p, nothing_q = seen.segment[pairs.p] == NOTHING, seen.segment[pairs.q] == NOTHING
    of_a, of_b = np.where(nothing_p, pairs.q, pairs.p), np.where(nothing_q, pairs.p, pairs.q)
    out_a, out_b = (
        _profile(gather, seen, rays, of, at)[0].abs().numpy() for of, at in ((of_a, pairs.q), (of_b, pairs.p))
    )
    depth_a, depth_b = (_depth(*_profile(gather, seen, rays, of, of)).numpy() for of in (of_a, of_b))
    a_ends = np.where((out_a > 1.0) & (out_b > 1.0), depth_a <= depth_b, out_a > out_b)
    a_ends = nothing_q | ~nothing_p & a_ends
    return np.where(a_ends, pairs.p, pairs.q), np.where(a_ends, pairs.q, pairs.p)


def _showing(gather: Gatherer, seen: Seen, rays: Rays, ends: Ints, other: Ints, at: Ints) -> Tensor:
    """The jump function of the fibers that pixels ``ends`` see before those that ``other`` see, at pixels ``at``."""
    h, axis, unit = _profile(gather, seen, rays, ends, at)
    solid = np.flatnonzero(seen.segment[other] != NOTHING)
    rows = torch.from_numpy(solid)
    behind = _depth(*_profile(gather, seen, rays, other[solid], at[solid]))
    sunk = torch.zeros_like(h).index_copy(0, rows, ((axis[rows] - behind) / unit[rows]).clamp_min(0.0))
    return torch.sqrt(h * h + sunk * sunk + 1e-12) - 1.0


def _profile(gather: Gatherer, seen: Seen, rays: Rays, of: Ints, at: Ints) -> tuple[Tensor, Tensor, Tensor]:
    """h of the fibers that pixels ``of`` see from the rays of pixels ``at``, the depth of their axes, their radii.

    Depths are below the cloth's plane, which the rays of all pixels have in common; radii as long as along the ray.
    """
    direction = rays.direction[torch.from_numpy(at)]
    s = gather.beside(seen, rays.start[at], direction, of)
    down = -direction[:, 2]
    h, middle, half = pass_by(s, direction)
    return h, middle * down, half * down


def _depth(h: Tensor, axis: Tensor, unit: Tensor) -> Tensor:
    """Of the surface; beyond the sides, of the sides."""
    return axis - unit * torch.sqrt((1.0 - h * h).clamp_min(1e-9))


def shadow_edges(
    gather: Gatherer,
    seen: Seen,
    shadow: Seen,
    rays: Rays,
    places: Tensor,
    lamp: NDArray[np.float64],
    pairs: Pairs,
    along_row: bool,
) -> list[Jumps]:
    """Rims of one lamp's shadows between pixels of the same fiber, for ``edges.blended``.

    Parameters
    ----------
    places: (N, 3)
        Where the camera rays meet fibers, relative to ``rays.start``, in units; any where they do not.
    lamp: (3,) metres
    """
    dark = shadow.segment != NOTHING
    on_fiber = seen.segment[pairs.p] != NOTHING
    pairs = pairs[(dark[pairs.p] != dark[pairs.q]) & on_fiber & ~jumps(gather, seen, pairs.p, pairs.q)]
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
        return pass_by(moved, to_lamp / torch.linalg.norm(to_lamp, dim=-1, keepdim=True))[0]

    with torch.no_grad():
        # At r another fiber may be seen: then nothing tells how the rim runs, and rows take it.
        same = ~jumps(gather, seen, pairs.p, pairs.r) & (seen.segment[pairs.r] != NOTHING)
        here = cast(pairs.p)
        row, column = (cast(pairs.q) - here).abs(), (cast(np.where(same, pairs.r, pairs.p)) - here).abs()
        keep = (row >= column if along_row else row > column).numpy() & (same | along_row)
        sign = torch.sign(cast(lit))[torch.from_numpy(keep)]
    pairs, owner, lit = pairs[keep], owner[keep], lit[keep]
    if not len(pairs.p):
        return []
    # Light and shadow are the same everywhere on their sides of the rim: nothing runs on.
    flat = np.zeros(len(pairs.p), dtype=bool)
    return [Jumps(pairs, crossing(sign * cast(pairs.p) - 1.0, sign * cast(pairs.q) - 1.0), flat, flat)]
