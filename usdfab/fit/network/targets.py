"""What the network estimates of each yarn system, as numbers without bounds, and back.

Lengths are relative to the picture's side: a network cannot see how large it is. A number without meaning in a fabric
(one colour of a striped yarn, say) is masked and not learned from it.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, FabricParameters, YarnParameters

Floats = NDArray[np.float64]

_FLYAWAY_FLOOR = 0.1
"""Flyaways per cell that count as none: below, their logarithm would say more than a picture shows."""


@dataclass(frozen=True)
class Target:
    """One number of a yarn system.

    Parameters
    ----------
    name, symbol:
        As in the parameter table where it is one of it.
    encode:
        Of the yarn, its spacing and the picture's side, in metres: the number without bounds; ``None`` where it means
        nothing.
    decode:
        From that number to its units.
    """

    name: str
    symbol: str
    encode: Callable[[YarnParameters, float, float], float | None]
    decode: Callable[[Floats], Floats]


def _logit(value: float, low: float = 0.0, high: float = 1.0, margin: float = 1e-3) -> float:
    share = min(max((value - low) / (high - low), margin), 1.0 - margin)
    return math.log(share / (1.0 - share))


def _sigmoid(low: float = 0.0, high: float = 1.0) -> Callable[[Floats], Floats]:
    return lambda x: low + (high - low) / (1.0 + np.exp(-x))


def _color(channel: int) -> Callable[[YarnParameters, float, float], float | None]:
    return lambda yarn, spacing, side: None if yarn.yarn_albedo else _logit(yarn.albedo[channel])


_TWIST_SCALE = 0.05
"""Turns per cell up to which the twist's map is a straight line."""

TARGETS: tuple[Target, ...] = (
    Target("count", "n", lambda y, s, side: math.log(side / s), np.exp),
    # Height and width of the yarn over the spacing: what a picture shows, whatever its size. Width is cover.
    Target("height", "2 e n / L", lambda y, s, side: math.log(2.0 * y.radius / s), np.exp),
    Target("cover", "2 e f n / L", lambda y, s, side: math.log(2.0 * y.radius * y.flattening / s), np.exp),
    Target("fiber_count", "m", lambda y, s, side: math.log(y.fiber_count), np.exp),
    Target("packing", "packing", lambda y, s, side: _logit(y.packing), _sigmoid()),
    Target("inclination", "u_max", lambda y, s, side: _logit(y.inclination, 0.0, 1.57), _sigmoid(0.0, 1.57)),
    Target("crimp", "beta", lambda y, s, side: math.log(max(y.crimp, 0.05)), np.exp),
    Target(
        "twist", "alpha", lambda y, s, side: math.asinh(y.twist / _TWIST_SCALE), lambda x: _TWIST_SCALE * np.sinh(x)
    ),
    Target("plied", "plied", lambda y, s, side: float(y.ply_count > 1), lambda x: np.clip(x, 0.0, 1.0)),
    Target("irregularity", "Q", lambda y, s, side: math.sqrt(y.irregularity), np.square),
    Target("migration", "G", lambda y, s, side: _logit(y.migration), _sigmoid()),
    Target("migration_rate", "s", lambda y, s, side: math.log(max(y.migration_rate, 0.01)), np.exp),
    Target(
        "flyaways", "rho_fly L / n", lambda y, s, side: math.log(_FLYAWAY_FLOOR + y.flyaway_density * s),
        lambda x: np.maximum(np.exp(x) - _FLYAWAY_FLOOR, 0.0),
    ),
    Target("albedo_r", "C red", _color(0), _sigmoid()),
    Target("albedo_g", "C green", _color(1), _sigmoid()),
    Target("albedo_b", "C blue", _color(2), _sigmoid()),
    Target("roughness_longitudinal", "gamma_M", lambda y, s, side: _logit(y.roughness_longitudinal), _sigmoid()),
    Target("roughness_azimuthal", "gamma_N", lambda y, s, side: math.log(y.roughness_azimuthal), np.exp),
    Target("roughness_primary", "gamma_M0", lambda y, s, side: math.log(y.roughness_primary), np.exp),
)  # fmt: skip

NAMES = tuple(target.name for target in TARGETS)
INDEX = {name: k for k, name in enumerate(NAMES)}
REVISION = 1
"""Raised whenever a number of ``TARGETS`` means something else under the same name."""


def encode(fabric: FabricParameters) -> tuple[Floats, NDArray[np.bool_]]:
    """The numbers (2, P) of ``fabric``, rows as ``SYSTEMS``, columns as ``TARGETS``, and which have a meaning (2, P).

    The picture is taken to show the whole of ``fabric.size``.
    """
    values = np.zeros((len(SYSTEMS), len(TARGETS)))
    known = np.zeros(values.shape, dtype=bool)
    for row, (system, side) in enumerate(zip(SYSTEMS, fabric.size, strict=True)):
        yarn = fabric.system(system)
        for column, target in enumerate(TARGETS):
            value = target.encode(yarn, side / yarn.count, side)
            if value is not None:
                values[row, column], known[row, column] = value, True
    return values, known


def decode(values: Floats) -> dict[str, Floats]:
    """Numbers (..., P) in their units by name, each (...); also ``radius``, over the side, and ``flattening``."""
    found = {target.name: target.decode(values[..., k]) for k, target in enumerate(TARGETS)}
    found["radius"] = found["height"] / (2.0 * found["count"])
    found["flattening"] = np.maximum(found["cover"] / found["height"], 1.0)
    return found


def targets_hash() -> str:
    """Changes whenever weights for other targets would be misread."""
    return hashlib.sha256(repr((NAMES, REVISION)).encode()).hexdigest()[:16]
