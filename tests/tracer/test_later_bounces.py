"""Fibers with softer lobes after the first bounce: less noise, the same first bounce, nearly the same brightness."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import fabric, swatch

from usdfab.scattering.fiber_numba import pack_fiber, soften_fiber
from usdfab.scattering.roughness import azimuthal_scale
from usdfab.tracer import RenderSettings, Tracer


def test_only_the_azimuth_is_softened():
    narrow, wide = (pack_fiber([0.6, 0.4, 0.2], 0.4, gamma_n, 0.3) for gamma_n in (0.1, 0.5))
    scale = float(azimuthal_scale(0.5))
    softer = soften_fiber(narrow, scale)
    changed = softer != narrow
    assert 0 < changed.sum() <= 5
    np.testing.assert_allclose(softer[changed], wide[changed], rtol=1e-12)
    np.testing.assert_array_equal(soften_fiber(wide, 0.5 * scale), wide)


@pytest.fixture(scope="module")
def pair():
    scene, camera = swatch(fabric("twill 2/2", fibers=30, roughness_azimuthal=0.1))
    settings = RenderSettings((32, 32), spp=256)
    return [Tracer(scene, later_scale=scale).render(camera, settings) for scale in (None, 0.15)]


def test_there_is_less_noise_and_the_first_bounce_stays(pair):
    exact, soft = pair
    np.testing.assert_array_equal(exact.direct, soft.direct)
    assert soft.variance.mean() < 0.7 * exact.variance.mean()


def test_brightness_stays(pair):
    exact, soft = pair
    (a, ea), (b, eb) = ((r.pixels.mean(dtype=float), np.sqrt(r.variance.mean(axis=-1).sum()) / 32**2) for r in pair)
    assert np.hypot(ea, eb) < 0.015 * a, "too noisy to tell"
    assert abs(b / a - 1.0) < 0.02 + 2.0 * np.hypot(ea, eb) / a
    assert exact.pixels.shape == soft.pixels.shape
