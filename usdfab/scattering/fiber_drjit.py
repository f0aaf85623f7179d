"""The near-field fiber BSDF for Dr.Jit: pack a material, prepare a vertex, then evaluate and sample.

    S(theta_i, theta_o, phi) = sum_p M_p(theta_i, theta_o) A_p(h, theta_o) D(phi - Phi_p(h)),  p = R, TT, TRT, rest

The model, the names, the notation and the references are those of `usdfab.scattering.fiber_numba`; tests hold the two
together. When to use it: inside `usdfab.mi.fiber_bsdf`, to render and to differentiate. All functions trace arrays of
any backend and precision, colours being any Dr.Jit array of three; they know nothing of Mitsuba and check nothing.

What differs, because Dr.Jit works in float32, traces both sides of every choice and differentiates them:
    x, z       Components of wo across the fiber: x = h cos(theta_o) along axis x normal, z = cos(theta_o) cos(gamma_o)
               along the normal (axis y, normal z: the frame of a hit in Mitsuba). All that depends on h is a function
               of them without a division by cos(theta_o) or a difference of near numbers: the cosine at which light
               meets the surface is z itself, tan(gamma_t) = x / sqrt(eta^2 - 1 + z^2).
    alpha      Azimuth counted from the normal, atan2(x, z), instead of phi, which is counted from wo: phi is
               alpha_i - alpha_o. No frame along wo is needed.
    exponents  (cos(theta_i + theta_o) - 1) / v is a sum of squares of differences and keeps its digits at 1 / v = 7e4.
    gradients  Guards hold the argument of a root, a logarithm or a quotient away from where its derivative is infinite,
               also in the branch that is not taken: infinity times zero is not a number.

Samples are made without gradients ("detached"): the lobe is a discrete choice, through which no derivative goes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import drjit as dr

__all__ = [
    "PackedFiber",
    "PreparedFiber",
    "absorption_from_albedo",
    "azimuth",
    "eval_fiber",
    "pack_fiber",
    "prepare_fiber",
    "sample_fiber",
]

_PI = math.pi
_TWO_PI = 2.0 * math.pi
_INV_TWO_PI = 0.5 / math.pi

# 2 pi in two parts, the first exact in float32 together with its small multiples.
_TWO_PI_HIGH = 6.28125
_TWO_PI_LOW = _TWO_PI - _TWO_PI_HIGH

_U_MIN = 2.0**-25
"""Half of the smallest step of a float32 random number."""

_U_MAX = 1.0 - 2.0**-24
"""The largest float32 below 1."""

_ALBEDO_MIN = 1e-12
_ETA_MIN = 1.0 + 1e-6


class PackedFiber(NamedTuple):
    """Constants of a material: Dr.Jit arrays of size 1, or one entry per lane. Lobes R, TT, TRT; the rest has v of TRT.

    They are differentiable functions of the parameters. `tilt` may be a plain number, which is then a part of the
    program (without tilt less is computed), or an array where materials of several tilts meet in one program.
    """

    sigma: Any  # absorption, three colours
    eta: Any
    eta2_minus_1: Any
    s: Any
    inv_s: Any
    d_scale: Any  # 1 / (s Z), Z the mass of the untrimmed logistic inside [-pi, pi]
    d_below: Any  # its mass below -pi
    d_inside: Any  # Z
    v: tuple[Any, Any, Any]
    inv_v: tuple[Any, Any, Any]
    m_scale: tuple[Any, Any, Any]  # 1 / (v (1 - e^(-2/v)))
    m_range: tuple[Any, Any, Any]  # 1 - e^(-2/v)
    tilt: Any

    @property
    def tilted(self) -> bool:
        """Whether any lane may have a tilt."""
        return not isinstance(self.tilt, (int, float)) or self.tilt != 0.0

    def arrays(self) -> list[Any]:
        """All Dr.Jit arrays but the tilt, to be evaluated together."""
        return [self.sigma, *self[1:8], *self.v, *self.inv_v, *self.m_scale, *self.m_range]


class PreparedFiber(NamedTuple):
    """What about a vertex does not depend on the incident direction. Lobes in the order R, TT, TRT, the rest."""

    sin_o: tuple[Any, Any, Any, Any]  # theta_o, tilted
    cos_o: tuple[Any, Any, Any, Any]
    center: tuple[Any, Any, Any]  # alpha at which D of R, TT, TRT has its peak
    attenuation: tuple[Any, Any, Any, Any]  # A_p: R without colour, the others of three colours
    share: tuple[Any, Any, Any, Any]  # probabilities


def absorption_from_albedo(albedo: Any, gamma_n: Any) -> Any:
    """Absorption sigma_a from the albedo coefficient C, Chiang et al. 2015; its derivative at C = 1 is 0.

    C is held in [1e-12, 1], gamma_N in [0.01, 1]. See `usdfab.scattering.roughness.absorption_from_albedo`.
    """
    g = dr.clip(gamma_n, 0.01, 1.0)
    polynomial = 5.969 + g * (-0.215 + g * (2.532 + g * (-10.73 + g * (5.574 + g * 0.245))))
    return dr.square(dr.log(dr.clip(albedo, _ALBEDO_MIN, 1.0)) / polynomial)


def pack_fiber(albedo: Any, gamma_m: Any, gamma_n: Any, gamma_m0: Any, eta: Any, tilt: Any = 0.0) -> PackedFiber:
    """Precompute the constants of a fiber material, with gradients.

    Parameters
    ----------
    albedo: array of three
        Albedo coefficient C, linear RGB. Range: (0, 1].
    gamma_m, gamma_n, gamma_m0: array
        Longitudinal, azimuthal and primary reflection roughness. Range: [0.01, 1].
    eta: array
        Index of refraction of the fiber over that of the medium around it. Range: (1, inf).
    tilt: float or array
        Cuticle tilt a, rad. Range: [-pi/8, pi/8].

    Values outside of a range count as its nearest end and get no gradient: a step of an optimizer that goes too far
    leaves finite pictures.
    """
    g = dr.clip(gamma_n, 0.01, 1.0)
    g2 = g * g
    g4 = g2 * g2
    g22 = dr.square(dr.square(g4)) * g4 * g2
    s = math.sqrt(_PI / 8.0) * (0.265 * g + 1.194 * g2 + 5.372 * g22)
    # Trimmed logistic: CDF(x) = 1 / (1 + e^(-x/s)), so CDF(pi) - CDF(-pi) = tanh(pi / 2s).
    inside = dr.tanh(_PI / (2.0 * s))
    below = dr.exp(-_PI / s)

    v_rough = _longitudinal_variance(gamma_m)
    v = (_longitudinal_variance(gamma_m0), 0.25 * v_rough, 4.0 * v_rough)
    inv_v = tuple(1.0 / x for x in v)
    # 1 - e^(-2 y) = 2 tanh(y) / (1 + tanh(y)), exact also for small y.
    tanh = [dr.tanh(x) for x in inv_v]
    m_range = tuple(2.0 * t / (1.0 + t) for t in tanh)
    n = dr.maximum(eta, _ETA_MIN)
    return PackedFiber(
        sigma=absorption_from_albedo(albedo, gamma_n),
        eta=n,
        eta2_minus_1=(n - 1.0) * (n + 1.0),
        s=s,
        inv_s=1.0 / s,
        d_scale=1.0 / (s * inside),
        d_below=below / (1.0 + below),
        d_inside=inside,
        v=v,
        inv_v=inv_v,
        m_scale=tuple(i / r for i, r in zip(inv_v, m_range, strict=True)),
        m_range=m_range,
        tilt=tilt,
    )


def _longitudinal_variance(gamma_m: Any) -> Any:
    """v = (0.726 g + 0.812 g^2 + 3.7 g^20)^2, Chiang et al. 2015."""
    g = dr.clip(gamma_m, 0.01, 1.0)
    g2 = g * g
    g4 = g2 * g2
    return dr.square(0.726 * g + 0.812 * g2 + 3.7 * dr.square(dr.square(g4)) * g4)


# --- The pieces that evaluation and sampling share ---


def _scaled_bessel(a: Any) -> tuple[Any, Any]:
    """I0(a) as (factor, exponent): factor e^exponent; the exponent is a for large a, 0 for small.

    The two least-maximum fits of the Numba target, relative error 2e-8. Each sees its own interval only, so that
    neither it nor its derivative overflows in the other.
    """
    small = dr.minimum(a, 5.0)
    x = small * small
    below = 4.3284612068228183e-10 + x * 3.4074463779672236e-12
    below = 6.7745472060247186e-06 + x * (6.85320849661319e-08 + x * below)
    below = 0.015624911348234745 + x * (0.000434064719286229 + x * below)
    below = 0.9999999906144375 + x * (0.2500000750636793 + x * below)
    root = dr.rsqrt(dr.maximum(a, 5.0))
    x = root * root
    above = 16.365955390366384 + x * -26.137822445613317
    above = 0.4243761206049833 + x * (-3.4661366494266534 + x * above)
    above = 0.028579972217730794 + x * (0.008627573219322504 + x * above)
    above = 0.3989422883840288 + x * (0.04986269455300198 + x * above)
    is_small = a < 5.0
    return dr.select(is_small, below, above * root), dr.select(is_small, 0.0, a)


def _longitudinal(p: PackedFiber, k: int, distance: Any, cos_cos: Any) -> Any:
    """M_p, per radian of theta_i over cos(theta_i), of the k-th variance; d'Eon et al. 2011.

    M = exp(-(1 + sin_i sin_o) / v) I0(cos_i cos_o / v) / (v (1 - e^(-2/v))), with `cos_cos` = cos_i cos_o and
    `distance` = 1 + sin_i sin_o - cos_cos = 1 - cos(theta_i + theta_o).
    """
    a = cos_cos * p.inv_v[k]
    bessel, exponent = _scaled_bessel(a)
    return p.m_scale[k] * bessel * dr.exp(exponent - a - distance * p.inv_v[k])


def _mirror_distance(sin_i: Any, cos_i: Any, sin_o: Any, cos_o: Any) -> Any:
    """1 - cos(theta_i + theta_o): half the squared distance of two points of the unit circle."""
    return 0.5 * (dr.square(sin_i + sin_o) + dr.square(cos_i - cos_o))


def _azimuthal(p: PackedFiber, x: Any) -> Any:
    """D, per radian: logistic density at the angle x (any), trimmed to [-pi, pi] and normalised there."""
    turns = dr.round(x * _INV_TWO_PI)
    x = dr.fma(turns, -_TWO_PI_LOW, dr.fma(turns, -_TWO_PI_HIGH, x))
    e = dr.exp(-dr.abs(x) * p.inv_s)
    return p.d_scale * e / dr.square(1.0 + e)


def _fresnel(cos_i: Any, g: Any, eta2: Any) -> tuple[Any, Any]:
    """Unpolarised Fresnel reflectance F of a dielectric from outside, and 1 - F with all its digits.

    g is eta cos(theta_t) = sqrt(eta^2 - 1 + cos_i^2) > 0.
    """
    s = 1.0 / (cos_i + g)
    p = 1.0 / (eta2 * cos_i + g)
    reflect = 0.5 * (dr.square((cos_i - g) * s) + dr.square((eta2 * cos_i - g) * p))
    # 1 - ((a - b) / (a + b))^2 = 4 a b / (a + b)^2.
    return reflect, 2.0 * cos_i * g * (s * s + eta2 * p * p)


def azimuth(x: Any, z: Any) -> Any:
    """alpha = atan2(x, z), 0 where both vanish, with finite derivatives.

    Absolute error 2e-7 in float32; Dr.Jit's own `atan2` (1.5) has 8e-7, which made values of lobes of s = 0.01 wrong
    by 2e-4. A least-maximum polynomial for the arc tangent of the smaller over the larger, relative error 2e-8.
    """
    a, b = dr.abs(x), dr.abs(z)
    t = dr.minimum(a, b) / dr.maximum(dr.maximum(a, b), 1e-12)
    u = t * t
    y = 0.04269138206110059 + u * (-0.016068544318339487 + u * 0.0028498684166374014)
    y = 0.10640928617649265 + u * (-0.07504282962282417 + u * y)
    y = 0.1999261922126337 + u * (-0.14203643095918259 + u * y)
    y = t * (0.9999999847651483 + u * (-0.33333073336995556 + u * y))
    y = dr.select(a > b, 0.5 * _PI - y, y)
    y = dr.select(z < 0.0, _PI - y, y)
    return dr.select(x < 0.0, -y, y)


# --- What the plugin calls ---


def prepare_fiber(p: PackedFiber, x: Any, sin_to: Any, z: Any) -> PreparedFiber:
    """Everything about a vertex that does not depend on the incident direction.

    Parameters
    ----------
    p: PackedFiber
        Material.
    x, sin_to, z: array
        Unit direction wo in the frame of the hit: along axis x normal, along the axis, along the normal.

    References: Chiang et al. 2015 (A_p); Marschner et al. 2003 (Phi and the modified index eta').
    """
    # The gradient of a root is infinite at 0: below 1e-8 the cosine no longer follows.
    cos2_to = x * x + z * z
    cos_to = dr.sqrt(dr.maximum(cos2_to, 1e-16))
    alpha_o = azimuth(x, z)
    gamma_o = dr.select(z < 0.0, dr.copysign(_PI, alpha_o) - alpha_o, alpha_o)

    # Refraction, with eta' = sqrt(eta^2 - sin^2 theta_o) / cos theta_o and sin gamma_t = h / eta'.
    cos_i = dr.abs(z)
    g = dr.sqrt(p.eta2_minus_1 + z * z)  # eta' cos theta_o cos gamma_t
    two_gamma_t = 2.0 * azimuth(x, g)

    # Phi = 2 p gamma_t - 2 gamma_o + p pi, counted from the normal; eval wraps, so whole turns are left out.
    center_r = alpha_o - 2.0 * gamma_o
    center = (center_r, center_r + two_gamma_t + _PI, center_r + 2.0 * two_gamma_t)

    # Attenuation: T = exp(-sigma_a 2 cos gamma_t / cos theta_t) over one crossing.
    f, one_minus_f = _fresnel(cos_i, g, p.eta2_minus_1 + 1.0)
    transmit = dr.exp(-p.sigma * (2.0 * p.eta * g / (p.eta2_minus_1 + cos2_to)))
    inside = f * transmit
    tt = one_minus_f * one_minus_f * transmit
    trt = tt * inside
    # A_rest = A_TRT F T / (1 - F T), the sum of all later lobes. Where F = 1 both sides of the fraction vanish, the
    # numerator twice: (1 - F) / (1 - F T) stays below 1. The guard is such that its inverse square is a float32.
    fraction = one_minus_f / dr.maximum(one_minus_f + f * (1.0 - transmit), 1e-12)
    rest = one_minus_f * fraction * transmit * inside * inside

    # A lobe's probability is its share of the mean of the three colours: no weight can then exceed 3.
    sums = (3.0 * f, *(lobe[0] + lobe[1] + lobe[2] for lobe in (tt, trt, rest)))
    scale = 1.0 / (sums[0] + sums[1] + sums[2] + sums[3])

    # Tilted cuticle: theta_o - 2 a, theta_o + a, theta_o + 4 a; past the pole the cosine keeps its sign positive.
    sin_o, cos_o = [sin_to] * 4, [cos_to] * 4
    if p.tilted:
        for k, factor in enumerate((2.0, -1.0, -4.0)):
            sin_a, cos_a = dr.sin(factor * p.tilt), dr.cos(factor * p.tilt)
            sin_o[k] = sin_to * cos_a - cos_to * sin_a
            cos_o[k] = dr.abs(cos_to * cos_a + sin_to * sin_a)
    return PreparedFiber(
        sin_o=tuple(sin_o),
        cos_o=tuple(cos_o),
        center=center,
        attenuation=(f, tt, trt, rest),
        share=tuple(part * scale for part in sums),
    )


def eval_fiber(p: PackedFiber, prep: PreparedFiber, sin_ti: Any, cos_ti: Any, alpha: Any) -> tuple[Any, Any]:
    """Value of the BSDF times cosine, three colours, and the density with which `sample_fiber` takes the direction.

    Parameters
    ----------
    p, prep: PackedFiber, PreparedFiber
        Material and vertex.
    sin_ti, cos_ti: array
        Sine and cosine of the inclination of wi. Range: [-1, 1], [0, 1].
    alpha: array
        Azimuth of wi counted from the normal, rad, any.

    Returns
    -------
    value, pdf: array of three, array
        Per steradian. The integral of the value over all directions is the albedo of the fiber seen from wo at h, that
        of the density is 1.
    """
    value, pdf = 0.0, 0.0
    m: Any = None
    for k in range(4):
        # Without tilt the lobes differ by variance alone, and TRT and the rest have the same M.
        if k == 0 or p.tilted:
            distance = _mirror_distance(sin_ti, cos_ti, prep.sin_o[k], prep.cos_o[k])
            cos_cos = cos_ti * prep.cos_o[k]
        if k < 3 or p.tilted:
            m = _longitudinal(p, min(k, 2), distance, cos_cos)
        lobe = m * (_azimuthal(p, alpha - prep.center[k]) if k < 3 else _INV_TWO_PI)
        value = value + lobe * prep.attenuation[k]
        pdf = pdf + lobe * prep.share[k]
    return value, pdf


def sample_fiber(p: PackedFiber, prep: PreparedFiber, u0: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
    """Take an incident direction: a lobe by its share of the attenuation, then M_p and D_p exactly.

    Parameters
    ----------
    p, prep: PackedFiber, PreparedFiber
        Material and vertex, without gradients.
    u0, u1, u2: array
        Independent uniform numbers in [0, 1). u0 takes the lobe, and what is left of its digits the way around the
        mirror cone, which needs the fewest.

    Returns
    -------
    sin_ti, cos_ti, alpha: array
        The direction as `eval_fiber` takes it.

    References: d'Eon et al. 2011 (M); D by the inverse of the logistic's distribution function.
    """
    # Lobe.
    bounds = [prep.share[0], prep.share[0] + prep.share[1], prep.share[0] + prep.share[1] + prep.share[2]]
    below = [u0 < bound for bound in bounds]

    def of_lobe(r: Any, tt: Any, trt: Any, rest: Any) -> Any:
        return dr.select(below[0], r, dr.select(below[1], tt, dr.select(below[2], trt, rest)))

    left = (u0 - of_lobe(0.0, *bounds)) / dr.maximum(of_lobe(*prep.share), 1e-12)
    v = of_lobe(*p.v, p.v[2])
    m_range = of_lobe(*p.m_range, p.m_range[2])
    sin_o = of_lobe(*prep.sin_o) if p.tilted else prep.sin_o[0]
    cos_o = of_lobe(*prep.cos_o) if p.tilted else prep.cos_o[0]

    # Inclination. M is the distribution of sin(theta_i) of a direction spread around the mirror cone's -theta_o with
    # density ~ e^(cos(x) / v) (von Mises-Fisher): draw 1 - cos(x), then the way around, of which half a turn is enough.
    # The cosine comes from the two other components: 1 - sin^2 would leave half of its digits near the axis.
    drop = dr.minimum(-v * dr.log(dr.maximum(1.0 - u1 * m_range, _U_MIN)), 2.0)
    radius = dr.sqrt(dr.maximum(drop * (2.0 - drop), 0.0))
    sin_psi, cos_psi = dr.sincos(_PI * dr.clip(left, 0.0, 1.0))
    sin_ti = dr.clip(radius * cos_psi * cos_o - (1.0 - drop) * sin_o, -1.0, 1.0)
    cos_ti = dr.minimum(dr.hypot((1.0 - drop) * cos_o + radius * cos_psi * sin_o, radius * sin_psi), 1.0)

    # Azimuth.
    y = dr.clip(p.d_below + u2 * p.d_inside, _U_MIN, _U_MAX)
    x = dr.clip(p.s * dr.log(y / (1.0 - y)), -_PI, _PI)
    alpha = dr.select(below[2], of_lobe(*prep.center, 0.0) + x, _TWO_PI * u2)
    return sin_ti, cos_ti, alpha
