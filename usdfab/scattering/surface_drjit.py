"""UsdPreviewSurface as a BSDF for Dr.Jit: prepare a vertex, then evaluate and sample.

The model, the names, the frame and the references are those of `usdfab.scattering.surface_numba`; tests hold the two
together. When to use it: inside `usdfab.mi.surface_bsdf`. All functions trace arrays of any backend; they know nothing
of Mitsuba and check nothing.

What differs: whether there is a specular lobe or a coat at all is a plain truth value, a part of the program.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import drjit as dr

__all__ = ["ALPHA_MIN", "PreparedSurface", "eval_surface", "prepare_surface", "sample_surface"]

ALPHA_MIN = 1e-3
"""Least width of a GGX lobe."""

_PI = math.pi
_INV_PI = 1.0 / math.pi
_B_OFFSET = 5e-4
_F90_SLOPE = 1000.0


class PreparedSurface(NamedTuple):
    """What about a vertex does not depend on the incident direction; ``b`` are scale, power and offset of B."""

    diffuse: Any  # three colours: all of f_d but 1 - B(wi_z)
    f0: Any  # three colours
    f90: Any
    alpha: Any
    b: tuple[Any, Any, Any]
    coat_f0: float
    coat_f90: float
    coat_alpha: float
    coat_b: tuple[Any, Any]
    share: tuple[Any, Any, Any]  # probabilities of diffuse, specular, coat
    specular: bool
    coat: bool


def _clamp(x: Any) -> Any:
    return dr.clip(x, 0.0, 1.0)


def _power(x: Any, exponent: Any) -> Any:
    """x^exponent for x in [0, 1]."""
    return dr.exp(exponent * dr.log(dr.maximum(x, 1e-20)))


def _grazing(alpha: Any) -> tuple[Any, Any]:
    """Scale and power of the bound B(mu), as in the Numba target."""
    s = dr.sqrt(alpha)
    x = s / 0.33
    power = 2.6 + 2.4 / (1.0 + x * x * x)
    odds = s * s * (0.105 + s * (15.568 + s * (72.448 + s * (-108.431 + s * 40.473))))
    return 1.0 / (1.0 + odds), power


def _sum(color: Any) -> Any:
    return color[0] + color[1] + color[2]


def prepare_surface(
    base: Any,
    roughness: Any,
    metallic: Any,
    f0: Any,
    cos_o: Any,
    *,
    specular: bool = True,
    coat: float = 0.0,
    coat_roughness: float = 0.01,
    coat_f0: float = 0.04,
) -> PreparedSurface:
    """Everything about a vertex that does not depend on the incident direction.

    Parameters
    ----------
    base, f0: array of three
        Base colour; F0 before metallic. Clamped to [0, 1], as roughness and metallic are.
    metallic: array
        0 in the specular workflow.
    cos_o: array
        wo_z.
    specular:
        Whether any F0 can be above 0.
    coat, coat_roughness, coat_f0:
        Weight of the coat, its roughness, and F0 of the index of refraction.
    """
    metallic, base = _clamp(metallic), _clamp(base)
    f0 = _clamp(f0) * (1.0 - metallic) + base * metallic
    f90 = dr.minimum(1.0, _F90_SLOPE * dr.maximum(dr.maximum(f0[0], f0[1]), f0[2])) if specular else 0.0 * cos_o
    rest = 1.0 - dr.maximum(cos_o, 0.0)

    # Specular: what is left for the diffuse lobe.
    alpha = dr.maximum(dr.square(_clamp(roughness)), ALPHA_MIN)
    scale, power = _grazing(alpha)
    scale, offset = scale * f90, _B_OFFSET * f90
    left = dr.maximum(1.0 - offset - scale * _power(rest, power), 0.0)
    average = 1.0 - offset - 2.0 * scale / ((power + 1.0) * (power + 2.0))
    matte = (1.0 - metallic) * left
    diffuse = base * (1.0 - f0)

    # Coat: what is left for both.
    coat_f90 = min(1.0, _F90_SLOPE * coat_f0) * coat
    coat_alpha = max(coat_roughness * coat_roughness, ALPHA_MIN)
    coat_scale, coat_power = _grazing(coat_alpha)
    coated = 0.0
    if coat_f90 > 0.0:
        b = dr.minimum(coat_scale * _power(rest, coat_power) + _B_OFFSET, 1.0)
        coated = coat * coat_f0 + (coat_f90 - coat * coat_f0) * b

    # A lobe's probability is about its share of the light reflected, mean of the three colours.
    q_diffuse = (1.0 - coated) * matte * _sum(diffuse)
    q_specular = (1.0 - coated) * (_sum(f0) + (3.0 * f90 - _sum(f0)) * (1.0 - left)) if specular else 0.0 * left
    q_coat = 3.0 * coated + 0.0 * left
    total = q_diffuse + q_specular + q_coat
    black = total <= 0.0
    total = dr.select(black, 1.0, total)
    return PreparedSurface(
        diffuse=diffuse * (matte * _INV_PI / average),
        f0=f0,
        f90=f90,
        alpha=alpha,
        b=(scale, power, offset),
        coat_f0=coat * coat_f0,
        coat_f90=coat_f90,
        coat_alpha=coat_alpha,
        coat_b=(coat_scale, coat_power),
        share=(dr.select(black, 1.0, q_diffuse / total), q_specular / total, q_coat / total),
        specular=specular,
        coat=coat_f90 > 0.0,
    )


def _ggx(alpha: Any, across2: Any, hz2: Any, iz: Any, oz: Any) -> tuple[Any, Any]:
    """GGX reflection with F = 1: value times cosine, and density of the mirrored visible normal."""
    a2 = alpha * alpha
    t = across2 + a2 * hz2
    half_d = 0.5 * a2 * _INV_PI / (t * t)
    lambda_i = dr.sqrt(a2 + (1.0 - a2) * iz * iz)
    lambda_o = dr.sqrt(a2 + (1.0 - a2) * oz * oz)
    return half_d * iz / (oz * lambda_i + iz * lambda_o), half_d / (oz + lambda_o)


def eval_surface(prep: PreparedSurface, wi: Any, wo: Any) -> tuple[Any, Any]:
    """Value of the BSDF times cosine, three colours, and the density with which `sample_surface` takes ``wi``.

    ``wi`` to the light and ``wo`` to the viewer are unit vectors in the shading frame; below the horizon all is 0.
    """
    above = (wi.z > 0.0) & (wo.z > 0.0)
    iz, oz = dr.maximum(wi.z, 1e-9), dr.maximum(wo.z, 1e-9)
    cosine = iz * _INV_PI
    pdf = prep.share[0] * cosine
    left, value = iz, 0.0
    hx, hy, hz = wi.x + wo.x, wi.y + wo.y, iz + oz
    length2 = hx * hx + hy * hy + hz * hz
    across2, hz2 = (hx * hx + hy * hy) / length2, hz * hz / length2
    miss = dr.maximum(1.0 - 0.5 * dr.sqrt(length2), 0.0)
    schlick = dr.square(dr.square(miss)) * miss
    if prep.specular:
        scale, power, offset = prep.b
        left = iz * dr.maximum(1.0 - offset - scale * _power(1.0 - dr.minimum(iz, 1.0), power), 0.0)
        lobe, density = _ggx(prep.alpha, across2, hz2, iz, oz)
        value = lobe * (prep.f0 + (prep.f90 - prep.f0) * schlick)
        pdf += prep.share[1] * density
    value = prep.diffuse * left + value
    if prep.coat:
        lower = dr.minimum(dr.minimum(iz, oz), 1.0)
        b = dr.minimum(prep.coat_b[0] * _power(1.0 - lower, prep.coat_b[1]) + _B_OFFSET, 1.0)
        through = 1.0 - (prep.coat_f0 + (prep.coat_f90 - prep.coat_f0) * b)
        lobe, density = _ggx(prep.coat_alpha, across2, hz2, iz, oz)
        value = value * through + lobe * (prep.coat_f0 + (prep.coat_f90 - prep.coat_f0) * schlick)
        pdf += prep.share[2] * density
    return dr.select(above, value, 0.0), dr.select(above, pdf, 0.0)


def sample_surface(prep: PreparedSurface, wo: Any, u0: Any, u1: Any, u2: Any) -> Any:
    """A unit vector towards the light, as ``wo`` is one: the cosine, or the visible normals of GGX, by their shares."""
    kind = type(wo)
    sin_phi, cos_phi = dr.sincos(2.0 * _PI * u1)
    radius = dr.sqrt(u2)
    wi = kind(radius * cos_phi, radius * sin_phi, dr.sqrt(dr.maximum(1.0 - u2, 0.0)))
    if not (prep.specular or prep.coat):
        return wi
    alpha = prep.alpha
    if prep.coat:
        alpha = dr.select(u0 < prep.share[0] + prep.share[1], alpha, prep.coat_alpha)
    # Stretched so that GGX is a hemisphere, its mirror directions are uniform on a spherical cap.
    s = dr.normalize(kind(alpha * wo.x, alpha * wo.y, wo.z))
    z = (1.0 - u2) * (1.0 + s.z) - s.z
    sine = dr.sqrt(dr.maximum(1.0 - z * z, 0.0))
    h = kind(alpha * (sine * cos_phi + s.x), alpha * (sine * sin_phi + s.y), z + s.z)
    h *= dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-30))
    mirrored = 2.0 * dr.dot(h, wo) * h - wo
    return dr.select(u0 < prep.share[0], wi, mirrored)
