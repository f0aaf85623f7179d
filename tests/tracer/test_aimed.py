"""Aimed light: densities against quadrature, geometry against straight cylinders, its mean against plain paths."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import fabric, swatch

from usdfab.scattering.fiber_numba import fiber_angles, fiber_direction, fiber_frame, pack_fiber, prepare_fiber
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.aimed import aim, density_in_window, draw_aimed, draw_in_window
from usdfab.usd.scene import DistantLight

MIDPOINTS = (np.arange(4000) + 0.5) / 4000


def logistic(x, scale):
    return 1.0 / (4.0 * scale * np.cosh(x / (2.0 * scale)) ** 2)


@pytest.mark.parametrize(("scale", "x"), [(0.02, 0.01), (0.1, -0.5), (0.6, 1.0), (0.6, -3.1)])
def test_density_of_the_window(scale, x):
    y = np.array([draw_in_window(0, scale, x, u) for u in MIDPOINTS])
    assert (np.diff(y) > 0.0).all() or (np.diff(y) < 0.0).all()
    assert np.abs(y - x).max() <= 6.0 * scale * (1 + 1e-9)
    # u = P(y) / P: so the density of y is p(y) / P, and density_in_window has the same P.
    mass = logistic(x, scale) / density_in_window(0, scale, x)
    inner = slice(200, -200)
    np.testing.assert_allclose(logistic(y, scale)[inner] * np.abs(np.gradient(y, MIDPOINTS))[inner], mass, rtol=2e-3)


def test_density_of_the_lobe_without_azimuth():
    y = np.array([draw_in_window(3, 0.02, 0.7, u) for u in MIDPOINTS])
    assert density_in_window(3, 0.02, 0.7) * (y.max() - y.min()) == pytest.approx(1.0, rel=1e-3)
    assert y.mean() == pytest.approx(0.7)


@pytest.mark.parametrize(("x", "middle", "width"), [(0.0, 0.05, 0.004), (0.03, -0.08, 0.03), (-0.1, 0.0, 0.3)])
def test_density_of_what_is_aimed(x, middle, width):
    scale, window = 0.025, 0.15
    # By the share that is uniform and the one that is not.
    parts = [(0.06, 0.01), (0.94, 0.99)]
    drawn = np.array([[draw_aimed(0, scale, x, middle, width, u, choice) for u in MIDPOINTS] for _, choice in parts])
    assert np.abs(drawn[..., 0] - x).max() <= window * (1 + 1e-9)
    # Means of f / q are integrals of f over the window.
    for power, integral in ((0, 2 * window), (1, 2 * window * x), (2, ((x + window) ** 3 - (x - window) ** 3) / 3)):
        means = (drawn[..., 0] ** power / drawn[..., 1]).mean(axis=1)
        found = sum(share * mean for (share, _), mean in zip(parts, means, strict=True))
        assert found == pytest.approx(integral, abs=2e-3 * window)


def met(material, axis, first, incline, x, other, center, radius, light):
    """What ``aim`` takes of a ray at azimuth x to a straight fiber; how far the light is from the middle of TT."""
    d = np.array(fiber_direction(*axis, *first, math.sin(incline), math.cos(incline), x))
    flat, start = d - (d @ other) * other, -center + (center @ other) * other
    b, c = flat @ start, start @ start - radius**2
    t = (-b - math.sqrt(b * b - (flat @ flat) * c)) / (flat @ flat)
    normal = (start + t * flat) / radius
    sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(*other, *normal, *-d)
    sin_ti, cos_ti, phi = fiber_angles(*other, ex, ey, ez, fx, fy, fz, *light)
    prep = prepare_fiber(material, h, sin_to, cos_to)
    missing = (prep[9] - phi + math.pi) % (2 * math.pi) - math.pi
    return (prep, h, cos_to, sin_ti, cos_ti, phi, (ex, ey, ez), (fx, fy, fz), *d, t), missing


def test_aim_finds_where_a_straight_fiber_transmits_towards_the_light():
    """Two straight cylinders, rays met by quadratic equations; parallel ones exactly, crossed ones nearly."""
    material = pack_fiber((0.7, 0.5, 0.3), 0.45, 0.45, 0.1)
    generator = np.random.default_rng(7)
    errors = []
    for _ in range(3000):
        axis, azimuth = np.array([0.0, 0.0, 1.0]), generator.uniform(-0.5, 0.5)
        first = fiber_frame(*axis, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0)[3:]
        incline = generator.uniform(-0.3, 0.3)
        other = np.array([0.0, math.sin(generator.uniform(-0.3, 0.3)), 1.0]) if len(errors) % 2 else axis
        other = other / np.linalg.norm(other)
        radius, away = 1.0, generator.uniform(1.5, 6.0)
        center = away * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        light = generator.normal(size=3) * (1.0, 1.0, 0.3)
        light /= np.linalg.norm(light)

        # The lobe without azimuth: where it is aimed is then the middle of what is transmitted.
        flight = (*axis, *first, math.sin(incline), math.cos(incline), 0.0, azimuth, 0.02, 3.0, *(0.0,) * 8)
        rest = (other, center, radius, light)
        seen, before = met(material, axis, first, incline, azimuth, *rest)
        value, middle, _width = aim(material, *seen, radius, flight, azimuth)
        if value > 1e-6 and abs(before) > 0.1:
            errors.append(abs(met(material, axis, first, incline, middle, *rest)[1]))
    errors = np.array(errors)
    assert len(errors) > 100
    assert np.quantile(errors[::2], 0.99) < 0.03
    assert np.quantile(errors[1::2], 0.8) < 0.1


def test_the_mean_is_that_of_plain_paths_with_less_noise():
    """A lamp of a thousandth of a radian gives the same light; its paths are not aimed."""
    cloth = fabric("twill_1_3", fibers=20, variants=2, roughness_azimuthal=0.1, albedo=(0.8, 0.5, 0.3))
    pictures = []
    for half_angle in (0.0, 1e-3):
        lamp = DistantLight("/Lamp", np.array([0.5, 0.3, -math.sqrt(0.66)]), np.full(3, 3.0), half_angle)
        scene, camera = swatch(cloth, lamp)
        pictures.append(Tracer(scene).render(camera, RenderSettings((16, 16), spp=400, max_depth=24, seed=3)))
    mean = [p.pixels.mean(axis=(0, 1)) for p in pictures]
    error = [np.sqrt(p.variance.sum(axis=(0, 1))) / 256 for p in pictures]
    assert (error[0] < 0.025 * mean[0]).all()
    assert (np.abs(mean[0] - mean[1]) < 3.0 * np.hypot(*error)).all()
    assert (error[0] < 0.9 * error[1]).all()
