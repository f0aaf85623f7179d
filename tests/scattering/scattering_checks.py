"""Helpers of the scattering tests: quadrature that resolves the lobes, a plain reference, a chi-square test.

The reference is written from the equations with SciPy's Bessel function, without the tricks of the kernels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import special, stats

from usdfab.scattering import fiber_numba, roughness


class Fiber(NamedTuple):
    """A material by its parameters; `packed` is what the kernels take."""

    gamma_m: float
    gamma_n: float
    gamma_m0: float
    albedo: tuple[float, float, float] = (1.0, 1.0, 1.0)
    eta: float = 1.55
    tilt: float = 0.0

    @property
    def packed(self):
        return fiber_numba.pack_fiber(self.albedo, self.gamma_m, self.gamma_n, self.gamma_m0, self.eta, self.tilt)


# --- Quadrature over the sphere ---

_GAUSS = np.polynomial.legendre.leggauss(6)
# In units of a lobe's width (root of the variance, scale of the logistic), out to where it is below e^-40.
_THETA_STEPS = np.array([0.0, 0.8, 1.7, 2.8, 4.0, 5.5, 7.2, 9.2, 13.0])
_PHI_STEPS = np.array([0.0, 1.0, 2.2, 3.6, 5.5, 8.0, 11.5, 16.0, 23.0, 32.0, 42.0])


def _composite_gauss(edges):
    """Nodes and weights of 6-point Gauss-Legendre between consecutive edges: two (6 n,) float arrays."""
    edges = np.unique(edges)
    half = 0.5 * np.diff(edges)[:, None]
    middle = 0.5 * (edges[1:] + edges[:-1])[:, None]
    return (middle + half * _GAUSS[0]).ravel(), (half * _GAUSS[1]).ravel()


def lobe_edges(fiber, h, theta_o):
    """Break points in theta_i and in phi around the peaks of all lobes, in [-pi/2, pi/2] and [-pi, pi]."""
    widths = np.sqrt(roughness.lobe_variances(fiber.gamma_m, fiber.gamma_m0))
    theta = [np.linspace(-math.pi / 2, math.pi / 2, 9)]
    for width, shift in zip(widths, np.array([-2.0, 1.0, 4.0, 0.0]) * fiber.tilt, strict=True):
        center = -(theta_o + shift)
        # Past the pole the peak is mirrored.
        center = math.asin(math.sin(center))
        theta += [center + width * _THETA_STEPS, center - width * _THETA_STEPS]
    s = float(roughness.azimuthal_scale(fiber.gamma_n))
    phi = [np.linspace(-math.pi, math.pi, 9)]
    for p in range(3):
        center = _phi(p, h, theta_o, fiber.eta)
        steps = np.concatenate([center + s * _PHI_STEPS, center - s * _PHI_STEPS, [center + math.pi]])
        phi.append(np.mod(steps + math.pi, 2.0 * math.pi) - math.pi)
    half_pi = math.pi / 2
    return np.clip(np.concatenate(theta), -half_pi, half_pi), np.clip(np.concatenate(phi), -math.pi, math.pi)


@njit(cache=True)
def _tabulate(p, h, sin_to, cos_to, theta, w_theta, phi, w_phi, out):
    """Sum of weight cos(theta) over (theta, phi) of value rgb, pdf, and of value rgb times `radiance`: out (7,)."""
    prep = fiber_numba.prepare_fiber(p, h, sin_to, cos_to)
    for i in range(theta.size):
        sin_ti, cos_ti = math.sin(theta[i]), math.cos(theta[i])
        for j in range(phi.size):
            w = w_theta[i] * w_phi[j] * cos_ti
            r, g, b, pdf = fiber_numba.eval_fiber(p, prep, sin_ti, cos_ti, phi[j])
            light = w * radiance(sin_ti, phi[j])
            out[0] += w * r
            out[1] += w * g
            out[2] += w * b
            out[3] += w * pdf
            out[4] += light * r
            out[5] += light * g
            out[6] += light * b


@njit(cache=True)
def radiance(sin_ti, phi):
    """A smooth made-up sky, between 0.1 and 2.7."""
    return 1.4 + 0.7 * sin_ti + 0.6 * math.cos(phi - 1.0)


def integrate(fiber, h, theta_o):
    """Integrals over the sphere: (7,) float, value rgb, pdf, reflected radiance rgb."""
    theta_edges, phi_edges = lobe_edges(fiber, h, theta_o)
    out = np.zeros(7)
    nodes = (*_composite_gauss(theta_edges), *_composite_gauss(phi_edges))
    _tabulate(fiber.packed, h, math.sin(theta_o), math.cos(theta_o), *nodes, out)
    return out


# --- Samples ---


@njit(cache=True)
def draw(p, h, sin_to, cos_to, u):
    """`sample_fiber` for every row of u (n, 4): (n, 7) float, sin_ti, cos_ti, phi, weight rgb, pdf."""
    out = np.empty((u.shape[0], 7))
    prep = fiber_numba.prepare_fiber(p, h, sin_to, cos_to)
    for i in range(u.shape[0]):
        out[i] = fiber_numba.sample_fiber(p, prep, u[i, 0], u[i, 1], u[i, 2], u[i, 3])
    return out


@njit(cache=True)
def _average_over_h(p, theta_o, theta_i, phi, h, weights):
    """Weighted mean over h (n,) of the values of one pair of directions: (3,) float."""
    out = np.zeros(3)
    for k in range(h.size):
        prep = fiber_numba.prepare_fiber(p, h[k], math.sin(theta_o), math.cos(theta_o))
        r, g, b, _ = fiber_numba.eval_fiber(p, prep, math.sin(theta_i), math.cos(theta_i), phi)
        out += 0.5 * weights[k] * np.array([r, g, b])
    return out


def average_over_h(fiber, theta_o, theta_i, phi):
    """Mean value over the width of the fiber for one pair of directions: (3,) float."""
    return _average_over_h(fiber.packed, theta_o, theta_i, phi, *np.polynomial.legendre.leggauss(400))


@njit(cache=True)
def evaluate(p, h, sin_to, cos_to, sin_ti, cos_ti, phi):
    """`eval_fiber` for n directions, (n,) each: (n, 4) float, value rgb, pdf."""
    out = np.empty((sin_ti.size, 4))
    prep = fiber_numba.prepare_fiber(p, h, sin_to, cos_to)
    for i in range(sin_ti.size):
        out[i] = fiber_numba.eval_fiber(p, prep, sin_ti[i], cos_ti[i], phi[i])
    return out


# --- Chi-square test ---


@njit(cache=True)
def _fill(p, h, sin_to, cos_to, theta, w_theta, cell_theta, phi, w_phi, cell_phi, out):
    """Add the integral of the pdf over each cell to out[row, column], cell_theta and cell_phi say whose a node is."""
    prep = fiber_numba.prepare_fiber(p, h, sin_to, cos_to)
    for i in range(theta.size):
        sin_ti, cos_ti = math.sin(theta[i]), math.cos(theta[i])
        for j in range(phi.size):
            pdf = fiber_numba.eval_fiber(p, prep, sin_ti, cos_ti, phi[j])[3]
            out[cell_theta[i], cell_phi[j]] += w_theta[i] * w_phi[j] * cos_ti * pdf


def chi_square_p_value(fiber, h, theta_o, n=100_000, cells=(24, 40), seed=0):
    """Probability that samples as far from the density as those drawn, or farther, come from it.

    The cells are a grid whose lines are quantiles of a pilot draw, so that narrow lobes get many; those that expect
    fewer than 5 samples are pooled into one.
    """
    p, sin_to, cos_to = fiber.packed, math.sin(theta_o), math.cos(theta_o)
    rng = np.random.default_rng(seed)
    pilot = draw(p, h, sin_to, cos_to, rng.random((20_000, 4)))
    edges = []
    for values, count, limit in ((np.arcsin(pilot[:, 0]), cells[0], math.pi / 2), (pilot[:, 2], cells[1], math.pi)):
        inner = np.quantile(values, np.linspace(0.0, 1.0, count + 1)[1:-1])
        edges.append(np.unique(np.concatenate([[-limit], inner, [limit]])))
    grids = [
        _composite_gauss(np.concatenate([edge, lobes]))
        for edge, lobes in zip(edges, lobe_edges(fiber, h, theta_o), strict=True)
    ]
    owners = [np.searchsorted(edge, nodes) - 1 for edge, (nodes, _) in zip(edges, grids, strict=True)]
    expected = np.zeros((edges[0].size - 1, edges[1].size - 1))
    (theta, w_theta), (phi, w_phi) = grids
    _fill(p, h, sin_to, cos_to, theta, w_theta, owners[0], phi, w_phi, owners[1], expected)
    expected *= n

    samples = draw(p, h, sin_to, cos_to, rng.random((n, 4)))
    observed = np.histogram2d(np.arcsin(samples[:, 0]), samples[:, 2], bins=edges)[0]
    assert observed.sum() == n

    return goodness_of_fit(observed, expected)


def goodness_of_fit(observed, expected):
    """Pearson's p-value for counts, any shape; cells that expect fewer than 5 are pooled into one."""
    few = expected < 5.0
    observed = np.append(observed[~few], observed[few].sum())
    expected = np.append(expected[~few], expected[few].sum())
    if expected[-1] < 5.0:  # the pool itself: to the smallest of the others
        smallest = np.argmin(expected[:-1])
        observed[smallest] += observed[-1]
        expected[smallest] += expected[-1]
        observed, expected = observed[:-1], expected[:-1]
    statistic = np.sum((observed - expected) ** 2 / expected)
    return float(stats.chi2.sf(statistic, expected.size - 1))


def sidak(level, tests):
    """Threshold for each of so many independent tests, such that one of them fails by chance with probability level."""
    return 1.0 - (1.0 - level) ** (1.0 / tests)


# --- Plain reference ---


def _gamma_t(h, theta_o, eta):
    eta_p = math.sqrt(eta**2 - math.sin(theta_o) ** 2) / math.cos(theta_o)
    return math.asin(h / eta_p)


def _phi(p, h, theta_o, eta):
    return 2.0 * p * _gamma_t(h, theta_o, eta) - 2.0 * math.asin(h) + p * math.pi


def log_bessel(x):
    """log I0, exact."""
    return np.log(special.ive(0, x)) + x


def log_bessel_of_mitsuba(x):
    """log I0 as in Mitsuba's `hair` (3.9.1, found by measuring it): eleven terms, above 12 an expansion."""
    k = np.arange(11)
    series = np.sum((x / 2.0) ** (2 * k) / special.factorial(k) ** 2)
    return x + 0.5 * (math.log(1.0 / (2.0 * math.pi * x)) + 1.0 / (8.0 * x)) if x > 12.0 else math.log(series)


def reference(fiber, h, theta_o, theta_i, phi, log_i0=log_bessel):
    """The BSDF times cosine, (3,) float, from the equations of Chiang et al. 2015 and Li et al. 2024."""
    eta = fiber.eta
    gamma_o, gamma_t = math.asin(h), _gamma_t(h, theta_o, eta)
    cos_i = math.cos(theta_o) * math.cos(gamma_o)
    cos_t = math.sqrt(1.0 - (1.0 - cos_i**2) / eta**2)
    f = 0.5 * (
        ((cos_i - eta * cos_t) / (cos_i + eta * cos_t)) ** 2 + ((cos_t - eta * cos_i) / (cos_t + eta * cos_i)) ** 2
    )
    sigma = roughness.absorption_from_albedo(fiber.albedo, fiber.gamma_n)
    t = np.exp(-2.0 * sigma * math.cos(gamma_t) / math.sqrt(1.0 - (math.sin(theta_o) / eta) ** 2))
    a = [np.full(3, f), (1 - f) ** 2 * t]
    a.append(a[1] * f * t)
    a.append(a[2] * f * t / (1 - f * t))

    s = float(roughness.azimuthal_scale(fiber.gamma_n))
    total = np.zeros(3)
    variances = roughness.lobe_variances(fiber.gamma_m, fiber.gamma_m0)
    for p, (v, shift) in enumerate(zip(variances, np.array([-2.0, 1.0, 4.0, 0.0]) * fiber.tilt, strict=True)):
        theta = theta_o + shift
        cc, ss = math.cos(theta_i) * abs(math.cos(theta)) / v, math.sin(theta_i) * math.sin(theta) / v
        # log(2 v sinh(1/v)) = 1/v + log(v (1 - e^(-2/v)))
        m = math.exp(log_i0(cc) - ss - 1.0 / v - math.log(-v * math.expm1(-2.0 / v)))
        d = 1.0 / (2.0 * math.pi)
        if p < 3:
            x = math.remainder(phi - _phi(p, h, theta_o, eta), 2.0 * math.pi)
            d = stats.logistic.pdf(x, scale=s) / (1.0 - 2.0 * stats.logistic.cdf(-math.pi, scale=s))
        total += m * d * a[p]
    return total
