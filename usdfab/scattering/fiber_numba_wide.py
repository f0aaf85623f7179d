"""The fiber BSDF for Numba seen through a pixel that is wide beside the fiber, with derivatives by everything.

D is averaged over a range of h, as if Phi ran straight there; all else is taken at the middle. That is
``fiber_torch.eval_fiber`` with a ``spread``, to which tests hold it: the same model, the same notation.

When to use it: where a picture's gradient by the geometry is wanted, too (h, inclinations and azimuth), as in the
rasterization stage of the fit. Reverse mode: given how a loss changes with the value, the ``..._slopes`` functions
return how it changes with the arguments, and add to a row how it changes with the material's constants.

The constants of a material are a row of ``WIDE_SIZE`` numbers, in the order of ``fiber_torch.PackedFiber``: sigma (3),
eta, 1/s, 1/(s Z), 1/v (3), 1/(v (1 - e^(-2/v))) (3). ``tilts`` makes the constants of the cuticle's tilt, which has no
derivative here.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.scattering.elementary_numba import INLINED, fast_asin, fast_exp
from usdfab.scattering.fiber_numba import _fresnel, _longitudinal
from usdfab.scattering.fiber_numba_grad import _longitudinal_slope

__all__ = ["TILTS_SIZE", "WIDE_SIZE", "tilts", "wide_lobes", "wide_lobes_slopes", "wide_slopes", "wide_value"]

WIDE_SIZE = 12
"""Numbers of a material."""
TILTS_SIZE = 8
"""Numbers that ``tilts`` returns."""

_ETA, _INV_S, _D_SCALE, _INV_V, _M_SCALE = 3, 4, 5, 6, 9
_INV_TWO_PI = 0.5 / math.pi
_NARROW = 1e-2
"""Ranges of Phi below this many s count as points."""


def tilts(tilt: float) -> NDArray[np.float64]:
    """(TILTS_SIZE,) sines, then cosines, of what a cuticle tilt (rad) turns R, TT, TRT and the rest by."""
    turn = tilt * np.array([2.0, -1.0, -4.0, 0.0])
    return np.r_[np.sin(turn), np.cos(turn)]


@njit(**INLINED)
def _turned(turn, k, sin_to, cos_to):
    sin, cos = turn[k], turn[4 + k]
    return sin_to * cos - cos_to * sin, abs(cos_to * cos + sin_to * sin)


@njit(**INLINED)
def wide_lobes(m, turn, sin_to, cos_to, sin_ti, cos_ti):
    """M_p of R, TT, TRT and the rest.

    Parameters
    ----------
    m: (WIDE_SIZE,), turn: (TILTS_SIZE,)
        Material, or tuples of as many.
    """
    so, co = _turned(turn, 0, sin_to, cos_to)
    reflect = _longitudinal(m[_M_SCALE], m[_INV_V], sin_ti, cos_ti, so, co)
    so, co = _turned(turn, 1, sin_to, cos_to)
    tt = _longitudinal(m[_M_SCALE + 1], m[_INV_V + 1], sin_ti, cos_ti, so, co)
    so, co = _turned(turn, 2, sin_to, cos_to)
    trt = _longitudinal(m[_M_SCALE + 2], m[_INV_V + 2], sin_ti, cos_ti, so, co)
    rest = trt
    if turn[0] != 0.0:
        rest = _longitudinal(m[_M_SCALE + 2], m[_INV_V + 2], sin_ti, cos_ti, sin_to, cos_to)
    return reflect, tt, trt, rest


@njit(**INLINED)
def wide_lobes_slopes(m, turn, sin_to, cos_to, sin_ti, cos_ti, lobes, adjoints, row):
    """Derivatives of a loss by the arguments of ``wide_lobes``: (sin_to, cos_to, sin_ti, cos_ti).

    Parameters
    ----------
    lobes, adjoints: tuples of 4
        What ``wide_lobes`` returned, and derivatives of the loss by it.
    row: (WIDE_SIZE,) array
        Where the derivatives by the material are added.
    """
    by_sin_to = by_cos_to = by_sin_ti = by_cos_ti = 0.0
    for k in range(4):
        # d ln M, of which e^b I0(a) with a = cos cos / v, b = -(1 + sin sin) / v is all but the scale.
        weight = adjoints[k] * lobes[k]
        if weight == 0.0:
            continue
        v = min(k, 2)
        inv_v = m[_INV_V + v]
        so, co = _turned(turn, k, sin_to, cos_to)
        a, distance = cos_ti * co * inv_v, 1.0 + sin_ti * so - cos_ti * co
        # u = a (1 - I1(a) / I0(a))
        u = _longitudinal_slope(inv_v, 1.0, sin_ti, cos_ti, so, co) - distance * inv_v
        ratio = 1.0 - u / max(a, 1e-300)
        row[_M_SCALE + v] += weight / m[_M_SCALE + v]
        row[_INV_V + v] -= weight * (distance + u / inv_v)
        by_sin_ti -= weight * so * inv_v
        by_cos_ti += weight * ratio * co * inv_v
        by_so, by_co = -weight * sin_ti * inv_v, weight * ratio * cos_ti * inv_v
        sin, cos = turn[k], turn[4 + k]
        if cos_to * cos + sin_to * sin < 0.0:
            by_co = -by_co
        by_sin_to += by_so * cos + by_co * sin
        by_cos_to += by_co * cos - by_so * sin
    return by_sin_to, by_cos_to, by_sin_ti, by_cos_ti


@njit(**INLINED)
def _logistic(m, x):
    """(sigmoid of an angle over s, D there, the angle wrapped, its turns)."""
    turns = math.floor(x * _INV_TWO_PI + 0.5)
    y = x - 2.0 * math.pi * turns
    e = fast_exp(-abs(y) * m[_INV_S])
    over = 1.0 / (1.0 + e)
    return (over if y >= 0.0 else e * over), m[_D_SCALE] * e * over * over, y, turns


@njit(**INLINED)
def _mean(m, x0, x1):
    """Mean of D over the angles between x0 and x1 (any)."""
    width = x1 - x0
    if abs(width) * m[_INV_S] < _NARROW:
        return _logistic(m, 0.5 * (x0 + x1))[1]
    s0, _, _, t0 = _logistic(m, x0)
    s1, _, _, t1 = _logistic(m, x1)
    # The distribution function at x is turns + (sigmoid - 1/2) / Z.
    return ((t1 - t0) + (s1 - s0) * (m[_D_SCALE] / m[_INV_S])) / width


@njit(**INLINED)
def _mean_slopes(m, x0, x1):
    """(mean of D, its derivatives by x0, x1, 1/s, 1/(s Z))."""
    width, inv_s, scale = x1 - x0, m[_INV_S], m[_D_SCALE]
    if abs(width) * inv_s < _NARROW:
        _, d, y, _ = _logistic(m, 0.5 * (x0 + x1))
        e = fast_exp(-abs(y) * inv_s)
        tangent = (1.0 - e) / (1.0 + e)
        by_x = -0.5 * d * tangent * math.copysign(inv_s, y)
        return d, by_x, by_x, -d * tangent * abs(y), d / scale
    s0, d0, y0, t0 = _logistic(m, x0)
    s1, d1, y1, t1 = _logistic(m, x1)
    over = 1.0 / width
    rise = s1 - s0
    mean = ((t1 - t0) + rise * (scale / inv_s)) * over
    by_scale = rise / inv_s * over
    by_inv_s = ((d1 * y1 - d0 * y0) / inv_s - rise * scale / (inv_s * inv_s)) * over
    return mean, (mean - d0) * over, (d1 - mean) * over, by_inv_s, by_scale


@njit(**INLINED)
def _refracted(m, h, cos_to):
    """(eta cos theta_t, sin gamma_t / h, cos gamma_t, length of a crossing)."""
    eta = m[_ETA]
    eta_cos_tt = math.sqrt(eta * eta - 1.0 + cos_to * cos_to)
    ratio = cos_to / eta_cos_tt
    cos_gt = math.sqrt(1.0 - h * h * ratio * ratio)
    return eta_cos_tt, ratio, cos_gt, 2.0 * eta * cos_gt / eta_cos_tt


@njit(**INLINED)
def _angles(low, ratio, phi):
    """phi - Phi of R, TT and TRT, up to whole turns."""
    r, two_gt = phi + 2.0 * fast_asin(low), 2.0 * fast_asin(low * ratio)
    return r, r - two_gt - math.pi, r - 2.0 * two_gt


@njit(**INLINED)
def wide_value(m, lobes, low, high, cos_to, phi):
    """Value of the BSDF times cosine per steradian, averaged over the h between ``low`` and ``high``: RGB.

    Parameters
    ----------
    lobes: tuple of 4
        Of ``wide_lobes``.
    low, high: float
        Inside (-1, 1).
    cos_to, phi: float
        As for ``fiber_torch.eval_fiber``.
    """
    h = 0.5 * (low + high)
    eta = m[_ETA]
    _, ratio, _, length = _refracted(m, h, cos_to)
    reflect = _fresnel(cos_to * math.sqrt(1.0 - h * h), eta * eta - 1.0)
    r0, tt0, trt0 = _angles(low, ratio, phi)
    r1, tt1, trt1 = _angles(high, ratio, phi)
    first = lobes[0] * _mean(m, r0, r1) * reflect
    second = lobes[1] * _mean(m, tt0, tt1)
    third = lobes[2] * _mean(m, trt0, trt1)
    rest = lobes[3] * _INV_TWO_PI
    red = first + _inner(m[0], reflect, length, second, third, rest)
    green = first + _inner(m[1], reflect, length, second, third, rest)
    blue = first + _inner(m[2], reflect, length, second, third, rest)
    return red, green, blue


@njit(**INLINED)
def _inner(sigma, reflect, length, second, third, rest):
    """TT, TRT and the rest of one colour: their M D times their attenuations."""
    transmit = fast_exp(-sigma * length)
    inside = reflect * transmit
    outer = (1.0 - reflect) * (1.0 - reflect) * transmit
    return outer * (second + inside * (third + rest * inside / max(1.0 - inside, 1e-12)))


@njit(**INLINED)
def wide_slopes(m, lobes, low, high, cos_to, phi, weights, row):
    """``wide_value`` and derivatives of a loss by its arguments.

    Parameters
    ----------
    weights: tuple of 3
        Derivatives of the loss by the value.
    row: (WIDE_SIZE,) array
        Where the derivatives by the material are added.

    Returns
    -------
    value (3), by lobes (4), (by low, by high, by cos_to, by phi)
    """
    h = 0.5 * (low + high)
    eta = m[_ETA]
    eta_cos_tt, ratio, cos_gt, length = _refracted(m, h, cos_to)
    cos_h = math.sqrt(1.0 - h * h)
    cos_i = cos_to * cos_h
    g = math.sqrt(eta * eta - 1.0 + cos_i * cos_i)
    reflect = _fresnel(cos_i, eta * eta - 1.0)
    r0, tt0, trt0 = _angles(low, ratio, phi)
    r1, tt1, trt1 = _angles(high, ratio, phi)
    d_r, r_by_0, r_by_1, r_by_s, r_by_scale = _mean_slopes(m, r0, r1)
    d_tt, tt_by_0, tt_by_1, tt_by_s, tt_by_scale = _mean_slopes(m, tt0, tt1)
    d_trt, trt_by_0, trt_by_1, trt_by_s, trt_by_scale = _mean_slopes(m, trt0, trt1)
    first, second, third, rest = lobes[0] * d_r, lobes[1] * d_tt, lobes[2] * d_trt, lobes[3] * _INV_TWO_PI

    # Attenuations of the three colours; sums of derivatives by F, the length of a crossing and the three inner M D.
    total = weights[0] + weights[1] + weights[2]
    sums = total * first, 0.0, 0.0, 0.0, 0.0
    red, sums = _inner_slopes(m[0], weights[0], reflect, length, second, third, rest, sums, row, 0)
    green, sums = _inner_slopes(m[1], weights[1], reflect, length, second, third, rest, sums, row, 1)
    blue, sums = _inner_slopes(m[2], weights[2], reflect, length, second, third, rest, sums, row, 2)
    by_reflect, by_length, by_second, by_third, by_rest = sums
    by_first = total * reflect
    by_lobes = by_first * d_r, by_second * d_tt, by_third * d_trt, by_rest * _INV_TWO_PI
    by_r, by_tt, by_trt = by_first * lobes[0], by_second * lobes[1], by_third * lobes[2]
    row[_INV_S] += by_r * r_by_s + by_tt * tt_by_s + by_trt * trt_by_s
    row[_D_SCALE] += by_r * r_by_scale + by_tt * tt_by_scale + by_trt * trt_by_scale

    # phi - Phi at both ends: phi + 2 asin(x) less 0, 1 or 2 times 2 asin(x ratio).
    r_by_0, tt_by_0, trt_by_0 = by_r * r_by_0, by_tt * tt_by_0, by_trt * trt_by_0
    r_by_1, tt_by_1, trt_by_1 = by_r * r_by_1, by_tt * tt_by_1, by_trt * trt_by_1
    by_0, by_1 = r_by_0 + tt_by_0 + trt_by_0, r_by_1 + tt_by_1 + trt_by_1
    inner_0 = -2.0 * (tt_by_0 + 2.0 * trt_by_0) / math.sqrt(1.0 - low * low * ratio * ratio)
    inner_1 = -2.0 * (tt_by_1 + 2.0 * trt_by_1) / math.sqrt(1.0 - high * high * ratio * ratio)
    by_low = 2.0 * by_0 / math.sqrt(1.0 - low * low) + inner_0 * ratio
    by_high = 2.0 * by_1 / math.sqrt(1.0 - high * high) + inner_1 * ratio
    by_ratio = inner_0 * low + inner_1 * high

    # Length of a crossing, 2 eta cos gamma_t / (eta cos theta_t).
    by_cos_gt = by_length * 2.0 * eta / eta_cos_tt
    by_sin_gt = -by_cos_gt * h * ratio / cos_gt
    by_h = by_sin_gt * ratio
    by_ratio += by_sin_gt * h
    by_eta = by_length * 2.0 * cos_gt / eta_cos_tt
    by_eta_cos = -by_length * length / eta_cos_tt - by_ratio * ratio / eta_cos_tt
    by_cos_to = by_ratio / eta_cos_tt + by_eta_cos * cos_to / eta_cos_tt
    by_eta += by_eta_cos * eta / eta_cos_tt

    # Fresnel: r = (a - g) / (a + g), a = c and eta^2 c.
    a = eta * eta * cos_i
    over_s, over_p = 1.0 / (cos_i + g), 1.0 / (a + g)
    by_s = by_reflect * (cos_i - g) * over_s * 2.0 * over_s * over_s
    by_p = by_reflect * (a - g) * over_p * 2.0 * over_p * over_p
    by_g = -by_s * cos_i - by_p * a
    by_cos_i = by_s * g + by_p * g * eta * eta + by_g * cos_i / g
    by_eta += by_p * g * 2.0 * eta * cos_i + by_g * eta / g
    by_cos_to += by_cos_i * cos_h
    by_h -= by_cos_i * cos_to * h / cos_h
    row[_ETA] += by_eta
    by_low, by_high = by_low + 0.5 * by_h, by_high + 0.5 * by_h
    base = first * reflect
    return (base + red, base + green, base + blue), by_lobes, (by_low, by_high, by_cos_to, by_0 + by_1)


@njit(**INLINED)
def _inner_slopes(sigma, weight, reflect, length, second, third, rest, sums, row, channel):
    """``_inner``, and ``sums`` with this colour's derivatives by F, the length and the three M D added."""
    transmit = fast_exp(-sigma * length)
    inside = reflect * transmit
    outer = (1.0 - reflect) * (1.0 - reflect) * transmit
    over = 1.0 / max(1.0 - inside, 1e-12)
    chain = third + rest * inside * over
    bracket = second + inside * chain
    by_outer, by_inside = weight * bracket, weight * outer * (chain + inside * rest * over * over)
    by_transmit = by_outer * (1.0 - reflect) * (1.0 - reflect) + by_inside * reflect
    row[channel] -= by_transmit * transmit * length
    weighted = weight * outer
    return outer * bracket, (
        sums[0] + by_inside * transmit - 2.0 * by_outer * (1.0 - reflect) * transmit,
        sums[1] - by_transmit * transmit * sigma,
        sums[2] + weighted,
        sums[3] + weighted * inside,
        sums[4] + weighted * inside * inside * over,
    )
