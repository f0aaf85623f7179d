"""Derivatives of the fiber BSDF by its parameters: against finite differences, and against what must not change."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scattering_checks as checks
from hypothesis import given, settings, strategies as st
from numba import njit
from scattering_checks import Fiber
from scipy import special

from usdfab.scattering import fiber_numba_grad, roughness
from usdfab.scattering.fiber_numba import eval_fiber, pack_fiber, prepare_fiber, sample_fiber_lobe
from usdfab.scattering.fiber_numba_grad import eval_fiber_slopes, lobe_slopes, pack_slopes, prepare_slopes

PARAMETERS = ("C", "gamma_m", "gamma_n", "gamma_m0", "eta")


@njit(cache=True)
def _values(p, h, theta_o, theta_i, phi):
    prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
    return eval_fiber(p, prep, math.sin(theta_i), math.cos(theta_i), phi)


@njit(cache=True)
def _slopes(p, g, h, theta_o, theta_i, phi):
    prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
    slopes = prepare_slopes(p, prep, h, math.cos(theta_o))
    return eval_fiber_slopes(p, g, prep, slopes, math.sin(theta_i), math.cos(theta_i), phi)


@njit(cache=True)
def _lobe(p, g, h, theta_o, u):
    """One draw: lobe's logarithmic derivatives, direction and weights."""
    prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
    slopes = prepare_slopes(p, prep, h, math.cos(theta_o))
    sin_ti, cos_ti, phi, wr, wg, wb = sample_fiber_lobe(p, prep, u[0], u[1], u[2], u[3])
    a, d = lobe_slopes(p, g, prep, slopes, u[0], sin_ti, cos_ti, phi)
    both = (
        a[0], a[1], a[2], d[0], d[0], d[0], a[3] + d[1], a[4] + d[1], a[5] + d[1], d[2], d[2], d[2],
        a[6] + d[3], a[7] + d[3], a[8] + d[3], *d,
    )  # fmt: skip
    return both, (sin_ti, cos_ti, phi), (wr, wg, wb)


def arguments(fiber: Fiber) -> tuple:
    return fiber.albedo, fiber.gamma_m, fiber.gamma_n, fiber.gamma_m0, fiber.eta, fiber.tilt


def moved(fiber: Fiber, parameter: int, step: float) -> Fiber:
    if parameter == 0:
        return fiber._replace(albedo=tuple(c + step for c in fiber.albedo))
    name = PARAMETERS[parameter]
    return fiber._replace(**{name: getattr(fiber, name) + step})


def differences(fiber: Fiber, parameter: int, *place: float) -> tuple[np.ndarray, np.ndarray]:
    """(3,) derivative by central differences, Richardson's extrapolation of two steps, and how far they are apart."""

    def central(step: float) -> np.ndarray:
        high, low = (np.array(_values(moved(fiber, parameter, s).packed, *place)[:3]) for s in (step, -step))
        return (high - low) / (2.0 * step)

    wide, narrow = central(2e-5), central(1e-5)
    return narrow + (narrow - wide) / 3.0, abs(narrow - wide)


roughnesses = st.floats(0.02, 0.98)
FIBERS = st.builds(
    Fiber, roughnesses, roughnesses, roughnesses, st.tuples(*[st.floats(0.02, 0.98)] * 3), st.floats(1.1, 2.5),
    st.sampled_from([0.0, 0.05]),
)  # fmt: skip


@settings(max_examples=150)
@given(
    FIBERS, st.floats(-0.98, 0.98), st.floats(-1.4, 1.4), st.sampled_from(["R", "TT", "TRT", "any"]),
    st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.integers(0, 4),
)  # fmt: skip
def test_slopes_are_the_finite_differences_of_the_value(fiber, h, theta_o, lobe, off_theta, off_phi, parameter):
    """At places around the lobes' peaks, given in widths of the lobe; the value is eval_fiber's."""
    p, g = fiber.packed, pack_slopes(*arguments(fiber))
    prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
    k = {"R": 0, "TT": 1, "TRT": 2, "any": 2}[lobe]
    width = math.sqrt(roughness.lobe_variances(fiber.gamma_m, fiber.gamma_m0)[k])
    theta_i = float(np.clip(-theta_o + off_theta * min(width, 0.7), -1.5, 1.5))
    center = 0.0 if lobe == "any" else prep[8 + k]
    scale = 1.0 if lobe == "any" else min(float(roughness.azimuthal_scale(fiber.gamma_n)), 1.0)
    place = h, theta_o, theta_i, center + off_phi * scale
    value, derivatives = _slopes(p, g, *place)
    expected = _values(p, *place)
    # The same operations, up to how the compiler contracts them; exponents are differences of numbers of about 1 / v.
    rounding = 4.0 * np.finfo(float).eps / float(roughness.lobe_variances(fiber.gamma_m, fiber.gamma_m0).min())
    np.testing.assert_allclose(value, expected, rtol=1e-14 + rounding, atol=1e-300)
    got = np.array(derivatives).reshape(5, 3)[parameter]
    wanted, doubt = differences(fiber, parameter, *place)
    # Sums of lobes that cancel are as exact as their parts; parts are at most this large.
    size = np.abs(np.array(value[:3])) * (1.0 if parameter == 0 else 10.0)
    assert np.all(abs(got - wanted) <= 1e-5 * abs(wanted) + 1e-6 * size + 0.5 * doubt + 1e-30), (got, wanted, doubt)


FIXED = (
    Fiber(0.5, 0.05, 0.12, (0.9, 0.5, 0.1)),
    Fiber(0.4, 0.15, 0.15, (0.2, 0.6, 0.97)),
    Fiber(0.3, 0.3, 0.3, (0.5, 0.5, 0.5), 1.3, 0.1),
    Fiber(0.9, 0.8, 0.9, (0.9, 0.5, 0.1)),
)


@pytest.mark.parametrize("fiber", FIXED)
@pytest.mark.parametrize("parameter", range(5), ids=PARAMETERS)
def test_every_parameter_at_the_peaks(fiber, parameter):
    """Within 1e-6 where the lobe is large: no allowance for its size."""
    p, g = fiber.packed, pack_slopes(*arguments(fiber))
    for h, theta_o in ((0.3, 0.4), (-0.7, -0.9), (0.05, 0.1)):
        prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
        for k in range(3):
            place = h, theta_o, -theta_o + 0.07, prep[8 + k] + 0.6 * float(roughness.azimuthal_scale(fiber.gamma_n))
            got = np.array(_slopes(p, g, *place)[1]).reshape(5, 3)[parameter]
            wanted, doubt = differences(fiber, parameter, *place)
            np.testing.assert_array_less(abs(got - wanted), 1e-6 * abs(wanted) + doubt + 1e-9)


@pytest.mark.parametrize("gamma", [0.01, 0.05, 0.3, 0.7, 1.0])
def test_slopes_of_the_roughness_maps(gamma):
    step = 1e-6
    g = pack_slopes((0.5, 0.3, 0.2), gamma, gamma, gamma)

    def slope(function):
        return (np.log(function(gamma + step)) - np.log(function(gamma - step))) / (2.0 * step)

    assert g[0] == pytest.approx(slope(roughness.longitudinal_variance), rel=1e-7)
    assert g[1] == g[0]
    assert g[2] == pytest.approx(slope(roughness.azimuthal_scale), rel=1e-7)
    assert g[3] == pytest.approx(slope(lambda n: roughness.absorption_from_albedo(0.3, n)), rel=1e-7, abs=1e-8)


def test_the_longitudinal_slope_by_scipy():
    """u(a) over both fits and their border: exact to 2e-6 of what it stands beside."""
    v = 0.05
    for a in (1e-6, 0.1, 1.0, 3.0, 4.999, 5.001, 7.0, 30.0, 500.0):
        cos_o = 0.9
        cos_i = a * v / cos_o
        if cos_i > 1.0:
            cos_i, scale = 1.0, 0.9 / a
        else:
            scale = v
        got = fiber_numba_grad._longitudinal_slope(1.0 / scale, 0.0, 0.0, cos_i, 0.0, cos_o)
        x = cos_i * cos_o / scale
        u = x * (1.0 - special.ive(1, x) / special.ive(0, x))
        assert got == pytest.approx((1.0 - cos_i * cos_o) / scale + u - 1.0, rel=2e-6, abs=2e-6)


@pytest.mark.parametrize("fiber", FIXED)
@pytest.mark.parametrize(("h", "theta_o"), [(0.0, 0.0), (0.6, 0.6), (-0.9, -1.2)])
def test_white_fibers_stay_white(fiber, h, theta_o):
    """Integrated over directions the derivative by roughness and index is zero, at C = 1; by C it is not below 1."""
    fiber = fiber._replace(albedo=(1.0, 1.0, 0.8))
    p, g = fiber.packed, pack_slopes(*arguments(fiber))
    theta, phi = checks.lobe_edges(fiber, h, theta_o)
    theta, w_theta = checks._composite_gauss(theta)
    phi, w_phi = checks._composite_gauss(phi)
    total = _integral(p, g, h, theta_o, theta, w_theta, phi, w_phi)
    assert np.all(abs(total[:, :2].ravel()[2:]) < 2e-6), total
    assert np.all(total[0, :2] == 0.0)  # sigma = (ln C / q)^2 is flat there
    assert total[0, 2] > 0.01
    # The absorbing channel loses nothing by roughness M either: attenuation does not depend on it.
    assert np.all(abs(total[[1, 3], 2]) < 2e-6)


@njit(cache=True)
def _integral(p, g, h, theta_o, theta, w_theta, phi, w_phi):
    """(5, 3) derivatives integrated over directions."""
    out = np.zeros(15)
    prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
    slopes = prepare_slopes(p, prep, h, math.cos(theta_o))
    for i in range(theta.size):
        for j in range(phi.size):
            _, d = eval_fiber_slopes(p, g, prep, slopes, math.sin(theta[i]), math.cos(theta[i]), phi[j])
            for k in range(15):
                out[k] += w_theta[i] * w_phi[j] * math.cos(theta[i]) * d[k]
    return out.reshape(5, 3)


@njit(cache=True)
def _sampled(p, g, h, theta_o, numbers):
    """Means over draws of weight times derivative times two functions of the direction, and their standard errors.

    Then those of the directions' own scores.
    """
    mean, square = np.zeros((2, 15)), np.zeros((2, 15))
    score, own = np.zeros(4), np.zeros(4)
    for k in range(len(numbers)):
        d, (sin_ti, _cos_ti, phi), w = _lobe(p, g, h, theta_o, numbers[k])
        for j in range(15):
            for m in range(2):
                x = w[j % 3] * d[j] * ((1.0 + sin_ti) if m == 0 else math.cos(phi))
                mean[m, j] += x
                square[m, j] += x * x
        for j in range(4):
            score[j] += d[15 + j]
            own[j] += d[15 + j] ** 2
    n = len(numbers)
    return mean / n, np.sqrt((square / n - (mean / n) ** 2) / n), score / n, np.sqrt(own) / n


@njit(cache=True)
def _exact(p, g, h, theta_o, theta, w_theta, phi, w_phi):
    """The same means by quadrature of ``eval_fiber_slopes``."""
    out = np.zeros((2, 15))
    prep = prepare_fiber(p, h, math.sin(theta_o), math.cos(theta_o))
    slopes = prepare_slopes(p, prep, h, math.cos(theta_o))
    for i in range(theta.size):
        for j in range(phi.size):
            _, d = eval_fiber_slopes(p, g, prep, slopes, math.sin(theta[i]), math.cos(theta[i]), phi[j])
            w = w_theta[i] * w_phi[j] * math.cos(theta[i])
            for k in range(15):
                out[0, k] += w * d[k] * (1.0 + math.sin(theta[i]))
                out[1, k] += w * d[k] * math.cos(phi[j])
    return out


@pytest.mark.parametrize("fiber", FIXED)
@pytest.mark.parametrize(("h", "theta_o"), [(0.1, 0.2), (-0.8, -0.9)])
def test_slopes_of_single_lobes_have_the_mean_of_all(fiber, h, theta_o):
    """Draws of one lobe with its own slopes give the derivative of integrals over all directions."""
    p, g = tuple(fiber.packed), tuple(pack_slopes(*arguments(fiber)))
    numbers = np.random.default_rng(1).random((1_000_000, 4))
    mean, error, score, doubt = _sampled(p, g, h, theta_o, numbers)
    theta, phi = checks.lobe_edges(fiber, h, theta_o)
    exact = _exact(p, g, h, theta_o, *checks._composite_gauss(theta), *checks._composite_gauss(phi))
    assert np.all(abs(mean - exact) < 4.5 * error + 1e-5), (abs(mean - exact) / error).max()
    assert error.max() < 0.03 * abs(exact).max()
    # Densities stay densities: their logarithms' derivatives are 0 in the mean.
    assert np.all(abs(score) < 4.5 * doubt + 1e-9), score / doubt


def test_edges_are_finite():
    """Grazing, along the axis, |h| = 1, no and nearly full absorption: finite numbers everywhere."""
    for albedo in ((1.0, 1.0, 1.0), (1e-4, 0.5, 1.0)):
        for gamma in (0.01, 1.0):
            p, g = pack_fiber(albedo, gamma, gamma, gamma), pack_slopes(albedo, gamma, gamma, gamma)
            for h in (-1.0, 0.0, 1.0, float(np.nextafter(1.0, 0.0))):
                for theta_o in (0.0, math.pi / 2, -1.5):
                    for theta_i, phi in ((0.0, 0.0), (1.5, 3.0), (-math.pi / 2, math.pi)):
                        value, slopes = _slopes(p, g, h, theta_o, theta_i, phi)
                        assert np.isfinite(value).all() and np.isfinite(slopes).all()
                    for u in (np.zeros(4), np.full(4, 1.0 - 1e-16), np.full(4, 0.5)):
                        assert np.isfinite(_lobe(p, g, h, theta_o, u)[0]).all()
