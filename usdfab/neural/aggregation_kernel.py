"""The loop of ``aggregation``: samples of a footprint, for many queries at once."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from usdfab.neural.surface_kernel import GAP, WARP, frame_at, hidden
from usdfab.scattering.surface_model_numba import flake_reflection, flake_transmission
from usdfab.tracer.counted import mix

# R2 sequence (Roberts 2018): inverse powers of the plastic number.
_R2_X, _R2_Y = 0.7548776662466927, 0.5698402909980532
_INV_PI = 1.0 / math.pi


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def aggregate_queries(
    queries, cells, yarns, half_width, beta, alpha, horizons, texels, transmission, samples, seed, blend, out
):
    """Four components and the visible share of gaps of each query, into ``out`` (Q, 5). See ``aggregation``."""
    rows, columns, _ = cells.shape
    azimuths = horizons.shape[0]
    for k in prange(queries.shape[0]):
        wix, wiy, wiz = queries[k, 3], queries[k, 4], queries[k, 5]
        wox, woy = queries[k, 6], queries[k, 7]
        woz = math.sqrt(max(1.0 - wox * wox - woy * woy, 0.0))
        io = wix * wox + wiy * woy + wiz * woz
        lit = wiz < 0.0 if transmission else wiz > 0.0
        side = -1.0 if transmission else 1.0
        cloth = abs(wiz)

        # Horizons: the azimuth is the same for all samples; heights scale with beta, so its sky is that at tan / beta.
        i_low, i_high, i_blend, i_level = _direction(wix, wiy, cloth, beta, azimuths)
        o_low, o_high, o_blend, o_level = _direction(wox, woy, woz, beta, azimuths)

        stream = mix(mix(seed + np.uint64(0x9E3779B97F4A7C15)) + np.uint64(k))
        shift_x = np.float64(stream >> np.uint64(40)) * 2.0**-24
        shift_y = np.float64((stream >> np.uint64(8)) & np.uint64(0xFFFFFF)) * 2.0**-24
        size = queries[k, 2]
        left, bottom = queries[k, 0] - 0.5 * size, queries[k, 1] - 0.5 * size
        tiles = math.floor(size)

        area = gaps = c_warp = c_weft = s_warp = s_weft = 0.0
        for n in range(samples):
            x = shift_x + n * _R2_X
            y = shift_y + n * _R2_Y
            x = left + _within(size * (x - math.floor(x)), tiles)
            y = bottom + _within(size * (y - math.floor(y)), tiles)
            x = min((x - math.floor(x)) * columns, columns * (1.0 - 1e-12))
            y = min((y - math.floor(y)) * rows, rows * (1.0 - 1e-12))
            system, nx, ny, nz, tx, ty, tz = frame_at(x, y, cells, yarns, half_width, beta)

            # A(p, wo), eq. 4
            co = wox * nx + woy * ny + woz * nz
            if co <= 0.0 or hidden(horizons, o_low, o_high, o_blend, x * texels, y * texels, o_level):
                continue
            own = co / nz
            area += own
            if system == GAP:
                gaps += own
                continue
            ci = side * (wix * nx + wiy * ny + wiz * nz)
            if not lit or ci <= 0.0 or hidden(horizons, i_low, i_high, i_blend, x * texels, y * texels, i_level):
                continue

            # f_p <wi.n_p> of eq. 3, without albedo; the specular term's cosines cancel against those of A.
            ti, to = wix * tx + wiy * ty + wiz * tz, wox * tx + woy * ty + woz * tz
            if transmission:
                specular = flake_transmission(ci, co, ti, to, io, alpha) / nz
            else:
                specular = flake_reflection(ci, co, ti, to, io, alpha) / nz
            diffuse = _INV_PI * (blend * ci + (1.0 - blend) * cloth) * own
            if system == WARP:
                c_warp += diffuse
                s_warp += specular
            else:
                c_weft += diffuse
                s_weft += specular
        if area > 0.0:
            scale = 1.0 / area
            out[k, 0], out[k, 1] = c_warp * scale, c_weft * scale
            out[k, 2], out[k, 3] = s_warp * scale, s_weft * scale
            out[k, 4] = gaps * scale


@njit(cache=True, error_model="numpy", inline="always")
def _within(place, tiles):
    """Where the footprint is ``tiles`` or more wide, its whole tiles are one tile, gone through once by all samples.

    A sequence that went through many of them would be thinned out to a worse one.
    """
    return place / tiles if place < tiles else place - tiles


@njit(cache=True, error_model="numpy", inline="always")
def _direction(x, y, z, beta, azimuths):
    """Two neighbouring azimuths, the place between them, and the elevation as ``hidden`` takes it."""
    across = math.sqrt(x * x + y * y)
    turn = math.atan2(y, x) / (2.0 * math.pi) * azimuths
    turn = turn + azimuths if turn < 0.0 else turn
    low = int(turn) % azimuths
    tangent = z / max(across * beta, 1e-12)
    return low, (low + 1) % azimuths, turn - math.floor(turn), 255.0 * tangent / (1.0 + tangent)
