"""The approximate model of eq. 10 for all pixels of a picture, in Numba, with derivatives written out by hand.

A pixel sees a range of a fiber's width. It is cut into pieces of equal angle gamma = arc sine of h, over each of which
attenuation and normal count as constant and D is averaged (``usdfab.scattering.fiber_numba_wide``).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from usdfab.fit.raster.segments import BLOCK, INLINE, SYSTEM
from usdfab.scattering.fiber_numba_wide import WIDE_SIZE, wide_lobes, wide_lobes_slopes, wide_slopes, wide_value
from usdfab.tracer.intrinsics import ENTRY, KERNEL, borrow

DIFFUSE_WEIGHT = 0.5
"""w_d of eq. 10: how much of the diffuse term follows the fiber's normal, the rest that of the cloth."""

PIECE = 0.45
"""Widest piece, in gamma."""

MATERIAL = WIDE_SIZE + 3
"""Numbers of a material: those of ``fiber_numba_wide``, then k_d (3)."""

UNSHADOWED = 0.7
"""How much of the diffuse term shadows do not take, where it stands for multiple scattering: that light comes from all
sides. Read from path-traced plain, twill and satin: what is left of their pictures after single scattering, by place in
the cell, is nearest to k_d times (.7 + .3 of the light that is not shadowed), for C of .25, .6 and .93 alike."""

_EDGE = 1.0 - 1e-6
"""|h| beyond which nothing is looked at: the derivatives of arc sine and root are of no use there."""

_TINY = 1e-12
_LEAST = 1e-8


@njit(**INLINE)
def _frame(distance, tx, ty, tz, dx, dy, dz, ox, oy, oz):
    """At a hit under a lamp at (ox, oy, oz) from the start of the ray: the lamp's direction (3) and squared distance;
    f and e of the normal plane (6) and the length of d x t; sines of both inclinations, the lamp's part along e and f.
    """
    x, y, z = ox - distance * dx, oy - distance * dy, oz - distance * dz
    squared = x * x + y * y + z * z
    over = 1.0 / math.sqrt(squared)
    x, y, z = x * over, y * over, z * over
    # e along wo projected into the normal plane, f = axis x e.
    fx, fy, fz = dy * tz - dz * ty, dz * tx - dx * tz, dx * ty - dy * tx
    norm = math.sqrt(fx * fx + fy * fy + fz * fz + _TINY)
    fx, fy, fz = fx / norm, fy / norm, fz / norm
    ex, ey, ez = fy * tz - fz * ty, fz * tx - fx * tz, fx * ty - fy * tx
    sin_to, sin_ti = -(dx * tx + dy * ty + dz * tz), x * tx + y * ty + z * tz
    along_e, along_f = x * ex + y * ey + z * ez, x * fx + y * fy + z * fz
    return (x, y, z, squared), (fx, fy, fz, ex, ey, ez, norm), sin_to, sin_ti, along_e, along_f


@njit(**INLINE)
def _angles(sin_to, along_e, along_f):
    """(cos_to, cos_ti, phi)."""
    cos_to = math.sqrt(max(1.0 - sin_to * sin_to, _LEAST))
    cos_ti = math.sqrt(max(along_e * along_e + along_f * along_f, _LEAST))
    # The direction exactly along the fiber has no azimuth, and no gradient of it.
    phi = math.atan2(along_f, along_e if abs(along_e) + abs(along_f) > 1e-6 else 1e-6)
    return cos_to, cos_ti, phi


@njit(**INLINE)
def _range(h, spread):
    """(gamma from, gamma to, number of pieces)."""
    low = math.asin(min(max(h - 0.5 * spread, -_EDGE), _EDGE))
    high = math.asin(min(max(h + 0.5 * spread, -_EDGE), _EDGE))
    return low, high, max(math.ceil((high - low) / PIECE), 1)


@njit(**INLINE)
def _diffuse(h, along_e, along_f, up):
    """The diffuse term over k_d."""
    fiber = math.sqrt(1.0 - h * h) * along_e - h * along_f
    return (DIFFUSE_WEIGHT * max(fiber, 0.0) + (1.0 - DIFFUSE_WEIGHT) * max(up, 0.0)) / math.pi


@njit(**INLINE)
def _diffuse_light(lit, unshadowed):
    """How much of a lamp's light the diffuse term has."""
    return unshadowed + (1.0 - unshadowed) * lit


# Loops, since Numba takes seconds to compile what adds whole arrays.
@njit(**INLINE)
def _copy_row(table, row, target):
    for c in range(len(target)):
        target[c] = table[row, c]


@njit(**INLINE)
def _move(sums, totals, block, row):
    """Add sums to one row's of a block, and begin again."""
    for c in range(len(sums)):
        totals[block, row, c] += sums[c]
        sums[c] = 0.0


@njit(**ENTRY, parallel=True)
def shade(
    distance, tangent, h_, lit, spread, material, topology_, color_, start, direction, segment, lamps_, intensity_,
    turn_, single, diffuse, unshadowed, colors,
):  # fmt: skip
    """Fill ``colors`` (N, 3); the other arguments are those of ``shade.shaded``."""
    count = len(distance)
    for block in prange((count + BLOCK - 1) // BLOCK):
        topology, color, turns = borrow(topology_), borrow(color_), borrow(turn_)
        lamps, intensity, rows = borrow(lamps_), borrow(intensity_), borrow(material)
        m, turn = np.empty(MATERIAL), np.empty(turns.shape[1])
        before = -1
        for k in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            s = np.int64(segment[k])
            if s < 0:
                continue
            row = color[s]
            if row != before:
                _copy_row(rows, row, m)
                _copy_row(turns, row, turn)
                before = row
            low, high, pieces = _range(h_[k], spread[topology[s, SYSTEM]])
            for lamp in range(len(lamps)):
                shines, shines_diffuse = lit[k, lamp], _diffuse_light(lit[k, lamp], unshadowed)
                direct, indirect = single and shines > 0.0, diffuse and shines_diffuse > 0.0
                if not (direct or indirect):
                    continue
                to_lamp, _, sin_to, sin_ti, along_e, along_f = _frame(
                    distance[k], tangent[k, 0], tangent[k, 1], tangent[k, 2], direction[k, 0], direction[k, 1],
                    direction[k, 2], lamps[lamp, 0] - start[k, 0], lamps[lamp, 1] - start[k, 1],
                    lamps[lamp, 2] - start[k, 2],
                )  # fmt: skip
                cos_to, cos_ti, phi = _angles(sin_to, along_e, along_f)
                red = green = blue = 0.0
                lobes = 0.0, 0.0, 0.0, 0.0
                if direct:
                    lobes = wide_lobes(m, turn, sin_to, cos_to, sin_ti, cos_ti)
                first, last = math.sin(low), math.sin(high)
                a = first
                for piece in range(pieces):
                    b = math.sin(low + (high - low) * ((piece + 1) / pieces))
                    share = (b - a) / (last - first)
                    if direct:
                        r, g, bl = wide_value(m, lobes, a, b, cos_to, phi)
                        part = share * shines
                        red, green, blue = red + part * r, green + part * g, blue + part * bl
                    if indirect:
                        d = share * shines_diffuse * _diffuse(0.5 * (a + b), along_e, along_f, to_lamp[2])
                        red, green, blue = (
                            red + d * m[WIDE_SIZE], green + d * m[WIDE_SIZE + 1], blue + d * m[WIDE_SIZE + 2]
                        )  # fmt: skip
                    a = b
                colors[k, 0] += intensity[lamp, 0] * red / to_lamp[3]
                colors[k, 1] += intensity[lamp, 1] * green / to_lamp[3]
                colors[k, 2] += intensity[lamp, 2] * blue / to_lamp[3]


@njit(**ENTRY, parallel=True)
def shade_slopes(
    distance, tangent, h_, lit, spread, material, topology_, color_, start, direction, segment, lamps_, intensity_,
    turn_, single, diffuse, unshadowed, by_colors, by_distance, by_tangent, by_h, by_lit, by_spread, by_material,
):  # fmt: skip
    """Fill derivatives of a loss by the first six arguments of ``shade``, from those by ``colors``."""
    count = len(distance)
    blocks = (count + BLOCK - 1) // BLOCK
    # Sums of each block, added in order: the same every time, whatever the number of threads.
    spread_sums, material_sums = np.zeros((blocks, 2)), np.zeros((blocks, len(material), MATERIAL))
    for block in prange(blocks):
        topology, color, turns = borrow(topology_), borrow(color_), borrow(turn_)
        lamps, intensity, rows = borrow(lamps_), borrow(intensity_), borrow(material)
        m, turn = np.empty(MATERIAL), np.empty(turns.shape[1])
        sums = np.zeros(MATERIAL)
        before = -1
        for k in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            s = np.int64(segment[k])
            if s < 0:
                continue
            row = color[s]
            if row != before:
                if before >= 0:
                    _move(sums, material_sums, block, before)
                _copy_row(rows, row, m)
                _copy_row(turns, row, turn)
                before = row
            system = topology[s, SYSTEM]
            for lamp in range(len(lamps)):
                direct = single and lit[k, lamp] > 0.0
                indirect = diffuse and _diffuse_light(lit[k, lamp], unshadowed) > 0.0
                if not (direct or indirect):
                    continue
                found = _pixel_slopes(
                    m, turn, direct, indirect, unshadowed, sums, distance[k], tangent[k, 0], tangent[k, 1],
                    tangent[k, 2], h_[k], spread[system], direction[k, 0], direction[k, 1], direction[k, 2],
                    lamps[lamp, 0] - start[k, 0], lamps[lamp, 1] - start[k, 1], lamps[lamp, 2] - start[k, 2],
                    lit[k, lamp], by_colors[k, 0] * intensity[lamp, 0], by_colors[k, 1] * intensity[lamp, 1],
                    by_colors[k, 2] * intensity[lamp, 2],
                )  # fmt: skip
                by_distance[k] += found[0]
                by_tangent[k, 0] += found[1]
                by_tangent[k, 1] += found[2]
                by_tangent[k, 2] += found[3]
                by_h[k] += found[4]
                by_lit[k, lamp] = found[5]
                spread_sums[block, system] += found[6]
        if before >= 0:
            _move(sums, material_sums, block, before)
    for block in range(blocks):
        for system in range(2):
            by_spread[system] += spread_sums[block, system]
        for row in range(len(material)):
            for c in range(MATERIAL):
                by_material[row, c] += material_sums[block, row, c]


@njit(**KERNEL)
def _pixel_slopes(
    m, turn, single, diffuse, unshadowed, sums, distance, tx, ty, tz, h, spread, dx, dy, dz, ox, oy, oz, lit,
    by_r, by_g, by_b,
):  # fmt: skip
    """Derivatives of a loss by (distance, tangent (3), h, lit, spread), from those by the light of a lamp of 1 W/sr;
    those by the material are added to ``sums``."""
    to_lamp, plane, sin_to, sin_ti, along_e, along_f = _frame(distance, tx, ty, tz, dx, dy, dz, ox, oy, oz)
    x, y, z, squared = to_lamp
    cos_to, cos_ti, phi = _angles(sin_to, along_e, along_f)
    low, high, pieces = _range(h, spread)
    lobes = 0.0, 0.0, 0.0, 0.0
    if single:
        lobes = wide_lobes(m, turn, sin_to, cos_to, sin_ti, cos_ti)
    w_r, w_g, w_b = by_r * lit / squared, by_g * lit / squared, by_b * lit / squared
    shines_diffuse = _diffuse_light(lit, unshadowed)
    d_r, d_g, d_b = by_r * shines_diffuse / squared, by_g * shines_diffuse / squared, by_b * shines_diffuse / squared
    k_r, k_g, k_b = m[WIDE_SIZE], m[WIDE_SIZE + 1], m[WIDE_SIZE + 2]

    first, last = math.sin(low), math.sin(high)
    width = last - first
    a, cos_a, loss, diffuse_loss = first, math.cos(low), 0.0, 0.0
    by_low = by_high = by_e = by_f = by_z = by_phi = by_cos_to = 0.0
    l_0 = l_1 = l_2 = l_3 = 0.0
    for piece in range(pieces):
        part = (piece + 1) / pieces
        gamma = low + (high - low) * part
        b, cos_b = math.sin(gamma), math.cos(gamma)
        share, middle = (b - a) / width, 0.5 * (a + b)
        by_share = by_a = by_end = 0.0
        if single:
            value, by_lobes, rest = wide_slopes(
                m, lobes, a, b, cos_to, phi, (share * w_r, share * w_g, share * w_b), sums
            )  # fmt: skip
            by_share += w_r * value[0] + w_g * value[1] + w_b * value[2]
            l_0, l_1, l_2, l_3 = l_0 + by_lobes[0], l_1 + by_lobes[1], l_2 + by_lobes[2], l_3 + by_lobes[3]
            by_a, by_end = rest[0], rest[1]
            by_cos_to += rest[2]
            by_phi += rest[3]
        if diffuse:
            term, white = _diffuse(middle, along_e, along_f, z), d_r * k_r + d_g * k_g + d_b * k_b
            by_share += term * white
            diffuse_loss += share * term * white
            sums[WIDE_SIZE] += share * term * d_r
            sums[WIDE_SIZE + 1] += share * term * d_g
            sums[WIDE_SIZE + 2] += share * term * d_b
            by_term = share * white / math.pi
            root = math.sqrt(1.0 - middle * middle)
            if root * along_e - middle * along_f > 0.0:
                by_fiber = DIFFUSE_WEIGHT * by_term
                by_e += by_fiber * root
                by_f -= by_fiber * middle
                by_middle = -by_fiber * (along_e * middle / root + along_f)
                by_a, by_end = by_a + 0.5 * by_middle, by_end + 0.5 * by_middle
            if z > 0.0:
                by_z += (1.0 - DIFFUSE_WEIGHT) * by_term
        loss += share * by_share
        # share = (b - a) / (last - first)
        by_a, by_end = by_a - by_share / width, by_end + by_share / width
        by_low += share * by_share / width * math.cos(low)
        by_high -= share * by_share / width * math.cos(high)
        begun = piece / pieces
        by_low += by_a * cos_a * (1.0 - begun) + by_end * cos_b * (1.0 - part)
        by_high += by_a * cos_a * begun + by_end * cos_b * part
        a, cos_a = b, cos_b

    # gamma = asin(h -+ spread / 2) where that is inside
    side_low, side_high = h - 0.5 * spread, h + 0.5 * spread
    by_low = by_low / math.cos(low) if abs(side_low) <= _EDGE else 0.0
    by_high = by_high / math.cos(high) if abs(side_high) <= _EDGE else 0.0
    by_h, by_spread = by_low + by_high, 0.5 * (by_high - by_low)

    by_sin_to = by_sin_ti = 0.0
    if single:
        by_sin_to, by_cos, by_sin_ti, by_cos_ti = wide_lobes_slopes(
            m, turn, sin_to, cos_to, sin_ti, cos_ti, lobes, (l_0, l_1, l_2, l_3), sums
        )
        by_cos_to += by_cos
        if 1.0 - sin_to * sin_to > _LEAST:
            by_sin_to -= by_cos_to * sin_to / cos_to
        across = along_e * along_e + along_f * along_f
        if across > _LEAST:
            by_e += by_cos_ti * along_e / cos_ti
            by_f += by_cos_ti * along_f / cos_ti
        if abs(along_e) + abs(along_f) > 1e-6:
            by_e -= by_phi * along_f / across
            by_f += by_phi * along_e / across

    # Along e and f, with e = f x t and f = (d x t) / |d x t|
    fx, fy, fz, ex, ey, ez, norm = plane
    by_x, by_y = by_e * ex + by_f * fx + by_sin_ti * tx, by_e * ey + by_f * fy + by_sin_ti * ty
    by_z += by_e * ez + by_f * fz + by_sin_ti * tz
    ux, uy, uz = by_e * x, by_e * y, by_e * z
    by_fx, by_fy, by_fz = by_f * x + ty * uz - tz * uy, by_f * y + tz * ux - tx * uz, by_f * z + tx * uy - ty * ux
    by_tx = uy * fz - uz * fy - by_sin_to * dx + by_sin_ti * x
    by_ty = uz * fx - ux * fz - by_sin_to * dy + by_sin_ti * y
    by_tz = ux * fy - uy * fx - by_sin_to * dz + by_sin_ti * z
    straight = by_fx * fx + by_fy * fy + by_fz * fz
    gx, gy, gz = (by_fx - straight * fx) / norm, (by_fy - straight * fy) / norm, (by_fz - straight * fz) / norm
    by_tx, by_ty, by_tz = by_tx + gy * dz - gz * dy, by_ty + gz * dx - gx * dz, by_tz + gx * dy - gy * dx

    # The lamp's direction and squared distance, from the distance along the camera's ray
    over = 1.0 / math.sqrt(squared)
    straight = by_x * x + by_y * y + by_z * z
    pull = -2.0 * loss / squared / over
    by_distance = -(
        dx * ((by_x - straight * x) * over + pull * x)
        + dy * ((by_y - straight * y) * over + pull * y)
        + dz * ((by_z - straight * z) * over + pull * z)
    )
    by_lit = (loss - diffuse_loss) / lit if single else 0.0
    if diffuse:
        by_lit += diffuse_loss * (1.0 - unshadowed) / shines_diffuse
    return by_distance, by_tx, by_ty, by_tz, by_h, by_lit, by_spread
