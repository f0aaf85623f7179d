"""Light on what the pixels see, in compiled loops: queries for cloth, radiance of other surfaces, shadows."""

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
    VIEW,
)
from usdfab.scattering.surface_numba import eval_surface, prepare_surface
from usdfab.tracer.intrinsics import new_ray_buffer
from usdfab.tracer.lights import light_blocks, sample_light
from usdfab.tracer.surfaces import MAX_SURFACES, surface_frame, trace_macro
from usdfab.tracer.textures import normal_at, opacity_at, surface_at
from usdfab.tracer.vertex import shading_frame, to_local
from usdfab.tracer.world import FIRST_PATCH

LEAST = 1e-3
"""Cosine with the cloth below which light is taken to pass along it."""


@njit(**OPTIONS)
def filter_side(size):
    """Side in tiles of the square that a pixel shows, from its footprint's: the same up close, twice it far away.

    From half a tile a pixel on, pixels cannot show the weave (Nyquist), but a square as wide as their distance passes a
    good part of it, which would be moiré. Of twice that side nothing of a pattern of one tile is left there.
    """
    return size * (1.0 + min(2.0 * size, 1.0))


@njit(**OPTIONS)
def unblocked(world, buffer, ox, oy, oz, dx, dy, dz, near, reach):
    """Share of light that comes through from distance ``reach``: cloth and opaque surfaces stop all of it."""
    if light_blocks(world.lights, ox, oy, oz, dx, dy, dz, reach):
        return 0.0
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
def _surface_value(world, out, tags, dx, dy, dz):
    """BSDF times cosine (r, g, b) of the surface in a pixel for light from a direction."""
    macro = world.macro
    material, prim, copy = tags[MATERIAL], tags[PRIM], tags[COPY]
    tx, ty, nx, ny, nz, frame = surface_frame(macro, 0.0, prim, copy, out[HIT], out[HIT + 1])
    side = -1.0 if tags[BACK] else 1.0
    packed, _r, _g, _b = surface_at(world.materials, world.textures, material, tx, ty)
    mapped, qx, qy, qz = normal_at(world.materials, world.textures, material, tx, ty)
    shading = shading_frame(
        side * frame[0], side * frame[1], side * frame[2], frame[3], frame[4], frame[5], frame[6], frame[7], frame[8],
        mapped, side * qx, side * qy, qz,
    )  # fmt: skip
    vx, vy, vz = out[VIEW], out[VIEW + 1], out[VIEW + 2]
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


@njit(**OPTIONS)
def light_pixels(world, lights, u1, u2, share, tags, numbers, group, queries, weights, radiance):
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
    queries, weights: (P, 8) float32, (P, 3) float64
        Filled for those: what to ask, and the light by which answers are multiplied.
    radiance: (P, 3)
        Of other surfaces; added to.
    """
    buffer = new_ray_buffer(world.embree[2])
    for pixel in range(len(tags)):
        group[pixel] = -1
        kind = tags[pixel, KIND]
        if kind == NOTHING:
            continue
        out = numbers[pixel]
        px, py, pz = out[POSITION], out[POSITION + 1], out[POSITION + 2]
        dx, dy, dz, distance, lr, lg, lb, _pdf = sample_light(lights, px, py, pz, 0.5, u1, u2)
        if lr <= 0.0 and lg <= 0.0 and lb <= 0.0:
            continue
        faces = dx * out[FACE] + dy * out[FACE + 1] + dz * out[FACE + 2]
        ix = iy = iz = 0.0
        if kind == CLOTH:
            ix = dx * out[FRAME] + dy * out[FRAME + 1] + dz * out[FRAME + 2]
            iy = dx * out[FRAME + 3] + dy * out[FRAME + 4] + dz * out[FRAME + 5]
            iz = dx * out[FRAME + 6] + dy * out[FRAME + 7] + dz * out[FRAME + 8]
            # The interpolated normal and the triangle's must agree on which side the light is.
            if abs(iz) < LEAST or iz * faces <= 0.0:
                continue
        elif faces <= 0.0:
            continue
        else:
            lr, lg, lb = lr * share, lg * share, lb * share
            ix, iy, iz = _surface_value(world, out, tags[pixel], dx, dy, dz)
            if ix + iy + iz <= 0.0:
                continue
        # Embree's single precision counts from the world's origin.
        near = 2e-6 * (1.0 + out[DEPTH] + abs(px) + abs(py) + abs(pz))
        seen = unblocked(world, buffer, px, py, pz, dx, dy, dz, near, distance * (1.0 - 1e-6))
        if seen <= 0.0:
            continue
        if kind != CLOTH:
            radiance[pixel, 0] += seen * lr * ix
            radiance[pixel, 1] += seen * lg * iy
            radiance[pixel, 2] += seen * lb * iz
            continue
        group[pixel] = 4 * tags[pixel, FABRIC] + 2 * tags[pixel, BACK] + (1 if iz < 0.0 else 0)
        q = queries[pixel]
        q[0], q[1], q[2] = out[PLACE], out[PLACE + 1], filter_side(out[SIZE])
        q[3], q[4], q[5], q[6], q[7] = ix, iy, iz, out[VIEW], out[VIEW + 1]
        seen *= share
        weights[pixel, 0], weights[pixel, 1], weights[pixel, 2] = seen * lr, seen * lg, seen * lb
