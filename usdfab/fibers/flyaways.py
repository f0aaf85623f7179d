"""Flyaways: fibers that stand off a yarn, as hairs with a free end or as loops (Zhao, Luan, Bala 2016).

A flyaway starts inside the yarn, runs along its helix, lifts off and goes its own way: a curve of unit speed whose
direction is given by its angle off the surface and its angle sideways, both smooth and random. The more it has risen,
the less it follows the yarn's twist and centre line. A hair ends in the air; a loop comes back and ends in the yarn.

Notation: ``x`` in [0, 1] along the part outside, ``h`` height above the place where it lifts off, ``y`` along the yarn
in cells. Arrays have shape (flyaways, vertices). Every number is a hash of (seed, system, yarn, flyaway, variant).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, System, YarnParameters, ply_circles
from usdfab.fibers.centerline import unit_centerline
from usdfab.fibers.draws import Draws
from usdfab.fibers.fibers import closed_twist
from usdfab.fibers.randomness import normal, uniform
from usdfab.fibers.segments import Layout
from usdfab.fibers.unevenness import THINNEST, interpolated

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LENGTH_SPREAD = 0.4
"""Standard deviation of the logarithm of a flyaway's length."""

ROOT_DEPTH = 0.8
"""Where flyaways lift off, in radii of their ply: below the surface, so that no cut end shows."""

EMBEDDED = 0.6
"""Length of each end that lies in the yarn, in yarn radii."""

CURL = 1.3
"""How far flyaways bend sideways, radians."""

MAX_PER_YARN = 20_000
"""More flyaways than this on one yarn of the patch are refused."""

_FLYAWAY = 9
"""Channel that keeps these draws apart from those of the fibers."""


@dataclass(frozen=True)
class OpenCurves:
    """Curves with two free ends, in contrast to a ``FiberSystem``'s, which go on for ever.

    Each starts at a yarn of the patch and may reach beyond the patch; it repeats with the patch like everything else.

    Parameters
    ----------
    points: (N, 3) float64, metres
        Control points of all curves, one curve after the other.
    offsets: (curves + 1,) int64
        First point of each curve.
    yarn, number: (curves,) int64
        Which yarn of the patch it stands on, which flyaway of the yarn.
    loop: (curves,) bool
        Whether it returns to the yarn.
    radius: metres
        Radius of the fibers.
    albedo: (curves, 3)
        Fiber albedo coefficient C, linear Rec. 709.
    """

    system: System
    points: Floats
    offsets: Ints
    yarn: Ints
    number: Ints
    loop: NDArray[np.bool_]
    radius: float
    albedo: Floats

    @property
    def curves(self) -> int:
        """Number of curves."""
        return len(self.yarn)

    def pinned(self) -> tuple[Floats, Ints]:
        """Control points with one more at each end, so that the cubic B-spline starts and ends at the own end points.

        Returns
        -------
        points: (N + 2 curves, 3) metres, offsets: (curves + 1,)
        """
        first, last = self.offsets[:-1], self.offsets[1:] - 1
        before = 2.0 * self.points[first] - self.points[first + 1]
        after = 2.0 * self.points[last] - self.points[last - 1]
        offsets = self.offsets + 2 * np.arange(len(self.offsets))
        points = np.empty((offsets[-1], 3))
        own = np.ones(len(points), dtype=bool)
        own[offsets[:-1]] = own[offsets[1:] - 1] = False
        points[own], points[offsets[:-1]], points[offsets[1:] - 1] = self.points, before, after
        return points, offsets

    @cached_property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest place of each curve's surface, (curves, 3) each, metres."""
        if not self.curves:
            return np.zeros((0, 3)), np.zeros((0, 3))
        starts = self.offsets[:-1]
        low, high = np.minimum.reduceat(self.points, starts), np.maximum.reduceat(self.points, starts)
        return low - self.radius, high + self.radius


def flyaway_counts(density: float, length: float, yarns: int, seed: int, system: System) -> Ints:
    """(yarns,) flyaways on each yarn of ``length`` metres: ``density * length`` on average, rounded at random.

    Raises
    ------
    UsdfabError
        For more than ``MAX_PER_YARN`` on a yarn.
    """
    if density * length > MAX_PER_YARN:
        raise UsdfabError(
            f"{density:g} flyaways a metre are {density * length:.3g} on each yarn of the patch, above {MAX_PER_YARN}",
            place=f"{system}.flyaway_density",
        )
    place = SYSTEMS.index(system)
    return np.floor(density * length + uniform(seed, place, np.arange(yarns), _FLYAWAY)).astype(np.int64)


def flyaway_offsets(
    yarn: YarnParameters,
    layout: Layout,
    draws: Draws,
    owner: Ints,
    number: Ints,
    along_cell: float,
    vertices: int,
    seed: int,
    variant: int = 0,
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Places of flyaways relative to the straight axis of their yarn.

    Parameters
    ----------
    owner, number: (flyaways,)
        The yarn of the patch, and the flyaway's number on it.
    along_cell: metres
        Length of a cell along the yarns.
    vertices:
        Vertices on each flyaway.

    Returns
    -------
    along, across, height: (flyaways, vertices) metres, loop: (flyaways,)
        ``along`` from the start of the patch; each flyaway lifts off within it.
    """
    key = (seed, SYSTEMS.index(layout.system), owner, number, variant, _FLYAWAY)
    loop = uniform(*key, 0) < yarn.flyaway_loop_fraction
    length = yarn.flyaway_length * np.exp(LENGTH_SPREAD * (normal(*key, 1) - 0.5 * LENGTH_SPREAD))
    backwards = uniform(*key, 2) < 0.5

    # Vertices at equal steps of arc length: embedded, outside, and for loops embedded again.
    embedded = EMBEDDED * yarn.radius
    total = length + embedded * (1.0 + loop)
    arc = total[:, None] * np.linspace(0.0, 1.0, vertices) - embedded
    step = (total / (vertices - 1))[:, None]
    x = np.clip(arc / length[:, None], 0.0, 1.0)

    rise, turn = _directions(x, loop, yarn.flyaway_spread, key)
    h = _integral(np.sin(rise), step)
    # A loop comes down to where it rose from.
    h = np.where(loop[:, None], h - x * h[:, -1:], h)
    forward = _integral(np.cos(rise) * np.cos(turn), step)
    sideways = _integral(np.cos(rise) * np.sin(turn), step)
    sign = np.where(backwards, -1.0, 1.0)[:, None]
    lift_off = along_cell * layout.length * uniform(*key, 3)[:, None]
    # Integrals start at the embedded end; the part outside starts at arc 0.
    origin = np.take_along_axis(forward, np.argmin(np.abs(arc), axis=1)[:, None], axis=1)
    along = lift_off + sign * (forward - origin)

    # How far along the yarn it still follows it.
    follow = np.exp(-np.maximum(h, 0.0) / yarn.radius)
    steps = np.diff(along, axis=1) * 0.5 * (follow[:, 1:] + follow[:, :-1])
    y = (along[:, :1] + np.c_[np.zeros(len(arc)), np.cumsum(steps, axis=1)]) / along_cell

    across, height = _place(yarn, layout, draws, owner, y, lift_off / along_cell, h, sideways, key)
    return along, across, height, loop


def _integral(speed: Floats, step: Floats) -> Floats:
    """Running integral by the trapezoidal rule, 0 at the first vertex."""
    return step * np.c_[np.zeros(len(speed)), np.cumsum(0.5 * (speed[:, 1:] + speed[:, :-1]), axis=1)]


def _directions(x: Floats, loop: NDArray[np.bool_], spread: float, key: tuple) -> tuple[Floats, Floats]:
    """Angle off the yarn's surface and angle sideways along the flyaways, radians; both 0 at arc 0."""
    upright = 0.5 * math.pi * np.clip(spread * (0.5 + uniform(*key, 4)), 0.0, 1.0)[:, None]
    t = np.clip(2.0 * x, 0.0, 1.0)
    lifting = t * t * (3.0 - 2.0 * t)
    bend = [CURL * normal(*key, channel)[:, None] / mode for mode, channel in ((1, 5), (2, 6), (3, 7), (1, 8), (2, 9))]
    wave = [np.sin(math.pi * mode * x) for mode in (1, 2, 3)]
    # Hairs nod a little while they rise; loops go down as they went up.
    hair = upright * lifting * (1.0 + 0.3 * (bend[3] * wave[0] + bend[4] * wave[1]))
    rise = np.where(loop[:, None], upright * np.sin(2.0 * math.pi * x), hair)
    turn = bend[0] * (1.0 - np.cos(math.pi * x)) / 2.0 + bend[1] * wave[1] / 2.0 + bend[2] * wave[2] / 2.0
    return rise, np.where(loop[:, None], bend[1] * wave[1], turn)


def _place(
    yarn: YarnParameters,
    layout: Layout,
    draws: Draws,
    owner: Ints,
    y: Floats,
    y_root: Floats,
    h: Floats,
    sideways: Floats,
    key: tuple,
) -> tuple[Floats, Floats]:
    """Across and height in metres of places ``h`` above the root and ``sideways`` of it, at ``y`` cells."""
    plies = yarn.ply_count
    ply_radius, distance = ply_circles(plies)
    ply_radius, distance = ply_radius * yarn.radius, distance * yarn.radius
    root = ROOT_DEPTH * ply_radius
    ply = np.floor(plies * uniform(*key, 10))[:, None]
    twist = yarn.twist if plies == 1 else closed_twist(yarn.twist, layout.length, plies)
    center = 2.0 * math.pi * (twist * y + ply / plies) + draws.phase[owner][:, None]
    # The outside of a ply is what looks away from the yarn's axis.
    start = 2.0 * math.pi * (uniform(*key, 11)[:, None] - 0.5) * (1.0 if plies == 1 else 0.6)
    if plies > 1:
        start = start + 2.0 * math.pi * (twist * y_root + ply / plies) + draws.phase[owner][:, None]
    own_twist = yarn.twist if plies == 1 else yarn.ply_twist
    angle = start + 2.0 * math.pi * own_twist * (y - y_root) + sideways / (root + np.maximum(h, 0.0))
    thickness, wander = _uneven(yarn, draws, owner[:, None], y)
    across = yarn.flattening * thickness * (distance * np.cos(center) + root * np.cos(angle)) + h * np.cos(angle)
    across = across + yarn.flattening * yarn.radius * wander
    height = thickness * (distance * np.sin(center) + root * np.sin(angle)) + h * np.sin(angle)
    return across, height + yarn.crimp * yarn.radius * _centerlines(yarn, layout, owner, y)


def _uneven(yarn: YarnParameters, draws: Draws, owner: Ints, y: Floats) -> tuple[Floats, Floats]:
    """Thickness of the yarns over its mean, and their sideways place in half widths, at ``y`` cells.

    Those of variant 0: in the others a yarn that wanders otherwise carries its flyaways a fraction of its width off.
    """
    thickness = np.maximum(1.0 + yarn.unevenness * interpolated(draws.thickness, owner, y), THINNEST)
    return thickness, yarn.waviness * interpolated(draws.wander, owner, y)


def _centerlines(yarn: YarnParameters, layout: Layout, owner: Ints, y: Floats) -> Floats:
    """Height of the yarns' centre lines at ``y`` cells, in units of their greatest height."""
    unit = layout.side * unit_centerline(layout.y, layout.segment_length, yarn.inclination)
    out = np.empty_like(y)
    for k in np.unique(owner):
        own = slice(layout.first[k], layout.first[k + 1])
        mine = owner == k
        out[mine] = np.interp(y[mine], layout.position[own], unit[own], period=layout.length)
    return out
