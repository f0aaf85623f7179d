"""Inside a fabric: patch space, its tile that repeats for ever, and the fibers in it (Li et al. 2024, section 6).

A ray that meets a mesh with a fabric goes into patch space through a linear map fixed at the hit, ``M``: its rows are
the gradients of the cloth's x and y over the surface and the shading normal, times patch units per metre. It holds
rotation, scale, shear and mirroring of the texture coordinates; the third axis is scaled by the root of the area's
change. Directions in patch space are unit vectors; ``stretch`` is patch units per metre along the ray. Shading happens
in the world, to which ``inverse`` (columns of M^-1, as rows) brings the fibers' tangents.

A place in the tile comes with the tile's integer coordinates, whose hash picks the tile's variant.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.tracer.counted import mix
from usdfab.tracer.intrinsics import ARGS_FILTER, KERNEL, TFAR, intersect, occluded
from usdfab.tracer.lights import FAR
from usdfab.tracer.world import EPSILON, FIRST_PATCH, HEIGHT, HIGH, LOW, UNITS, UV_SCALE, VARIANTS, WIDTH

MAX_TILES = 256
"""Tile borders a ray may cross before it counts as having left; only rays within 1e-3 of the plane get there."""

ESCAPED_UP, ESCAPED_DOWN, HIT = 1, -1, 0


@njit(**KERNEL, forceinline=True)
def variant_at(first, count, ix, iy):
    """The patch that stands at tile (ix, iy): one of ``count`` from ``first`` on, by a hash."""
    if count <= 1:
        return first
    key = np.uint64(ix & 0xFFFFFFFF) | (np.uint64(iy & 0xFFFFFFFF) << np.uint64(32))
    return first + np.int64(mix(mix(key)) % np.uint64(count))


@njit(**KERNEL)
def enter_slab(macro, patches, material, tx, ty, nx, ny, nz, faces, frame, dx, dy, dz, t):
    """The map from world to patch at a hit on a fabric, and where the ray enters the slab.

    Parameters
    ----------
    tx, ty: float
        Texture coordinates of the hit.
    nx, ny, nz, faces: float
        Unit normal of the triangle, and its product with the direction.
    frame: tuple of 9
        Shading normal and gradients of x and y, as interpolated.

    Returns
    -------
    (ok, first patch, variants, M (9), patch units per metre along the normal, place in the tile (3), tile (2), world
    distance stepped back); not ok where the surface has no usable frame.
    """
    row = macro.fabrics[material]
    first, count = int(row[FIRST_PATCH]), int(row[VARIANTS])
    table = patches.table[first]
    units = table[UNITS]
    mx, my, mz = frame[0], frame[1], frame[2]
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    if norm > 0.0:
        mx, my, mz = mx / norm, my / norm, mz / norm
    # The interpolated normal must see the ray from the same side as the triangle does, not at a grazing angle, and must
    # not lie in the triangle.
    across = dx * mx + dy * my + dz * mz
    if norm <= 0.0 or across * faces <= 0.0 or abs(across) < 0.02 or abs(mx * nx + my * ny + mz * nz) < 0.1:
        mx, my, mz, across = nx, ny, nz, faces
    # Gradients in the plane normal to it.
    gx, gy, gz, hx, hy, hz = frame[3], frame[4], frame[5], frame[6], frame[7], frame[8]
    dot = gx * mx + gy * my + gz * mz
    gx, gy, gz = gx - dot * mx, gy - dot * my, gz - dot * mz
    dot = hx * mx + hy * my + hz * mz
    hx, hy, hz = hx - dot * mx, hy - dot * my, hz - dot * mz
    cx, cy, cz = gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx
    area = abs(cx * mx + cy * my + cz * mz)
    size = max(gx * gx + gy * gy + gz * gz, hx * hx + hy * hy + hz * hz)
    ok = area > 1e-6 * size and size > 0.0 and abs(across) > 1e-5
    if not ok:
        return ok, first, count, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 1.0, 0.0, 0.0, 0.0, 0, 0, 0.0
    up = units * math.sqrt(area)
    m = (units * gx, units * gy, units * gz, units * hx, units * hy, units * hz, up * mx, up * my, up * mz)
    px, py, pz = to_patch(m, dx, dy, dz)
    # Step back from the mid-surface to the side of the slab that the ray comes from.
    border = table[HIGH] if pz < 0.0 else -table[LOW]
    back = min(border / max(abs(pz), 1e-9 * up), t, 20.0 * (table[HIGH] - table[LOW]) / up)
    lx, ly, lz = units * row[UV_SCALE] * tx - back * px, units * row[UV_SCALE] * ty - back * py, -back * pz
    ix, iy = math.floor(lx / table[WIDTH]), math.floor(ly / table[HEIGHT])
    lx, ly = lx - ix * table[WIDTH], ly - iy * table[HEIGHT]
    return ok, first, count, m, up, lx, ly, lz, np.int64(ix), np.int64(iy), back


@njit(**KERNEL, forceinline=True)
def to_patch(m, x, y, z):
    """A world vector in patch space, not normalised."""
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )


@njit(**KERNEL, forceinline=True)
def inverse_columns(m):
    """Columns of the inverse of M, up to its determinant: images of the patch's axes in the world."""
    s = m[0] * (m[4] * m[8] - m[5] * m[7]) + m[1] * (m[5] * m[6] - m[3] * m[8]) + m[2] * (m[3] * m[7] - m[4] * m[6])
    k = 1.0 if s > 0.0 else -1.0
    return (
        k * (m[4] * m[8] - m[5] * m[7]), k * (m[5] * m[6] - m[3] * m[8]), k * (m[3] * m[7] - m[4] * m[6]),
        k * (m[2] * m[7] - m[1] * m[8]), k * (m[0] * m[8] - m[2] * m[6]), k * (m[1] * m[6] - m[0] * m[7]),
        k * (m[1] * m[5] - m[2] * m[4]), k * (m[2] * m[3] - m[0] * m[5]), k * (m[0] * m[4] - m[1] * m[3]),
    )  # fmt: skip


@njit(**KERNEL, forceinline=True)
def _step(width, height, low, high, lx, ly, lz, dx, dy, dz):
    """Distance to the border of the tile or slab, and which: 0 x, 1 y, 2 z."""
    t, axis = FAR, 2
    if dz > 0.0:
        t = (high - lz) / dz
    elif dz < 0.0:
        t = (low - lz) / dz
    t = max(t, 0.0)
    if dx != 0.0:
        tx = ((width if dx > 0.0 else 0.0) - lx) / dx
        if tx < t:
            t, axis = max(tx, 0.0), 0
    if dy != 0.0:
        ty = ((height if dy > 0.0 else 0.0) - ly) / dy
        if ty < t:
            t, axis = max(ty, 0.0), 1
    return t, axis


@njit(**KERNEL, forceinline=True)
def trace_slab(trace, table, handles, buffer, first, count, lx, ly, lz, ix, iy, dx, dy, dz):
    """Nearest fiber along a ray in patch space.

    Parameters
    ----------
    trace, table, handles:
        Address of rtcIntersect1; of ``Patches``. (Not the whole world: it would be copied onto the stack.)

    Returns
    -------
    (outcome, distance, place in its tile (3), tile (2), patch); on ``HIT`` the hit's other fields are in the buffer.
    """
    width, height, low, high = table[first, WIDTH], table[first, HEIGHT], table[first, LOW], table[first, HIGH]
    total, near = 0.0, table[first, EPSILON]
    patch = variant_at(first, count, ix, iy)
    for _ in range(MAX_TILES):
        t, axis = _step(width, height, low, high, lx, ly, lz, dx, dy, dz)
        if t > near and intersect(trace, handles[patch], buffer, lx, ly, lz, dx, dy, dz, near, t, ARGS_FILTER):
            hit = np.float64(buffer[0][TFAR])
            return HIT, total + hit, lx + hit * dx, ly + hit * dy, lz + hit * dz, ix, iy, patch
        total += t
        near = max(near - t, 0.0)
        lx, ly, lz = lx + t * dx, ly + t * dy, lz + t * dz
        if axis == 2:
            break
        if axis == 0:
            ix, lx = (ix + 1, 0.0) if dx > 0.0 else (ix - 1, width)
        else:
            iy, ly = (iy + 1, 0.0) if dy > 0.0 else (iy - 1, height)
        patch = variant_at(first, count, ix, iy)
    return (ESCAPED_UP if dz > 0.0 else ESCAPED_DOWN), total, lx, ly, lz, ix, iy, patch


@njit(**KERNEL)
def slab_occluded(trace, table, handles, buffer, first, count, lx, ly, lz, ix, iy, dx, dy, dz, tmax):
    """Whether a fiber lies on a ray in patch space before it leaves the slab: (occluded, distance to the exit).

    ``trace`` is the address of rtcOccluded1, the rest as for ``trace_slab``.
    """
    width, height, low, high = table[first, WIDTH], table[first, HEIGHT], table[first, LOW], table[first, HIGH]
    total, near = 0.0, table[first, EPSILON]
    for _ in range(MAX_TILES):
        t, axis = _step(width, height, low, high, lx, ly, lz, dx, dy, dz)
        end = min(t, tmax - total)
        handle = handles[variant_at(first, count, ix, iy)]
        if end > near and occluded(trace, handle, buffer, lx, ly, lz, dx, dy, dz, near, end, ARGS_FILTER):
            return True, total
        total += t
        if total >= tmax:
            break
        near = max(near - t, 0.0)
        lx, ly, lz = lx + t * dx, ly + t * dy, lz + t * dz
        if axis == 2:
            break
        if axis == 0:
            ix, lx = (ix + 1, 0.0) if dx > 0.0 else (ix - 1, width)
        else:
            iy, ly = (iy + 1, 0.0) if dy > 0.0 else (iy - 1, height)
    return False, total


@njit(**KERNEL)
def leave_slab(patches, first, up, pz):
    """How a ray that leaves a slab goes on: (world distance it steps back, thickness of the cloth in the world).

    It steps back along itself to about the mid-surface: meshes that lie within the cloth's thickness (the body under a
    garment) are then met, and the cloth's own mesh is skipped up to the distance plus twice the thickness.

    Parameters
    ----------
    up, pz: float
        Patch units per metre along the normal; the world direction's z in patch space, not normalised.
    """
    table = patches.table[first]
    thickness = (table[HIGH] - table[LOW]) / up
    return min(max(table[HIGH], -table[LOW]) / max(abs(pz), 1e-9 * up), 4.0 * thickness), thickness
