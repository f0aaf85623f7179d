"""Fibers of one yarn system (Li et al. 2024, eq. 7 to 9), periodic over the patch, differentiable in ``YarnShape``.

Notation: ``i`` = 1..m fibers, ``y`` place in the segment, ``l`` its length, both in cells; lengths across the yarn
are in metres. Arrays have shape (fibers, stations).

**How the patch closes.** Fibers twist: after the patch's length L they have turned by 2 pi alpha L, which is no whole
turn, so fiber i cannot close on itself. It closes on a neighbour: ``successor`` pairs each fiber's end with the start
of the fiber that lies nearest there (a minimal assignment), and over the patch fiber i's raw curve is blended into its
successor's, taken one patch earlier. At the border position and direction then agree exactly, the twist is kept, and
no parameter is rounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from usdfab.fabric import SYSTEMS, YarnParameters
from usdfab.fibers.centerline import unit_centerline
from usdfab.fibers.cross_section import JITTER, fiber_angle, fiber_radius, migrated_radius
from usdfab.fibers.noise import perlin3
from usdfab.fibers.randomness import hash_integers, normal, uniform
from usdfab.fibers.segments import Layout

SEGMENT_INDEX_PER_CELL = 8.0
"""lambda_seg of eq. 9 counts this many per cell: at Q = 0.15 the vertical noise has about one bump per cell."""

KAPPA_MIN = 0.25
"""kappa = 1 + U(-k, k) is not let below this; for Q > 0.3 the paper's k would turn y^kappa around."""


@dataclass(frozen=True)
class YarnShape:
    """The numbers that the fibers' shape depends on differentiably: floats, or 0-d arrays of any array library.

    ``radius`` in metres, ``inclination`` in radians, ``twist`` in turns per cell, the others without unit.
    """

    radius: Any
    flattening: Any
    inclination: Any
    crimp: Any
    twist: Any
    irregularity: Any
    migration: Any
    migration_rate: Any

    @classmethod
    def of(cls, yarn: YarnParameters) -> YarnShape:
        """The shape part of a yarn system's parameters."""
        return cls(**{name: getattr(yarn, name) for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class Draws:
    """Every random number of one yarn system.

    ``jitter`` (J S), ``theta0``, ``xi``: (yarns, fibers); ``kappa``: (yarns, fibers, segments), U(-1, 1).
    """

    jitter: NDArray[np.float64]
    theta0: NDArray[np.float64]
    xi: NDArray[np.float64]
    kappa: NDArray[np.float64]
    noise_seed: int


def draw(layout: Layout, fiber_count: int, seed: int) -> Draws:
    """All draws, as hashes of (seed, system, yarn, fiber, segment, channel)."""
    system = SYSTEMS.index(layout.system)
    yarn = np.arange(layout.yarns)[:, None]
    fiber = np.arange(fiber_count)[None, :]
    segment = np.arange(int(layout.segment.max()) + 1)
    key = (seed, system, yarn, fiber)
    return Draws(
        jitter=JITTER * uniform(*key, 0, 0) * normal(*key, 0, 1),
        theta0=2.0 * math.pi * uniform(*key, 0, 2),
        xi=100.0 * uniform(*key, 0, 3),
        kappa=2.0 * uniform(seed, system, yarn[..., None], fiber[..., None], segment, 4) - 1.0,
        noise_seed=int(hash_integers(seed, system, 5) >> np.uint64(33)),
    )


def successors(shape: YarnShape, layout: Layout, draws: Draws) -> NDArray[np.int64]:
    """(yarns, fibers): which fiber's start each fiber's end is joined to."""
    fibers = draws.jitter.shape[1]
    values = YarnShape(**{k: float(getattr(shape, k)) for k in YarnShape.__dataclass_fields__})
    index = np.arange(1, fibers + 1)
    start_end = [
        _cross_section(values, index, draws.jitter, draws.theta0, np.asarray(turns))
        for turns in (0.0, values.twist * layout.length)
    ]
    (x0, z0), (x1, z1) = start_end
    cost = (x1[:, :, None] - x0[:, None, :]) ** 2 + (z1[:, :, None] - z0[:, None, :]) ** 2
    return np.stack([linear_sum_assignment(c)[1] for c in cost])


def _cross_section(shape: YarnShape, index: Any, jitter: Any, theta0: Any, turns: Any) -> tuple[Any, Any]:
    """Place in a round cross-section of unit radius after ``turns`` turns of twist (eq. 7, 8)."""
    xp = array_namespace(jitter, theta0)
    theta = 2.0 * math.pi * turns
    radius = migrated_radius(
        fiber_radius(index, jitter.shape[1] if jitter.ndim == 2 else len(index), jitter),
        theta,
        theta0,
        shape.migration,
        shape.migration_rate,
    )
    angle = theta + fiber_angle(index)
    return radius * xp.cos(angle), radius * xp.sin(angle)


def fiber_offsets(shape: YarnShape, layout: Layout, draws: Draws, successor: NDArray, xp: Any = np) -> tuple[Any, Any]:
    """Place of every fiber at every station, relative to the yarn's straight axis.

    Returns
    -------
    across, height: (fibers, stations) metres, in the array library ``xp``
        ``x_fib`` and ``z_fib`` of Li et al. 2024, eq. 8 and 9.
    """
    yarn = layout.yarn
    fibers = np.arange(draws.jitter.shape[1])[:, None]
    t = layout.position / layout.length
    fade = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)

    # Raw fiber i from the start of the patch, and its successor's curve one patch earlier.
    own = _raw(shape, layout, draws, np.broadcast_to(fibers, (len(fibers), len(yarn))), 0.0, xp)
    after = _raw(shape, layout, draws, successor[yarn].T, -float(layout.length), xp)

    blend = xp.asarray(fade[None, :])
    # Independent noises lose variance where they are averaged; this keeps it.
    noise_gain = xp.asarray(1.0 / np.sqrt(fade**2 + (1.0 - fade) ** 2)[None, :])
    mixed = [(1.0 - blend) * a + blend * b for a, b in zip(own, after, strict=True)]
    across = shape.radius * shape.flattening * mixed[0]
    height = shape.radius * (mixed[1] + noise_gain * mixed[2])
    return across, height


def _raw(shape: YarnShape, layout: Layout, draws: Draws, fiber: NDArray, shift: float, xp: Any) -> tuple[Any, Any, Any]:
    """Across, height and vertical noise in yarn radii of the fibers ``fiber`` (fibers, stations), shifted in cells."""
    yarn = layout.yarn[None, :]
    place = layout.position[None, :] + shift

    # Cross-section, turned by the twist.
    fibers = draws.jitter.shape[1]
    index = xp.asarray(fiber + 1.0)
    theta = 2.0 * math.pi * shape.twist * xp.asarray(place)
    radius = migrated_radius(
        fiber_radius(index, fibers, xp.asarray(draws.jitter[yarn, fiber])),
        theta,
        xp.asarray(draws.theta0[yarn, fiber]),
        shape.migration,
        shape.migration_rate,
    )
    angle = theta + fiber_angle(index)

    # Centre line with its highest point moved: z'_cen of eq. 9, with y^kappa on the normalised place.
    length = xp.asarray(layout.segment_length[None, :])
    start = layout.y[None, :] == 0.0
    unit = xp.asarray(np.where(start, 1.0, layout.y[None, :] / layout.segment_length[None, :]))
    k = 2.5 * shape.irregularity / (length * length)
    kappa = xp.asarray(draws.kappa[yarn, fiber, layout.segment[None, :]]) * k + 1.0
    kappa = xp.clip(kappa, KAPPA_MIN, None)
    moved = length * unit**kappa
    center = unit_centerline(moved, length, shape.inclination) * xp.asarray(np.where(start, 0.0, layout.side[None, :]))

    # Vertical noise z_P of eq. 9.
    q = shape.irregularity
    shape2 = np.broadcast_shapes(fiber.shape, place.shape)
    noise = q * perlin3(
        q * xp.asarray(yarn + np.zeros(shape2)),
        q * xp.asarray(fiber.astype(float)),
        q * xp.asarray(SEGMENT_INDEX_PER_CELL * place + np.zeros(shape2)) + xp.asarray(draws.xi[yarn, fiber]),
        draws.noise_seed,
    )
    return radius * xp.cos(angle), radius * xp.sin(angle) + shape.crimp * center, noise
