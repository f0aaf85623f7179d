"""Whether a fabric could exist: yarns that share space, fibers that do not fit, sizes no textile has.

Everything here can be generated and rendered; that is why these are warnings. Lengths are metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from usdfab.fabric.fabric import SYSTEMS, FabricParameters, System
from usdfab.fabric.parameters import PARAMETER_BY_NAME, YARN_PARAMETERS
from usdfab.fabric.plies import ply_fill

DENSEST = math.pi / (2.0 * math.sqrt(3.0))
"""Share of a plane that equal circles can cover at most: the hexagonal packing (Thue), 0.907."""
FIBER_RADII = PARAMETER_BY_NAME["fiber_radius"].soft
"""Radii that textile fibers have: 2 um (microfiber) to 50 um (coarse wool, jute)."""
LOOSE = 1.5
"""Distance of two crossing yarns' centres over the sum of their radii above which they float freely."""
_ROUNDING = 1e-3


@dataclass(frozen=True)
class Doubt:
    """Something implausible: a stable name, the yarn system and parameter to look at, what is wrong, what to do."""

    rule: str
    system: System
    parameter: str
    message: str
    remedy: str


def doubts(fabric: FabricParameters) -> list[Doubt]:
    """Everything about ``fabric`` that no real cloth has; empty for a plausible one."""
    found = [doubt for system in SYSTEMS for doubt in _system_doubts(fabric, system)]
    return found + list(_crossings(fabric))


def unusual(fabric: FabricParameters) -> list[Doubt]:
    """Values outside of the table's ``soft`` range, where real fabrics lie; parameters that are not in use are not."""
    found = []
    for system in SYSTEMS:
        yarn = fabric.system(system)
        idle = {"count", "fiber_radius", *(() if yarn.fiber_radius == 0 else ("packing",))}
        idle |= {"ply_twist"} if yarn.ply_count == 1 else set()
        idle |= set() if yarn.flyaway_density else {p.name for p in YARN_PARAMETERS if p.name.startswith("flyaway_")}
        for p in YARN_PARAMETERS:
            if p.kind in ("color", "colors") or p.name in idle:
                continue
            value, (low, high) = getattr(yarn, p.name), p.soft
            if not low <= value <= high:
                unit = "" if p.unit == "1" else f" {p.unit}"
                message = f"{value:g}{unit} is unusual; real fabrics have {low:g} to {high:g}"
                found.append(Doubt("unusual", system, p.name, message, ""))
    return found


def fiber_fill(fabric: FabricParameters, system: System) -> float:
    """Area of a yarn's fibers over that of its cross-section (of its plies)."""
    yarn = fabric.system(system)
    area = yarn.radius**2 * yarn.flattening * ply_fill(yarn.ply_count)
    return yarn.fiber_count * yarn.effective_fiber_radius**2 / area


def _system_doubts(fabric: FabricParameters, system: System) -> Iterator[Doubt]:
    yarn = fabric.system(system)
    spacing = fabric.cell[0] if system == "warp" else fabric.cell[1]
    width, round_width = 2.0 * yarn.radius * yarn.flattening, 2.0 * yarn.radius * math.sqrt(yarn.flattening)
    cover = width / spacing
    if round_width > spacing * (1.0 + _ROUNDING):
        yield Doubt(
            "interpenetration", system, "radius",
            f"yarns of this cross-section are {round_width * 1e3:.3g} mm wide even when round, and only "
            f"{spacing * 1e3:.3g} mm apart: neighbours interpenetrate whatever their flattening",
            "lower the radius or the count",
        )  # fmt: skip
    elif cover > 1.0 + _ROUNDING:
        yield Doubt(
            "cover", system, "flattening",
            f"the cover is {cover:.3g}: yarns are {width * 1e3:.3g} mm wide and {spacing * 1e3:.3g} mm apart, so that "
            "neighbours share space",
            "lower the flattening, the radius or the count",
        )  # fmt: skip
    fill = fiber_fill(fabric, system)
    if fill > DENSEST:
        parameter = "fiber_radius" if yarn.fiber_radius > 0 else "packing"
        yield Doubt(
            "packing", system, parameter,
            f"the fibers fill {100.0 * fill:.3g} % of the yarn's cross-section; at most {100.0 * DENSEST:.3g} % fit",
            f"lower the {parameter} or the fiber_count" if parameter == "fiber_radius" else "lower the packing",
        )  # fmt: skip
    radius, (low, high) = yarn.effective_fiber_radius, FIBER_RADII
    # A monofilament is one thick fiber.
    if yarn.fiber_count > 1 and not low <= radius <= high:
        given = "" if yarn.fiber_radius > 0 else ", as follows from packing and fiber_count"
        yield Doubt(
            "fiberRadius", system, "fiber_radius" if yarn.fiber_radius > 0 else "fiber_count",
            f"a fiber radius of {radius * 1e6:.3g} um{given}; textile fibers have {low * 1e6:g} to {high * 1e6:g} um",
            "raise the fiber_count" if radius > high else "lower the fiber_count",
        )  # fmt: skip


def _crossings(fabric: FabricParameters) -> Iterator[Doubt]:
    """Warp and weft where they cross: their centres are crimp * radius above and below the middle."""
    warp, weft = fabric.warp, fabric.weft
    apart = warp.crimp * warp.radius + weft.crimp * weft.radius
    ratio = apart / (warp.radius + weft.radius)
    fill = fiber_fill(fabric, "warp") + fiber_fill(fabric, "weft")
    if ratio > LOOSE:
        yield Doubt(
            "crimp", "warp", "crimp",
            f"crossing yarns are {apart * 1e3:.3g} mm apart, {ratio:.3g} times their radii together: they do not touch",
            "lower the crimp of warp or weft",
        )  # fmt: skip
    # Loose yarns press into each other where they cross; fibers of dense ones have nowhere to go.
    if ratio < 1.0 - _ROUNDING and fill > DENSEST:
        yield Doubt(
            "interpenetration", "warp", "crimp",
            f"crossing yarns overlap by {100.0 * (1.0 - ratio):.2g} % of their height, and their fibers together fill "
            f"{100.0 * fill:.3g} % of the space they share; at most {100.0 * DENSEST:.3g} % fit",
            "raise the crimp or lower the packing",
        )  # fmt: skip
