"""A fabric between two others.

Lengths, numbers of yarns and fibers, and other scales are mixed by their logarithms (half-way between 0.1 and 0.4 mm is
0.2 mm), everything else linearly, colours as linear light. What comes in kinds (the weave, plies with their twist, the
albedo map, seed, name, variants) is that of the nearer fabric, of the first at 0.5.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import SYSTEMS, Color, FabricParameters, Provenance, YarnParameters
from usdfab.fabric.parameters import YARN_PARAMETERS, Parameter
from usdfab.fabric.weave import MAX_REPEAT

SCALES = ("count", "flattening", "fiber_count")
"""Parameters without a unit of length that are scales all the same."""

KINDS = ("ply_count", "twist", "ply_twist")
"""Taken together from the nearer fabric: with plies, twist means something else than without."""


def mixed(first: FabricParameters, second: FabricParameters, amount: float) -> FabricParameters:
    """The fabric at ``amount`` between ``first`` (0) and ``second`` (1).

    Raises
    ------
    UsdfabError
        For an amount outside [0, 1].
    """
    if not 0.0 <= amount <= 1.0:
        raise UsdfabError(f"{amount:g} is not between 0 (the first fabric) and 1 (the second)", place="--mix")
    if amount in (0.0, 1.0):
        return second if amount else first
    nearer = first if amount <= 0.5 else second
    yarns = {s: _mixed_yarn(first.system(s), second.system(s), amount) for s in SYSTEMS}
    size = tuple(_log(a, b, amount) for a, b in zip(first.size, second.size, strict=True))
    source = f"{1 - amount:g} {first.name} + {amount:g} {second.name}"
    return replace(nearer, size=size, provenance=Provenance(source=source, stages=("mix",)), **yarns)  # type: ignore[arg-type]


def _mixed_yarn(first: YarnParameters, second: YarnParameters, amount: float) -> YarnParameters:
    nearer = first if amount <= 0.5 else second
    values: dict[str, Any] = {}
    for p in YARN_PARAMETERS:
        a, b = getattr(first, p.name), getattr(second, p.name)
        if p.name in KINDS or p.kind == "colors":
            values[p.name] = getattr(nearer, p.name)
        elif p.kind == "color":
            values[p.name] = _mixed_color(a, b, amount)
        else:
            values[p.name] = _mixed_number(p, a, b, amount)
    if 0.0 in (first.fiber_radius, second.fiber_radius) and first.fiber_radius != second.fiber_radius:
        # 0 is no length, it stands for the radius that follows from the packing.
        values["fiber_radius"] = _log(first.effective_fiber_radius, second.effective_fiber_radius, amount)
    if first.yarn_albedo or second.yarn_albedo:
        values["yarn_albedo"] = _mixed_stripes(first.colors(), second.colors(), amount)
    return YarnParameters(**values)


def _mixed_number(p: Parameter, a: float, b: float, amount: float) -> float:
    scale = p.unit in ("m", "1/m") or p.name in SCALES
    value = _log(a, b, amount) if scale and a > 0 and b > 0 else _linear(a, b, amount)
    return round(value) if p.kind == "int" else value


def _mixed_stripes(first: tuple[Color, ...], second: tuple[Color, ...], amount: float) -> tuple[Color, ...]:
    """Both sequences side by side until both repeat; where that takes too long, the nearer one."""
    length = math.lcm(len(first), len(second))
    if length > MAX_REPEAT:
        return first if amount <= 0.5 else second
    pairs = ((first[k % len(first)], second[k % len(second)]) for k in range(length))
    return tuple(_mixed_color(a, b, amount) for a, b in pairs)


def _mixed_color(a: Color, b: Color, amount: float) -> Color:
    red, green, blue = (_linear(x, y, amount) for x, y in zip(a, b, strict=True))
    return red, green, blue


def _linear(a: float, b: float, amount: float) -> float:
    # Rounding must not lead outside of the two: ranges are checked.
    return float(np.clip((1.0 - amount) * a + amount * b, min(a, b), max(a, b)))


def _log(a: float, b: float, amount: float) -> float:
    return float(np.clip(math.exp((1.0 - amount) * math.log(a) + amount * math.log(b)), min(a, b), max(a, b)))
