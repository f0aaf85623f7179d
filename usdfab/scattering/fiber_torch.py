"""The near-field fiber BSDF for torch: pack a material, then evaluate, with gradients in everything.

    S(theta_i, theta_o, phi) = sum_p M_p(theta_i, theta_o) A_p(h, theta_o) D(phi - Phi_p(h)),  p = R, TT, TRT, rest

The model, the names, the notation and the references are those of `usdfab.scattering.fiber_numba`; tests hold the two
together. When to use it: where geometry is differentiated too (h and the angles carry gradients), as in the
rasterization stage of the fit. Nothing is sampled here. Any floating-point type; shapes broadcast.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["PackedFiber", "absorption_from_albedo", "eval_fiber", "pack_fiber"]

_H_MAX = 1.0 - 1e-6
"""Beyond, the derivative of arc sine and root is no longer of use."""


class PackedFiber(NamedTuple):
    """Constants of a material, differentiable functions of its parameters. Lobes R, TT, TRT; the rest has v of TRT."""

    sigma: Tensor  # (..., 3)
    eta: Tensor
    inv_s: Tensor
    d_scale: Tensor  # 1 / (s Z), Z the mass of the untrimmed logistic inside [-pi, pi]
    inv_v: tuple[Tensor, Tensor, Tensor]
    m_scale: tuple[Tensor, Tensor, Tensor]  # 1 / (v (1 - e^(-2/v)))
    tilt: float


def absorption_from_albedo(albedo: Tensor, gamma_n: Tensor) -> Tensor:
    """Absorption sigma_a from the albedo coefficient C, per fiber radius (Chiang et al. 2015)."""
    g = gamma_n
    polynomial = 5.969 + g * (-0.215 + g * (2.532 + g * (-10.73 + g * (5.574 + g * 0.245))))
    return (torch.log(albedo) / polynomial) ** 2


def pack_fiber(
    albedo: Tensor, gamma_m: Tensor, gamma_n: Tensor, gamma_m0: Tensor, eta: Tensor, tilt: float = 0.0
) -> PackedFiber:
    """The constants of a fiber material.

    Parameters
    ----------
    albedo: (..., 3)
        Albedo coefficient C, linear RGB, in (0, 1].
    gamma_m, gamma_n, gamma_m0:
        Longitudinal, azimuthal and primary reflection roughness, in [0.01, 1].
    eta:
        Index of refraction, above 1.
    tilt:
        Cuticle tilt, rad; a plain number.
    """
    s = math.sqrt(math.pi / 8.0) * (0.265 * gamma_n + 1.194 * gamma_n**2 + 5.372 * gamma_n**22)
    inside = torch.tanh(math.pi / (2.0 * s))
    rough = _variance(gamma_m)
    v = (_variance(gamma_m0), 0.25 * rough, 4.0 * rough)
    return PackedFiber(
        absorption_from_albedo(albedo, gamma_n),
        eta,
        1.0 / s,
        1.0 / (s * inside),
        (1.0 / v[0], 1.0 / v[1], 1.0 / v[2]),
        tuple(-1.0 / (x * torch.expm1(-2.0 / x)) for x in v),  # type: ignore[arg-type]
        tilt,
    )


def _variance(g: Tensor) -> Tensor:
    """v = (0.726 g + 0.812 g^2 + 3.7 g^20)^2, Chiang et al. 2015."""
    return (0.726 * g + 0.812 * g**2 + 3.7 * g**20) ** 2


def _longitudinal(p: PackedFiber, k: int, distance: Tensor, cos_cos: Tensor) -> Tensor:
    """M_p, per radian of theta_i over cos(theta_i), of the k-th variance; d'Eon et al. 2011.

    M = exp(-(1 + sin_i sin_o) / v) I0(cos_i cos_o / v) / (v (1 - e^(-2/v))), with `cos_cos` = cos_i cos_o and
    `distance` = 1 + sin_i sin_o - cos_cos = 1 - cos(theta_i + theta_o); i0e(a) is I0(a) e^-a.
    """
    return p.m_scale[k] * torch.special.i0e(cos_cos * p.inv_v[k]) * torch.exp(-distance * p.inv_v[k])


def _azimuthal(p: PackedFiber, x: Tensor) -> Tensor:
    """D, per radian: logistic density at the angle x (any), trimmed to [-pi, pi] and normalised there."""
    x = x - 2.0 * math.pi * torch.round(x.detach() / (2.0 * math.pi))
    e = torch.exp(-x.abs() * p.inv_s)
    return p.d_scale * e / (1.0 + e) ** 2


def _mean_azimuthal(p: PackedFiber, x0: Tensor, x1: Tensor) -> Tensor:
    """Mean of D over the angles between x0 and x1 (any): its distribution function is a logistic function."""
    middle = 0.5 * (x0 + x1)
    width = x1 - x0
    narrow = width.abs() * p.inv_s < 1e-2
    return torch.where(
        narrow,
        _azimuthal(p, middle),
        (_distribution(p, x1) - _distribution(p, x0)) / torch.where(narrow, torch.ones_like(width), width),
    )


def _distribution(p: PackedFiber, x: Tensor) -> Tensor:
    """Integral of the periodic D from 0 to the angle x (any)."""
    turns = torch.round(x.detach() / (2.0 * math.pi))
    # 1 / (s Z) and 1 / s give 1 / Z, Z = tanh(pi / 2s).
    return turns + (torch.sigmoid((x - 2.0 * math.pi * turns) * p.inv_s) - 0.5) * (p.d_scale / p.inv_s)


def _centers(h: Tensor, ratio: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Phi = 2 p gamma_t - 2 gamma_o + p pi of R, TT and TRT, up to whole turns; sin gamma_t = h * ratio."""
    phi_r = -2.0 * torch.asin(h)
    two_gt = 2.0 * torch.asin(h * ratio)
    return phi_r, phi_r + two_gt + math.pi, phi_r + 2.0 * two_gt


def _fresnel(cos_i: Tensor, g: Tensor, eta2: Tensor) -> Tensor:
    """Unpolarised Fresnel reflectance from outside; g = eta cos(theta_t) = sqrt(eta^2 - 1 + cos_i^2)."""
    r_s = (cos_i - g) / (cos_i + g)
    r_p = (eta2 * cos_i - g) / (eta2 * cos_i + g)
    return 0.5 * (r_s**2 + r_p**2)


def eval_fiber(
    p: PackedFiber,
    h: Tensor,
    sin_to: Tensor,
    cos_to: Tensor,
    sin_ti: Tensor,
    cos_ti: Tensor,
    phi: Tensor,
    spread: Tensor | None = None,
) -> Tensor:
    """Value of the BSDF times cosine, (..., 3) per steradian.

    Parameters
    ----------
    h: (...)
        Offset across the fiber at which wo leaves.
    sin_to, cos_to, sin_ti, cos_ti: (...)
        Sine and cosine of the inclinations of wo and wi.
    phi: (...)
        phi_i - phi_o, rad, any.
    spread: (...)
        Width in h of what is looked at, for example a pixel's: D is averaged over it as if Phi ran straight
        there, everything else is taken at ``h``. D is often much narrower than a pixel, and points would miss it or
        make sparks of it.
    """
    h = h.clamp(-_H_MAX, _H_MAX)
    eta2 = p.eta * p.eta
    # Refraction, with eta' = sqrt(eta^2 - sin^2 theta_o) / cos theta_o and sin gamma_t = h / eta'.
    eta_cos_tt = torch.sqrt(eta2 - 1.0 + cos_to**2)
    sin_gt = h * cos_to / eta_cos_tt
    cos_gt = torch.sqrt(1.0 - sin_gt**2)
    if spread is None:
        centers = _centers(h, cos_to / eta_cos_tt)
    else:
        low, high = ((h + side * spread).clamp(-_H_MAX, _H_MAX) for side in (-0.5, 0.5))
        centers, centers_high = (_centers(x, cos_to / eta_cos_tt) for x in (low, high))

    # Attenuation: T = exp(-sigma_a 2 cos gamma_t / cos theta_t) over one crossing.
    cos_i = cos_to * torch.sqrt(1.0 - h**2)
    f = _fresnel(cos_i, torch.sqrt(eta2 - 1.0 + cos_i**2), eta2)[..., None]
    transmit = torch.exp(-p.sigma * (2.0 * p.eta * cos_gt / eta_cos_tt)[..., None])
    inside = f * transmit
    tt = (1.0 - f) ** 2 * transmit
    trt = tt * inside
    rest = trt * inside / (1.0 - inside).clamp_min(1e-12)
    attenuation = (f, tt, trt, rest)

    value: Tensor | float = 0.0
    m = distance = cos_cos = h
    for k, factor in enumerate((2.0, -1.0, -4.0, 0.0)):
        # Without tilt the lobes differ by variance alone, and TRT and the rest have the same M.
        if k == 0 or p.tilt:
            sin_a, cos_a = math.sin(factor * p.tilt), math.cos(factor * p.tilt)
            sin_o = sin_to * cos_a - cos_to * sin_a
            cos_o = (cos_to * cos_a + sin_to * sin_a).abs()
            # 1 - cos(theta_i + theta_o): half the squared distance of two points of the unit circle.
            distance = 0.5 * ((sin_ti + sin_o) ** 2 + (cos_ti - cos_o) ** 2)
            cos_cos = cos_ti * cos_o
        if k < 3 or p.tilt:
            m = _longitudinal(p, min(k, 2), distance, cos_cos)
        if k == 3:
            d: Tensor | float = 0.5 / math.pi
        elif spread is None:
            d = _azimuthal(p, phi - centers[k])
        else:
            d = _mean_azimuthal(p, phi - centers[k], phi - centers_high[k])
        value = value + (m * d)[..., None] * attenuation[k]
    assert isinstance(value, Tensor)
    return value
