"""The geometry of a woven surface for kernels: frame and height at a point, horizons of a tile.

Lengths are in cells: x over [0, columns), y over [0, rows). Systems are numbered as ``SurfaceTile.yarn`` has them:
0 weft, 1 warp, 2 gap. ``cells`` (rows, columns, 3) holds for each crossing the system on top, the middle of its segment
along the yarn counted from the cell's lower end, and the segment's length; ``yarns`` (2, 3) the sine and cosine of the
twist, and the inclination, of weft and warp.

Per segment (Irawan and Marschner 2012; MODEL of Chen et al. 2024): x across, y along from the middle, in cells;
u = u_max y / (length / 2), v = pi x. Normal and fiber direction in (across, along, up):

    n = (sin v, sin u cos v, cos u cos v)
    t = (-cos v sin psi, cos u cos psi + sin u sin v sin psi, -sin u cos psi + cos u sin v sin psi)

For the warp (across, along) is (+x, +y), for the weft (-y, +x), so that the same twist is the same handedness.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

WEFT, WARP, GAP = 0, 1, 2

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz", "arcp"},
    "forceinline": True,
}


@njit(**_OPTIONS)
def locate(x, y, cells, half_width):
    """(system, across, along, length) of the point (x, y) of the tile; the system is ``GAP`` beside the yarn."""
    row = min(int(y), cells.shape[0] - 1)
    column = min(int(x), cells.shape[1] - 1)
    system = int(cells[row, column, 0])
    middle = cells[row, column, 1]
    if system == WARP:
        across, along = x - column - 0.5, y - row - middle
    else:
        across, along = -(y - row - 0.5), x - column - middle
    if abs(across) > half_width:
        system = GAP
    return system, across, along, cells[row, column, 2]


@njit(**_OPTIONS)
def frame_at(x, y, cells, yarns, half_width, beta):
    """(system, nx, ny, nz, tx, ty, tz): unit normal and fiber direction, slopes scaled by ``beta``.

    In a gap the normal is +z and the direction 0.
    """
    system, across, along, length = locate(x, y, cells, half_width)
    if system == GAP:
        return GAP, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    sin_p, cos_p, u_max = yarns[system, 0], yarns[system, 1], yarns[system, 2]
    u, v = 2.0 * u_max * along / length, math.pi * across
    sin_u, cos_u, sin_v, cos_v = math.sin(u), math.cos(u), math.sin(v), math.cos(v)
    na, nl, nz = beta * sin_v, beta * sin_u * cos_v, cos_u * cos_v
    scale = 1.0 / math.sqrt(na * na + nl * nl + nz * nz)
    na, nl, nz = na * scale, nl * scale, nz * scale
    ta = -cos_v * sin_p
    tl = cos_u * cos_p + sin_u * sin_v * sin_p
    tz = -sin_u * cos_p + cos_u * sin_v * sin_p
    # Orthogonal again after the normal was bent.
    part = ta * na + tl * nl + tz * nz
    ta, tl, tz = ta - part * na, tl - part * nl, tz - part * nz
    scale = 1.0 / math.sqrt(max(ta * ta + tl * tl + tz * tz, 1e-20))
    ta, tl, tz = ta * scale, tl * scale, tz * scale
    if system == WARP:
        return WARP, na, nl, nz, ta, tl, tz
    return WEFT, nl, -na, nz, tl, -ta, tz


@njit(**_OPTIONS)
def height_at(x, y, cells, yarns, half_width):
    """Height in cells for beta = 1, 0 where a segment's crest line ends; a gap lies as low as the yarns' edges there.

    Its slopes are tan v across and tan u along: the normal's but for a factor 1 / cos u across, which no height field
    has at every point.
    """
    system, across, along, length = locate(x, y, cells, half_width)
    if system == GAP:
        return math.log(math.cos(math.pi * half_width)) / math.pi
    u_max = yarns[system, 2]
    height = math.log(math.cos(math.pi * across)) / math.pi
    if u_max > 1e-4:
        u = 2.0 * u_max * along / length
        height += 0.5 * length / u_max * (math.log(math.cos(u)) - math.log(math.cos(u_max)))
    return height


@njit(cache=True, error_model="numpy")
def sample_tile(cells, yarns, half_width, beta, normal, orientation, yarn):
    """Frames at the pixel centres of one tile, into (P, P, 3), (P, P, 3) and (P, P)."""
    rows, columns, _ = cells.shape
    height, width = yarn.shape
    for r in range(height):
        for c in range(width):
            x, y = (c + 0.5) / width * columns, (r + 0.5) / height * rows
            system, nx, ny, nz, tx, ty, tz = frame_at(x, y, cells, yarns, half_width, beta)
            yarn[r, c] = system
            normal[r, c, 0], normal[r, c, 1], normal[r, c, 2] = nx, ny, nz
            orientation[r, c, 0], orientation[r, c, 1], orientation[r, c, 2] = tx, ty, tz


@njit(cache=True, error_model="numpy")
def tile_heights(cells, yarns, half_width, texels):
    """(rows texels, columns texels) heights at texel centres for beta = 1."""
    rows, columns, _ = cells.shape
    heights = np.empty((rows * texels, columns * texels))
    for r in range(heights.shape[0]):
        for c in range(heights.shape[1]):
            heights[r, c] = height_at((c + 0.5) / texels, (r + 0.5) / texels, cells, yarns, half_width)
    return heights


@njit(**_OPTIONS)
def bilinear(image, x, y):
    """``image`` (H, W), periodic, between its texel centres; x in [0, W), y in [0, H)."""
    height, width = image.shape
    fx, fy = x - 0.5, y - 0.5
    c0, r0 = math.floor(fx), math.floor(fy)
    fx, fy = fx - c0, fy - r0
    c0 = c0 + width if c0 < 0 else c0
    r0 = r0 + height if r0 < 0 else r0
    c1 = c0 + 1 if c0 + 1 < width else 0
    r1 = r0 + 1 if r0 + 1 < height else 0
    # As floats: differences of bytes would wrap.
    a, b, c, d = float(image[r0, c0]), float(image[r0, c1]), float(image[r1, c0]), float(image[r1, c1])
    low = a + fx * (b - a)
    high = c + fx * (d - c)
    return low + fy * (high - low)


@njit(cache=True, parallel=True, error_model="numpy")
def tile_horizons(heights, finer, texels, azimuths):
    """(azimuths, H, W) uint8, 255 t / (1 + t): the tile hides the sky below an elevation of tangent t, for beta = 1.

    One byte keeps t to 0.004 (1 + t)^2 and the tables in the processor's cache.

    ``heights`` (finer H, finer W) has ``finer texels`` a cell, an odd multiple, so that each texel's centre is one of
    its own. Azimuth k is the direction (cos, sin)(2 pi k / azimuths) in (x, y). Marches in steps of half a texel,
    of 6 % of the way farther out, until nothing of the tile can stand higher.
    """
    height, width = heights.shape[0] // finer, heights.shape[1] // finer
    horizons = np.zeros((azimuths, height, width), dtype=np.uint8)
    top = heights.max()
    step = 0.5 * finer
    wide, high = float(heights.shape[1]), float(heights.shape[0])
    over_w, over_h = 1.0 / wide, 1.0 / high
    for k in prange(azimuths):
        angle = 2.0 * math.pi * k / azimuths
        dx, dy = math.cos(angle), math.sin(angle)
        for r in range(height):
            for c in range(width):
                base = heights[r * finer + finer // 2, c * finer + finer // 2]
                most = 0.0
                x, y = (c + 0.5) * finer, (r + 0.5) * finer
                reach = step
                # Beyond this distance not even the highest crest rises above what hides the sky already.
                while (top - base) * texels * finer > max(most, 0.02) * reach:
                    # A remainder would cost more than the look-up.
                    px = (x + reach * dx) * over_w
                    py = (y + reach * dy) * over_h
                    px = min((px - math.floor(px)) * wide, wide - 1e-6)
                    py = min((py - math.floor(py)) * high, high - 1e-6)
                    slope = (bilinear(heights, px, py) - base) * texels * finer / reach
                    most = max(most, slope)
                    reach += max(step, 0.06 * reach)
                horizons[k, r, c] = int(255.0 * most / (1.0 + most) + 0.5)
    return horizons


@njit(**_OPTIONS)
def hidden(horizons, low, high, blend, x, y, level):
    """Whether the tile hides the sky at elevation ``level`` (255 t / (1 + t)) from texel position (x, y).

    Between the azimuths ``low`` and ``high``.
    """
    here = bilinear(horizons[low], x, y)
    return here + blend * (bilinear(horizons[high], x, y) - here) > level
