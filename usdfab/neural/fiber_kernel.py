"""What a flat, endless cloth of fibers answers to a query: paths from random places of the footprint, in four parts.

The tracer's own pieces (``tracer.slab``, ``scattering.fiber_numba``) on the tracer's own tiles, without a scene around.
A query here has many directions of light, from either side of the cloth: every vertex of a path looks at all of them
(next-event estimation). Rays are the dearer part, so that one path serves many answers, of reflection and transmission.

Light is told apart by the yarn system that the viewer's ray meets first, and by its way: ``GLOSS`` was mirrored at
fibers' surfaces only (R lobes), which has no colour; all else went through a fiber at least once and has.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.scattering.fiber_numba import (
    eval_fiber,
    fiber_angles,
    fiber_direction,
    fiber_frame,
    load_fiber,
    prepare_fiber,
    sample_fiber_lobe,
)
from usdfab.tracer.counted import next_uniform, start_stream
from usdfab.tracer.intrinsics import ENTRY, KERNEL, NG, PRIM, U, borrow, new_ray_buffer
from usdfab.tracer.kernel import RUSSIAN_ROULETTE_DEPTH, SHADOW_ROULETTE
from usdfab.tracer.slab import HIT, slab_occluded, trace_slab
from usdfab.tracer.tangents import tangent_at
from usdfab.tracer.vertex import pixel_shift
from usdfab.tracer.world import FIRST_CURVE, HEIGHT, HIGH, LOW, MATERIAL, WIDTH, Patches

COLOR, GLOSS = 0, 6
PARTS = 8
"""Of an answer: RGB of the coloured light by warp, by weft (6), then of the gloss by warp, by weft (2)."""

_R_SHARE = 21
"""Where R's probability is in what ``prepare_fiber`` returns. The nine numbers before it are the attenuations of the
coloured lobes."""

_TILES = 1024
"""Tiles in either direction among which a sample's is drawn: all variants and copies take their turns."""


@njit(**ENTRY, nogil=True)
def answer_queries(
    addresses, borrowed_patches, systems, tile, up, queries, lights, first, samples, seed, max_depth, out
):  # fmt: skip
    """Mean radiance towards viewers for an irradiance of 1 across each light's direction, cosine included.

    Parameters
    ----------
    addresses:
        rtcIntersect1, rtcOccluded1, back-face filter.
    borrowed_patches: Patches
        Variants of one fabric's tile.
    systems: (M,) int32
        Of each material: 0 warp, 1 weft.
    tile: (2,) float64
        Width and height of what queries call a tile, in patch units.
    up: float
        1: seen from the front, -1: from behind; u, x and z are then reversed (the cloth turned about its warp).
    queries: (Q, 5) float64
        u, v, side of the footprint in tiles; x, y towards the viewer.
    lights: (Q, L, 3) float64
        Towards the lights, unit; z is positive on the viewer's side.
    first: int
        Number of the first query: its random numbers hang on it.
    samples, seed, max_depth: int
        Paths of each query; longest path, counted as ``usdfab render --max-depth`` does.
    out: (Q, L, PARTS) float64
        Filled.
    """
    memory = new_ray_buffer(addresses[2])
    buffer = (borrow(memory[0]), borrow(memory[1]), memory[2])
    q = borrowed_patches
    p = Patches(
        borrow(q.table), borrow(q.handles), borrow(q.records), borrow(q.materials), borrow(q.albedo), borrow(q.curves)
    )
    owners = borrow(systems)
    width, height = p.table[0, WIDTH], p.table[0, HEIGHT]
    border = p.table[0, HIGH] if up > 0.0 else p.table[0, LOW]
    for k in range(len(queries)):
        row = borrow(queries[k])
        answer = borrow(out[k])
        answer[:, :] = 0.0
        u, v, size = row[0], row[1], row[2]
        ox, oy = row[3], row[4]
        oz = math.sqrt(max(1.0 - ox * ox - oy * oy, 1e-6))
        towards = borrow(lights[k])
        dx, dy, dz = -up * ox, -oy, -up * oz
        shift_x, shift_y = pixel_shift(seed, first + k)
        for sample in range(samples):
            stream = start_stream(seed, first + k, sample)
            # The R2 sequence (Roberts 2018), as in the tracer's pixels; any of the tiles.
            jx = shift_x + 0.7548776662466927 * (sample + 1)
            jy = shift_y + 0.5698402909980532 * (sample + 1)
            s = u + size * (jx - math.floor(jx) - 0.5)
            t = v + size * (jy - math.floor(jy) - 0.5)
            s, t = s - math.floor(s), t - math.floor(t)
            stream, u0 = next_uniform(stream)
            stream, u1 = next_uniform(stream)
            back = border / dz
            lx = (math.floor(u0 * _TILES) + (s if up > 0.0 else 1.0 - s)) * tile[0] + back * dx
            ly = (math.floor(u1 * _TILES) + t) * tile[1] + back * dy
            ix, iy = np.int64(math.floor(lx / width)), np.int64(math.floor(ly / height))
            _follow(
                addresses, p, owners, buffer, stream, lx - ix * width, ly - iy * height, border, ix, iy, dx, dy, dz,
                up, towards, max_depth, 1.0 / samples, answer,
            )  # fmt: skip
    memory[1][0] = np.uint32(0)  # Numba frees an array after its last use: this is after the last ray


@njit(**KERNEL)
def _follow(
    addresses, p, owners, buffer, stream, lx, ly, lz, ix, iy, dx, dy, dz, up, lights, max_depth, share, answer
):  # fmt: skip
    """One path; adds ``share`` of what arrives to ``answer`` (L, PARTS)."""
    zero = np.int64(0)
    variants = len(p.table)
    floats, words, _address = buffer
    beta_r = beta_g = beta_b = 1.0
    mirrored = True
    system = 0
    for depth in range(1, max_depth):
        outcome, _t, lx, ly, lz, ix, iy, patch = trace_slab(
            addresses[0], p.table, p.handles, buffer, zero, variants, lx, ly, lz, ix, iy, dx, dy, dz
        )
        if outcome != HIT:
            return
        curve, ax, ay, az = tangent_at(p.records, patch, np.int64(words[PRIM]), np.float64(floats[U]))
        norm = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * norm, ay * norm, az * norm
        nx, ny, nz = np.float64(floats[NG]), np.float64(floats[NG + 1]), np.float64(floats[NG + 2])
        dot = nx * ax + ny * ay + nz * az
        nx, ny, nz = nx - dot * ax, ny - dot * ay, nz - dot * az
        norm = 1.0 / math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        row = np.int64(p.curves[int(p.table[patch, FIRST_CURVE]) + curve, MATERIAL])
        if depth == 1:
            system = owners[row]
        material = load_fiber(p.materials, row)
        sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -dx, -dy, -dz)
        prepared = prepare_fiber(material, h, sin_to, cos_to)

        none = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        only_r = (*prepared[:12], *none, *prepared[21:])
        for light in range(len(lights)):
            wx, wy, wz = up * lights[light, 0], lights[light, 1], up * lights[light, 2]
            sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wx, wy, wz)
            fr, fg, fb, _pdf = eval_fiber(material, prepared, sin_ti, cos_ti, phi)
            cr, cg, cb = beta_r * fr, beta_g * fg, beta_b * fb
            likely = max(cr, cg, cb) * SHADOW_ROULETTE
            weight = share
            if likely < 1.0 and depth > 1:
                stream, u0 = next_uniform(stream)
                if u0 >= likely:
                    continue
                weight = share / likely
            if cr + cg + cb <= 0.0:
                continue
            blocked, _through = slab_occluded(
                addresses[1], p.table, p.handles, buffer, zero, variants, lx, ly, lz, ix, iy, wx, wy, wz, 1e30
            )
            if blocked:
                continue
            gloss = 0.0
            if mirrored:
                gloss, _g, _b, _pdf = eval_fiber(material, only_r, sin_ti, cos_ti, phi)
                # Not a colour yet: the throughput of mirrors is the same for all channels.
                gloss *= beta_r
            part = COLOR + 3 * system
            answer[light, part] += weight * (cr - gloss)
            answer[light, part + 1] += weight * (cg - gloss)
            answer[light, part + 2] += weight * (cb - gloss)
            answer[light, GLOSS + system] += weight * gloss

        stream, u0 = next_uniform(stream)
        stream, u1 = next_uniform(stream)
        stream, u2 = next_uniform(stream)
        stream, u3 = next_uniform(stream)
        mirrored = mirrored and u0 < prepared[_R_SHARE]
        sin_ti, cos_ti, phi, wr, wg, wb = sample_fiber_lobe(material, prepared, u0, u1, u2, u3)
        dx, dy, dz = fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi)
        beta_r, beta_g, beta_b = beta_r * wr, beta_g * wg, beta_b * wb
        if beta_r + beta_g + beta_b <= 0.0:
            return
        if depth >= RUSSIAN_ROULETTE_DEPTH:
            # As the tracer's.
            beta = max(beta_r, beta_g, beta_b)
            survive = min(beta, max(0.95, 0.5 * beta), 1.0)
            stream, u0 = next_uniform(stream)
            if u0 >= survive:
                return
            beta_r, beta_g, beta_b = beta_r / survive, beta_g / survive, beta_b / survive
