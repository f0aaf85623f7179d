"""From a fabric's fibers to the surface model: which smooth yarns look like those bundles of fibers?

Everything follows from the fitted parameters; nothing is rendered (``surface_albedos.measured_albedos`` does that,
where colours must be right to a few percent). Symbols: e yarn radius, f flattening, c spacing of the crossings along
the yarn, d across it, all in metres; l length of a float in cells; beta, psi, u, alpha those of the surface model.

Numbers end up in the ranges of Table 2 of Chen et al. 2024, on which networks are trained (``INCLINATIONS``, ...); only
the gap does not (the paper's is always 0.2).

Gap
    1 - (2 e f / d), the part of the spacing that yarns leave open, mean of warp and weft. At least 0.05.
Height scale
    The cross-section is an ellipse of half axes e f and e, whose curvature at the crest is e / (e f)^2; that of the
    surface is beta pi / d (v = pi x). Equal for beta = d / (pi f^2 e): 0.8 for round yarns at a gap of 0.2. One number
    for both systems: their geometric mean. Where the arches (below) would need an inclination above 45 degrees with it,
    the geometric mean of it and of what they need: cross-section and arch are then wrong by the same factor.
Inclination
    The centre line's height is crimp e, its shape ``unit_centerline`` with the fitted inclination. The surface's slope
    along a segment is beta tan(u y / (l/2)). u is chosen so that both have the same mean square slope over the floats
    on the face, on which the width of highlights depends: sqrt(tan u / u - 1) = slope / beta.
Twist
    A fiber at the yarn's surface moves across by 2 pi twist e f in one cell: tan psi = - 2 pi twist e f / c. Positive
    twist is Z, "/" along a warp yarn, which is a negative psi. Plied yarns: plies move by twist times the distance of
    their axis, fibers about it by ply_twist times the ply's radius.
Roughness
    The flakes' spread along the fiber, an angle of the half vector: half the deviation of the fiber's R lobe,
    sqrt(v(gamma_M0)) / 2, and the waviness of the fibers (``WAVINESS`` irregularity e / c), as variances. One number:
    the mean of both systems. (TT and TRT are wider, but most of their light is scattered again: it counts as diffuse.)
Specular albedo
    Light that a fiber reflects at its surface: the mean of Fresnel's reflectance over its width. White.
Diffuse albedo
    The colour that fibers show after many scatterings: ``DIFFUSE`` (1 - (1 - C)^``POWER``), and for light from behind
    ``TRANSMITTED`` times the same; within about 20 % of what ``surface_albedos`` measures for linen, denim, silk satin,
    canvas and taffeta dyed from 0.1 to 0.98. They may add up to more than 1, since the components themselves lose light
    to shadows and gaps. Yarns of several colours: the mean. Specular transmission has the specular albedo times C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, FabricParameters, System, YarnParameters, ply_circles
from usdfab.fibers.centerline import unit_centerline
from usdfab.neural.surface_material import (
    GAP_RANGE,
    TWIST_RANGE,
    SurfaceMaterial,
    weave_of,
)
from usdfab.neural.surface_tile import packed_cells
from usdfab.scattering.roughness import longitudinal_variance

Floats = NDArray[np.float64]

WAVINESS = 2.0
"""Slope of fibers per irregularity and yarn radius over cell length: one bump of that height in a cell (eq. 9)."""

DIFFUSE, TRANSMITTED, POWER = 0.72, 0.6, 1.85

INCLINATIONS = (math.radians(15.0), math.radians(45.0))
ROUGHNESSES = (0.1, 1.0)
HEIGHT_SCALES = (0.05, 2.0)


@dataclass(frozen=True, eq=False)
class SurfaceAlbedos:
    """What to multiply the four components with, linear Rec. 709.

    Parameters
    ----------
    reflection, transmission: (4, 3)
        Rows kd_warp, kd_weft, ks_warp, ks_weft, the columns of ``aggregate``: ``components @ reflection`` is RGB.
    """

    reflection: Floats
    transmission: Floats


def surface_from_fabric(fabric: FabricParameters) -> tuple[SurfaceMaterial, SurfaceAlbedos]:
    """The surface material that stands for a fabric of fibers, and its albedos; numbers are clamped to their ranges."""
    crests = [_crest_scale(fabric, system) for system in SYSTEMS]
    slopes = [_arch_slope(fabric, system) for system in SYSTEMS]
    crest, needed = math.sqrt(crests[0] * crests[1]), max(slopes) / slope_of_inclination(INCLINATIONS[1])
    height_scale = float(np.clip(crest * max(1.0, math.sqrt(needed / crest)), *HEIGHT_SCALES))
    gap = float(np.clip(1.0 - np.mean([fabric.cover(system) for system in SYSTEMS]), *GAP_RANGE))
    alpha = float(np.clip(np.mean([_roughness(fabric, system) for system in SYSTEMS]), *ROUGHNESSES))
    inclinations = [inclination_of_slope(slope / height_scale) for slope in slopes]
    twists = [_twist(fabric, system) for system in SYSTEMS]
    material = SurfaceMaterial(
        weave_of(fabric.weave), (twists[0], twists[1]), (inclinations[0], inclinations[1]), alpha, height_scale, gap,
        fabric.weave.name,
    )  # fmt: skip
    return material, _albedos(fabric)


def cell_along(fabric: FabricParameters, system: System) -> float:
    """Spacing of the crossings along a yarn of the system, metres."""
    return fabric.cell[1] if system == "warp" else fabric.cell[0]


def _cell_across(fabric: FabricParameters, system: System) -> float:
    return fabric.cell[0] if system == "warp" else fabric.cell[1]


def _crest_scale(fabric: FabricParameters, system: System) -> float:
    yarn = fabric.system(system)
    return _cell_across(fabric, system) / (math.pi * yarn.flattening**2 * yarn.radius)


def _roughness(fabric: FabricParameters, system: System) -> float:
    yarn = fabric.system(system)
    lobe = 0.25 * float(longitudinal_variance(yarn.roughness_primary))
    waves = WAVINESS * yarn.irregularity * yarn.radius / cell_along(fabric, system)
    return math.sqrt(lobe + waves**2)


def _twist(fabric: FabricParameters, system: System) -> float:
    yarn = fabric.system(system)
    if yarn.ply_count > 1:
        radius, distance = ply_circles(yarn.ply_count)
        turns = yarn.twist * distance + yarn.ply_twist * radius
    else:
        turns = yarn.twist
    across = 2.0 * math.pi * turns * yarn.radius * yarn.flattening
    return float(np.clip(-math.atan(across / cell_along(fabric, system)), *TWIST_RANGE))


def _arch_slope(fabric: FabricParameters, system: System) -> float:
    """Root mean square slope of the system's centre lines on the face."""
    yarn = fabric.system(system)
    return yarn.crimp * yarn.radius / cell_along(fabric, system) * _shape_slope(fabric, system)


def _shape_slope(fabric: FabricParameters, system: System) -> float:
    """Root mean square slope per cell of the centre line of height 1, over the system's floats on the face."""
    cells = packed_cells(SurfaceMaterial(weave_of(fabric.weave)).bits())
    shown = cells[..., 0] == (1 if system == "warp" else 0)
    squares = []
    for length in cells[shown][:, 2]:
        y = np.linspace(0.0, length, 65)
        heights = unit_centerline(y, np.full(65, length), fabric.system(system).inclination)
        squares.append(float(np.mean(np.diff(heights) ** 2)) / (length / 64) ** 2)
    return math.sqrt(float(np.mean(squares)))


def slope_of_inclination(u: float) -> float:
    """The root mean square of tan over [-u, u]: sqrt(tan u / u - 1)."""
    return math.sqrt(max(math.tan(u) / u - 1.0, 0.0))


def inclination_of_slope(slope: float) -> float:
    """The inverse of ``slope_of_inclination``, clamped to ``INCLINATIONS``."""
    low, high = INCLINATIONS
    for _ in range(60):
        middle = 0.5 * (low + high)
        if slope_of_inclination(middle) < slope:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def fiber_reflectance(ior: float) -> float:
    """Mean of Fresnel's reflectance over the width of a smooth fiber, for light across it."""
    h = (np.arange(256) + 0.5) / 256
    cos_i, cos_t = np.sqrt(1.0 - h**2), np.sqrt(1.0 - (h / ior) ** 2)
    across = ((cos_i - ior * cos_t) / (cos_i + ior * cos_t)) ** 2
    along = ((ior * cos_i - cos_t) / (ior * cos_i + cos_t)) ** 2
    return float(np.mean(0.5 * (across + along)))


def _albedos(fabric: FabricParameters) -> SurfaceAlbedos:
    colors = [np.mean(fabric.system(system).colors(), axis=0) for system in SYSTEMS]
    shine = [_shine(fabric.system(system)) for system in SYSTEMS]
    many = [1.0 - (1.0 - c) ** POWER for c in colors]
    return SurfaceAlbedos(
        np.array([DIFFUSE * m for m in many] + [np.full(3, s) for s in shine]),
        np.array([TRANSMITTED * m for m in many] + [s * c for s, c in zip(shine, colors, strict=True)]),
    )


def _shine(yarn: YarnParameters) -> float:
    return fiber_reflectance(yarn.ior)
