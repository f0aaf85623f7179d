"""The plain surface that is to look like the fibers: its means against closed forms, its fit against its targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import fabric

from usdfab.scattering.surface_numba import pack_surface
from usdfab.tracer.bake import BakedMaps, BakeSettings, bake
from usdfab.tracer.bake_look import (
    F0_TRIED,
    _bent,
    _lamp_lights,
    _mean_values,
    _sky_lights,
    f0_of,
    fit_look,
    ior_of,
    lamp_reflectance,
)

CLOTH = replace(fabric("plain", fibers=12), size=(3e-3, 3e-3))
MATT = pack_surface((1.0, 1.0, 1.0), 1.0, 0.0, None, 0.0, 0.01, 1.0)


@pytest.fixture(scope="module")
def maps() -> BakedMaps:
    return bake(CLOTH, BakeSettings((32, 0), rays=64))[0]


@pytest.mark.parametrize("lights", [_sky_lights(64), _lamp_lights()])
def test_a_flat_matt_sheet_has_its_albedo(lights) -> None:
    """Without reflection and with normals upright, both lights give back the albedo, times the weight."""
    albedo = np.array([[0.2, 0.4, 0.6], [0.4, 0.6, 0.8]])
    upright = np.tile([0.0, 0.0, 1.0], (2, 1))
    diffuse, shine = _mean_values(np.ones(2), upright, np.array([0.5, 0.5]), albedo, *lights, 0.0, MATT)
    assert shine == pytest.approx(0.0, abs=1e-12)
    assert diffuse == pytest.approx([0.3, 0.5, 0.7], rel=1e-9)


def test_a_leaning_matt_sheet_sees_less_sky() -> None:
    """A plane tilted by t receives (1 + cos t) / 2 of the upper half of a uniform sky."""
    for tilt in (0.3, 0.8):
        normal = np.array([[np.sin(tilt), 0.0, np.cos(tilt)]])
        diffuse, _ = _mean_values(np.ones(1), normal, np.ones(1), np.ones((1, 3)), *_sky_lights(4096), 0.0, MATT)
        assert diffuse == pytest.approx(np.full(3, (1.0 + np.cos(tilt)) / 2.0), rel=5e-3)


def test_index_and_reflectance_are_inverse() -> None:
    for f0 in F0_TRIED:
        assert f0_of(ior_of(f0)) == pytest.approx(f0)
    assert f0_of(1.5) == pytest.approx(0.04)


def test_normals_lean_less_but_to_the_same_side() -> None:
    normal = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    half = _bent(normal, 0.5)
    assert np.linalg.norm(half, axis=1) == pytest.approx(1.0)
    assert half[0, 0] / half[0, 2] == pytest.approx(0.375) and half[1, 1] / half[1, 2] == pytest.approx(-0.375)


def test_the_fit_meets_sky_and_lamp(maps: BakedMaps) -> None:
    look = fit_look(CLOTH, maps)
    assert np.abs(look.error).max() < 0.06
    assert 1.2 < look.ior < 2.0 and 0.1 < look.strength <= 1.0
    assert look.albedo.shape == maps.reflectance.shape and look.albedo.max() <= 1.0
    # The same pattern, channel by channel only brighter or darker.
    factor = look.albedo / np.maximum(maps.reflectance, 1e-6)
    assert np.ptp(factor[maps.reflectance.min(axis=-1) > 0.01], axis=0).max() < 1e-3


def test_the_lamp_of_the_rig_is_brighter_than_the_sky(maps: BakedMaps) -> None:
    """Fibers reflect towards where the light comes from more than to the sides."""
    lamp = lamp_reflectance(CLOTH, spp=16)
    assert np.all(lamp > 0.9 * maps.mean_reflectance) and np.all(lamp < 3.0 * maps.mean_reflectance)
