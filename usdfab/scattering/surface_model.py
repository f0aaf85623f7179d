"""The point model of woven cloth as a surface: specular microflakes and a blended Lambert term, in NumPy.

When to use it: to read what the model is, and to test faster code against. It is Jin et al. 2022 as Chen et al. 2024
(paper B) write it down in eq. 1 and 2, with the transmission of SpongeCake (Wang et al. 2022):

    f = k_s D(h) G(wi, wo) / (4 cos_i cos_o)  +  w k_d <wi.n_p> / (pi <wi.n_s>)  +  (1 - w) k_d / pi

All functions give the terms *without albedo* (k_s = k_d = 1). ``surface_model_numba`` has the same for kernels.

Notation
    wi, wo   unit directions towards light and viewer, pointing away from the surface
    n_p      normal of the yarn's surface at the point;  n_s  normal of the cloth
    t        unit fiber direction at the point, orthogonal to n_p
    cos      |w.n_p|. Settled: the cosines of the specular term and of Lambda are those with n_p, as in SpongeCake,
             whose layer has one normal. The value is then bounded after the cosines of eq. 3 have cancelled.
    alpha    roughness of the flakes around the fiber direction: 1 is isotropic, small is a fiber
    S        I - (1 - alpha^2) t t^T, that is diag(1, 1, alpha^2) turned to t (SGGX of a fiber, Heitz et al. 2015)
    T rho    ``OPTICAL_DEPTH``: thickness times density of the layer, 2 for fabrics

Directions and frames are (..., 3) arrays that broadcast; values are (...) float64.

What holds (``tests/scattering/test_surface_model.py``): the flakes' projected area integrates to sigma; the specular
term is reciprocal, for transmission as well; reflected and transmitted specular light together with what passes
unscattered, exp(-T rho Lambda), is at most 1, and is the single scattering of a layer: it tends to T rho Lambda for a
thin one. Measured for k_s = 1 and alpha = 0.3, light that comes back, goes through, passes unscattered: 0.25, 0.04,
0.14 in normal view, 0.41, 0.04, 0.00 at 83 degrees; what is missing would scatter more than once.

What does not: k_s = k_d = 1 reflects more than 1 in sum (up to 1.4); the blended Lambert term is not reciprocal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

OPTICAL_DEPTH = 2.0
"""T rho: "always assigned a value of 2 for fabrics" (paper B, 3.1)."""

DIFFUSE_BLEND = 0.5
"""w of eq. 1. Paper B does not say; Li et al. 2024, eq. 10, "typically set to 0.5"."""


def dot(a: ArrayLike, b: ArrayLike) -> Floats:
    """Scalar products over the last axis."""
    return np.sum(np.asarray(a, dtype=np.float64) * np.asarray(b, dtype=np.float64), axis=-1)


def projected_area(w: ArrayLike, tangent: ArrayLike, alpha: ArrayLike) -> Floats:
    """sigma(w) = sqrt(w^T S w), the flakes' area seen from unit ``w`` (eq. 2)."""
    a = np.asarray(alpha, dtype=np.float64)
    return np.sqrt(np.maximum(dot(w, w) - (1.0 - a**2) * dot(w, tangent) ** 2, 0.0))


def flake_density(h: ArrayLike, tangent: ArrayLike, alpha: ArrayLike) -> Floats:
    """D(h) = 1 / (pi alpha q^2), q = h^T S^-1 h (eq. 2), per steradian over the whole sphere.

    ``integral of |w.h| D(h) / 2 dh = sigma(w)`` over the sphere (each flake has two faces).
    """
    a = np.asarray(alpha, dtype=np.float64)
    q = dot(h, h) + (1.0 / a**2 - 1.0) * dot(h, tangent) ** 2
    return 1.0 / (np.pi * a * q**2)


def smith_lambda(w: ArrayLike, normal: ArrayLike, tangent: ArrayLike, alpha: ArrayLike) -> Floats:
    """Lambda(w) = sigma(w) / |w.n| (eq. 2)."""
    return projected_area(w, tangent, alpha) / np.abs(dot(w, normal))


def attenuation_reflection(lambda_i: ArrayLike, lambda_o: ArrayLike, depth: float = OPTICAL_DEPTH) -> Floats:
    """G = (1 - exp(-T rho (L_i + L_o))) / (L_i + L_o) (eq. 2)."""
    total = np.asarray(lambda_i, dtype=np.float64) + np.asarray(lambda_o, dtype=np.float64)
    return -np.expm1(-depth * total) / total


def attenuation_transmission(lambda_i: ArrayLike, lambda_o: ArrayLike, depth: float = OPTICAL_DEPTH) -> Floats:
    """G = (exp(-T rho L_o) - exp(-T rho L_i)) / (L_i - L_o), and T rho exp(-T rho L) where both are equal."""
    li, lo = np.broadcast_arrays(np.asarray(lambda_i, dtype=np.float64), np.asarray(lambda_o, dtype=np.float64))
    least, gap = np.minimum(li, lo), np.abs(li - lo)
    # The smaller exponent is taken out, so that nothing cancels.
    slope = np.where(gap > 1e-9, -np.expm1(-depth * gap) / np.maximum(gap, 1e-9), depth)
    return np.exp(-depth * least) * slope


def half_vector(wi: ArrayLike, wo: ArrayLike, tangent: ArrayLike) -> Floats:
    """(wi + wo) / |wi + wo|; for light that goes straight on, a unit vector across the fiber and across ``wi``."""
    wi, wo, t = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (wi, wo, tangent)))
    h = wi + wo
    length = np.sqrt(dot(h, h))[..., None]
    across = np.cross(wi, t)
    norm = np.sqrt(dot(across, across))[..., None]
    across = np.where(norm > 1e-9, across / np.maximum(norm, 1e-9), 0.0)
    return np.where(length > 1e-7, h / np.maximum(length, 1e-7), across)


def specular_reflection(
    wi: ArrayLike, wo: ArrayLike, normal: ArrayLike, tangent: ArrayLike, alpha: ArrayLike, depth: float = OPTICAL_DEPTH
) -> Floats:
    """f_r^s without albedo (eq. 1), per steradian; 0 unless both directions are above the yarn's surface."""
    ci, co = dot(wi, normal), dot(wo, normal)
    lit = (ci > 0.0) & (co > 0.0)
    g = attenuation_reflection(*_lambdas(wi, wo, ci, co, tangent, alpha), depth)
    d = flake_density(half_vector(wi, wo, tangent), tangent, alpha)
    return np.where(lit, d * g / (4.0 * _away(ci) * _away(co)), 0.0)


def specular_transmission(
    wi: ArrayLike, wo: ArrayLike, normal: ArrayLike, tangent: ArrayLike, alpha: ArrayLike, depth: float = OPTICAL_DEPTH
) -> Floats:
    """f_t^s without albedo, per steradian; 0 unless the directions are on opposite sides of the yarn's surface."""
    ci, co = dot(wi, normal), dot(wo, normal)
    g = attenuation_transmission(*_lambdas(wi, wo, ci, co, tangent, alpha), depth)
    d = flake_density(half_vector(wi, wo, tangent), tangent, alpha)
    return np.where(ci * co < 0.0, d * g / (4.0 * _away(ci) * _away(co)), 0.0)


def diffuse(wi: ArrayLike, normal: ArrayLike, surface_normal: ArrayLike, blend: float = DIFFUSE_BLEND) -> Floats:
    """f^d without albedo (eq. 1): ``w <wi.n_p> / (pi <wi.n_s>) + (1 - w) / pi``.

    For ``wi`` on one side of both normals; times ``<wi.n_s>`` it is ``diffuse_cosine``. Transmission: pass -normals.
    """
    return diffuse_cosine(wi, normal, surface_normal, blend) / _away(dot(wi, surface_normal))


def diffuse_cosine(wi: ArrayLike, normal: ArrayLike, surface_normal: ArrayLike, blend: float = DIFFUSE_BLEND) -> Floats:
    """``(w <wi.n_p> + (1 - w) <wi.n_s>) / pi``: the Lambert blend with the cosine that belongs to it."""
    own, cloth = (np.maximum(dot(wi, n), 0.0) for n in (normal, surface_normal))
    return (blend * own + (1.0 - blend) * cloth) / np.pi


def _lambdas(
    wi: ArrayLike, wo: ArrayLike, ci: Floats, co: Floats, tangent: ArrayLike, alpha: ArrayLike
) -> tuple[Floats, Floats]:
    return projected_area(wi, tangent, alpha) / _away(ci), projected_area(wo, tangent, alpha) / _away(co)


def _away(cosine: Floats) -> Floats:
    """|cosine|, kept off zero: at grazing angles G falls with the cosine, so that their quotient stays finite."""
    return np.maximum(np.abs(cosine), 1e-7)
