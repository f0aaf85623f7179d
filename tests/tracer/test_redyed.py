"""Tiles whose fibers stay while their optics change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import fabric, swatch

from usdfab.fabric import FabricParameters
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.patch_scene import build_tiles, redyed

CLOTH = fabric("twill 2/2", variants=2, albedo_variation=0.4, flyaway_density=500.0)
STRIPES = replace(CLOTH, warp=replace(CLOTH.warp, yarn_albedo=((0.1,) * 3, (0.8, 0.3, 0.2), (0.1,) * 3)))


def with_warp(cloth: FabricParameters, **changes) -> FabricParameters:
    return replace(cloth, warp=replace(cloth.warp, **changes))


@pytest.mark.parametrize(
    ("cloth", "changes"),
    [
        (CLOTH, {"albedo": (0.2, 0.3, 0.9)}),
        (CLOTH, {"albedo_variation": 0.9, "roughness_azimuthal": 0.2}),
        (CLOTH, {"roughness_longitudinal": 0.2, "roughness_primary": 0.3, "ior": 1.4, "cuticle_tilt": 0.05}),
        (STRIPES, {"yarn_albedo": ((0.5,) * 3, (0.1, 0.2, 0.9), (0.5,) * 3)}),
    ],
)
def test_they_look_as_if_built_anew(cloth: FabricParameters, changes: dict) -> None:
    other = with_warp(cloth, **changes)
    tiles = redyed(build_tiles(cloth), cloth, other)
    assert tiles is not None
    scene, camera = swatch(other)
    settings = RenderSettings((16, 16), spp=2)
    again, anew = (t.render(camera, settings) for t in (Tracer(scene, build=lambda _: tiles), Tracer(scene)))
    np.testing.assert_array_equal(again.pixels, anew.pixels)
    np.testing.assert_array_equal(again.albedo, anew.albedo)


def test_other_fibers_and_yarns_that_part_are_built() -> None:
    tiles = build_tiles(STRIPES)
    for changes in (
        {"twist": 0.3},
        {"fiber_count": 13},
        {"albedo_variation": 0.0},
        {"yarn_albedo": ()},
        # Two yarns were of one colour, and would not be any more.
        {"yarn_albedo": ((0.5,) * 3, (0.1, 0.2, 0.9), (0.6,) * 3)},
    ):
        assert redyed(tiles, STRIPES, with_warp(STRIPES, **changes)) is None
