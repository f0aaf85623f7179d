"""Shortcuts of light sampling are free of bias: shadow roulette, weights of single lobes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scenes
from scenes import cloth_material, fabric, look, plane

from usdfab.scattering.fiber_numba import pack_fiber, prepare_fiber, sample_fiber, sample_fiber_lobe
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import DistantLight, PointLight, SphereLight


def mean_and_error(scene, camera, spp, seed=0, depth=24):
    render = Tracer(scene).render(camera, RenderSettings((24, 24), spp=spp, max_depth=depth, seed=seed))
    return render.pixels.mean(axis=(0, 1), dtype=float), np.sqrt(render.variance.sum(axis=(0, 1))) / render.alpha.size


PLACE = np.array([0.05, 0.1, 0.2])
SUN = np.array([0.36, 0.48, -0.8])
PAIRS = {
    # (no light has an extent: single lobes' weights, no weighing of two techniques; its like with an extent)
    "point": (
        PointLight("/P", PLACE, np.full(3, 0.1)),
        SphereLight("/S", PLACE, 2e-3, np.full(3, 0.1 / (math.pi * 4e-6))),
    ),
    "sun": (DistantLight("/D", SUN, np.full(3, 2.0), 0.0), DistantLight("/D", SUN, np.full(3, 2.0), 0.02)),
}


@pytest.mark.parametrize("albedo", [(0.9, 0.6, 0.2), (0.98, 0.98, 0.98)])
@pytest.mark.parametrize("name", PAIRS)
def test_lights_with_and_without_extent(name, albedo):
    camera = look((0.0, 0.02, 0.2), (0, 0, 0), (0.05, 0.05))
    cloth = fabric(albedo=albedo)
    (a, da), (b, db) = (
        mean_and_error(scenes.scene([plane(0.2)], [cloth_material()], [light], [cloth]), camera, 160, seed)
        for seed, light in enumerate(PAIRS[name])
    )
    error = np.hypot(da, db)
    assert np.all(error < 0.015 * a), f"too noisy to tell: {error / a}"
    assert np.all(abs(a - b) < 4 * error), f"{a} +- {da}, {b} +- {db}"


FIBERS = [
    pack_fiber((0.9, 0.5, 0.1), 0.5, 0.05, 0.12),
    pack_fiber((0.2, 0.6, 1.0), 0.4, 0.15, 0.15),
    pack_fiber((0.5, 0.5, 0.5), 0.3, 0.3, 0.3, eta=1.3, tilt=0.1),
]
MOMENTS = 6
"""Weights themselves, and times functions of the direction."""


def moments(sampler, fiber, h, theta, u):
    """Means of weight times f(direction) for some f, and their standard errors: (MOMENTS, 3) each."""
    prepared = prepare_fiber(fiber, h, math.sin(theta), math.cos(theta))
    rows = np.array([sampler(fiber, prepared, *x)[:6] for x in u])
    sin_ti, cos_ti, phi, weights = rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:]
    functions = np.stack([
        np.ones(len(u)), sin_ti, sin_ti**2, cos_ti * np.cos(phi), cos_ti * np.sin(phi), cos_ti * np.cos(2 * phi),
    ])  # fmt: skip
    values = functions[:, :, None] * weights[None]
    return values.mean(axis=1), values.std(axis=1) / math.sqrt(len(u))


@pytest.mark.parametrize("fiber", range(len(FIBERS)))
@pytest.mark.parametrize(("h", "degrees"), [(0.0, 0.0), (0.6, 35.0), (-0.9, -70.0)])
def test_weights_of_single_lobes_have_the_same_mean(fiber, h, degrees):
    packed = tuple(FIBERS[fiber])
    u = np.random.default_rng(fiber).random((2, 20_000, 4))
    (a, da), (b, db) = (
        moments(sampler, packed, h, math.radians(degrees), x)
        for sampler, x in zip((sample_fiber, sample_fiber_lobe), u, strict=True)
    )
    assert a.shape == (MOMENTS, 3)
    error = np.hypot(da, db)
    assert error.max() < 0.02
    assert np.all(abs(a - b) < 4.5 * error + 1e-9), (abs(a - b) / error).max()
    # With the same numbers both take the same direction.
    prepared = prepare_fiber(packed, h, math.sin(math.radians(degrees)), math.cos(math.radians(degrees)))
    for x in u[0, :20]:
        np.testing.assert_allclose(
            sample_fiber(packed, prepared, *x)[:3], sample_fiber_lobe(packed, prepared, *x)[:3], rtol=1e-12
        )
