"""Derivatives of the fiber BSDF of ``fiber_numba`` with respect to its parameters, for Numba, written out by hand.

Forward mode with directions held fixed: one call gives the value and its derivatives by all parameters of the material,
of which a colour channel has five: its own albedo coefficient C, gamma_M, gamma_N, gamma_M0 and the index eta. The
other channels' C do not touch it. The tilt is not differentiated.

When to use it: beside ``fiber_numba`` in a kernel. ``pack_slopes`` once per material (NumPy), ``prepare_slopes`` once
per vertex after ``prepare_fiber``, then ``eval_fiber_slopes`` for a given direction, and ``lobe_slopes`` for the weight
of ``sample_fiber_lobe``.

Everything is logarithmic, since what a path wants is the derivative of a product. Of one lobe, A M D,

    d ln A / d sigma = -(number of crossings) l;   d ln A / d eta through F and l
    v d ln M / d v   = (1 + sin sin - cos cos) / v + u(a) - 1 + (2/v) / (e^(2/v) - 1),   a = cos cos / v
    s d ln D / d s   = x tanh(x/2) - 1 + (pi/s) / sinh(pi/s),   x = |phi - Phi| / s
    d ln D / d Phi   = +- tanh(x/2) / s

with u(a) = a (1 - I1(a) / I0(a)), which goes from a at 0 to 1/2 at infinity, l the length of a crossing, T =
e^(-sigma l), F Fresnel's reflectance; all with the same fits as ``fiber_numba``, so that these are the derivatives of
what it computes. Derived from the equations of Chiang et al. 2015 and d'Eon et al. 2011.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from usdfab.scattering.elementary_numba import INLINED
from usdfab.scattering.fiber_numba import (
    _ETA,
    _INV_S,
    _INV_V,
    _M_SCALE,
    _SIGMA,
    _SIN_TILT,
    BESSEL_LARGE,
    BESSEL_SMALL,
    BESSEL_SPLIT,
    ETA_TEXTILE,
    _azimuthal,
    _longitudinal,
    _wrap,
)
from usdfab.scattering.roughness import absorption_from_albedo, azimuthal_scale, lobe_variances

__all__ = [
    "PREPARED_SLOPES",
    "SLOPES_SIZE",
    "eval_fiber_slopes",
    "load_slopes",
    "lobe_slopes",
    "pack_slopes",
    "prepare_slopes",
]

SLOPES_SIZE = 11
"""Length of the array that ``pack_slopes`` returns."""
PREPARED_SLOPES = 8
"""Length of the tuple that ``prepare_slopes`` returns."""

# Layout of the packed slopes `g`.
_V_BY_M = 0  # d ln v / d gamma_M
_V_BY_M0 = 1  # d ln v_R / d gamma_M0
_S_BY_N = 2  # d ln s / d gamma_N
_SIGMA_BY_N = 3  # d ln sigma / d gamma_N
_ROOT_BY_C = 4  # 3: -d sqrt(sigma) / d C
_M_EDGE = 7  # 3: (2/v) / (e^(2/v) - 1) of R, TT, TRT
_D_EDGE = 10  # (pi/s) / sinh(pi/s)

_TINY = 1e-12


def pack_slopes(
    albedo: npt.ArrayLike, gamma_m: float, gamma_n: float, gamma_m0: float, eta: float = ETA_TEXTILE, tilt: float = 0.0
) -> npt.NDArray[np.float64]:
    """Precompute how the constants of a fiber material depend on its parameters.

    Parameters
    ----------
    albedo, gamma_m, gamma_n, gamma_m0, eta, tilt:
        Those of ``fiber_numba.pack_fiber``, which checks them.

    Returns
    -------
    (SLOPES_SIZE,) float64

    Example
    -------
    >>> pack_slopes([0.8, 0.4, 0.2], gamma_m=0.5, gamma_n=0.05, gamma_m0=0.12).shape
    (11,)
    """
    color = np.asarray(albedo, dtype=np.float64)
    g = np.zeros(SLOPES_SIZE)
    g[_V_BY_M], g[_V_BY_M0] = _log_variance_slope(gamma_m), _log_variance_slope(gamma_m0)
    n = gamma_n
    g[_S_BY_N] = (0.265 + 2.388 * n + 118.184 * n**21) / (0.265 * n + 1.194 * n**2 + 5.372 * n**22)
    # sqrt(sigma) = -ln C / q, and q = 1 / sqrt(sigma) where C = 1/e.
    inverse_q = math.sqrt(float(absorption_from_albedo(math.exp(-1.0), n)))
    slope = -0.215 + 5.064 * n - 32.19 * n**2 + 22.296 * n**3 + 1.225 * n**4
    g[_SIGMA_BY_N] = -2.0 * slope * inverse_q
    g[_ROOT_BY_C : _ROOT_BY_C + 3] = inverse_q / color
    v = lobe_variances(gamma_m, gamma_m0)[:3]
    # Written with e^(-x), which cannot overflow.
    twice = 2.0 / v
    g[_M_EDGE : _M_EDGE + 3] = -twice * np.exp(-twice) / np.expm1(-twice)
    x = math.pi / float(azimuthal_scale(n))
    g[_D_EDGE] = -2.0 * x * math.exp(-x) / math.expm1(-2.0 * x)
    return g


def _log_variance_slope(g: float) -> float:
    """d ln v / d gamma, v = (0.726 g + 0.812 g^2 + 3.7 g^20)^2."""
    return 2.0 * (0.726 + 1.624 * g + 74.0 * g**19) / (0.726 * g + 0.812 * g**2 + 3.7 * g**20)


@njit(**INLINED)
def load_slopes(slopes, k):
    """Row k of an array of ``pack_slopes`` as a tuple, see ``fiber_numba.load_fiber``."""
    m = slopes
    return (
        *(m[k, 0], m[k, 1], m[k, 2], m[k, 3], m[k, 4], m[k, 5], m[k, 6], m[k, 7], m[k, 8], m[k, 9], m[k, 10]),
    )  # fmt: skip


@njit(**INLINED)
def prepare_slopes(p, prep, h, cos_to):
    """How the attenuations and the angles of a vertex depend on the material.

    Parameters
    ----------
    p, prep, h, cos_to:
        Material, vertex of ``prepare_fiber`` and what it was made of.

    Returns
    -------
    tuple of 8 float
        Length of a crossing and its slope by eta; d F / d eta over F and over 1 - F; number of crossings that the rest
        stands for, RGB; d gamma_t / d eta.
    """
    h = min(max(h, -1.0), 1.0)
    eta = p[_ETA]
    g2 = eta * eta - 1.0 + cos_to * cos_to  # (eta cos theta_t)^2
    g = math.sqrt(g2)
    sin_gamma_t = h * cos_to / g
    cos_gamma_t = math.sqrt(1.0 - sin_gamma_t * sin_gamma_t)
    by_eta = eta / g2  # -d ln(sin gamma_t) / d eta
    tangent = sin_gamma_t / cos_gamma_t
    length = 2.0 * cos_gamma_t * eta / g
    length_slope = length * (tangent * tangent * by_eta + 1.0 / eta - by_eta)

    # r = (a - g) / (a + g), a = c and eta^2 c, g = sqrt(eta^2 - 1 + c^2).
    c = cos_to * math.sqrt(1.0 - h * h)
    g = math.sqrt(eta * eta - 1.0 + c * c)
    a = eta * eta * c
    over_s, over_p = 1.0 / (c + g), 1.0 / (a + g)
    slope_s = -2.0 * c * (eta / g) * over_s * over_s
    slope_p = 2.0 * (2.0 * eta * c * g - a * (eta / g)) * over_p * over_p
    f = prep[11]
    slope = (c - g) * over_s * slope_s + (a - g) * over_p * slope_p

    # A_rest / A_TRT = F T / (1 - F T) crossings more than the third.
    m_r = 3.0 + (prep[18] / prep[15] if prep[15] > 0.0 else 0.0)
    m_g = 3.0 + (prep[19] / prep[16] if prep[16] > 0.0 else 0.0)
    m_b = 3.0 + (prep[20] / prep[17] if prep[17] > 0.0 else 0.0)
    return length, length_slope, slope / f, slope / max(1.0 - f, _TINY), m_r, m_g, m_b, -tangent * by_eta


@njit(**INLINED)
def _longitudinal_slope(inv_v, edge, sin_i, cos_i, sin_o, cos_o):
    """v d ln M / d v."""
    a = cos_i * cos_o * inv_v
    if a < BESSEL_SPLIT:
        # I0 = P(a^2): u = a - 2 x P'(x) / P(x)
        x = a * a
        c = BESSEL_SMALL
        value = c[6] + x * c[7]
        value = c[4] + x * (c[5] + x * value)
        value = c[2] + x * (c[3] + x * value)
        value = c[0] + x * (c[1] + x * value)
        slope = 6.0 * c[6] + x * (7.0 * c[7])
        slope = 4.0 * c[4] + x * (5.0 * c[5] + x * slope)
        slope = 2.0 * c[2] + x * (3.0 * c[3] + x * slope)
        u = a - 2.0 * x * (c[1] + x * slope) / value
    else:
        # I0 = e^a sqrt(x) Q(x), x = 1/a: u = 1/2 + x Q'(x) / Q(x)
        x = 1.0 / a
        c = BESSEL_LARGE
        value = c[6] + x * c[7]
        value = c[4] + x * (c[5] + x * value)
        value = c[2] + x * (c[3] + x * value)
        value = c[0] + x * (c[1] + x * value)
        slope = 6.0 * c[6] + x * (7.0 * c[7])
        slope = 4.0 * c[4] + x * (5.0 * c[5] + x * slope)
        slope = 2.0 * c[2] + x * (3.0 * c[3] + x * slope)
        u = 0.5 + x * (c[1] + x * slope) / value
    return (1.0 + sin_i * sin_o - cos_i * cos_o) * inv_v + u - 1.0 + edge


@njit(**INLINED)
def _azimuthal_slopes(p, g, x):
    """(s d ln D / d s, d ln D / d Phi) at phi - Phi = x."""
    x = _wrap(x)
    y = abs(x) * p[_INV_S]
    e = math.exp(-y)
    t = (1.0 - e) / (1.0 + e)
    return y * t - 1.0 + g[_D_EDGE], math.copysign(t * p[_INV_S], x)


@njit(**INLINED)
def _by_albedo(p, g, channel, by_sigma):
    """From a derivative by sigma to one by C; sigma = (ln C / q)^2."""
    return -2.0 * math.sqrt(p[_SIGMA + channel]) * g[_ROOT_BY_C + channel] * by_sigma


@njit(**INLINED)
def lobe_slopes(p, g, prep, slopes, u0, sin_ti, cos_ti, phi):
    """Logarithmic derivatives of what ``sample_fiber_lobe`` weighs: the one lobe that it drew, at a fixed direction.

    The mean over directions of the weight, and of the weight times any function of the direction, has for derivative
    the mean of the weight times these (times the function): the density of the draw stays as it is.

    Parameters
    ----------
    p, g, prep, slopes:
        Of ``load_fiber``, ``load_slopes``, ``prepare_fiber`` and ``prepare_slopes``.
    u0: float
        The number that chose the lobe.
    sin_ti, cos_ti, phi: float
        The direction it took.

    Returns
    -------
    attenuation: tuple of 9 float
        d ln A in red, green, blue by: the channel's own C; gamma_N (through sigma); eta.
    direction: tuple of 4 float
        d ln(M D), the same in all channels, by gamma_M, gamma_N, gamma_M0, eta. Over the directions that the lobe
        draws their mean is 0.
    """
    sin_o, cos_o, k, crossings = prep[6], prep[7], 2, 0.0
    by_m = by_n = by_m0 = by_phi = phi_slope = by_f = 0.0
    s_r = s_g = s_b = 0.0
    if u0 < prep[21]:
        sin_o, cos_o, k = prep[0], prep[1], 0
        by_n, by_phi = _azimuthal_slopes(p, g, phi - prep[8])
        by_f = slopes[2]
    elif u0 < prep[21] + prep[22]:
        sin_o, cos_o, k, crossings = prep[2], prep[3], 1, 1.0
        by_n, by_phi = _azimuthal_slopes(p, g, phi - prep[9])
        phi_slope, by_f = 2.0 * slopes[7], -2.0 * slopes[3]
        s_r = s_g = s_b = 1.0
    elif u0 < prep[21] + prep[22] + prep[23]:
        sin_o, cos_o, crossings = prep[4], prep[5], 2.0
        by_n, by_phi = _azimuthal_slopes(p, g, phi - prep[10])
        phi_slope, by_f = 4.0 * slopes[7], slopes[2] - 2.0 * slopes[3]
        s_r = s_g = s_b = 2.0
    else:
        crossings, by_f = 3.0, 2.0 * slopes[2] - 2.0 * slopes[3]
        s_r, s_g, s_b = slopes[4], slopes[5], slopes[6]
    m = _longitudinal_slope(p[_INV_V + k], g[_M_EDGE + k], sin_ti, cos_ti, sin_o, cos_o)
    if k == 0:
        by_m0 = m * g[_V_BY_M0]
    else:
        by_m = m * g[_V_BY_M]
    # F T of the rest's sum: its share beyond three crossings grows with F too.
    more = slopes[2] if crossings == 3.0 else 0.0
    length, length_slope = slopes[0], slopes[1]
    n_r, n_g, n_b = p[_SIGMA] * g[_SIGMA_BY_N], p[_SIGMA + 1] * g[_SIGMA_BY_N], p[_SIGMA + 2] * g[_SIGMA_BY_N]
    return (
        _by_albedo(p, g, 0, -s_r * length), _by_albedo(p, g, 1, -s_g * length), _by_albedo(p, g, 2, -s_b * length),
        -s_r * length * n_r, -s_g * length * n_g, -s_b * length * n_b,
        by_f - s_r * length_slope * p[_SIGMA] + more * (s_r - 3.0),
        by_f - s_g * length_slope * p[_SIGMA + 1] + more * (s_g - 3.0),
        by_f - s_b * length_slope * p[_SIGMA + 2] + more * (s_b - 3.0),
    ), (by_m, by_n * g[_S_BY_N], by_m0, by_phi * phi_slope)  # fmt: skip


@njit(**INLINED)
def eval_fiber_slopes(p, g, prep, slopes, sin_ti, cos_ti, phi):
    """Value and density of ``eval_fiber``, and the value's derivatives.

    Parameters
    ----------
    p, g, prep, slopes:
        Of ``load_fiber``, ``load_slopes``, ``prepare_fiber`` and ``prepare_slopes``.
    sin_ti, cos_ti, phi: float
        Direction, as in ``eval_fiber``.

    Returns
    -------
    value: tuple of 4 float
        Value in RGB and density, those of ``eval_fiber``.
    derivatives: tuple of 15 float
        Of the value in each of red, green, blue by: the channel's own C; gamma_M; gamma_N; gamma_M0; eta.
    """
    length, length_slope, over_f, over_t, m_r, m_g, m_b, gamma_slope = slopes

    # The rest. Sums over lobes: value by channel (f), by M's variance (m), D's scale (d), sigma (s), eta (e).
    m_rest = _longitudinal(p[_M_SCALE + 2], p[_INV_V + 2], sin_ti, cos_ti, prep[6], prep[7])
    lobe = m_rest / (2.0 * math.pi)
    r, gr, b = lobe * prep[18], lobe * prep[19], lobe * prep[20]
    pdf = lobe * prep[24]
    rough = 0.0
    if lobe > 0.0:
        rough = _longitudinal_slope(p[_INV_V + 2], g[_M_EDGE + 2], sin_ti, cos_ti, prep[6], prep[7])
    f_r, f_g, f_b = r, gr, b
    v_r, v_g, v_b = rough * r, rough * gr, rough * b
    d_r = d_g = d_b = z_r = z_g = z_b = 0.0
    s_r, s_g, s_b = m_r * r, m_g * gr, m_b * b
    reflect = 2.0 * over_f - 2.0 * over_t
    e_r, e_g, e_b = (
        (reflect + over_f * (m_r - 3.0)) * r,
        (reflect + over_f * (m_g - 3.0)) * gr,
        (reflect + over_f * (m_b - 3.0)) * b,
    )

    d = _azimuthal(p, phi - prep[8])
    if d > 0.0:
        lobe = d * _longitudinal(p[_M_SCALE], p[_INV_V], sin_ti, cos_ti, prep[0], prep[1])
        if lobe > 0.0:
            value = lobe * prep[11]
            by_s, _by_phi = _azimuthal_slopes(p, g, phi - prep[8])
            zero = value * _longitudinal_slope(p[_INV_V], g[_M_EDGE], sin_ti, cos_ti, prep[0], prep[1])
            f_r, f_g, f_b = f_r + value, f_g + value, f_b + value
            z_r, z_g, z_b = z_r + zero, z_g + zero, z_b + zero
            d_r, d_g, d_b = d_r + by_s * value, d_g + by_s * value, d_b + by_s * value
            e_r, e_g, e_b = e_r + over_f * value, e_g + over_f * value, e_b + over_f * value
            pdf += lobe * prep[21]

    d = _azimuthal(p, phi - prep[9])
    if d > 0.0:
        lobe = d * _longitudinal(p[_M_SCALE + 1], p[_INV_V + 1], sin_ti, cos_ti, prep[2], prep[3])
        if lobe > 0.0:
            r, gr, b = lobe * prep[12], lobe * prep[13], lobe * prep[14]
            by_s, by_phi = _azimuthal_slopes(p, g, phi - prep[9])
            rough = _longitudinal_slope(p[_INV_V + 1], g[_M_EDGE + 1], sin_ti, cos_ti, prep[2], prep[3])
            by_eta = 2.0 * gamma_slope * by_phi - 2.0 * over_t
            f_r, f_g, f_b = f_r + r, f_g + gr, f_b + b
            v_r, v_g, v_b = v_r + rough * r, v_g + rough * gr, v_b + rough * b
            d_r, d_g, d_b = d_r + by_s * r, d_g + by_s * gr, d_b + by_s * b
            s_r, s_g, s_b = s_r + r, s_g + gr, s_b + b
            e_r, e_g, e_b = e_r + by_eta * r, e_g + by_eta * gr, e_b + by_eta * b
            pdf += lobe * prep[22]

    d = _azimuthal(p, phi - prep[10])
    if d > 0.0:
        if p[_SIN_TILT] != 0.0:
            m_rest = _longitudinal(p[_M_SCALE + 2], p[_INV_V + 2], sin_ti, cos_ti, prep[4], prep[5])
        lobe = d * m_rest
        if lobe > 0.0:
            r, gr, b = lobe * prep[15], lobe * prep[16], lobe * prep[17]
            by_s, by_phi = _azimuthal_slopes(p, g, phi - prep[10])
            rough = _longitudinal_slope(p[_INV_V + 2], g[_M_EDGE + 2], sin_ti, cos_ti, prep[4], prep[5])
            by_eta = 4.0 * gamma_slope * by_phi + over_f - 2.0 * over_t
            f_r, f_g, f_b = f_r + r, f_g + gr, f_b + b
            v_r, v_g, v_b = v_r + rough * r, v_g + rough * gr, v_b + rough * b
            d_r, d_g, d_b = d_r + by_s * r, d_g + by_s * gr, d_b + by_s * b
            s_r, s_g, s_b = s_r + 2.0 * r, s_g + 2.0 * gr, s_b + 2.0 * b
            e_r, e_g, e_b = e_r + by_eta * r, e_g + by_eta * gr, e_b + by_eta * b
            pdf += lobe * prep[23]

    # From sigma to C and gamma_N, from ln v and ln s to gammas.
    s_r, s_g, s_b = -length * s_r, -length * s_g, -length * s_b
    along = length_slope / length
    k_m, k_m0, k_s, k_n = g[_V_BY_M], g[_V_BY_M0], g[_S_BY_N], g[_SIGMA_BY_N]
    return (f_r, f_g, f_b, pdf), (
        _by_albedo(p, g, 0, s_r), _by_albedo(p, g, 1, s_g), _by_albedo(p, g, 2, s_b),
        k_m * v_r, k_m * v_g, k_m * v_b,
        k_s * d_r + k_n * p[_SIGMA] * s_r, k_s * d_g + k_n * p[_SIGMA + 1] * s_g,
        k_s * d_b + k_n * p[_SIGMA + 2] * s_b,
        k_m0 * z_r, k_m0 * z_g, k_m0 * z_b,
        e_r + along * p[_SIGMA] * s_r, e_g + along * p[_SIGMA + 1] * s_g, e_b + along * p[_SIGMA + 2] * s_b,
    )  # fmt: skip
