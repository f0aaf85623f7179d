"""UsdPreviewSurface as a BSDF for Numba: pack a material, prepare a vertex, then evaluate and sample.

    f = T (diffuse + specular) + coat

When to use it: inside a path tracer's kernel, for everything that is not made of fibers. A material is packed once
(`pack_surface`, NumPy, checks its input), a hit is prepared once (`load_surface`, `prepare_surface`), and what was
prepared serves both the evaluation for next-event estimation and the sampling of the next direction. All functions but
`pack_surface` are Numba functions of scalars and tuples; none allocates and none checks. Emission and opacity are the
caller's.

Frame: the shading normal is +z; wo (towards the viewer) and wi (towards the light) point away from the surface. There
is light above the horizon only: where wi_z <= 0 or wo_z <= 0 value and density are 0. Values include the cosine of wi.

Specular and coat
    GGX with height-correlated Smith shadowing, alpha = roughness^2 (at least `ALPHA_MIN`: no mirror is a delta), and
    Schlick's F = F0 + (F90 - F0) (1 - wo.h)^5. F90 = 1 as in the specification, but for F0 < 0.001 (an index of
    refraction below 1.07) it falls to 0 with F0, so that an index of 1 is a purely diffuse material. F0 is
    specularColor, or ((1 - ior) / (1 + ior))^2, mixed with the base colour by metallic; the coat's is that of ior.
    Light that bounces between microfacets is left out: a rough metal loses up to two thirds at alpha = 1, as in most
    renderers of this model.
Diffuse
    Lambert, coupled to what specular leaves of the light on its way in and out (Kelemen and Szirmay-Kalos 2001):

        f_d = rho / pi (1 - F0) (1 - B(wi_z)) (1 - B(wo_z)) / (1 - B_avg),   rho = base (1 - metallic)

    The specular lobe reflects E = F0 A + F90 B of the light, A + B <= 1, so (1 - F0) (1 - B) <= 1 - E, and the sum of
    both lobes reflects at most 1; for a white dielectric it is less than 1 by 0.3 % on average, and by what is lost
    between microfacets (4 % of it). B has no closed form; used is `_grazing`, an upper bound of our own making.
Coat
    T = 1 - E_coat at the more grazing one of wi and wo: never more than the coat leaves.

Every lobe is reciprocal, so the whole is: value / wi_z does not change when wi and wo are swapped.

References: UsdPreviewSurface specification 2.6; Walter et al., "Microfacet Models for Refraction through Rough
Surfaces", 2007 (GGX); Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", 2014 (G2);
Dupuy and Benyoub, "Sampling Visible GGX Normals with Spherical Caps", 2023; Kelemen and Szirmay-Kalos, "A Microfacet
Based Coupled Specular-Matte BRDF Model with Importance Sampling", 2001.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from usdfab.errors import UsdfabError

__all__ = [
    "ALPHA_MIN",
    "PREPARED_SURFACE",
    "SURFACE_SIZE",
    "eval_surface",
    "load_surface",
    "pack_surface",
    "prepare_surface",
    "sample_surface",
]

ALPHA_MIN = 1e-3
"""Least width of a GGX lobe: 0.06 degrees; the peak of its density is 3e5."""

SURFACE_SIZE = 12
"""Length of the array that `pack_surface` returns."""

PREPARED_SURFACE = 19
"""Length of the tuple that `prepare_surface` returns."""

# Layout of the packed material `p`: 0:3 base colour, 3 roughness, 4 metallic, 5:8 F0 before metallic, 8 whether it is
# the specular workflow, which ignores metallic, 9 coat, 10 its roughness, 11 its F0.
BASE, ROUGHNESS, METALLIC, SPECULAR, WORKFLOW = 0, 3, 4, 5, 8

# Layout of a prepared vertex.
_DIFFUSE = 0  # 3: all of f_d but 1 - B(wi_z)
_F0 = 3  # 3
_F90 = 6  # 0 if there is no specular lobe
_ALPHA = 7
_B = 8  # 3: scale, power and offset of B, scale and offset times F90
_COAT_F0 = 11
_COAT_F90 = 12  # 0 if there is no coat
_COAT_ALPHA = 13
_COAT_B = 14  # 2: scale and power
_Q = 16  # 3: probabilities of diffuse, specular, coat

_PI = math.pi
_INV_PI = 1.0 / math.pi
_B_OFFSET = 5e-4
_F90_SLOPE = 1000.0

# As in `fiber_numba`: the guards must stay, no divisor can be zero, tuples must not pass through memory.
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz", "arcp"},
    "forceinline": True,
}


def pack_surface(
    base_color: npt.ArrayLike,
    roughness: float = 0.5,
    metallic: float = 0.0,
    specular_color: npt.ArrayLike | None = None,
    clearcoat: float = 0.0,
    clearcoat_roughness: float = 0.01,
    ior: float = 1.5,
) -> npt.NDArray[np.float64]:
    """Check a material and bring it into the form that the kernels read.

    Parameters
    ----------
    base_color: (3,) linear Rec. 709
        ``diffuseColor``. Range: [0, 1].
    roughness, metallic, clearcoat, clearcoat_roughness: float
        Range: [0, 1].
    specular_color: (3,) or None
        F0 of the specular workflow, in which metallic is ignored; None: the metallic workflow. Range: [0, 1].
    ior: float
        Index of refraction; 1 leaves the diffuse lobe only. Range: above 0.

    Returns
    -------
    (SURFACE_SIZE,) float64

    Raises
    ------
    UsdfabError
        For a value that is out of its range, with its name as the place.
    """
    packed = np.zeros(SURFACE_SIZE)
    packed[BASE : BASE + 3] = _color(base_color, "base_color")
    packed[ROUGHNESS] = _unit_number(roughness, "roughness")
    packed[METALLIC] = _unit_number(metallic, "metallic")
    if not (math.isfinite(ior) and ior > 0.0):
        raise UsdfabError(f"{ior} is not an index of refraction", place="ior", remedy="give a number above 0")
    f0 = ((1.0 - ior) / (1.0 + ior)) ** 2
    packed[SPECULAR : SPECULAR + 3] = f0 if specular_color is None else _color(specular_color, "specular_color")
    packed[WORKFLOW] = 0.0 if specular_color is None else 1.0
    packed[9] = _unit_number(clearcoat, "clearcoat")
    packed[10] = _unit_number(clearcoat_roughness, "clearcoat_roughness")
    packed[11] = f0
    return packed


def _color(value: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
    color = np.asarray(value, dtype=np.float64)
    if color.shape != (3,) or not np.all((color >= 0.0) & (color <= 1.0)):
        raise UsdfabError(f"{color.tolist()} is not a colour", place=name, remedy="give three numbers from 0 to 1")
    return color


def _unit_number(value: float, name: str) -> float:
    if not 0.0 <= value <= 1.0:
        raise UsdfabError(f"{value} is out of range", place=name, remedy="give a number from 0 to 1")
    return float(value)


# --- Pieces ---


@njit(**_OPTIONS)
def _clamp(x):
    return min(max(x, 0.0), 1.0)


@njit(**_OPTIONS)
def _alpha(roughness):
    return max(roughness * roughness, ALPHA_MIN)


@njit(**_OPTIONS)
def _grazing(alpha):
    """Scale b and power n of the bound B(mu) = b (1 - mu)^n + `_B_OFFSET`.

    B is what a GGX lobe of F = (1 - wo.h)^5 reflects at wo_z = mu. Fitted for alpha in [0.001, 1] to a quadrature of
    that integral, from above; the mean over the cosine is 0.3 % too large at most.
    """
    s = math.sqrt(alpha)
    x = s / 0.33
    power = 2.6 + 2.4 / (1.0 + x * x * x)
    odds = s * s * (0.105 + s * (15.568 + s * (72.448 + s * (-108.431 + s * 40.473))))
    return 1.0 / (1.0 + odds), power


@njit(**_OPTIONS)
def _ggx(alpha, across2, hz2, iz, oz):
    """GGX reflection with F = 1: value times cosine, and density of the mirrored visible normal.

    ``across2`` and ``hz2`` are the squares of the unit half vector's parts across and along the normal.
    """
    a2 = alpha * alpha
    t = across2 + a2 * hz2  # small at the peak: no difference of large numbers may make it
    half_d = 0.5 * a2 * _INV_PI / (t * t)
    lambda_i = math.sqrt(a2 + (1.0 - a2) * iz * iz)
    lambda_o = math.sqrt(a2 + (1.0 - a2) * oz * oz)
    return half_d * iz / (oz * lambda_i + iz * lambda_o), half_d / (oz + lambda_o)


# --- What the path tracer calls ---


@njit(**_OPTIONS)
def load_surface(table, k):
    """Row k of packed materials (n, >= SURFACE_SIZE) as a tuple of SURFACE_SIZE numbers, see `fiber_numba.load_fiber`.

    To put texture values in the place of constants, build such a tuple from this one: 0:3 base colour, 3 roughness,
    4 metallic, 5:8 specular colour (only if 8, the specular workflow, is 1). Values are clamped by `prepare_surface`.
    """
    m = table
    return (
        *(m[k, 0], m[k, 1], m[k, 2], m[k, 3], m[k, 4], m[k, 5]),
        *(m[k, 6], m[k, 7], m[k, 8], m[k, 9], m[k, 10], m[k, 11]),
    )


@njit(**_OPTIONS)
def prepare_surface(p, cos_o):
    """Everything about a vertex that does not depend on the incident direction.

    Parameters
    ----------
    p: tuple or (SURFACE_SIZE,) float64
        Material of `load_surface` or `pack_surface`; colours, roughness and metallic are clamped to [0, 1].
    cos_o: float
        wo_z. Range: [-1, 1].

    Returns
    -------
    tuple of 19 float
    """
    metallic = 0.0 if p[WORKFLOW] != 0.0 else _clamp(p[METALLIC])
    base_r, base_g, base_b = _clamp(p[0]), _clamp(p[1]), _clamp(p[2])
    f0_r = _clamp(p[5]) * (1.0 - metallic) + base_r * metallic
    f0_g = _clamp(p[6]) * (1.0 - metallic) + base_g * metallic
    f0_b = _clamp(p[7]) * (1.0 - metallic) + base_b * metallic
    f90 = min(1.0, _F90_SLOPE * max(f0_r, f0_g, f0_b))
    rest = 1.0 - max(cos_o, 0.0)

    # Specular: what is left for the diffuse lobe. The integral of 2 mu (1 - mu)^n is 2 / ((n + 1) (n + 2)).
    alpha, scale, power, left, offset = 1.0, 0.0, 1.0, 1.0, 0.0
    if f90 > 0.0:
        alpha = _alpha(_clamp(p[ROUGHNESS]))
        scale, power = _grazing(alpha)
        scale, offset = scale * f90, _B_OFFSET * f90
        left = max(1.0 - offset - scale * rest**power, 0.0)
    average = 1.0 - offset - 2.0 * scale / ((power + 1.0) * (power + 2.0))
    matte = (1.0 - metallic) * left
    diffuse_r, diffuse_g, diffuse_b = base_r * (1.0 - f0_r), base_g * (1.0 - f0_g), base_b * (1.0 - f0_b)

    # Coat: what is left for both.
    coat_f90 = min(1.0, _F90_SLOPE * p[11]) * p[9]
    coat_f0, coat_alpha, coat_scale, coat_power, coat = p[11] * p[9], 1.0, 0.0, 1.0, 0.0
    if coat_f90 > 0.0:
        coat_alpha = _alpha(p[10])
        coat_scale, coat_power = _grazing(coat_alpha)
        coat_b = min(coat_scale * rest**coat_power + _B_OFFSET, 1.0)
        coat = coat_f0 + (coat_f90 - coat_f0) * coat_b

    # A lobe's probability is about its share of the light reflected, mean of the three colours.
    q_diffuse = (1.0 - coat) * matte * (diffuse_r + diffuse_g + diffuse_b)
    f0_sum = f0_r + f0_g + f0_b
    q_specular = (1.0 - coat) * (f0_sum + (3.0 * f90 - f0_sum) * (1.0 - left)) if f90 > 0.0 else 0.0
    q_coat = 3.0 * coat
    total = q_diffuse + q_specular + q_coat
    if total > 0.0:
        q_diffuse, q_specular, q_coat = q_diffuse / total, q_specular / total, q_coat / total
    else:
        q_diffuse = 1.0  # black
    matte *= _INV_PI / average
    return (
        *(diffuse_r * matte, diffuse_g * matte, diffuse_b * matte, f0_r, f0_g, f0_b, f90, alpha, scale, power, offset),
        *(coat_f0, coat_f90, coat_alpha, coat_scale, coat_power, q_diffuse, q_specular, q_coat),
    )


@njit(**_OPTIONS)
def eval_surface(prep, wix, wiy, wiz, wox, woy, woz):
    """Value of the BSDF times cosine in RGB, and the density with which `sample_surface` takes the direction.

    Parameters
    ----------
    prep: tuple
        Vertex of `prepare_surface` for the same wo.
    wix, wiy, wiz, wox, woy, woz: float
        Unit vectors in the shading frame.

    Returns
    -------
    r, g, b: float
        f(wi, wo) wi_z, per steradian.
    pdf: float
        Density, per steradian. Its integral is 1 less the probability of a specular sample below the horizon.
    """
    if wiz <= 0.0 or woz <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    cosine = wiz * _INV_PI
    if prep[_F90] <= 0.0 and prep[_COAT_F90] <= 0.0:
        return prep[0] * wiz, prep[1] * wiz, prep[2] * wiz, cosine

    hx, hy, hz = wix + wox, wiy + woy, wiz + woz
    length2 = hx * hx + hy * hy + hz * hz  # above 0: both are above the horizon
    across2, hz2 = (hx * hx + hy * hy) / length2, hz * hz / length2
    # wo.h is half the length of wi + wo.
    miss = max(1.0 - 0.5 * math.sqrt(length2), 0.0)
    schlick = miss * miss
    schlick = schlick * schlick * miss
    pdf = prep[_Q] * cosine

    left = wiz
    specular = 0.0
    if prep[_F90] > 0.0:
        left *= max(1.0 - prep[_B + 2] - prep[_B] * (1.0 - min(wiz, 1.0)) ** prep[_B + 1], 0.0)
        specular, density = _ggx(prep[_ALPHA], across2, hz2, wiz, woz)
        pdf += prep[_Q + 1] * density
    red = prep[0] * left + specular * (prep[3] + (prep[_F90] - prep[3]) * schlick)
    green = prep[1] * left + specular * (prep[4] + (prep[_F90] - prep[4]) * schlick)
    blue = prep[2] * left + specular * (prep[5] + (prep[_F90] - prep[5]) * schlick)

    if prep[_COAT_F90] > 0.0:
        f0, f90 = prep[_COAT_F0], prep[_COAT_F90]
        lower = min(wiz, woz, 1.0)
        b = min(prep[_COAT_B] * (1.0 - lower) ** prep[_COAT_B + 1] + _B_OFFSET, 1.0)
        through = 1.0 - (f0 + (f90 - f0) * b)
        value, density = _ggx(prep[_COAT_ALPHA], across2, hz2, wiz, woz)
        value *= f0 + (f90 - f0) * schlick
        pdf += prep[_Q + 2] * density
        red, green, blue = red * through + value, green * through + value, blue * through + value
    return red, green, blue, pdf


@njit(**_OPTIONS)
def sample_surface(prep, wox, woy, woz, u0, u1, u2):
    """Take an incident direction with density close to the value of the BSDF.

    A lobe by its share of the light, then the cosine or the visible normals of GGX.

    Parameters
    ----------
    prep: tuple
        Vertex of `prepare_surface` for the same wo.
    wox, woy, woz: float
        Unit vector in the shading frame.
    u0, u1, u2: float
        Independent uniform numbers. Range: [0, 1).

    Returns
    -------
    wix, wiy, wiz: float
        Unit vector.
    wr, wg, wb: float
        Value of `eval_surface` over density, of all lobes together.
    pdf: float
        Density of `eval_surface`; 0, with weight 0, for a sample below the horizon: end the path there.
    """
    phi = 2.0 * _PI * u1
    cos_phi, sin_phi = math.cos(phi), math.sin(phi)
    if u0 < prep[_Q]:
        radius = math.sqrt(u2)
        wix, wiy, wiz = radius * cos_phi, radius * sin_phi, math.sqrt(1.0 - u2)
    else:
        alpha = prep[_ALPHA] if u0 < prep[_Q] + prep[_Q + 1] else prep[_COAT_ALPHA]
        # Stretched so that GGX is a hemisphere, its mirror directions are uniform on a spherical cap.
        sx, sy, sz = alpha * wox, alpha * woy, woz
        norm = 1.0 / math.sqrt(sx * sx + sy * sy + sz * sz)
        sx, sy, sz = sx * norm, sy * norm, sz * norm
        z = (1.0 - u2) * (1.0 + sz) - sz
        sine = math.sqrt(max(1.0 - z * z, 0.0))
        hx, hy, hz = alpha * (sine * cos_phi + sx), alpha * (sine * sin_phi + sy), z + sz
        length2 = hx * hx + hy * hy + hz * hz
        along = 2.0 * (hx * wox + hy * woy + hz * woz) / length2 if length2 > 0.0 else 0.0
        wix, wiy, wiz = along * hx - wox, along * hy - woy, along * hz - woz
    red, green, blue, pdf = eval_surface(prep, wix, wiy, wiz, wox, woy, woz)
    inv_pdf = 1.0 / pdf if pdf > 0.0 else 0.0
    return wix, wiy, wiz, red * inv_pdf, green * inv_pdf, blue * inv_pdf, pdf
