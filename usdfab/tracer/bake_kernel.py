"""Rays straight down (or up) through one periodic patch: what a map's texels see of the fibers.

Patch space as in ``slab.py``, one tile that repeats. A texel's rays start at jittered places of its own square, so that
a texel is the mean over its area. Each ray gives the visible fiber's place, normal and direction, one ray towards the
sky for the ambient occlusion, and, for the first ``paths`` of them, a path that scatters until it leaves the cloth: in
a uniform sky of radiance 1 the weight with which it leaves above is what the texel would look like, and the weight
below is what shines through from a uniform sky there.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.scattering.fiber_numba import fiber_direction, fiber_frame, load_fiber, prepare_fiber, sample_fiber_lobe
from usdfab.tracer.counted import mix, next_uniform, start_stream
from usdfab.tracer.intrinsics import ENTRY, KERNEL, NG, PRIM, U, borrow, new_ray_buffer
from usdfab.tracer.slab import ESCAPED_UP, HIT, slab_occluded, trace_slab
from usdfab.tracer.tangents import tangent_at
from usdfab.tracer.world import HEIGHT, HIGH, LOW, MATERIAL, WIDTH, YARN, Patches

HITS, BENT, PLACE, ACROSS, SKY, COLOR, WARP, LOOSE, PATHS, BACK, THROUGH = 0, 1, 4, 5, 7, 8, 11, 12, 13, 14, 17
SUMS = 20
"""Layers of sums over a texel's rays: rays that hit a fiber; of these the normal (3), the height, the doubled angle of
the fiber in the plane (2: cos, sin, times the squared length of its projection), what sees the sky, the fiber albedo
coefficient (3), those of warp yarns, those of flyaways; paths, and the weight (3) with which they leave on the side
that is looked at and (3) on the other."""

_ROULETTE_DEPTH = 5


@njit(**ENTRY, nogil=True)
def bake_rows(
    addresses, patches, width, height, up, seed, rows, samples, paths, max_depth, last_warp, first_loose, sums
):
    """Add the sums of texel rows ``rows[0]`` to ``rows[1]`` (from the top, that is from the highest y).

    Runs without Python's lock; a texel's sums do not depend on how rows are shared out.

    Parameters
    ----------
    addresses:
        rtcIntersect1, rtcOccluded1, back-face filter.
    patches: Patches
        One patch.
    width, height: int
        Texels over the patch.
    up: float
        1: seen from above, -1: from below.
    samples, paths: int
        Rays per texel, and how many of them go on as paths.
    last_warp, first_loose: int
        Number of the last warp yarn (``Patches.curves``), and of the first curve that is a flyaway.
    sums: (rows[1] - rows[0], width, SUMS) float64
    """
    memory = new_ray_buffer(addresses[2])
    buffer = (borrow(memory[0]), borrow(memory[1]), memory[2])
    p = Patches(
        borrow(patches.table), borrow(patches.handles), borrow(patches.records), borrow(patches.materials),
        borrow(patches.albedo), borrow(patches.curves),
    )  # fmt: skip
    table = p.table
    for row in range(rows[0], rows[1]):
        for column in range(width):
            pixel = row * width + column
            shift = mix(np.uint64(pixel) + mix(np.uint64(seed)))
            shift_x = np.float64(shift >> np.uint64(40)) * 2.0**-24
            shift_y = np.float64((shift >> np.uint64(16)) & np.uint64(0xFFFFFF)) * 2.0**-24
            out = borrow(sums[row - rows[0], column])
            for sample in range(samples):
                # The R2 sequence (Roberts 2018), as in render_tile.
                jx = shift_x + 0.7548776662466927 * (sample + 1)
                jy = shift_y + 0.5698402909980532 * (sample + 1)
                x = (column + jx - math.floor(jx)) / width * table[0, WIDTH]
                y = (1.0 - (row + jy - math.floor(jy)) / height) * table[0, HEIGHT]
                z = table[0, HIGH] if up > 0.0 else table[0, LOW]
                stream = start_stream(seed, pixel, sample)
                _follow(
                    addresses, p, buffer, stream, x, y, z, up, max_depth if sample < paths else 1, last_warp,
                    first_loose, out,
                )  # fmt: skip
    memory[1][0] = np.uint32(0)  # Numba frees an array after its last use: this is after the last ray


@njit(**KERNEL)
def _follow(addresses, p, buffer, stream, lx, ly, lz, up, max_depth, last_warp, first_loose, out):
    """One ray, its sky ray and its path; adds to ``out``."""
    zero = np.int64(0)
    floats, words, _address = buffer
    dx, dy, dz = 0.0, 0.0, -up
    ix = iy = zero
    beta_r = beta_g = beta_b = 1.0
    for depth in range(max_depth):
        outcome, _t, lx, ly, lz, ix, iy, _patch = trace_slab(
            addresses[0], p.table, p.handles, buffer, zero, 1, lx, ly, lz, ix, iy, dx, dy, dz
        )
        if outcome != HIT:
            if depth > 0:
                at = BACK if (outcome == ESCAPED_UP) == (up > 0.0) else THROUGH
                out[at], out[at + 1], out[at + 2] = out[at] + beta_r, out[at + 1] + beta_g, out[at + 2] + beta_b
            return
        curve, ax, ay, az = tangent_at(p.records, 0, np.int64(words[PRIM]), np.float64(floats[U]))
        norm = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * norm, ay * norm, az * norm
        nx, ny, nz = np.float64(floats[NG]), np.float64(floats[NG + 1]), np.float64(floats[NG + 2])
        dot = nx * ax + ny * ay + nz * az
        nx, ny, nz = nx - dot * ax, ny - dot * ay, nz - dot * az
        norm = 1.0 / math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        row = np.int64(p.curves[curve, MATERIAL])
        if depth == 0:
            out[HITS] += 1.0
            out[BENT], out[BENT + 1], out[BENT + 2] = out[BENT] + nx, out[BENT + 1] + ny, out[BENT + 2] + nz
            out[PLACE] += lz
            out[ACROSS] += ax * ax - ay * ay
            out[ACROSS + 1] += 2.0 * ax * ay
            for k in range(3):
                out[COLOR + k] += p.albedo[row, k]
            if p.curves[curve, YARN] <= last_warp:
                out[WARP] += 1.0
            if curve >= first_loose:
                out[LOOSE] += 1.0
            stream, u0 = next_uniform(stream)
            stream, u1 = next_uniform(stream)
            # Towards a uniform sky, as the cloth's own plane receives it.
            wz, flat, phi = up * math.sqrt(1.0 - u0), math.sqrt(u0), 2.0 * math.pi * u1
            wx, wy = flat * math.cos(phi), flat * math.sin(phi)
            if wx * nx + wy * ny + wz * nz > 0.0:
                hidden, _through = slab_occluded(
                    addresses[1], p.table, p.handles, buffer, zero, 1, lx, ly, lz, ix, iy, wx, wy, wz, 1e30
                )
                if not hidden:
                    out[SKY] += 1.0
            if max_depth == 1:
                return
            out[PATHS] += 1.0
        sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -dx, -dy, -dz)
        material = load_fiber(p.materials, row)
        prepared = prepare_fiber(material, h, sin_to, cos_to)
        stream, u0 = next_uniform(stream)
        stream, u1 = next_uniform(stream)
        stream, u2 = next_uniform(stream)
        stream, u3 = next_uniform(stream)
        sin_ti, cos_ti, phi, wr, wg, wb = sample_fiber_lobe(material, prepared, u0, u1, u2, u3)
        dx, dy, dz = fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi)
        beta_r, beta_g, beta_b = beta_r * wr, beta_g * wg, beta_b * wb
        if depth >= _ROULETTE_DEPTH:
            beta = max(beta_r, beta_g, beta_b)
            if beta <= 0.0:
                return
            survive = min(max(beta, 0.05), 0.98)
            stream, u0 = next_uniform(stream)
            if u0 >= survive:
                return
            beta_r, beta_g, beta_b = beta_r / survive, beta_g / survive, beta_b / survive
