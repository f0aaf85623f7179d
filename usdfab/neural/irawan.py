"""The woven cloth of Irawan and Marschner 2012, "Specular Reflection from Woven Cloth", to compare with.

From the publication, compactly. Taken over:
- yarns as segments of bent cylinders with twisted fibers: normal and direction as in ``surface_kernel`` (beta = 1);
- a fiber reflects into the cone h.t = 0 around its direction, with the phase function a + M(-wi.wo; b), uniform plus
  von Mises, and Seeliger's attenuation cos_i cos_o / (cos_i + cos_o) with the yarn's normal;
- a segment's highlight is that integrated over its surface: half a cylinder, as long as its arc, 1 / |wi + wo| from the
  cone's delta function;
- f_r = k_s f_s + k_d / pi, k_s scaled so that white yarns reflect all light specularly at normal incidence.

Different or left out:
- the delta function is a Gaussian in h.t of deviation ``width`` (the paper integrates it in closed form and smooths the
  result), so that one formula serves filament and staple yarns, points and footprints;
- no random variation of the highlights along yarns, no transmission; shadows of yarns on one another are not in the
  model; yarns fill their cells.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from usdfab.neural.aggregation import checked_queries
from usdfab.neural.surface_kernel import WARP, frame_at, locate
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.neural.surface_tile import packed_geometry
from usdfab.tracer.counted import mix

UNIFORM, FORWARD = 0.2, 3.0
"""a and b of the phase function: within what the paper fits to its six cloths."""

LEAST_WIDTH = 0.03


def irawan_components(
    material: SurfaceMaterial, queries: ArrayLike, *, samples: int = 256, seed: int = 0
) -> NDArray[np.float32]:
    """(Q, 4) C_warp, C_weft, S_warp, S_weft with the cosine of wi included; arguments as ``aggregation.aggregate``.

    Roughness is the highlight's width, as an angle of the half vector like the microflakes'; height scale and gap play
    no part.
    """
    rows = checked_queries(queries)
    return _components(material, rows, samples, seed) * np.array([1, 1, *[_normalisation(material)] * 2], np.float32)


def _components(material: SurfaceMaterial, rows: NDArray[np.float64], samples: int, seed: int) -> NDArray[np.float32]:
    cells, yarns = packed_geometry(material)
    out = np.zeros((len(rows), 4), dtype=np.float32)
    width = max(material.roughness, LEAST_WIDTH)
    _aggregate(rows, cells, yarns, width, UNIFORM, FORWARD, _bessel(FORWARD), samples, np.uint64(seed), out)
    return out


@lru_cache(maxsize=64)
def _normalisation(material: SurfaceMaterial) -> float:
    """1 over the specular albedo at normal incidence: a sum over directions that are uniform in the unit disk."""
    count = 2048
    k = np.arange(count)
    radius, turn = np.sqrt((k + 0.5) / count), 2.0 * np.pi * ((0.6180339887498949 * k) % 1.0)
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    z = np.sqrt(1.0 - x * x - y * y)
    rows = np.column_stack([np.full((count, 2), 0.5), np.ones(count), x, y, z, np.zeros((count, 2))])
    # f_s cos dw is f_s dx dy: the disk's area times the mean.
    values = _components(material, rows, 512, 0)[:, 2:].sum(axis=1) / z
    return 1.0 / (math.pi * float(np.mean(values)))


def _bessel(b: float) -> float:
    """I_0(b)."""
    return float(np.i0(b))


@njit(cache=True, parallel=True, error_model="numpy")
def _aggregate(queries, cells, yarns, width, uniform, forward, bessel, samples, seed, out):
    rows, columns, _ = cells.shape
    for k in prange(queries.shape[0]):
        wix, wiy, wiz = queries[k, 3], queries[k, 4], queries[k, 5]
        wox, woy = queries[k, 6], queries[k, 7]
        woz = math.sqrt(max(1.0 - wox * wox - woy * woy, 0.0))
        if wiz <= 0.0:
            continue
        hx, hy, hz = wix + wox, wiy + woy, wiz + woz
        between = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / between, hy / between, hz / between
        turn = math.acos(min(max(-(wix * wox + wiy * woy + wiz * woz), -1.0), 1.0))
        phase = uniform + math.exp(forward * math.cos(turn)) / (2.0 * math.pi * bessel)
        shift = mix(mix(seed) + np.uint64(k))
        sx = np.float64(shift >> np.uint64(40)) * 2.0**-24
        sy = np.float64((shift >> np.uint64(8)) & np.uint64(0xFFFFFF)) * 2.0**-24
        size = queries[k, 2]
        sums = np.zeros(4)
        for n in range(samples):
            x = sx + n * 0.7548776662466927
            y = sy + n * 0.5698402909980532
            x = queries[k, 0] + size * (x - math.floor(x) - 0.5)
            y = queries[k, 1] + size * (y - math.floor(y) - 0.5)
            x = min((x - math.floor(x)) * columns, columns * (1.0 - 1e-12))
            y = min((y - math.floor(y)) * rows, rows * (1.0 - 1e-12))
            system, nx, ny, nz, tx, ty, tz = frame_at(x, y, cells, yarns, 0.5, 1.0)
            u_max = yarns[locate(x, y, cells, 0.5)[0], 2]
            place = 0 if system == WARP else 1
            sums[place] += wiz / math.pi
            ci, co = wix * nx + wiy * ny + wiz * nz, wox * nx + woy * ny + woz * nz
            if ci <= 0.0 or co <= 0.0:
                continue
            off = (hx * tx + hy * ty + hz * tz) / width
            cone = math.exp(-0.5 * off * off) / (width * math.sqrt(2.0 * math.pi))
            area = 0.5 * math.pi * (u_max / math.sin(u_max) if u_max > 1e-6 else 1.0)
            sums[2 + place] += wiz * phase * ci * co / (ci + co) * cone / between * area
        for c in range(4):
            out[k, c] = sums[c] / samples
