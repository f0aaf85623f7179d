"""Rims of shadows where a fiber ends between two pixels, so that no second pixel shows it: beside ``shadows``.

Between two pixels of one fiber, the rim of a shadow lies where the two differ. At a fiber's side, only one pixel shows
the fiber, and it may end before the rim or after. So what the fiber looks like at its end, or at the pixel's border if
that comes first, is asked for with shadow rays of its own, and a rim on the way there lights a part of the pixel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from usdfab.fit.raster.curves import Polylines, as_numpy
from usdfab.fit.raster.edges import Ints, Jumps, Pairs, inside
from usdfab.fit.raster.hits import sides
from usdfab.fit.raster.jumps import Ends, ends_between
from usdfab.fit.raster.segments import Floats, Geometry
from usdfab.fit.raster.shadows import shadow_edges
from usdfab.fit.raster.visibility import NOTHING, PatchIndex, Seen, shadows_at, taken

LEAST_REACH = 1e-3
"""Of a pixel: less of a fiber is not looked at."""


def rims_at_ends(
    geometry: Geometry,
    lines: Polylines,
    index: PatchIndex,
    distance: Tensor,
    seen: Seen,
    shadows: list[Seen],
    lamps: Floats,
    pairs: Pairs,
    along_row: bool,
) -> list[list[tuple[Tensor, Tensor]]]:
    """What rims of shadows at the ends of fibers add to the light of each lamp.

    Parameters
    ----------
    distance: (N,)
        Of what the camera's rays meet.
    seen, shadows, lamps:
        As of ``visibility.look``.
    pairs:
        All pairs along the rows or, if not ``along_row``, along the columns.

    Returns
    -------
    For each lamp some (pixels (M,), light (M,)), 1 being all of it.
    """
    chosen, end, begin = ends_between(geometry, lines, seen, pairs)
    pairs = pairs[chosen]
    found: list[list[tuple[Tensor, Tensor]]] = [[] for _ in lamps]
    for own, other, reach in ((pairs.p, pairs.q, end), (pairs.q, pairs.p, 1.0 - begin)):
        reach = reach.clamp(max=0.5)
        rows = np.flatnonzero((seen.segment[own] != NOTHING) & (as_numpy(reach) > LEAST_REACH))
        at, reach = own[rows], reach[torch.from_numpy(rows)]
        fiber, cover = taken(seen, at), taken(seen, other[rows])
        there = _between(geometry, at, other[rows], as_numpy(reach))
        aside = replace(geometry, start=geometry.start[pairs.r[rows]], direction=geometry.direction[pairs.r[rows]])
        here = replace(geometry, start=geometry.start[at], direction=geometry.direction[at])
        far = sides(there, lines, fiber)
        distances = torch.cat([distance[torch.from_numpy(at)], far, sides(aside, lines, fiber)])
        for k, cast in enumerate(shadows_at(index, places_of(there, far), fiber, cover, lamps)):
            near = taken(shadows[k], at)
            for rims in _rims([here, there, aside], lines, distances, fiber, [near, cast], lamps[k], along_row,
                              as_numpy(reach)):  # fmt: skip
                which = torch.from_numpy(rims.pairs.p)
                found[k].append((torch.from_numpy(at)[which], reach[which] * (1.0 - rims.t) * rims.step[:, 0]))
    return found


def light_beyond(
    geometry: Geometry, lines: Polylines, index: PatchIndex, ends: Ends, seen: Seen, lamps: Floats, along_row: bool
) -> Tensor:
    """(M, lamps): how much of each lamp shines on what is beyond jumps, from the jump to the pixel's border.

    Rims that run across the pixels' line are left out: they are where the next pixel has them.
    """
    t, pairs = as_numpy(ends.t), ends.pairs
    cover = taken(seen, inside(pairs, ends.t))
    jump, border = (_between(geometry, pairs.p, pairs.q, part) for part in (t, np.full(len(t), 0.5)))
    aside = replace(jump, start=jump.start + geometry.start[pairs.r] - geometry.start[pairs.p])
    near, far, beside = (sides(rays, lines, ends.beyond) for rays in (jump, border, aside))
    width = (ends.t - 0.5).abs().clamp(min=LEAST_REACH)
    first, second = (
        shadows_at(index, places_of(rays, d), ends.beyond, cover, lamps) for rays, d in ((jump, near), (border, far))
    )
    columns = []
    for k, lamp in enumerate(lamps):
        shines = torch.from_numpy((first[k].segment == NOTHING).astype(np.float64))
        for rims in _rims(
            [jump, border, aside], lines, torch.cat([near, far, beside]), ends.beyond, [first[k], second[k]], lamp,
            along_row, as_numpy(width),
        ):  # fmt: skip
            which = torch.from_numpy(rims.pairs.p)
            wide = width[which]
            # The rim stays where it is while the jump moves.
            behind = wide.detach() * (1.0 - rims.t)
            shines = shines.index_add(0, which, behind / wide * rims.step[:, 0])
        columns.append(shines)
    return torch.stack(columns, dim=1)


def _rims(
    rays: list[Geometry], lines: Polylines, distances: Tensor, fiber: Seen, casters: list[Seen], lamp: Floats,
    along_row: bool, reach: Floats,
) -> list[Jumps]:  # fmt: skip
    """Rims on fibers (M,) between the first and the second of three sets of rays, the third running aside."""
    count = len(fiber.segment)
    number = np.arange(count)
    nothing = Seen(np.full(count, NOTHING, dtype=np.int32), np.zeros((count, 2), dtype=np.int32))
    cast = _joined([*casters, nothing])
    shines = torch.from_numpy((cast.segment == NOTHING).astype(np.float64))[:, None]
    found = shadow_edges(
        replace(
            rays[0], start=np.concatenate([r.start for r in rays]),
            direction=np.concatenate([r.direction for r in rays]),
        ),
        lines, distances, shines, _joined([fiber] * 3), cast, lamp,
        Pairs(number, number + count, number + 2 * count), along_row, reach,
    )  # fmt: skip
    # From the first to the second, wherever the rim lies.
    return [replace(r, step=shines[torch.from_numpy(r.pairs.q)] - shines[torch.from_numpy(r.pairs.p)]) for r in found]


def _between(geometry: Geometry, first: Ints, second: Ints, part: Floats) -> Geometry:
    """Rays between those of two pixels."""
    start = geometry.start[first] + part[:, None] * (geometry.start[second] - geometry.start[first])
    direction = geometry.direction[first] + part[:, None] * (geometry.direction[second] - geometry.direction[first])
    return replace(geometry, start=start, direction=direction / np.linalg.norm(direction, axis=1, keepdims=True))


def places_of(rays: Geometry, distance: Tensor) -> Floats:
    """Where rays are after a distance, metres."""
    return rays.scale * (rays.start + as_numpy(distance)[:, None] * rays.direction)


def _joined(parts: list[Seen]) -> Seen:
    return Seen(np.concatenate([p.segment for p in parts]), np.concatenate([p.copy for p in parts]))
