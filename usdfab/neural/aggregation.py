"""Ground truth of the neural material: the surface model aggregated over a footprint, in four components.

Chen et al. 2024 (paper B), eq. 3 to 8, by quasi Monte Carlo. For a footprint P, directions wi, wo:

    f_P = 1/A_P(wo)  integral over P of  f_p <wi.n_p> V(x_p, wi) A(p, wo) dp
    A(p, wo) = <wo.n_p> / <n_s.n_p> V(x_p, wo),     A_P(wo) = integral of A(p, wo)
    f_P = kd_warp C_warp + kd_weft C_weft + ks_warp S_warp + ks_weft S_weft

Settled here, where the paper is silent:
- The kernel k_P is a box: ``size`` tiles wide in u and in v, around the centre. For a weave whose repeat is not square
  the footprint is stretched with the tile.
- The cosine is *included*, as in eq. 3: light of radiance L from a solid angle dw adds ``f_P L dw``; a directional
  light of irradiance E across its own direction adds ``f_P E``. Nothing is to be multiplied by <wi.n_s> again.
- The specular term's cosines are those with n_p: with eq. 3 it becomes D G / (4 <n_s.n_p>), which is bounded.
- The Lambert term carries the cosine that its blend was made for: f^d <wi.n_s> = (w <wi.n_p> + (1 - w) <wi.n_s>) / pi.
  Taken literally, eq. 1 in eq. 3 is w <wi.n_p>^2 / (pi <wi.n_s>), which has no bound at grazing light.
- V is 1 where the direction is above the yarn's own surface, <w.n_p> > 0, and above the horizon of the tile's height
  field (beta times ``surface_kernel.height_at``), tabulated at ``TEXELS`` a cell and ``AZIMUTHS`` directions.
- Transmission: wi below the cloth. The yarn is lit from behind, <wi.n_p> < 0 < <wo.n_p>, and its underside lies as its
  mirror image does: V(x_p, wi) is that of wi mirrored at the cloth. So the specular part stays reciprocal.
- Gaps are area like any other, with the cloth's normal, and scatter nothing; what passes straight through them is
  ``delta_transmission``, not in the four components (paper B leaves it out).
- Nothing visible in the footprint (A_P = 0): all components are 0.

Energy, measured over all light for plain and satin, alpha 0.1 to 1, beta 0 to 2, views from 0 to 65 degrees: a white
cloth (k = 1) reflects 0.45 to 0.9 diffusely and 0.08 to 0.26 specularly, and lets through, lit from below, 0.34 to 0.85
and 0.01 to 0.04; up to 0.2 passes the gaps. So k_d of both sides together must stay near 1, which nothing enforces.

Against exact heights and finely marched shadows components are within 1 % on the mean; the visible share of gaps is up
to 0.02 too large.

Cost: 6 to 10 million samples a second on a thread, and up to 1.5 s once for a new geometry (8 x 8 crossings);
``tests/benchmarks/bench_aggregation.py``.
"""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.neural.aggregation_kernel import aggregate_queries
from usdfab.neural.surface_kernel import tile_heights, tile_horizons
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.neural.surface_tile import packed_geometry
from usdfab.scattering.surface_model import DIFFUSE_BLEND

TEXELS, AZIMUTHS, FINER = 32, 32, 3
"""Resolution of the horizons: texels along a cell, directions around; how much finer their heights are."""

_POOL = numba.get_num_threads()
"""Numba's threads; more cannot be asked for."""

COMPONENTS = ("C_warp", "C_weft", "S_warp", "S_weft")
"""The columns of what ``aggregate`` returns."""

QUERY = ("u", "v", "size", "wi_x", "wi_y", "wi_z", "wo_x", "wo_y")
"""The columns of queries."""


def aggregate(
    material: SurfaceMaterial,
    queries: ArrayLike,
    *,
    transmission: bool = False,
    samples: int = 2048,
    seed: int = 0,
    blend: float = DIFFUSE_BLEND,
    threads: int | None = None,
) -> NDArray[np.float32]:
    """C_warp, C_weft, S_warp, S_weft of eq. 7 and 8 for many queries: coefficients of albedo, cosine of wi included.

    Parameters
    ----------
    queries: (Q, 8) float
        Footprint centre u, v in tiles (any number, it wraps), footprint size in tiles (>= 0; 0 is the point); wi x, y,
        z, a unit vector; wo x, y, whose z is the positive root. wi_z > 0 for reflection, < 0 for transmission; rows
        with the other sign give 0.
    transmission:
        Light from below instead of above.
    samples:
        Points in the footprint (R2 sequence, shifted by a hash of seed and row).
    blend:
        w of eq. 1.
    threads:
        All that Numba has by default.

    Returns
    -------
    (Q, 4) float32, columns as ``COMPONENTS``; the same for the same arguments whatever the threads.

    Raises
    ------
    UsdfabError
        For queries of another shape, not finite, with wi no unit vector, wo outside the disk or a negative size.
    """
    return _run(material, queries, transmission, samples, seed, blend, threads)[:, :4]


def delta_transmission(
    material: SurfaceMaterial, queries: ArrayLike, *, samples: int = 2048, seed: int = 0, threads: int | None = None
) -> NDArray[np.float32]:
    """(Q,) float32: the share of the footprint's visible area that is gap, through which light passes unbent.

    Radiance along -wo behind the cloth adds this much of itself. Queries as in ``aggregate``; wi plays no part.
    """
    return _run(material, queries, False, samples, seed, DIFFUSE_BLEND, threads)[:, 4]


def _run(
    material: SurfaceMaterial, queries: ArrayLike, transmission: bool, samples: int, seed: int, blend: float,
    threads: int | None,
) -> NDArray[np.float32]:  # fmt: skip
    rows = checked_queries(queries)
    if samples < 1:
        raise UsdfabError(f"{samples} samples are none", place="samples", remedy="give 1 or more")
    if not 0.0 <= blend <= 1.0:
        raise UsdfabError(f"{blend:g} is not between 0 and 1", place="blend")
    cells, yarns = packed_geometry(material)
    horizons = _horizons(material.bits(), *material.inclination, material.gap)
    out = np.zeros((len(rows), 5), dtype=np.float32)
    before = numba.get_num_threads()
    numba.set_num_threads(min(threads or before, _POOL))
    try:
        aggregate_queries(
            rows, cells, yarns, material.half_width, material.height_scale, material.roughness, horizons, TEXELS,
            transmission, samples, np.uint64(seed), blend, out,
        )  # fmt: skip
    finally:
        numba.set_num_threads(before)
    return out


def checked_queries(queries: ArrayLike) -> NDArray[np.float64]:
    """(Q, 8) float64 with wi made exactly unit, or ``UsdfabError`` naming the first bad row."""
    rows = np.array(queries, dtype=np.float64, ndmin=2)
    if rows.ndim != 2 or rows.shape[1] != len(QUERY):
        raise UsdfabError(f"queries of shape {rows.shape} have not {len(QUERY)} columns", remedy=", ".join(QUERY))
    length = np.sqrt(np.sum(rows[:, 3:6] ** 2, axis=1))
    for bad, why in (
        (~np.isfinite(rows).all(axis=1), "is not finite"),
        (rows[:, 2] < 0.0, "has a negative footprint"),
        (np.abs(length - 1.0) > 1e-3, "has a wi that is no unit vector"),
        (rows[:, 6] ** 2 + rows[:, 7] ** 2 > 1.0, "has a wo outside the unit disk"),
    ):
        if bad.any():
            raise UsdfabError(f"query {int(np.flatnonzero(bad)[0])} {why}")
    rows[:, 3:6] /= length[:, None]
    return rows


@lru_cache(maxsize=16)
def _horizons(bits: str, inclination_warp: float, inclination_weft: float, gap: float) -> NDArray[np.uint8]:
    """Horizons for beta = 1; they scale with beta, and neither twist nor roughness change them."""
    from usdfab.neural.surface_material import weave_from_bits

    plain = SurfaceMaterial(weave_from_bits(bits), inclination=(inclination_warp, inclination_weft), gap=gap)
    cells, yarns = packed_geometry(plain)
    heights = tile_heights(cells, yarns, plain.half_width, FINER * TEXELS)
    return tile_horizons(heights, FINER, TEXELS, AZIMUTHS)
