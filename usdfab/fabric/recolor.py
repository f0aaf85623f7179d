"""New colours for yarns: ``warp=#204080``, ``#aa3322->#224488``.

Hex colours are sRGB, as people know them from colour pickers; three numbers are linear Rec. 709, as everywhere else.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import SYSTEMS, Color, FabricParameters, System, YarnParameters
from usdfab.srgb import linear_to_srgb, srgb_to_linear

TOLERANCE = 1.5 / 255.0
"""Two colours are one if no channel differs by more, in sRGB: hex codes are rounded."""

REMEDY = "write warp=#204080, weft=.1,.2,.5 (linear), both=..., '#aa3322->#224488' or 'warp:#aa3322->#224488'"


def parse_color(text: str, place: str = "") -> Color:
    """Linear Rec. 709 from ``#rgb`` or ``#rrggbb`` (sRGB) or from three linear numbers, ``".1,.2,.5"``.

    Raises
    ------
    UsdfabError
        For anything else, and numbers outside 0 to 1.
    """
    stripped = text.strip()
    code = re.fullmatch(r"#([0-9a-fA-F]{3}|[0-9a-fA-F]{6})", stripped)
    if code:
        digits = code[1] if len(code[1]) == 6 else "".join(2 * c for c in code[1])
        linear = srgb_to_linear(np.array([int(digits[k : k + 2], 16) for k in (0, 2, 4)]) / 255.0)
    else:
        try:
            linear = np.array([float(part) for part in stripped.split(",")])
        except ValueError:
            linear = np.zeros(0)
        if linear.shape != (3,) or not ((linear >= 0) & (linear <= 1)).all():
            raise UsdfabError(
                f"'{stripped}' is no colour",
                place=place,
                remedy="write #rrggbb (sRGB) or three numbers from 0 to 1 (linear)",
            )
    return float(linear[0]), float(linear[1]), float(linear[2])


def hex_color(color: Color) -> str:
    """``#rrggbb`` of a linear colour, rounded and clipped."""
    codes = np.round(255.0 * linear_to_srgb(np.clip(np.asarray(color), 0.0, 1.0))).astype(int)
    return "#" + "".join(f"{code:02x}" for code in codes)


def recolored(fabric: FabricParameters, changes: Sequence[str], place: str = "--recolor") -> FabricParameters:
    """``fabric`` with changes of colour, one after the other.

    ``warp=COLOR``, ``weft=COLOR``, ``both=COLOR`` dye all yarns of the systems, stripes included;
    ``COLOR->COLOR`` dyes the yarns that have the first colour, ``warp:COLOR->COLOR`` only among the warp.

    Raises
    ------
    UsdfabError
        For a change that is none of these, and where no yarn has the colour to be replaced.
    """
    for change in changes:
        fabric = _recolored_once(fabric, change.strip(), place)
    return fabric


def _recolored_once(fabric: FabricParameters, change: str, place: str) -> FabricParameters:
    old, arrow, new = change.partition("->")
    if not arrow:
        target, equals, color = change.partition("=")
        if not equals:
            raise UsdfabError(f"'{change}' is no change of colour", place=place, remedy=REMEDY)
        dye = parse_color(color, place)
        return fabric.with_systems(
            {s: replace(fabric.system(s), albedo=dye, yarn_albedo=()) for s in _systems(target, place)}
        )
    target, colon, color = old.rpartition(":")
    systems = _systems(target, place) if colon else SYSTEMS
    before, after = parse_color(color, place), parse_color(new, place)
    yarns = {s: _swapped(fabric.system(s), before, after) for s in systems}
    if all(yarns[s] is fabric.system(s) for s in systems):
        # A colour that stands only for stripes is not one that a yarn has.
        present = sorted({hex_color(c) for s in systems for c in fabric.system(s).colors()})
        raise UsdfabError(
            f"no yarn is {hex_color(before)}", place=place, remedy=f"the colours are {', '.join(present[:12])}"
        )
    return fabric.with_systems(yarns)


def _systems(name: str, place: str) -> tuple[System, ...]:
    systems = tuple(s for s in SYSTEMS if name.strip().lower() in (s, "both"))
    if not systems:
        raise UsdfabError(f"'{name.strip()}' is neither warp, weft nor both", place=place, remedy=REMEDY)
    return systems


def _swapped(yarn: YarnParameters, before: Color, after: Color) -> YarnParameters:
    """``yarn`` with one colour replaced; the same object where no yarn has it."""

    def swap(color: Color) -> Color:
        return after if _same(color, before) else color

    if not any(_same(c, before) for c in yarn.colors()):
        return yarn
    return replace(yarn, albedo=swap(yarn.albedo), yarn_albedo=tuple(swap(c) for c in yarn.yarn_albedo))


def _same(a: Color, b: Color) -> bool:
    return bool(np.abs(linear_to_srgb(np.asarray(a)) - linear_to_srgb(np.asarray(b))).max() <= TOLERANCE)
