"""First looks of the match stage: what differs from the start in kind rather than by a little.

Derivatives lead from a fabric to its neighbours. That the lamp was a ring, that yarns are spun hard the other way or
plied, or that they do not touch, is no neighbour: the way there leads uphill. So these are simply looked at, one
question after the other, each with the answers to those before, and what comes closer to the photo is kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from usdfab.fabric import SYSTEMS, FabricParameters, YarnParameters
from usdfab.usd.rig import Rig, ring_rig

RING_ELEVATIONS = (0.9, 0.6)
"""Radians above the cloth: ring lamps of microscopes."""

SIDE_ELEVATION = 0.7
SIDE_AZIMUTHS = (0.8, 2.4, 4.0, 5.5)
"""One lamp from the side, towards each corner of the picture."""

SPUN_ANGLE = 0.45
"""Radians between fibers and yarn on the surface of spun yarn: 15 to 35 degrees in real cloth."""

SPUN_FIBERS = 60
"""Fibers of a spun yarn as they show: real ones are thinner and many, but lie in strands."""

WIDTHS = (0.85, 0.72, 1.13)
"""Of the yarns, times the start's: how dark the valleys between yarns are decides much."""


@dataclass(frozen=True)
class Seen:
    """A fabric under a rig (None: the paper's)."""

    fabric: FabricParameters
    rig: Rig | None


Look = Callable[[Seen], Seen]


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
    return (
        *(() if rig_known else (tuple(_lamps()),)),
        tuple(_width(w) for w in WIDTHS),
        (_spun(1.0), _spun(-1.0)),
        (_plied,),
        (_yarns(unevenness=0.12, waviness=0.2), _yarns(unevenness=0.06, waviness=0.1)),
        (_yarns(flyaway_density=3000.0),),
    )


def looks_at(start: Seen, asked: tuple[tuple[Look, ...], ...], answers: tuple[int, ...]) -> Seen:
    """``start`` with the first ``answers`` (numbers of looks, -1 for none) to the questions."""
    for question, answer in zip(asked, answers, strict=False):
        if answer >= 0:
            start = question[answer](start)
    return start


def _lamps() -> list[Look]:
    def ring(elevation: float) -> Look:
        return lambda seen: Seen(seen.fabric, ring_rig(seen.fabric.size, elevation))

    def side(azimuth: float) -> Look:
        return lambda seen: Seen(seen.fabric, ring_rig(seen.fabric.size, SIDE_ELEVATION, 1, azimuth))

    return [*map(ring, RING_ELEVATIONS), *map(side, SIDE_AZIMUTHS)]


def _each(change: Callable[[YarnParameters, float], dict[str, Any]]) -> Look:
    """Both yarn systems changed; ``change`` gets a yarn and the length of a cell along it."""

    def look(seen: Seen) -> Seen:
        fabric = seen.fabric
        for system, along in zip(SYSTEMS, reversed(fabric.cell), strict=True):
            yarn = fabric.system(system)
            fabric = replace(fabric, **{system: replace(yarn, **change(yarn, along))})  # type: ignore[arg-type]
        return Seen(fabric, seen.rig)

    return look


def _width(factor: float) -> Look:
    """Yarns narrower by a factor, first rounder, then thinner; wider ones become thicker too."""

    def change(yarn: YarnParameters, _: float) -> dict[str, Any]:
        flattening = max(min(yarn.flattening, 1.0), yarn.flattening * min(factor, 1.0))
        return {"flattening": flattening, "radius": yarn.radius * factor * yarn.flattening / flattening}

    return _each(change)


def _spun(sign: float) -> Look:
    """Fewer, twisted fibers; a yarn that is plied keeps its twist."""

    def change(yarn: YarnParameters, along: float) -> dict[str, Any]:
        fibers = {"fiber_count": min(yarn.fiber_count, SPUN_FIBERS)}
        if yarn.ply_count > 1:
            return fibers
        # On the surface, at half the yarn's width from its axis, fibers run at this angle.
        turns = math.tan(SPUN_ANGLE) * along / (2.0 * math.pi * yarn.radius * yarn.flattening)
        return fibers | {"twist": sign * min(turns, 0.6)}

    return _each(change)


def _plied(seen: Seen) -> Seen:
    """Two plies, twisted as the fibers were: what a photo shows of twist is the slant of the lines on the yarn."""
    return _each(
        lambda yarn, _: {"ply_count": 2, "ply_twist": -yarn.twist} if yarn.ply_count == 1 else {}
    )(seen)  # fmt: skip


def _yarns(**numbers: float) -> Look:
    return _each(lambda yarn, _: {name: max(value, getattr(yarn, name)) for name, value in numbers.items()})
