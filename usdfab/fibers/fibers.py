"""Fibers of one yarn system (Li et al. 2024, eq. 7 to 9), periodic over the patch, differentiable in ``YarnShape``.

Notation: ``i`` = 1..m fibers, ``y`` place in the segment, ``l`` its length, both in cells; lengths across the yarn
are in metres. Arrays have shape (fibers, stations).

**How the patch closes.** Fibers twist: after the patch's length L they have turned by 2 pi alpha L, which is no whole
turn, so fiber i cannot close on itself. It closes on a neighbour: ``successor`` pairs each fiber's end with the start
of the fiber that lies nearest there (a minimal assignment), and over the patch fiber i's raw curve is blended into its
successor's, taken one patch earlier. At the border position and direction then agree exactly, the twist is kept, and
no parameter is rounded.

**Plies.** Few plies lie far apart, and blending one into the next would pinch the yarn. So the twist of the plies about
the yarn is rounded to the nearest k / (n L) turns per cell (``closed_twist``), n plies, k whole: each ply then ends
exactly where ply + k starts, the difference being spread evenly along the patch. Within the ply, fibers close on
neighbours as above. The patch of a plied yarn therefore does not change with ``twist`` between these steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are first used
from array_api_compat import array_namespace
from numpy.typing import NDArray

from usdfab.fabric import YarnParameters, ply_circles
from usdfab.fibers.centerline import unit_centerline
from usdfab.fibers.cross_section import fiber_angle, fiber_radius, migrated_radius
from usdfab.fibers.draws import Draws, Variation
from usdfab.fibers.noise import perlin3
from usdfab.fibers.segments import Layout
from usdfab.fibers.unevenness import THINNEST, interpolated

SEGMENT_INDEX_PER_CELL = 8.0
"""lambda_seg of eq. 9 counts this many per cell: at Q = 0.15 the vertical noise has about one bump per cell."""

OTHER_SHADE = 100.0
"""Squared yarn radii: more than lie between any two fibers. There are equally many of each shade, so none is joined to
another."""

KAPPA_MIN = 0.25
"""kappa = 1 + U(-k, k) is not let below this; for Q > 0.3 the paper's k would turn y^kappa around."""


@dataclass(frozen=True)
class YarnShape:
    """The numbers that the fibers' shape depends on differentiably: floats, or 0-d arrays of any array library.

    ``radius`` in metres, ``inclination`` in radians, ``twist`` and ``ply_twist`` in turns per cell, the others without
    unit; ``waviness`` in half widths of the yarn. How many plies there are is a matter of ``Draws``.
    """

    radius: Any
    flattening: Any
    inclination: Any
    crimp: Any
    twist: Any
    irregularity: Any
    migration: Any
    migration_rate: Any
    ply_twist: Any = 0.0
    unevenness: Any = 0.0
    waviness: Any = 0.0

    @classmethod
    def of(cls, yarn: YarnParameters) -> YarnShape:
        """The shape part of a yarn system's parameters."""
        return cls(**{name: getattr(yarn, name) for name in cls.__dataclass_fields__})

    def as_floats(self) -> YarnShape:
        """The same with plain numbers, cut off from any gradient."""
        values = {k: getattr(self, k) for k in self.__dataclass_fields__}
        return YarnShape(**{k: float(v.detach() if hasattr(v, "detach") else v) for k, v in values.items()})


def closed_twist(twist: float, length: int, plies: int, step: int | None = None) -> float:
    """Turns per cell of the plies about the yarn: those nearest to ``twist`` with which they close in ``length`` cells.

    Parameters
    ----------
    step:
        By how many plies they go on there, modulo ``plies``, where ``successors`` has settled it already.
    """
    turns = twist * length
    if step is None:
        return math.floor(turns * plies + 0.5) / (plies * length)
    rest = (step % plies) / plies
    return (math.floor(turns - rest + 0.5) + rest) / length


def successors(shape: YarnShape, layout: Layout, draws: Draws) -> NDArray[np.int64]:
    """(yarns, fibers): which fiber's start each fiber's end is joined to."""
    values = shape.as_floats()
    plies = draws.plies
    length = float(layout.length)
    step = round(closed_twist(values.twist, layout.length, plies) * plies * length) if plies > 1 else 0
    successor = np.empty(draws.jitter.shape, dtype=np.int64)
    twist = values.twist if plies == 1 else values.ply_twist
    index = np.arange(draws.fibers)
    (x0, z0), (x1, z1) = (
        _within_ply(values, index, draws.fibers, plies, draws.jitter, draws.theta0, 2.0 * math.pi * turns)
        for turns in (np.asarray(0.0), np.asarray(twist * length))
    )
    for ply in range(plies):
        ends, starts = slice(ply, None, plies), slice((ply + step) % plies, None, plies)
        cost = (x1[:, ends, None] - x0[:, None, starts]) ** 2 + (z1[:, ends, None] - z0[:, None, starts]) ** 2
        if draws.shade is not None:
            cost = cost + OTHER_SHADE * (draws.shade[:, ends, None] != draws.shade[:, None, starts])
        successor[:, ends] = index[starts][np.stack([scipy.optimize.linear_sum_assignment(c)[1] for c in cost])]
    return successor


def _within_ply(
    shape: YarnShape, fiber: Any, fibers: int, plies: int, jitter: Any, theta0: Any, theta: Any
) -> tuple[Any, Any]:
    """Place in a round ply (or unplied yarn) of unit radius after turning by ``theta`` (eq. 7, 8).

    ``fiber`` numbers the yarn's ``fibers`` fibers from 0.
    """
    xp = array_namespace(jitter, theta0)
    if plies == 1:
        index = xp.asarray(fiber + 1.0)
        start = fiber_angle(index)
    else:
        index = xp.asarray(fiber // plies + 1.0)
        start = fiber_angle(index) + xp.asarray(2.0 * math.pi / plies * (fiber % plies))
    radius = fiber_radius(index, fibers // plies, jitter)
    radius = migrated_radius(radius, theta, theta0, shape.migration, shape.migration_rate)
    angle = theta + start
    return radius * xp.cos(angle), radius * xp.sin(angle)


def fiber_offsets(
    shape: YarnShape,
    layout: Layout,
    draws: Draws,
    successor: NDArray,
    xp: Any = np,
    variation: Variation | None = None,
) -> tuple[Any, Any]:
    """Place of every fiber at every station, relative to the yarn's straight axis.

    Parameters
    ----------
    successor:
        What ``successors`` gave, for any shape near this one.
    xp:
        The array library to compute in.
    variation:
        Changes of the draws that make a variant of the patch.

    Returns
    -------
    across, height: (fibers, stations) metres, in the array library ``xp``
        ``x_fib`` and ``z_fib`` of Li et al. 2024, eq. 8 and 9.
    """
    yarn = layout.yarn
    fibers = np.arange(draws.fibers)[:, None]
    t = layout.position / layout.length
    fade = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)

    # Raw fiber i from the start of the patch, and its successor's curve one patch earlier.
    evaluate = _Raw(shape, layout, draws, int(successor[0, 0]), xp, variation)
    own = evaluate(np.broadcast_to(fibers, (len(fibers), len(yarn))), 0.0)
    after = evaluate(successor[yarn].T, -float(layout.length))

    blend = xp.asarray(fade[None, :])
    # Independent noises lose variance where they are averaged; this keeps it.
    noise_gain = xp.asarray(1.0 / np.sqrt(fade**2 + (1.0 - fade) ** 2)[None, :])
    mixed = [(1.0 - blend) * a + blend * b for a, b in zip(own, after, strict=True)]
    across = shape.radius * shape.flattening * mixed[0]
    height = shape.radius * (mixed[1] + noise_gain * mixed[2])
    return across, height


class _Raw:
    """Fibers before the patch is closed. ``step``: by how many plies the plies go on at the patch's end."""

    def __init__(
        self, shape: YarnShape, layout: Layout, draws: Draws, step: int, xp: Any, variation: Variation | None
    ) -> None:
        self.shape, self.layout, self.draws, self.xp, self.variation = shape, layout, draws, xp, variation
        self.yarn = layout.yarn[None, :]
        self.strength = None if variation is None else variation.weight * variation.mask[layout.yarn].T
        if draws.plies > 1:
            self.ply_twist = closed_twist(shape.as_floats().twist, layout.length, draws.plies, step)

    def __call__(self, fiber: NDArray, shift: float) -> tuple[Any, Any, Any]:
        """Across, height and noise in yarn radii of the fibers ``fiber`` (fibers, stations), shifted in cells."""
        xp, layout = self.xp, self.layout
        shape, shape2 = self.shape, fiber.shape
        place = layout.position[None, :] + shift
        across, height = self._cross_section(fiber, place)
        thickness = xp.clip(1.0 + shape.unevenness * xp.asarray(self._along("thickness")), THINNEST, None)
        across = thickness * across + shape.waviness * xp.asarray(self._along("wander"))
        height = thickness * height

        # Centre line with its highest point moved: z'_cen of eq. 9, with y^kappa on the normalised place.
        length = xp.asarray(layout.segment_length[None, :])
        start = layout.y[None, :] == 0.0
        unit = xp.asarray(np.where(start, 1.0, layout.y[None, :] / layout.segment_length[None, :]))
        k = 2.5 * shape.irregularity / (length * length)
        kappa = xp.asarray(self._drawn("kappa", fiber, layout.segment[None, :])) * k + 1.0
        kappa = xp.clip(kappa, KAPPA_MIN, None)
        center = unit_centerline(length * unit**kappa, length, shape.inclination)
        center = center * xp.asarray(np.where(start, 0.0, layout.side[None, :]))

        # Vertical noise z_P of eq. 9; within plies it is as much smaller as they are thinner.
        q = shape.irregularity
        noise = q * perlin3(
            q * xp.asarray(self.yarn + np.zeros(shape2)),
            q * xp.asarray(fiber.astype(float)),
            q * xp.asarray(SEGMENT_INDEX_PER_CELL * place + np.zeros(shape2)) + xp.asarray(self._drawn("xi", fiber)),
            self.draws.noise_seed,
        )
        if self.draws.plies > 1:
            noise = ply_circles(self.draws.plies)[0] * noise
        return across, height + shape.crimp * center, noise

    def _cross_section(self, fiber: NDArray, place: NDArray) -> tuple[Any, Any]:
        """Place in the yarn's round cross-section, in yarn radii, turned by the twist."""
        xp, draws, shape = self.xp, self.draws, self.shape
        plies = draws.plies
        jitter, theta0 = xp.asarray(self._drawn("jitter", fiber)), xp.asarray(self._drawn("theta0", fiber))
        theta = 2.0 * math.pi * (shape.twist if plies == 1 else shape.ply_twist) * xp.asarray(place)
        turn = np.zeros(1)
        if self.variation is not None:
            turn = (self.variation.weight * self.variation.rotation[self.layout.yarn])[None, :]
            theta = theta + xp.asarray(turn)
        x, z = _within_ply(shape, fiber, draws.fibers, plies, jitter, theta0, theta)
        if plies == 1:
            return x, z
        radius, distance = ply_circles(plies)
        center = 2.0 * math.pi * (self.ply_twist * place + (fiber % plies) / plies) + draws.phase[self.yarn] + turn
        return (
            radius * x + xp.asarray(distance * np.cos(center)),
            radius * z + xp.asarray(distance * np.sin(center)),
        )

    def _along(self, name: str) -> NDArray[np.float64]:
        """(1, stations) a random curve along the yarns; it closes over the patch by itself."""
        yarn, place = self.layout.yarn, self.layout.position
        common = interpolated(getattr(self.draws, name), yarn, place)
        if self.variation is None:
            return common[None, :]
        change = interpolated(getattr(self.variation, name), yarn, place)
        return (common + self.variation.weight * change)[None, :]

    def _drawn(self, name: str, fiber: NDArray, *segment: NDArray) -> NDArray[np.float64]:
        """A draw for each fiber and station, the variant's changes included."""
        index = (self.yarn, fiber, *segment)
        common = getattr(self.draws, name)[index]
        if self.variation is None:
            return common
        return common + self.strength * getattr(self.variation, name)[index]
