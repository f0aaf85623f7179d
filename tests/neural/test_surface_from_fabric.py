"""The way from fibers to a surface: signs and sizes against the fibers themselves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.presets import PRESETS, preset
from usdfab.fabric.weave import weave_from_name
from usdfab.fibers import generate_patch
from usdfab.neural.aggregation import aggregate
from usdfab.neural.surface_albedos import TILTS, Observation, fit_reflection, fitted, lamp_at, measured_albedos
from usdfab.neural.surface_from_fabric import (
    INCLINATIONS,
    fiber_reflectance,
    inclination_of_slope,
    slope_of_inclination,
    surface_from_fabric,
)
from usdfab.neural.surface_swatch import View, swatch_view
from usdfab.usd.rig import rig_for


def cloth(**yarn) -> FabricParameters:
    numbers = {"count": 10, "radius": 1.8e-4, "irregularity": 0.0, "migration": 0.0, "fiber_count": 60} | yarn
    both = YarnParameters(**numbers)
    return FabricParameters(weave_from_name("plain"), (5e-3, 5e-3), both, both)


@pytest.mark.parametrize("turns", [0.15, -0.1])
@pytest.mark.parametrize("system", ["warp", "weft"])
def test_the_twist_is_that_of_the_fibers_on_top(turns: float, system: str) -> None:
    """Fibers of a real patch, where they lie on the yarn's crest, run as the surface's orientation says."""
    fabric = cloth(twist=turns, crimp=0.0)
    material, _ = surface_from_fabric(fabric)
    found = next(s for s in generate_patch(fabric).systems if s.system == system)
    leans = []
    for first, last in zip(found.offsets[:-1], found.offsets[1:], strict=True):
        points = found.points[first:last]
        step = np.diff(points, axis=0)
        top = points[:-1, 2] > 0.9 * fabric.warp.radius
        along, across = (1, 0) if system == "warp" else (0, 1)
        sign = 1.0 if system == "warp" else -1.0  # the surface's across axis of the weft is -y
        leans.extend(sign * step[top, across] / step[top, along])
    psi = material.twist[0 if system == "warp" else 1]
    assert len(leans) > 20
    assert -math.tan(psi) == pytest.approx(float(np.median(leans)), rel=0.2)


def test_the_cross_section_has_the_fibers_crest() -> None:
    """Near the crest, an ellipse of half axes e f and e and the surface's profile rise and fall alike."""
    fabric = cloth(crimp=0.1, flattening=1.3)
    material, _ = surface_from_fabric(fabric)
    x = 0.15 * fabric.warp.radius * 1.3
    ellipse = fabric.warp.radius * (math.sqrt(1 - 0.15**2) - 1)
    cell = fabric.cell[0]
    surface = material.height_scale * cell / math.pi * math.log(math.cos(math.pi * x / cell))
    assert surface == pytest.approx(ellipse, rel=0.02)
    assert material.gap == pytest.approx(1 - 2 * 1.8e-4 * 1.3 / cell)


def test_steeper_arches_lean_more() -> None:
    leans = [surface_from_fabric(cloth(crimp=crimp, inclination=0.3))[0] for crimp in (0.25, 0.45, 0.7)]
    assert leans[0].inclination[0] < leans[1].inclination[0] <= leans[2].inclination[0]
    for slope in (0.2, 0.3, 0.5):
        assert slope_of_inclination(inclination_of_slope(slope)) == pytest.approx(slope, rel=1e-6)
    u = np.linspace(-0.6, 0.6, 20001)
    assert slope_of_inclination(0.6) == pytest.approx(float(np.sqrt(np.mean(np.tan(u) ** 2))), rel=1e-3)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_has_a_surface_that_networks_know(name: str) -> None:
    fabric = preset(name)
    material, albedos = surface_from_fabric(fabric)
    assert np.array_equal(material.weave, fabric.weave.matrix == 0)
    assert all(INCLINATIONS[0] <= u <= INCLINATIONS[1] + 1e-9 for u in material.inclination)
    assert 0.1 <= material.roughness <= 1.0 and 0.0 < material.height_scale <= 2.0
    for matrix in (albedos.reflection, albedos.transmission):
        assert matrix.shape == (4, 3) and np.all((matrix >= 0) & (matrix <= 1))
    # The darker system stays the darker.
    colors = [np.mean(fabric.system(s).colors(), axis=0) for s in ("warp", "weft")]
    assert np.array_equal(np.sign(colors[0] - colors[1]), np.sign(albedos.reflection[0] - albedos.reflection[1]))


def test_smoother_fibers_make_a_smoother_surface() -> None:
    smooth, rough = (surface_from_fabric(cloth(roughness_primary=g))[0].roughness for g in (0.2, 0.5))
    assert smooth < rough
    wavy = surface_from_fabric(cloth(roughness_primary=0.2, irregularity=0.4))[0].roughness
    assert wavy > smooth


def test_what_a_fiber_reflects() -> None:
    """At normal incidence Fresnel is ((n - 1) / (n + 1))^2; over the width of a fiber it is more, and less than 1."""
    assert fiber_reflectance(1.0) == pytest.approx(0.0, abs=1e-9)
    assert 0.0465 < fiber_reflectance(1.55) < 0.12


def test_the_fit_finds_albedos_that_are_there() -> None:
    """From pictures that the surface itself made, colours and gloss come back; below 0 nothing goes."""
    fabric = cloth()
    material, _ = surface_from_fabric(fabric)
    rig = rig_for(fabric.size)

    def components(view: View) -> np.ndarray:
        return aggregate(material, view.queries, samples=64).astype(np.float64)

    truth = np.array([[0.2, 0.5, 0.9], [0.7, 0.0, 0.3], [0.1] * 3, [0.3] * 3])
    observations = []
    for tilt in TILTS:
        view = swatch_view(fabric, rig, (30, 30), lamp_at(rig, *tilt))
        observations.append(Observation(view, view.picture(components(view) @ truth)))
    assert np.allclose(fit_reflection(components, observations), truth, atol=2e-3)

    parts = components(observations[0].view)
    seen = parts @ truth
    assert np.allclose(fitted(parts, seen, truth[2:]), truth[:2], atol=1e-6)
    darker = fitted(parts, seen - 0.2 * parts[:, 1:2], truth[2:])
    assert darker[1, 1] == 0.0 and darker.min() == 0.0


def test_the_lamps_of_a_measurement_are_equally_far() -> None:
    rig = rig_for((5e-3, 5e-3))
    places = np.array([lamp_at(rig, *tilt) for tilt in TILTS])
    assert np.allclose(np.linalg.norm(places, axis=1), np.linalg.norm(rig.light_position))
    assert np.allclose(places[0], rig.light_position)
    assert places[1][0] > 0.7 * np.linalg.norm(places[1]) and places[2][1] > 0.7 * np.linalg.norm(places[2])


def test_measured_albedos_follow_the_dye() -> None:
    """A red warp and a blue weft under the rig: each system of the surface gets the colour of its fibers."""
    fabric = cloth(fiber_count=20)
    dyed = replace(
        fabric,
        size=(2e-3, 2e-3),
        warp=replace(fabric.warp, count=4, albedo=(0.8, 0.1, 0.1)),
        weft=replace(fabric.weft, count=4, albedo=(0.1, 0.1, 0.8)),
    )
    albedos = measured_albedos(dyed, paths=20_000, threads=1)
    for matrix in (albedos.reflection, albedos.transmission):
        warp, weft = matrix[0], matrix[1]
        assert warp[0] > 1.5 * warp[1] and weft[2] > 1.5 * weft[1]
        assert warp[0] > warp[2] and weft[2] > weft[0]
    assert np.array_equal(albedos.transmission[2:], surface_from_fabric(dyed)[1].transmission[2:])
    assert np.ptp(albedos.reflection[2:], axis=1).max() == 0.0
