"""Light on what the pixels see, in compiled loops over sixteen pixels: queries for cloth, other surfaces, shadows."""

from __future__ import annotations

import numpy as np
from numba import njit

from usdfab.neural.gbuffer import (
    BACK,
    CLOTH,
    COPY,
    DEPTH,
    FABRIC,
    FACE,
    FRAME,
    HIT,
    KIND,
    MATERIAL,
    NOTHING,
    OPTIONS,
    PLACE,
    POSITION,
    PRIM,
    SIZE,
    SURFACE,
    TINT,
    VIEW,
)
from usdfab.neural.packets import occluded_packet
from usdfab.neural.simd import LANES, bits_of, invert, least, load, size_of, spread, spread_integer, store, where
from usdfab.neural.simd_math import INLINE, dot, inverse_length
from usdfab.scattering.surface_numba import eval_surface, prepare_surface
from usdfab.tracer.lights import DISTANT, DOME, FAR, POINT, light_blocks, sample_light
from usdfab.tracer.surfaces import MAX_SURFACES, surface_frame, trace_macro
from usdfab.tracer.textures import normal_at, opacity_at, surface_at
from usdfab.tracer.vertex import shading_frame, to_local
from usdfab.tracer.world import FIRST_PATCH

LEAST = 1e-3
"""Cosine with the cloth below which light is taken to pass along it."""

QUERY = 8
"""Columns of queries (``encoding``)."""


@njit(**INLINE)
def filter_side(size):
    """Side in tiles of the square that a pixel shows, from its footprint's: the same up close, twice it far away.

    From half a tile a pixel on, pixels cannot show the weave (Nyquist), but a square as wide as their distance passes a
    good part of it, which would be moiré. Of twice that side nothing of a pattern of one tile is left there.
    """
    return size * (1.0 + least(2.0 * size, 1.0))


@njit(**OPTIONS)
def unblocked(world, buffer, ox, oy, oz, dx, dy, dz, near, reach):
    """Share of light that comes through from distance ``reach``: cloth and opaque surfaces stop all of it."""
    macro = world.macro
    share = 1.0
    for _ in range(MAX_SURFACES):
        hit, t, prim, copy, _mesh, u, v = trace_macro(
            world, buffer, 0.0, ox, oy, oz, dx, dy, dz, near, reach, np.int64(-1), 0.0
        )
        if not hit:
            return share
        material = macro.material[prim]
        if macro.fabrics[material, FIRST_PATCH] >= 0.0:
            return 0.0
        tx, ty, _nx, _ny, _nz, _frame = surface_frame(macro, 0.0, prim, copy, u, v)
        share *= 1.0 - opacity_at(world.materials, world.textures, material, tx, ty)
        if share <= 0.0:
            return 0.0
        near = t * (1.0 + 1e-6) + 1e-9
    return 0.0


@njit(**OPTIONS)
def _surface_value(world, tags, numbers, count, pixel, dx, dy, dz):
    """BSDF times cosine (r, g, b) of the surface in a pixel for light from a direction."""
    macro = world.macro
    material, prim = tags[MATERIAL * count + pixel], tags[PRIM * count + pixel]
    tx, ty, nx, ny, nz, frame = surface_frame(
        macro, 0.0, prim, tags[COPY * count + pixel], np.float64(numbers[HIT * count + pixel]),
        np.float64(numbers[(HIT + 1) * count + pixel]),
    )  # fmt: skip
    side = -1.0 if tags[BACK * count + pixel] else 1.0
    packed, _r, _g, _b = surface_at(world.materials, world.textures, material, tx, ty)
    mapped, qx, qy, qz = normal_at(world.materials, world.textures, material, tx, ty)
    shading = shading_frame(
        side * frame[0], side * frame[1], side * frame[2], frame[3], frame[4], frame[5], frame[6], frame[7], frame[8],
        mapped, side * qx, side * qy, qz,
    )  # fmt: skip
    vx, vy = np.float64(numbers[VIEW * count + pixel]), np.float64(numbers[(VIEW + 1) * count + pixel])
    vz = np.float64(numbers[(VIEW + 2) * count + pixel])
    wox, woy, woz = to_local(shading, vx, vy, vz)
    if woz <= 1e-4:
        # The interpolated normal looks away: the triangle's own does not.
        shading = shading_frame(
            side * nx, side * ny, side * nz, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, False, 0.0, 0.0, 1.0
        )  # fmt: skip
        wox, woy, woz = to_local(shading, vx, vy, vz)
    wix, wiy, wiz = to_local(shading, dx, dy, dz)
    r, g, b, _pdf = eval_surface(prepare_surface(packed, max(woz, 1e-4)), wix, wiy, wiz, wox, woy, woz)
    return r, g, b


@njit(**INLINE)
def _column(array, count, column, pixel):
    return load(array, column * count + pixel)


@njit(**OPTIONS)
def _sampled(lights, u1, u2, numbers, count, pixel, scratch):
    """What a light with an extent sends to sixteen places: direction (3), distance, radiance over density (3)."""
    for lane in range(LANES):
        at = POSITION * count + pixel + lane
        found = sample_light(lights, numbers[at], numbers[at + count], numbers[at + 2 * count], 0.5, u1, u2)
        for k in range(7):
            scratch[k * LANES + lane] = found[k]


@njit(**OPTIONS)
def light_pixels(
    world, cloth, lights, u1, u2, share, packet, buffer, count, tags, numbers, group, queries, weights, radiance
):
    """One place on one light, seen from all pixels.

    Parameters
    ----------
    lights: Lights
        One light alone.
    u1, u2: float
        The place on it, or the direction, the same for all pixels: no noise between neighbours.
    share: float
        Factor of what it sends: one over the number of places.
    group: (P,) int32
        Filled: which material is to be asked, ``4 fabric + 2 seen from behind + 1 lit from behind``; -1: none.
    queries, weights: (8 P,), (3 P,) float32
        Columns, filled for those: what to ask, and the light by which answers are multiplied.
    radiance: (3 P,) float32
        Of other surfaces; added to.
    """
    scratch, open_share = np.zeros(7 * LANES, dtype=np.float32), np.zeros(LANES, dtype=np.float32)
    table = lights.table
    kind = int(table[0, 0])
    # From domes and distant lights all places are lit from the same side.
    fixed = kind in (DOME, DISTANT)
    fx, fy, fz, _far, fr, fg, fb, _pdf = sample_light(lights, 0.0, 0.0, 0.0, 0.5, u1, u2)
    for pixel in range(0, count, LANES):
        store(group, pixel, spread_integer(-1))
        sort = load(tags, KIND * count + pixel)
        seen = sort > NOTHING
        if bits_of(seen) == 0:
            continue
        px, py = _column(numbers, count, POSITION, pixel), _column(numbers, count, POSITION + 1, pixel)
        pz = _column(numbers, count, POSITION + 2, pixel)
        dx, dy, dz, distance = spread(fx), spread(fy), spread(fz), spread(FAR)
        lr, lg, lb = spread(fr), spread(fg), spread(fb)
        if kind == POINT:
            dx, dy, dz = table[0, 5] - px, table[0, 6] - py, table[0, 7] - pz
            norm = inverse_length(dx, dy, dz)
            dx, dy, dz, distance = dx * norm, dy * norm, dz * norm, 1.0 / norm
            fall = norm * norm
            lr, lg, lb = fall * table[0, 2], fall * table[0, 3], fall * table[0, 4]
        elif not fixed:
            _sampled(lights, u1, u2, numbers, count, pixel, scratch)
            dx, dy, dz, distance = load(scratch, 0), load(scratch, LANES), load(scratch, 32), load(scratch, 48)
            lr, lg, lb = load(scratch, 64), load(scratch, 80), load(scratch, 96)
        facing = dot(
            dx, dy, dz, _column(numbers, count, FACE, pixel), _column(numbers, count, FACE + 1, pixel),
            _column(numbers, count, FACE + 2, pixel),
        )  # fmt: skip
        ix = dot(
            dx, dy, dz, _column(numbers, count, FRAME, pixel), _column(numbers, count, FRAME + 1, pixel),
            _column(numbers, count, FRAME + 2, pixel),
        )  # fmt: skip
        iy = dot(
            dx, dy, dz, _column(numbers, count, FRAME + 3, pixel), _column(numbers, count, FRAME + 4, pixel),
            _column(numbers, count, FRAME + 5, pixel),
        )  # fmt: skip
        iz = dot(
            dx, dy, dz, _column(numbers, count, FRAME + 6, pixel), _column(numbers, count, FRAME + 7, pixel),
            _column(numbers, count, FRAME + 8, pixel),
        )  # fmt: skip
        woven = sort == CLOTH
        # The interpolated normal and the triangle's must agree on which side the light is.
        agrees = (size_of(iz) >= LEAST) & (iz * facing > 0.0)
        lit = (woven & agrees) | ((sort == SURFACE) & (facing > 0.0))
        lit = lit & (lr + lg + lb > 0.0)
        if bits_of(lit) == 0:
            continue
        # Embree's single precision counts from the world's origin.
        depth = _column(numbers, count, DEPTH, pixel)
        near = 2e-6 * (1.0 + depth + size_of(px) + size_of(py) + size_of(pz))
        reach = distance * (1.0 - 1e-6)
        if not cloth.cutouts:
            dark = occluded_packet(cloth.packets[1], world.embree[3], packet, lit, px, py, pz, dx, dy, dz, near, reach)
            lit = lit & invert(dark)
        if cloth.cutouts or cloth.bodies:
            store(scratch, 0, dx)
            store(scratch, LANES, dy)
            store(scratch, 2 * LANES, dz)
            store(scratch, 3 * LANES, near)
            store(scratch, 4 * LANES, reach)
            some = bits_of(lit)
            for lane in range(LANES):
                part = 0.0
                if some >> lane & 1:
                    x, y = np.float64(scratch[lane]), np.float64(scratch[LANES + lane])
                    z, far = np.float64(scratch[2 * LANES + lane]), np.float64(scratch[4 * LANES + lane])
                    at = POSITION * count + pixel + lane
                    ox, oy = np.float64(numbers[at]), np.float64(numbers[at + count])
                    oz = np.float64(numbers[at + 2 * count])
                    part = 1.0
                    if cloth.bodies and light_blocks(world.lights, ox, oy, oz, x, y, z, far):
                        part = 0.0
                    elif cloth.cutouts:
                        part = unblocked(world, buffer, ox, oy, oz, x, y, z, np.float64(scratch[48 + lane]), far)
                open_share[lane] = part
            part = load(open_share, 0)
            lit = lit & (part > 0.0)
            lr, lg, lb = lr * part, lg * part, lb * part
        if bits_of(lit) == 0:
            continue
        lr, lg, lb = lr * share, lg * share, lb * share
        woven = woven & lit
        if bits_of(woven):
            back = _column(tags, count, BACK, pixel)
            number = _column(tags, count, FABRIC, pixel) * 4 + back * 2 + where(iz < 0.0, spread_integer(1), 0)
            store(group, pixel, where(woven, number, -1))
            store(queries, pixel, _column(numbers, count, PLACE, pixel))
            store(queries, count + pixel, _column(numbers, count, PLACE + 1, pixel))
            store(queries, 2 * count + pixel, filter_side(_column(numbers, count, SIZE, pixel)))
            store(queries, 3 * count + pixel, ix)
            store(queries, 4 * count + pixel, iy)
            store(queries, 5 * count + pixel, iz)
            store(queries, 6 * count + pixel, _column(numbers, count, VIEW, pixel))
            store(queries, 7 * count + pixel, _column(numbers, count, VIEW + 1, pixel))
            store(weights, pixel, lr)
            store(weights, count + pixel, lg)
            store(weights, 2 * count + pixel, lb)
        some = bits_of(lit & (sort == SURFACE))
        if some:
            store(scratch, 0, dx)
            store(scratch, LANES, dy)
            store(scratch, 2 * LANES, dz)
            store(scratch, 3 * LANES, lr)
            store(scratch, 4 * LANES, lg)
            store(scratch, 5 * LANES, lb)
            for lane in range(LANES):
                if some >> lane & 1:
                    r, g, b = _surface_value(
                        world, tags, numbers, count, pixel + lane, np.float64(scratch[lane]),
                        np.float64(scratch[LANES + lane]), np.float64(scratch[2 * LANES + lane]),
                    )  # fmt: skip
                    radiance[pixel + lane] += r * scratch[48 + lane]
                    radiance[count + pixel + lane] += g * scratch[64 + lane]
                    radiance[2 * count + pixel + lane] += b * scratch[80 + lane]


@njit(**OPTIONS)
def sort_pixels(group, starts, order):
    """Pixels by the material that is to be asked: those of ``number`` are ``order[starts[number]:starts[number + 1]]``.

    Parameters
    ----------
    group: (P,) int32
        As ``light_pixels`` fills it.
    starts: (groups + 1,) int32
    order: (P,) int32
        Both filled.
    """
    starts[:] = 0
    for pixel in range(len(group)):
        if group[pixel] >= 0:
            starts[group[pixel] + 1] += 1
    for number in range(1, len(starts)):
        starts[number] += starts[number - 1]
    for pixel in range(len(group)):
        if group[pixel] >= 0:
            order[starts[group[pixel]]] = pixel
            starts[group[pixel]] += 1
    for number in range(len(starts) - 1, 0, -1):
        starts[number] = starts[number - 1]
    starts[0] = 0


@njit(**OPTIONS)
def add_answers(order, first, last, answers, albedo, tinted, weights, numbers, count, radiance):
    """Turn answers (N, 4), row k of pixel ``order[k]``, to light: ``albedo`` (4, 3) of one material, times weights.

    A print colours what goes through fibers, not what they mirror: ``tinted`` (4,) is 1 for the former, else 0.
    """
    for k in range(first, last):
        p = order[k]
        for c in range(3):
            tint = numbers[(TINT + c) * count + p] - np.float32(1.0)
            value = np.float32(0.0)
            for j in range(4):
                value += answers[k, j] * albedo[j, c] * (np.float32(1.0) + tinted[j] * tint)
            at = c * count + p
            radiance[at] += weights[at] * value
