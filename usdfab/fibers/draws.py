"""Every random number of one yarn system, and how the draws of a variant of the tile depart from the common ones."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, ply_circles
from usdfab.fibers.cross_section import JITTER, fiber_radius
from usdfab.fibers.randomness import hash_integers, normal, uniform
from usdfab.fibers.segments import Layout
from usdfab.fibers.shades import drawn_shades
from usdfab.fibers.unevenness import highest

Floats = NDArray[np.float64]

_PHASE, _VARIANT, _ROTATION, _THICKNESS, _WANDER, _SHADE = 6, 7, 8, 10, 11, 12
"""Channels of draws that Li et al. 2024 do not have (9 is that of flyaways)."""


@dataclass(frozen=True)
class Draws:
    """Every random number of one yarn system.

    ``jitter`` (J S), ``theta0``, ``xi``: (yarns, fibers); ``kappa``: (yarns, fibers, segments), U(-1, 1).
    Of ``plies`` plies, fiber i belongs to ply ``i % plies``, in which it is number ``i // plies``; all plies hold
    equally many. ``phase`` (yarns,) radians is where ply 0 starts; fibers of a ply share their ``kappa``.
    ``thickness`` and ``wander`` (yarns, cells along) are standard normal: what a yarn's unevenness and its sideways
    wandering are interpolated from, see ``unevenness.interpolated``. ``shade`` (yarns, fibers) numbers
    ``shades.LEVELS``, None where all fibers of a yarn have one albedo.
    """

    jitter: Floats
    theta0: Floats
    xi: Floats
    kappa: Floats
    noise_seed: int
    plies: int = 1
    phase: Floats = field(default_factory=lambda: np.zeros(1))
    thickness: Floats = field(default_factory=lambda: np.zeros((1, 1)))
    wander: Floats = field(default_factory=lambda: np.zeros((1, 1)))
    shade: NDArray[np.int64] | None = None

    @property
    def fibers(self) -> int:
        """Fibers in a yarn."""
        return self.jitter.shape[1]


def draw(layout: Layout, fiber_count: int, seed: int, plies: int = 1, shaded: bool = False) -> Draws:
    """All draws, as hashes of (seed, system, yarn, fiber, segment, channel).

    ``fiber_count`` is rounded up to a multiple of ``plies``. ``shaded`` fibers differ in albedo (``shades.py``).
    """
    system = SYSTEMS.index(layout.system)
    fiber_count = plies * -(-fiber_count // plies)
    yarn = np.arange(layout.yarns)[:, None]
    fiber = np.arange(fiber_count)[None, :]
    segment = np.arange(int(layout.segment.max()) + 1)
    key = (seed, system, yarn, fiber)
    # The highest point of a segment moves for each fiber (eq. 9); plies would dissolve, so there it moves for each ply.
    moves = fiber if plies == 1 else fiber % plies
    phase = 2.0 * math.pi * uniform(seed, system, yarn[:, 0], _PHASE) if plies > 1 else np.zeros(layout.yarns)
    knot = np.arange(layout.length)
    return Draws(
        jitter=JITTER * uniform(*key, 0, 0) * normal(*key, 0, 1),
        theta0=2.0 * math.pi * uniform(*key, 0, 2),
        xi=100.0 * uniform(*key, 0, 3),
        kappa=2.0 * uniform(seed, system, yarn[..., None], moves[..., None], segment, 4) - 1.0,
        noise_seed=int(hash_integers(seed, system, 5) >> np.uint64(33)),
        plies=plies,
        phase=phase,
        thickness=normal(seed, system, yarn, knot, _THICKNESS),
        wander=normal(seed, system, yarn, knot, _WANDER),
        shade=drawn_shades(uniform(*key, _SHADE), plies) if shaded else None,
    )


# --- variants of the tile --------------------------------------------------------------------------------------------

BORDER_BAND = 0.25
"""Cells next to the border that yarns cross in which all variants are the same (more, where vertices are sparse)."""

RAMP = 0.75
"""Cells over which a variant departs from the common draws."""

MAX_ROTATION_RATE = 0.05
"""Turns per cell of twist that the turning of a variant's cross-sections adds at most."""

XI_SHIFT = 1.0
"""Lattice cells of the noise by which a variant's fibers are moved at most: enough for other bumps, no steeper ones."""


@dataclass(frozen=True)
class Variation:
    """What a variant adds to the draws: ``draw + weight * mask * change``, the weight varying along the yarn.

    ``jitter``, ``theta0``, ``xi`` (yarns, fibers), ``kappa`` (yarns, fibers, segments), ``thickness``, ``wander``
    (yarns, cells along): changes of the draws. The latter two are 0 for yarns that vary not in all of their fibers.
    ``rotation`` (yarns,) radians: turn of the yarn's whole cross-section. ``weight`` (stations,): 0 with zero first
    and second derivatives towards the patch's border, 1 in the middle. ``mask`` (yarns, fibers): 0 for curves that
    must be the same in all variants.
    """

    jitter: Floats
    theta0: Floats
    xi: Floats
    kappa: Floats
    thickness: Floats
    wander: Floats
    rotation: Floats
    weight: Floats
    mask: Floats


def smoother_step(t: Floats) -> Floats:
    """0 to 1 over [0, 1] with zero first and second derivatives at both ends (Perlin 2002); constant outside."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


def ramp(layout: Layout, margin: float) -> tuple[float, float]:
    """Cells at both ends of a yarn in which all variants agree, and cells over which they depart from each other.

    The pieces of spline that a fiber's vertices shape, three on either side, must not come within ``margin`` cells of
    the border.
    """
    # A yarn interlaces, so that it has two segments at least and many stations.
    spacing = float(np.diff(layout.position)[np.diff(layout.yarn) == 0].max())
    band = max(BORDER_BAND, 3.0 * spacing + margin)
    return band, min(RAMP, 0.5 * layout.length - band)


def variation_weight(layout: Layout, margin: float) -> Floats:
    """(stations,) how much a variant departs from the common draws; ``margin`` as in ``ramp``."""
    band, width = ramp(layout, margin)
    if width <= 0.0:
        return np.zeros(len(layout.position))
    border = np.minimum(layout.position, layout.length - layout.position)
    return smoother_step((border - band) / width)


def reach(draws: Draws, jitter: Floats) -> Floats:
    """(yarns, fibers) how far fibers get from the yarn's axis at most, in yarn radii, with the given ``jitter``."""
    radius, distance = ply_circles(draws.plies)
    place = np.arange(draws.fibers) // draws.plies + 1.0
    return distance + radius * np.abs(fiber_radius(place, draws.fibers // draws.plies, jitter))


def variation(
    layout: Layout,
    draws: Draws,
    successor: NDArray[np.int64],
    seed: int,
    variant: int,
    room: Floats,
    margin: float,
    unevenness: float = 0.0,
    waviness: float = 0.0,
) -> Variation:
    """The changes of the draws that make variant ``variant`` (1, 2, ...) of the tile.

    Parameters
    ----------
    successor: (yarns, fibers)
        That of the common draws; it stays.
    room: (yarns,)
        How far from the yarn's axis a fiber may get that varies, in yarn radii: as far as to the tile's side. A curve
        that may get further, with the common draws or the variant's, stays as it is.
    margin: cells
        How near to the patch's border along the yarn no fiber may vary.
    unevenness, waviness:
        Of the yarns, see ``YarnShape``.
    """
    other = draw(layout, draws.fibers, int(hash_integers(seed, _VARIANT, variant) >> np.uint64(33)), draws.plies)
    system = SYSTEMS.index(layout.system)
    yarn = np.arange(layout.yarns)
    farthest = np.maximum(reach(draws, draws.jitter), reach(draws, other.jitter))
    # A curve is a blend of its own fiber and its successor.
    farthest = np.maximum(farthest, np.take_along_axis(farthest, successor, axis=1))
    # Uneven yarns bulge, and wander sideways, by no more than this (one set of changes is blended into the other).
    bulge, shift = (
        np.maximum(highest(getattr(draws, name)), highest(getattr(other, name)))[:, None]
        for name in ("thickness", "wander")
    )
    farthest = farthest * (1.0 + unevenness * bulge) + waviness * shift
    mask = (farthest < room[:, None]).astype(float)
    # The step's steepest slope is 15 / 8. A cross-section turns as one or not at all.
    most = 2.0 * math.pi * MAX_ROTATION_RATE * max(ramp(layout, margin)[1], 0.0) * 8.0 / 15.0
    as_one = mask.min(axis=1)
    rotation = most * as_one * (2.0 * uniform(seed, system, yarn, variant, _ROTATION) - 1.0)
    return Variation(
        jitter=other.jitter - draws.jitter,
        # The shorter way round, so that no fiber wanders more than it must.
        theta0=np.mod(other.theta0 - draws.theta0 + math.pi, 2.0 * math.pi) - math.pi,
        xi=XI_SHIFT * (other.xi / 50.0 - 1.0),
        kappa=other.kappa - draws.kappa,
        thickness=as_one[:, None] * (other.thickness - draws.thickness),
        wander=as_one[:, None] * (other.wander - draws.wander),
        rotation=rotation,
        weight=variation_weight(layout, margin),
        mask=mask,
    )
