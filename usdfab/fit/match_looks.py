"""First looks of the match stage: what differs from the start in kind rather than by a little.

Derivatives lead from a fabric to its neighbours. That the lamp stood aside, that yarns are round and touch where dark
valleys look like gaps, that they are spun hard the other way or plied, is no neighbour: the way there leads uphill. So
these are simply looked at, each with the answers to others, and what comes closest to the photo is kept.

Round, closed, bulging yarns under a lamp across them are what dark satin needs most: flat ones under a lamp near the
camera have no shading, and only gaps could make the dark lines of the photo.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

from usdfab.fabric import SYSTEMS, FabricParameters, YarnParameters
from usdfab.fit.match_space import BLUR_UNIT
from usdfab.usd.rig import Rig, rig_for, ring_rig

RING_ELEVATIONS = (0.6,)
"""Radians above the cloth: ring lamps of microscopes."""

SIDE_ELEVATION = 0.7
SIDE_AZIMUTHS = tuple(0.5 * math.pi * k for k in range(4))
"""One lamp from the side, across either yarn system, whose yarns then have a bright and a dark side."""

OTHER_ELEVATIONS = (0.45, 0.95)
"""Of the lamps found best, in a second look; they are turned, too."""

TURNS = (0.25 * math.pi, -0.25 * math.pi)

FULL: Mapping[str, float] = {
    "irregularity": 0.1, "crimp": 0.9, "inclination": 1.0, "unevenness": 0.1, "waviness": 0.12,
    "albedo_variation": 0.3,
}  # fmt: skip
"""Yarns that bulge over each other, of fibers that lie in order but differ in colour."""

FULL_FLATTENING = 1.1

FIBERS = 70
"""Fibers of a yarn as they show: real ones are thinner and many, but lie in strands."""

SURFACE_ANGLES = (0.25, -0.25, 0.5, -0.5)
"""Radians between fibers and yarn on the surface: 15 to 35 degrees in real spun yarn."""

WIDTHS = (0.85, 1.15)
"""Of the yarns, times the start's: how dark the valleys between yarns are decides much."""

BLURS = (-0.8, 0.8, 1.3)
"""Of the camera, in ``BLUR_UNIT``: photos are sharpened, or enlarged, or not quite in focus."""

CLOSED_COVER = 1.04
"""Width over spacing of yarns that leave no gap. What looks like a gap may be a valley."""

MOST_TWIST = 0.6

SHAPES = 2
"""Shapes of yarns that the first question asks for, each under the same lamps: open and closed cloth."""

NEARLY = 1.15
"""Loss, over that of the best shape of yarns, up to which another is followed, too."""

SLACK = 0.05
"""Of the loss: how much more a look may gain than the last time without being overlooked."""

LOOKS_AGAIN = 0.5
"""How many looks are taken again, about, over the number of looks."""


@dataclass(frozen=True)
class Seen:
    """A fabric under a rig (None: the paper's)."""

    fabric: FabricParameters
    rig: Rig | None


Look = Callable[[Seen], Seen]
Answers = tuple[tuple[int, int], ...]
"""Numbers of questions and of the looks that answer them, in the order in which they were found."""


def questions(shapes: bool, rig_known: bool) -> tuple[tuple[Look, ...], ...]:
    """Looks by question.

    Parameters
    ----------
    shapes:
        Whether the shape of yarns may change. If only colours may, nothing is asked: with wrong colours another lamp
        is soon as good.
    rig_known:
        Whether the rig is given, so that lamps are not asked for.
    """
    if not shapes:
        return ()
    lamps: tuple[Look, ...] = (_as_lit, *(() if rig_known else _lamps()))
    moved: tuple[Look, ...] = (*map(_elevated, OTHER_ELEVATIONS), *map(_turned, TURNS))
    return (
        # A lamp from the side suits only yarns that have sides, and closed cloth only lamps that show its valleys. So
        # these are asked for at once.
        tuple(_then(shape, lamp) for shape in (_full, _then(_full, _closed)) for lamp in lamps),
        tuple(_width(w) for w in WIDTHS),
        () if rig_known else tuple(map(_blurred, BLURS)),
        () if rig_known else moved,
        tuple(map(_spun, SURFACE_ANGLES)),
        (_plied,),
        (_yarns(albedo_variation=0.7),),
        (_yarns(unevenness=0.2, waviness=0.25),),
        (_yarns(flyaway_density=3000.0),),
    )


def looks_at(start: Seen, asked: tuple[tuple[Look, ...], ...], answers: Answers) -> Seen:
    """``start`` with the looks that ``answers`` name, in their order."""
    for question, look in answers:
        start = asked[question][look](start)
    return start


def best_answers(asked: tuple[tuple[Look, ...], ...], loss_of: Callable[[Answers], float]) -> Answers:
    """The answers of least loss that a greedy search finds.

    The first question is asked before all others, since whether cloth is open or closed, and where the lamp stands,
    decides which of the others help; then, whichever helps most comes next. Where another shape of yarn, or none of
    these, came nearly as close, the search goes on from there, too.

    Parameters
    ----------
    asked:
        See ``questions``.
    loss_of:
        Of the picture of some answers; costly.
    """
    losses: dict[Answers, float] = {(): loss_of(())}
    if not asked:
        return ()
    shapes = [
        [((0, k),) for k in range(shape * len(asked[0]) // SHAPES, (shape + 1) * len(asked[0]) // SHAPES)]
        for shape in range(SHAPES)
    ]
    losses |= {look: loss_of(look) for shape in shapes for look in shape}
    branches = sorted([(), *(min(shape, key=losses.__getitem__) for shape in shapes)], key=losses.__getitem__)
    first = losses[branches[0]]
    # Equal losses are the same cloth: it was closed before.
    near = [branch for branch in branches[1:] if first < losses[branch] <= NEARLY * first]
    return min(
        (_climb(asked, branch, losses[branch], loss_of) for branch in [branches[0], *near[:1]]), key=itemgetter(0)
    )[1]


def most_looks(asked: tuple[tuple[Look, ...], ...]) -> int:
    """How many looks ``best_answers`` takes at most, about."""
    first, *others = asked or ((),)
    return 1 + len(first) + round((1.0 + LOOKS_AGAIN) * sum(map(len, others)))


def _climb(
    asked: tuple[tuple[Look, ...], ...], answers: Answers, loss: float, loss_of: Callable[[Answers], float]
) -> tuple[float, Answers]:
    """From ``answers`` on, the look that gains most, again and again: (loss, answers).

    What a look gains rarely grows by much when others were taken (Minoux 1978): so only those whose gain, as last seen,
    is within ``SLACK`` of the best are seen again.
    """
    waiting = {(q, k): math.inf for q in range(1, len(asked)) for k in range(len(asked[q]))}
    while waiting:
        fresh: dict[tuple[int, int], float] = {}
        for answer in sorted(waiting, key=waiting.__getitem__, reverse=True):
            if waiting[answer] + SLACK * loss > max(fresh.values(), default=0.0):
                fresh[answer] = loss - loss_of((*answers, answer))
        waiting |= fresh
        if max(fresh.values(), default=0.0) <= 0.0:
            break
        best = max(fresh, key=fresh.__getitem__)
        answers, loss = (*answers, best), loss - fresh[best]
        waiting = {answer: gain for answer, gain in waiting.items() if answer[0] != best[0]}
    return loss, answers


def _as_lit(seen: Seen) -> Seen:
    return seen


def _lamps() -> list[Look]:
    def ring(elevation: float) -> Look:
        return lambda seen: Seen(seen.fabric, ring_rig(seen.fabric.size, elevation))

    def side(azimuth: float) -> Look:
        return lambda seen: Seen(seen.fabric, ring_rig(seen.fabric.size, SIDE_ELEVATION, 1, azimuth))

    return [*map(ring, RING_ELEVATIONS), *map(side, SIDE_AZIMUTHS)]


def _elevated(elevation: float) -> Look:
    """The same lamps at another height."""

    def look(seen: Seen) -> Seen:
        rig = seen.rig or rig_for(seen.fabric.size)
        there = ring_rig(seen.fabric.size, elevation, rig.lamps, rig.azimuth)
        return Seen(seen.fabric, replace(there, blur=rig.blur))

    return look


def _blurred(units: float) -> Look:
    """The same lamps through another lens."""

    def look(seen: Seen) -> Seen:
        rig = seen.rig or rig_for(seen.fabric.size)
        return Seen(seen.fabric, replace(rig, blur=units * BLUR_UNIT * seen.fabric.size[0]))

    return look


def _turned(angle: float) -> Look:
    """The same lamp from another side."""

    def look(seen: Seen) -> Seen:
        rig = seen.rig or rig_for(seen.fabric.size)
        return Seen(seen.fabric, replace(rig, azimuth=rig.azimuth + angle) if rig.lamps == 1 else seen.rig)

    return look


def _then(first: Look, second: Look) -> Look:
    return lambda seen: second(first(seen))


def _each(change: Callable[[YarnParameters, float], dict[str, Any]]) -> Look:
    """Both yarn systems changed; ``change`` gets a yarn and the length of a cell along it."""

    def look(seen: Seen) -> Seen:
        fabric = seen.fabric
        for system, along in zip(SYSTEMS, reversed(fabric.cell), strict=True):
            yarn = fabric.system(system)
            fabric = replace(fabric, **{system: replace(yarn, **change(yarn, along))})  # type: ignore[arg-type]
        return Seen(fabric, seen.rig)

    return look


def _full(seen: Seen) -> Seen:
    """Round, orderly yarns that bulge, as wide as before."""

    def change(yarn: YarnParameters, _: float) -> dict[str, Any]:
        flattening = min(yarn.flattening, FULL_FLATTENING)
        shape = {"flattening": flattening, "radius": yarn.radius * yarn.flattening / flattening}
        return dict(FULL) | shape | {"fiber_count": FIBERS}

    return _each(change)(seen)


def _width(factor: float) -> Look:
    """Yarns narrower by a factor, first rounder, then thinner; wider ones become thicker too."""

    def change(yarn: YarnParameters, _: float) -> dict[str, Any]:
        flattening = max(min(yarn.flattening, 1.0), yarn.flattening * min(factor, 1.0))
        return {"flattening": flattening, "radius": yarn.radius * factor * yarn.flattening / flattening}

    return _each(change)


def _closed(seen: Seen) -> Seen:
    """Yarns that touch their neighbours, thicker by as much as they are wider."""
    fabric = seen.fabric
    for system, spacing in zip(SYSTEMS, fabric.cell, strict=True):
        yarn = fabric.system(system)
        radius = max(yarn.radius, 0.5 * CLOSED_COVER * spacing / yarn.flattening)
        fabric = replace(fabric, **{system: replace(yarn, radius=radius)})  # type: ignore[arg-type]
    return Seen(fabric, seen.rig)


def _spun(angle: float) -> Look:
    """Fewer, twisted fibers, at an angle on the yarn's surface; a yarn that is plied keeps its twist."""

    def change(yarn: YarnParameters, along: float) -> dict[str, Any]:
        fibers = {"fiber_count": min(yarn.fiber_count, FIBERS)}
        if yarn.ply_count > 1:
            return fibers
        # On the surface, at half the yarn's width from its axis, fibers run at this angle.
        turns = math.tan(angle) * along / (2.0 * math.pi * yarn.radius * yarn.flattening)
        return fibers | {"twist": min(max(turns, -MOST_TWIST), MOST_TWIST)}

    return _each(change)


def _plied(seen: Seen) -> Seen:
    """Two plies, twisted as the fibers were: what a photo shows of twist is the slant of the lines on the yarn."""
    return _each(
        lambda yarn, _: {"ply_count": 2, "ply_twist": -yarn.twist} if yarn.ply_count == 1 else {}
    )(seen)  # fmt: skip


def _yarns(**numbers: float) -> Look:
    return _each(lambda yarn, _: {name: max(value, getattr(yarn, name)) for name, value in numbers.items()})
