"""The near-field fiber BSDF for Numba: pack a material, prepare a vertex, then evaluate and sample.

    S(theta_i, theta_o, phi) = sum_p M_p(theta_i, theta_o) A_p(h, theta_o) D(phi - Phi_p(h)),  p = R, TT, TRT, rest

Chiang et al. 2015 as used by Li et al. 2024 (eq. 1 to 3): four lobes, the R lobe with its own roughness gamma_M0.

When to use it: inside a path tracer's kernel. A material is packed once (`pack_fiber`, NumPy, checks its input), the
hit of a ray is prepared once (`load_fiber`, `fiber_frame`, `prepare_fiber`), and what was prepared serves both the
evaluation for next-event estimation and the sampling of the next direction. All functions but `pack_fiber` are Numba
functions of scalars and tuples; none allocates and none checks. Everything is float64: in float32 the exponents of the
narrowest lobes (1 / v up to 7.4e4) would be left with three digits.

Notation
    axis      unit vector along the fiber
    wi, wo    unit directions of incident and outgoing light, both pointing away from the fiber
    theta     inclination from the normal plane, sin(theta) = w . axis, cos(theta) >= 0
    e, f      frame of the normal plane: e along wo projected into it, f = axis x e
    phi       phi_i - phi_o = atan2(wi . f, wi . e), in [-pi, pi]
    h         offset across the fiber at which wo leaves, -(normal . f), in [-1, 1]
    gamma_o, gamma_t   angle in the normal plane outside and inside, sin(gamma_o) = h
    v, s      variance of M_p and scale of D, see `usdfab.scattering.roughness`

Departures from other programs: the value includes the cosine factor, its integral over directions is the albedo of the
fiber seen at (h, theta_o); the Bessel function in M_p is accurate to 3e-8 (Mitsuba 3.9: 6e-3 near an argument of 12, so
that it gains or loses that much energy); the sampling has no clamp that shows, `pdf` is its density.

The model is not reciprocal: A_p depends on theta_o only. Averaged over h it is so between directions with
|theta_i| = |theta_o|, if the tilt is 0.

References: Chiang, Bitterli, Tappan, Burley, "A Practical and Controllable Hair and Fur Model for Production Path
Tracing", 2015; d'Eon, Francois, Hill, Letteri, Aubry, "An Energy-Conserving Hair Reflectance Model", 2011; Marschner et
al., "Light Scattering from Human Hair Fibers", 2003 (Phi, the modified index); Li et al. 2024.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from usdfab.errors import UsdfabError
from usdfab.scattering.elementary_numba import (
    INLINED,
    fast_asin,
    fast_atan2,
    fast_cos_half_turn,
    fast_exp,
    fast_log,
    fast_sincos,
)
from usdfab.scattering.roughness import absorption_from_albedo, azimuthal_scale, lobe_variances

__all__ = [
    "ETA_TEXTILE",
    "FIBER_SIZE",
    "PREPARED_FIBER",
    "ROUGHNESS_RANGE",
    "drawn_lobe",
    "eval_fiber",
    "fiber_angles",
    "fiber_direction",
    "fiber_frame",
    "load_fiber",
    "pack_fiber",
    "prepare_fiber",
    "sample_fiber",
    "sample_fiber_lobe",
    "soften_fiber",
]

ETA_TEXTILE = 1.55
"""Index of refraction of textile fibers against air (Li et al. 2024)."""

ROUGHNESS_RANGE = (0.01, 1.0)
"""Closed range of gamma_M, gamma_N and gamma_M0 in which the fits of Chiang et al. hold and this code is tested."""

FIBER_SIZE = 25
"""Length of the array that `pack_fiber` returns."""

PREPARED_FIBER = 25
"""Length of the tuple that `prepare_fiber` returns."""

# Layout of the packed material `p`. Lobes come in the order R, TT, TRT; the rest shares the variance of TRT.
_SIGMA = 0  # 3: absorption, red, green, blue
_ETA = 3
_ETA2_MINUS_1 = 4
_SIN_TILT = 5  # 3: sine and cosine of 2 a, -a, -4 a
_COS_TILT = 8
_S = 11  # scale of the logistic D
_INV_S = 12
_D_SCALE = 13  # 1 / (s Z), Z the mass of the untrimmed logistic inside [-pi, pi]
_D_BELOW = 14  # its mass below -pi
_D_INSIDE = 15  # Z
_V = 16  # 3: variance
_INV_V = 19  # 3
_M_SCALE = 22  # 3: 1 / (v (1 - e^(-2/v)))

_PI = math.pi
_TWO_PI = 2.0 * math.pi
_INV_TWO_PI = 0.5 / math.pi

# Lobes end where they have fallen to e^-40 of their peak, so that the many pairs of directions far from a narrow lobe
# cost nothing. Samples, made from numbers clamped to [2^-54, 1 - 2^-54], end at e^-37.5 and never meet the cut.
_CUT = 40.0
_U_MIN = 2.0**-54
_U_MAX = 1.0 - 2.0**-53


def pack_fiber(
    albedo: npt.ArrayLike,
    gamma_m: float,
    gamma_n: float,
    gamma_m0: float,
    eta: float = ETA_TEXTILE,
    tilt: float = 0.0,
) -> npt.NDArray[np.float64]:
    """Precompute the constants of a fiber material.

    Once per material; stack the rows of several into an (n, FIBER_SIZE) array for `load_fiber`. What the entries are is
    private to this module.

    Parameters
    ----------
    albedo: (3,) float
        Albedo coefficient C, linear RGB. Range: (0, 1]. C = 1 absorbs nothing, exactly.
    gamma_m, gamma_n: float
        Longitudinal and azimuthal roughness. Range: [0.01, 1].
    gamma_m0: float
        Primary reflection roughness: longitudinal roughness of the R lobe. Range: [0.01, 1].
    eta: float
        Index of refraction of the fiber over that of the medium around it. Range: (1, inf).
    tilt: float
        Cuticle tilt a, rad; shifts the R, TT and TRT lobes by 2 a, -a and -4 a. Range: [-pi/8, pi/8]; 0 for textile.

    Returns
    -------
    (FIBER_SIZE,) float64

    Raises
    ------
    UsdfabError
        If a value is outside its range or not finite.

    Example
    -------
    >>> p = pack_fiber([0.8, 0.4, 0.2], gamma_m=0.5, gamma_n=0.05, gamma_m0=0.12)
    >>> p.shape
    (25,)
    """
    color = np.asarray(albedo, dtype=np.float64)
    if color.shape != (3,):
        raise UsdfabError(f"got an array of shape {color.shape}, expected (3,)", place="albedo", remedy="give RGB")
    if not np.all((color > 0.0) & (color <= 1.0)):
        raise UsdfabError(f"got {color.tolist()}, expected values in (0, 1]", place="albedo")
    low, high = ROUGHNESS_RANGE
    for name, gamma in (("gamma_m", gamma_m), ("gamma_n", gamma_n), ("gamma_m0", gamma_m0)):
        if not low <= gamma <= high:
            raise UsdfabError(f"got {gamma}, expected a roughness in [{low}, {high}]", place=name)
    if not 1.0 < eta < math.inf:
        raise UsdfabError(f"got {eta}, expected an index ratio above 1", place="eta")
    if not abs(tilt) <= _PI / 8.0:
        raise UsdfabError(f"got {tilt}, expected an angle in [-pi/8, pi/8]", place="tilt", remedy="give radians")

    p = np.zeros(FIBER_SIZE, dtype=np.float64)
    p[_SIGMA : _SIGMA + 3] = absorption_from_albedo(color, gamma_n)
    p[_ETA] = eta
    p[_ETA2_MINUS_1] = eta * eta - 1.0
    tilts = np.array([2.0, -1.0, -4.0]) * tilt
    p[_SIN_TILT : _SIN_TILT + 3] = np.sin(tilts)
    p[_COS_TILT : _COS_TILT + 3] = np.cos(tilts)

    _set_azimuthal(p, float(azimuthal_scale(gamma_n)))

    v = lobe_variances(gamma_m, gamma_m0)[:3]
    p[_V : _V + 3] = v
    p[_INV_V : _INV_V + 3] = 1.0 / v
    p[_M_SCALE : _M_SCALE + 3] = -1.0 / (v * np.expm1(-2.0 / v))
    return p


def _set_azimuthal(p: npt.NDArray[np.float64], s: float) -> None:
    """Trimmed logistic: CDF(x) = 1 / (1 + e^(-x/s)), so CDF(pi) - CDF(-pi) = tanh(pi / 2s)."""
    inside = math.tanh(_PI / (2.0 * s))
    p[_S] = s
    p[_INV_S] = 1.0 / s
    p[_D_SCALE] = 1.0 / (s * inside)
    p[_D_BELOW] = math.exp(-_PI / s) / (1.0 + math.exp(-_PI / s))
    p[_D_INSIDE] = inside


def soften_fiber(p: npt.NDArray[np.float64], scale: float) -> npt.NDArray[np.float64]:
    """The material (FIBER_SIZE,) with an azimuthal logistic of at least this scale, rad; it absorbs as before."""
    softer = p.copy()
    _set_azimuthal(softer, max(scale, float(p[_S])))
    return softer


# --- The pieces that evaluation, sampling and density share ---

BESSEL_SPLIT = 5.0
BESSEL_SMALL = (
    *(0.9999999906144375, 0.2500000750636793, 0.015624911348234745, 0.000434064719286229),
    *(6.7745472060247186e-06, 6.85320849661319e-08, 4.3284612068228183e-10, 3.4074463779672236e-12),
)
"""I0(a) below the split: least-maximum coefficients of the powers of a^2, relative error 1e-8."""
BESSEL_LARGE = (
    *(0.3989422883840288, 0.04986269455300198, 0.028579972217730794, 0.008627573219322504),
    *(0.4243761206049833, -3.4661366494266534, 16.365955390366384, -26.137822445613317),
)
"""I0(a) e^-a sqrt(a) above it: of the powers of 1 / a, relative error 2e-8."""


@njit(**INLINED)
def _longitudinal(scale, inv_v, sin_i, cos_i, sin_o, cos_o):
    """M_p, per radian of theta_i over cos(theta_i): the integral of M_p cos(theta_i) over theta_i is 1.

    M = exp(-(1 + sin_i sin_o) / v) I0(cos_i cos_o / v) / (v (1 - e^(-2/v))), d'Eon et al. 2011: this is their
    1 / (2 v sinh(1/v)) written so that nothing overflows. For large arguments a the exponential and I0(a) ~ e^a cancel:
    what stays is (cos(theta_i + theta_o) - 1) / v <= 0.

    I0 is two least-maximum fits; no series, no log.
    """
    a = cos_i * cos_o * inv_v
    b = -(1.0 + sin_i * sin_o) * inv_v
    if a + b < -_CUT:
        return 0.0
    if a < BESSEL_SPLIT:
        x = a * a
        c = BESSEL_SMALL
        bessel = c[6] + x * c[7]
        bessel = c[4] + x * (c[5] + x * bessel)
        bessel = c[2] + x * (c[3] + x * bessel)
        bessel = c[0] + x * (c[1] + x * bessel)
        return scale * fast_exp(b) * bessel
    x = 1.0 / a
    c = BESSEL_LARGE
    bessel = c[6] + x * c[7]
    bessel = c[4] + x * (c[5] + x * bessel)
    bessel = c[2] + x * (c[3] + x * bessel)
    bessel = c[0] + x * (c[1] + x * bessel)
    return scale * fast_exp(a + b) * bessel * math.sqrt(x)


@njit(**INLINED)
def _wrap(x):
    """An angle's equal in [-pi, pi]."""
    return x - _TWO_PI * math.floor(x * _INV_TWO_PI + 0.5)


@njit(**INLINED)
def _azimuthal(p, x):
    """D, per radian: logistic density at the angle x (any), trimmed to [-pi, pi] and normalised there.

    Chiang et al. 2015. D is even, and written in e^(-|x|/s) it cannot overflow.
    """
    x = abs(_wrap(x)) * p[_INV_S]
    if x > _CUT:
        return 0.0
    e = fast_exp(-x)
    return p[_D_SCALE] * e / ((1.0 + e) * (1.0 + e))


@njit(**INLINED)
def _fresnel(cos_i, eta2_minus_1):
    """Unpolarised Fresnel reflectance of a dielectric from outside, 1 at grazing (cos_i = 0)."""
    g = math.sqrt(eta2_minus_1 + cos_i * cos_i)  # eta cos(theta_t)
    eta2_cos = (eta2_minus_1 + 1.0) * cos_i
    r_s = (cos_i - g) / (cos_i + g)
    r_p = (eta2_cos - g) / (eta2_cos + g)
    return 0.5 * (r_s * r_s + r_p * r_p)


@njit(**INLINED)
def _attenuation(reflect, transmit):
    """A_TT, A_TRT and A_rest of one colour from F and T; A_R is F itself. With T = 1 the four sum to 1.

    A_rest = A_TRT F T / (1 - F T), the sum of all later lobes, Chiang et al. 2015.
    """
    inside = reflect * transmit
    tt = (1.0 - reflect) * (1.0 - reflect) * transmit
    trt = tt * inside
    # At |h| = 1 and at grazing F = 1: both sides of the fraction vanish, the numerator twice.
    return tt, trt, trt * inside / max(1.0 - inside, 1e-300)


# --- What the path tracer calls ---


@njit(**INLINED)
def load_fiber(materials, k):
    """Row k of an array of materials as a tuple, to be used as `p` in a kernel.

    A view `materials[k]` works too, but in Numba it counts a reference: an atomic operation per vertex on one counter
    that all threads share. A tuple counts nothing, and what is not used is not loaded.

    Parameters
    ----------
    materials: (n, FIBER_SIZE) float64
        Rows of `pack_fiber`.
    k: int
        Index of the material. Range: [0, n).

    Returns
    -------
    tuple of FIBER_SIZE float
    """
    m = materials
    return (
        *(m[k, 0], m[k, 1], m[k, 2], m[k, 3], m[k, 4], m[k, 5], m[k, 6], m[k, 7], m[k, 8], m[k, 9]),
        *(m[k, 10], m[k, 11], m[k, 12], m[k, 13], m[k, 14], m[k, 15], m[k, 16], m[k, 17], m[k, 18], m[k, 19]),
        *(m[k, 20], m[k, 21], m[k, 22], m[k, 23], m[k, 24]),
    )


@njit(**INLINED)
def prepare_fiber(p, h, sin_to, cos_to):
    """Everything about a vertex that does not depend on the incident direction.

    Once per hit, then any number of `eval_fiber` and `sample_fiber`. Cost: 3 exponentials, 2 arc sines, 4 roots.

    Parameters
    ----------
    p: (FIBER_SIZE,) float64
        Material of `pack_fiber`, a row of several, or a tuple of `load_fiber`.
    h: float
        Offset across the fiber at which wo leaves, -(normal . f). Range: [-1, 1], clamped against rounding.
    sin_to, cos_to: float
        Sine and cosine of the inclination of wo. Range: [-1, 1], [0, 1].

    Returns
    -------
    tuple of 25 float
        Sine and cosine of theta_o for R, TT, TRT (tilted) and the rest; Phi of R, TT, TRT; A_R; A of TT, TRT and the
        rest in RGB; the probabilities of R, TT, TRT and the rest.

    References: Chiang et al. 2015 (A_p); Marschner et al. 2003 (Phi and the modified index eta').
    """
    h = min(max(h, -1.0), 1.0)
    cos_gamma_o = math.sqrt(1.0 - h * h)

    # Refraction, with eta' = sqrt(eta^2 - sin^2 theta_o) / cos theta_o and sin gamma_t = h / eta'.
    eta_cos_tt = math.sqrt(p[_ETA2_MINUS_1] + cos_to * cos_to)  # eta cos theta_t
    sin_gamma_t = h * cos_to / eta_cos_tt
    cos_gamma_t = math.sqrt(1.0 - sin_gamma_t * sin_gamma_t)

    # Phi = 2 p gamma_t - 2 gamma_o + p pi; eval wraps differences, so whole turns are left out.
    phi_r = -2.0 * fast_asin(h)
    two_gamma_t = 2.0 * fast_asin(sin_gamma_t)
    phi_tt = phi_r + two_gamma_t + _PI
    phi_trt = phi_r + 2.0 * two_gamma_t

    # Attenuation: T = exp(-sigma_a 2 cos gamma_t / cos theta_t) over one crossing.
    length = 2.0 * cos_gamma_t * p[_ETA] / eta_cos_tt
    f = _fresnel(cos_to * cos_gamma_o, p[_ETA2_MINUS_1])
    tt_r, trt_r, rest_r = _attenuation(f, fast_exp(-p[_SIGMA] * length))
    tt_g, trt_g, rest_g = _attenuation(f, fast_exp(-p[_SIGMA + 1] * length))
    tt_b, trt_b, rest_b = _attenuation(f, fast_exp(-p[_SIGMA + 2] * length))

    # A lobe's probability is its share of the mean of the three colours: no weight can then exceed 3.
    tt = tt_r + tt_g + tt_b
    trt = trt_r + trt_g + trt_b
    rest = rest_r + rest_g + rest_b
    share = 1.0 / (3.0 * f + tt + trt + rest)

    # Tilted cuticle: theta_o - 2 a, theta_o + a, theta_o + 4 a; past the pole the cosine keeps its sign positive.
    sin_r = sin_to * p[_COS_TILT] - cos_to * p[_SIN_TILT]
    cos_r = abs(cos_to * p[_COS_TILT] + sin_to * p[_SIN_TILT])
    sin_tt = sin_to * p[_COS_TILT + 1] - cos_to * p[_SIN_TILT + 1]
    cos_tt = abs(cos_to * p[_COS_TILT + 1] + sin_to * p[_SIN_TILT + 1])
    sin_trt = sin_to * p[_COS_TILT + 2] - cos_to * p[_SIN_TILT + 2]
    cos_trt = abs(cos_to * p[_COS_TILT + 2] + sin_to * p[_SIN_TILT + 2])

    tilted = (sin_r, cos_r, sin_tt, cos_tt, sin_trt, cos_trt, sin_to, cos_to)
    colors = (f, tt_r, tt_g, tt_b, trt_r, trt_g, trt_b, rest_r, rest_g, rest_b)
    probabilities = (3.0 * f * share, tt * share, trt * share, rest * share)
    return (*tilted, phi_r, phi_tt, phi_trt, *colors, *probabilities)


@njit(**INLINED)
def eval_fiber(p, prep, sin_ti, cos_ti, phi):
    """Value of the BSDF times cosine in RGB, and the density with which `sample_fiber` takes the direction.

    Parameters
    ----------
    p: (FIBER_SIZE,) float64
        Material, as in `prepare_fiber`.
    prep: tuple
        Vertex of `prepare_fiber`, of the same material.
    sin_ti, cos_ti: float
        Sine and cosine of the inclination of wi. Range: [-1, 1], [0, 1].
    phi: float
        phi_i - phi_o, rad, any.

    Returns
    -------
    fr, fg, fb: float
        S cos(theta_i) = sum of M_p A_p D_p, per steradian, so that the integral over all directions is the albedo of
        the fiber seen from wo at h; 1 if the fiber absorbs nothing.
    pdf: float
        Density, per steradian; its integral over all directions is 1.
    """
    (sin_r, cos_r, sin_tt, cos_tt, sin_trt, cos_trt, sin_to, cos_to, phi_r, phi_tt, phi_trt) = prep[:11]
    (f, tt_r, tt_g, tt_b, trt_r, trt_g, trt_b, rest_r, rest_g, rest_b) = prep[11:21]
    (q_r, q_tt, q_trt, q_rest) = prep[21:]

    # The rest: even in azimuth, theta_o without tilt.
    m_rest = _longitudinal(p[_M_SCALE + 2], p[_INV_V + 2], sin_ti, cos_ti, sin_to, cos_to)
    lobe = m_rest * _INV_TWO_PI
    red = lobe * rest_r
    green = lobe * rest_g
    blue = lobe * rest_b
    pdf = lobe * q_rest

    # D first: at common roughness it is zero for most directions, and M, the dearer one, is spared.
    d = _azimuthal(p, phi - phi_r)
    if d > 0.0:
        lobe = d * _longitudinal(p[_M_SCALE], p[_INV_V], sin_ti, cos_ti, sin_r, cos_r)
        red += lobe * f
        green += lobe * f
        blue += lobe * f
        pdf += lobe * q_r

    d = _azimuthal(p, phi - phi_tt)
    if d > 0.0:
        lobe = d * _longitudinal(p[_M_SCALE + 1], p[_INV_V + 1], sin_ti, cos_ti, sin_tt, cos_tt)
        red += lobe * tt_r
        green += lobe * tt_g
        blue += lobe * tt_b
        pdf += lobe * q_tt

    d = _azimuthal(p, phi - phi_trt)
    if d > 0.0:
        # Without tilt TRT and the rest have the same M.
        if p[_SIN_TILT] != 0.0:
            m_rest = _longitudinal(p[_M_SCALE + 2], p[_INV_V + 2], sin_ti, cos_ti, sin_trt, cos_trt)
        lobe = d * m_rest
        red += lobe * trt_r
        green += lobe * trt_g
        blue += lobe * trt_b
        pdf += lobe * q_trt

    return red, green, blue, pdf


@njit(**INLINED)
def drawn_lobe(prep, u):
    """The lobe that a uniform number chooses, and the middle of its azimuth: 0 R, 1 TT, 2 TRT, 3 the rest."""
    if u < prep[21]:
        return 0, prep[8]
    if u < prep[21] + prep[22]:
        return 1, prep[9]
    if u < prep[21] + prep[22] + prep[23]:
        return 2, prep[10]
    return 3, 0.0


@njit(**INLINED)
def _draw(p, prep, u0, u1, u2, u3):
    """A lobe by its share of the attenuation, then M_p and D_p exactly: (lobe, sin_ti, cos_ti, phi).

    References: d'Eon et al. 2011 (M); D by the inverse of the logistic's distribution function.
    """
    lobe, center = drawn_lobe(prep, u0)
    if lobe == 0:
        sin_o, cos_o, v, scale = prep[0], prep[1], p[_V], p[_M_SCALE]
    elif lobe == 1:
        sin_o, cos_o, v, scale = prep[2], prep[3], p[_V + 1], p[_M_SCALE + 1]
    elif lobe == 2:
        sin_o, cos_o, v, scale = prep[4], prep[5], p[_V + 2], p[_M_SCALE + 2]
    else:
        sin_o, cos_o, v, scale = prep[6], prep[7], p[_V + 2], p[_M_SCALE + 2]

    # Inclination. M is the distribution of sin(theta_i) of a direction spread around the mirror cone's -theta_o with
    # density ~ e^(cos(x) / v) (von Mises-Fisher): draw 1 - cos(x), then the way around, of which only the cosine
    # matters, so that half a turn is enough. 1 - e^(-2/v) is 1 / (v scale).
    drop = -v * fast_log(max(1.0 - u1 / (v * scale), _U_MIN))
    drop = min(drop, 2.0)
    sin_ti = math.sqrt(drop * (2.0 - drop)) * fast_cos_half_turn(u2) * cos_o - (1.0 - drop) * sin_o
    sin_ti = min(max(sin_ti, -1.0), 1.0)
    cos_ti = math.sqrt(1.0 - sin_ti * sin_ti)

    # Azimuth.
    if lobe == 3:
        phi = _TWO_PI * u3 - _PI
    else:
        y = min(max(p[_D_BELOW] + u3 * p[_D_INSIDE], _U_MIN), _U_MAX)
        x = p[_S] * fast_log(y / (1.0 - y))
        phi = _wrap(center + min(max(x, -_PI), _PI))

    return lobe, sin_ti, cos_ti, phi


@njit(**INLINED)
def sample_fiber(p, prep, u0, u1, u2, u3):
    """Take an incident direction with density close to the value of the BSDF.

    The weights differ from the albedo by colour only, see `_draw`.

    Parameters
    ----------
    p: (FIBER_SIZE,) float64
        Material, as in `prepare_fiber`.
    prep: tuple
        Vertex of `prepare_fiber`, of the same material.
    u0, u1, u2, u3: float
        Independent uniform numbers. Range: [0, 1).

    Returns
    -------
    sin_ti, cos_ti, phi: float
        The direction: sine and cosine of its inclination, phi_i - phi_o in [-pi, pi].
    wr, wg, wb: float
        Value of `eval_fiber` over density, RGB. Range: [0, 3].
    pdf: float
        Density of `eval_fiber`, per steradian.
    """
    _, sin_ti, cos_ti, phi = _draw(p, prep, u0, u1, u2, u3)
    red, green, blue, pdf = eval_fiber(p, prep, sin_ti, cos_ti, phi)
    inv_pdf = 1.0 / pdf if pdf > 0.0 else 0.0
    return sin_ti, cos_ti, phi, red * inv_pdf, green * inv_pdf, blue * inv_pdf, pdf


@njit(**INLINED)
def sample_fiber_lobe(p, prep, u0, u1, u2, u3):
    """`sample_fiber` with the weight of the lobe that was drawn alone, for when nobody asks for the density.

    Both weights have the same mean over directions. This one costs no evaluation, which is worth more than the little
    that averaging over lobes takes from the noise of coloured fibers.

    Returns
    -------
    sin_ti, cos_ti, phi, wr, wg, wb: float
    """
    lobe, sin_ti, cos_ti, phi = _draw(p, prep, u0, u1, u2, u3)
    # The share of a lobe is the mean of its colours over the mean of all.
    if lobe == 0:
        share = 1.0 / prep[21]
        return sin_ti, cos_ti, phi, prep[11] * share, prep[11] * share, prep[11] * share
    if lobe == 1:
        share = 1.0 / prep[22]
        return sin_ti, cos_ti, phi, prep[12] * share, prep[13] * share, prep[14] * share
    if lobe == 2:
        share = 1.0 / prep[23]
        return sin_ti, cos_ti, phi, prep[15] * share, prep[16] * share, prep[17] * share
    share = 1.0 / prep[24]
    return sin_ti, cos_ti, phi, prep[18] * share, prep[19] * share, prep[20] * share


# --- Between world space and (theta, phi, h) ---


@njit(**INLINED)
def fiber_frame(ax, ay, az, nx, ny, nz, wx, wy, wz):
    """From a hit in world space to what `prepare_fiber` wants, and the frame of the normal plane.

    f = axis x e, h = -(normal . f); the signs are those of Mitsuba's hair BSDF.

    Parameters
    ----------
    ax, ay, az: float
        Axis of the fiber, unit.
    nx, ny, nz: float
        Outward normal at the hit, unit, perpendicular to the axis.
    wx, wy, wz: float
        Outgoing direction wo, away from the surface, unit.

    Returns
    -------
    sin_to, cos_to: float
        Inclination of wo.
    h: float
        Offset across the fiber. Range: [-1, 1].
    ex, ey, ez: float
        Unit vector along wo projected into the normal plane. If wo is along the axis it has no projection: any one,
        to which nothing is sensitive, since then F = 1 and M_R does not depend on azimuth.
    fx, fy, fz: float
        axis x e.
    """
    sin_to = wx * ax + wy * ay + wz * az
    sin_to = min(max(sin_to, -1.0), 1.0)
    ex = wx - sin_to * ax
    ey = wy - sin_to * ay
    ez = wz - sin_to * az
    cos_to = math.sqrt(ex * ex + ey * ey + ez * ez)
    if cos_to < 1e-9:
        # Cross the axis with the coordinate direction that it is farthest from.
        if abs(ax) <= abs(ay) and abs(ax) <= abs(az):
            ex, ey, ez = 0.0, az, -ay
        elif abs(ay) <= abs(az):
            ex, ey, ez = -az, 0.0, ax
        else:
            ex, ey, ez = ay, -ax, 0.0
        scale = 1.0 / math.sqrt(ex * ex + ey * ey + ez * ez)
        cos_to = 0.0
    else:
        scale = 1.0 / cos_to
        cos_to = min(cos_to, 1.0)
    ex *= scale
    ey *= scale
    ez *= scale
    fx = ay * ez - az * ey
    fy = az * ex - ax * ez
    fz = ax * ey - ay * ex
    h = -(nx * fx + ny * fy + nz * fz)
    return sin_to, cos_to, min(max(h, -1.0), 1.0), ex, ey, ez, fx, fy, fz


@njit(**INLINED)
def fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wx, wy, wz):
    """From an incident direction in world space to the arguments of `eval_fiber`.

    Parameters
    ----------
    ax, ay, az, ex, ey, ez, fx, fy, fz: float
        Axis, e and f of `fiber_frame`.
    wx, wy, wz: float
        Incident direction wi, away from the surface, unit.

    Returns
    -------
    sin_ti, cos_ti: float
        Inclination of wi. Range: [-1, 1], [0, 1].
    phi: float
        phi_i - phi_o = atan2(wi . f, wi . e), in [-pi, pi]; 0 along the axis.
    """
    sin_ti = min(max(wx * ax + wy * ay + wz * az, -1.0), 1.0)
    along_e = wx * ex + wy * ey + wz * ez
    along_f = wx * fx + wy * fy + wz * fz
    return sin_ti, math.sqrt(1.0 - sin_ti * sin_ti), fast_atan2(along_f, along_e)


@njit(**INLINED)
def fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi):
    """From what `sample_fiber` gives to an incident direction in world space; the inverse of `fiber_angles`.

    Parameters
    ----------
    ax, ay, az, ex, ey, ez, fx, fy, fz: float
        Axis, e and f of `fiber_frame`.
    sin_ti, cos_ti, phi: float
        Inclination of wi, and phi_i - phi_o, rad.

    Returns
    -------
    wx, wy, wz: float
        Unit vector.
    """
    sin_phi, cos_phi = fast_sincos(phi)
    along_e = cos_ti * cos_phi
    along_f = cos_ti * sin_phi
    wx = sin_ti * ax + along_e * ex + along_f * fx
    wy = sin_ti * ay + along_e * ey + along_f * fy
    wz = sin_ti * az + along_e * ez + along_f * fz
    return wx, wy, wz
