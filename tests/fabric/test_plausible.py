"""Plausibility against sums done by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.plausible import DENSEST, doubts, fiber_fill, unusual
from usdfab.fabric.presets import PRESETS, preset

# 10 yarns in 5 mm: 0.5 mm apart, 0.4 mm wide.
YARN = YarnParameters(count=10, radius=2e-4, crimp=1.0, fiber_count=200)
CLOTH = FabricParameters(warp=YARN, weft=YARN)


def rules(fabric):
    return {(d.rule, d.system) for d in doubts(fabric)}


def warp(**changes):
    return replace(CLOTH, warp=replace(YARN, **changes))


def test_a_sound_cloth():
    assert doubts(CLOTH) == unusual(CLOTH) == []


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"flattening": 1.25}, set()),  # exactly closed
        ({"flattening": 1.27}, {("cover", "warp")}),
        # Round, a yarn of this section is 2 * 0.2 * sqrt(1.57) = 0.501 mm wide.
        ({"flattening": 1.57}, {("interpenetration", "warp")}),
        ({"packing": 0.9}, set()),
        ({"packing": 0.92}, {("packing", "warp")}),
        ({"crimp": 1.9}, set()),
        ({"crimp": 2.1}, {("crimp", "warp")}),
        # Half as high as two yarns side by side: loose yarns press into each other, dense ones cannot.
        ({"crimp": 0.0}, set()),
        ({"crimp": 0.0, "packing": 0.6}, {("interpenetration", "warp")}),
        ({"fiber_radius": 1.5e-6}, {("fiberRadius", "warp")}),
        ({"fiber_radius": 6e-5, "fiber_count": 2}, {("fiberRadius", "warp")}),
        ({"fiber_radius": 2e-4, "fiber_count": 1, "packing": 1.0}, {("packing", "warp")}),
        ({"fiber_radius": 1.9e-4, "fiber_count": 1}, set()),  # a monofilament
        ({"fiber_radius": 1.5e-5, "fiber_count": 200}, {("packing", "warp")}),
    ],
)
def test_each_doubt(changes, expected):
    fabric = warp(**changes)
    if changes == {"fiber_radius": 1.9e-4, "fiber_count": 1}:
        # 0.9025 of the section; what the crossing shares is another matter, at a crimp of 1 nothing.
        assert fiber_fill(fabric, "warp") == pytest.approx(0.9025)
    assert rules(fabric) == expected


def test_the_densest_packing_is_that_of_hexagons():
    # One circle of radius 1 in each hexagon of width 2.
    assert pytest.approx(math.pi / (6 / math.sqrt(3))) == DENSEST


@given(st.integers(1, 4), st.floats(0.05, 1.0), st.floats(0.3, 4.0), st.integers(1, 400))
def test_derived_fibers_fill_what_the_packing_says(plies, packing, flattening, fibers):
    fabric = warp(ply_count=plies, packing=packing, flattening=flattening, fiber_count=fibers)
    assert fiber_fill(fabric, "warp") == pytest.approx(packing)


def test_presets():
    found = {name: {d.rule for d in doubts(preset(name))} for name in PRESETS}
    # Dense satins have yarns that ride up on each other: their covers are 1.05.
    assert found == {n: {"cover"} if n in ("silk-satin", "cotton-sateen") else set() for n in PRESETS}


def test_unusual_values_of_what_is_in_use():
    assert [(d.system, d.parameter) for d in unusual(warp(flattening=5.0))] == [("warp", "flattening")]
    assert unusual(warp(ply_twist=3.0, flyaway_spread=0.0)) == []
    assert {d.parameter for d in unusual(warp(ply_count=2, ply_twist=3.0))} == {"ply_twist"}
    assert {d.parameter for d in unusual(warp(flyaway_density=10.0, flyaway_spread=0.0))} == {"flyaway_spread"}
