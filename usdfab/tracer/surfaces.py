"""Macro scale in kernels: rays against meshes, what they meet there, and whether light gets through."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.tracer.film import RAYS
from usdfab.tracer.intrinsics import ARGS_PLAIN, INST, KERNEL, PRIM, TFAR, U, V, intersect
from usdfab.tracer.slab import enter_slab, leave_slab, slab_occluded, to_patch
from usdfab.tracer.textures import opacity_at
from usdfab.tracer.world import FIRST_PATCH

MAX_SURFACES = 64
"""Layers of fabric or of transparent surface that a ray may pass."""


@njit(**KERNEL)
def misses_all(macro, ox, oy, oz, dx, dy, dz, near, tmax):
    """Whether a ray stays outside of the bounds of all meshes: cheaper than asking Embree."""
    b = macro.bounds
    low, high = near, tmax
    for axis in range(3):
        o, d = (ox, dx) if axis == 0 else ((oy, dy) if axis == 1 else (oz, dz))
        if d == 0.0:
            if o < b[0, axis] or o > b[1, axis]:
                return True
            continue
        first, last = (b[0, axis] - o) / d, (b[1, axis] - o) / d
        if first > last:
            first, last = last, first
        low, high = max(low, first), min(high, last)
    return low > high


@njit(**KERNEL)
def trace_macro(world, buffer, time, ox, oy, oz, dx, dy, dz, near, tmax, skip_mesh, skip_distance):
    """Nearest triangle, those of ``skip_mesh`` nearer than ``skip_distance`` left out.

    Returns
    -------
    (hit, t, triangle, copy or -1, mesh, u, v); copies count as meshes of their own, after all meshes.
    """
    macro = world.macro
    if macro.meshes == 1 and skip_mesh == 0:
        # Most rays that leave a flat cloth: nothing is left to be met.
        near = max(near, skip_distance)
    if misses_all(macro, ox, oy, oz, dx, dy, dz, near, tmax):
        return False, tmax, 0, -1, -1, 0.0, 0.0
    for _ in range(MAX_SURFACES):
        if not intersect(
            world.embree[0], world.embree[3], buffer, ox, oy, oz, dx, dy, dz, near, tmax, ARGS_PLAIN, time
        ):
            break
        floats, words, _address = buffer
        t, prim = np.float64(floats[TFAR]), np.int64(words[PRIM])
        # Copies come first among the geometries of the macro scene: their number is the instance's.
        copy = np.int64(-1) if words[INST] == np.uint32(0xFFFFFFFF) else np.int64(words[INST])
        if copy >= 0:
            prim += np.int64(macro.first[copy])
        mesh = np.int64(macro.mesh[prim]) if copy < 0 else np.int64(macro.meshes) + copy
        if t < skip_distance and mesh == skip_mesh:
            near = t * (1.0 + 1e-6) + 1e-9
            continue
        return True, t, prim, copy, mesh, np.float64(floats[U]), np.float64(floats[V])
    return False, tmax, 0, -1, -1, 0.0, 0.0


@njit(**KERNEL)
def surface_frame(macro, time, prim, copy, u, v):
    """What is interpolated at a hit, in the world.

    Returns
    -------
    (texture coordinates (2), unit normal of the triangle (3), (shading normal, gradients of the cloth's x and y) as a
    tuple of 9, not normalised)
    """
    w = 1.0 - u - v
    c = macro.corners
    keys = c.shape[0]
    late = time if keys > 1 else 0.0
    n0 = n1 = n2 = g0 = g1 = g2 = h0 = h1 = h2 = 0.0
    e0 = e1 = e2 = 0.0
    for key in range(keys):
        k = late if key == 1 else 1.0 - late
        for corner in range(3):
            q = k * (w if corner == 0 else (u if corner == 1 else v))
            n0 += q * c[key, prim, corner, 0]
            n1 += q * c[key, prim, corner, 1]
            n2 += q * c[key, prim, corner, 2]
            g0 += q * c[key, prim, corner, 3]
            g1 += q * c[key, prim, corner, 4]
            g2 += q * c[key, prim, corner, 5]
            h0 += q * c[key, prim, corner, 6]
            h1 += q * c[key, prim, corner, 7]
            h2 += q * c[key, prim, corner, 8]
        e0 += k * macro.faces[key, prim, 0]
        e1 += k * macro.faces[key, prim, 1]
        e2 += k * macro.faces[key, prim, 2]
    if copy >= 0:
        # Normals and gradients are covectors: they go by the inverse transpose. The cloth is fixed to the copy, as it
        # is where the same mesh is written out in the world: yarns grow with a copy that is larger.
        a = macro.placements
        k0, k1 = 1.0 - late, late
        last = a.shape[0] - 1
        m00 = k0 * a[0, copy, 0, 0] + k1 * a[last, copy, 0, 0]
        m01 = k0 * a[0, copy, 0, 1] + k1 * a[last, copy, 0, 1]
        m02 = k0 * a[0, copy, 0, 2] + k1 * a[last, copy, 0, 2]
        m10 = k0 * a[0, copy, 1, 0] + k1 * a[last, copy, 1, 0]
        m11 = k0 * a[0, copy, 1, 1] + k1 * a[last, copy, 1, 1]
        m12 = k0 * a[0, copy, 1, 2] + k1 * a[last, copy, 1, 2]
        m20 = k0 * a[0, copy, 2, 0] + k1 * a[last, copy, 2, 0]
        m21 = k0 * a[0, copy, 2, 1] + k1 * a[last, copy, 2, 1]
        m22 = k0 * a[0, copy, 2, 2] + k1 * a[last, copy, 2, 2]
        # Cofactors: the inverse transpose times the determinant.
        c00, c01, c02 = m11 * m22 - m12 * m21, m12 * m20 - m10 * m22, m10 * m21 - m11 * m20
        c10, c11, c12 = m02 * m21 - m01 * m22, m00 * m22 - m02 * m20, m01 * m20 - m00 * m21
        c20, c21, c22 = m01 * m12 - m02 * m11, m02 * m10 - m00 * m12, m00 * m11 - m01 * m10
        det = m00 * c00 + m01 * c01 + m02 * c02
        sign = math.copysign(1.0, det)
        inverse = sign / max(abs(det), 1e-300)
        n0, n1, n2 = (
            sign * (c00 * n0 + c01 * n1 + c02 * n2),
            sign * (c10 * n0 + c11 * n1 + c12 * n2),
            sign * (c20 * n0 + c21 * n1 + c22 * n2),
        )
        e0, e1, e2 = (
            sign * (c00 * e0 + c01 * e1 + c02 * e2),
            sign * (c10 * e0 + c11 * e1 + c12 * e2),
            sign * (c20 * e0 + c21 * e1 + c22 * e2),
        )
        g0, g1, g2 = (
            inverse * (c00 * g0 + c01 * g1 + c02 * g2),
            inverse * (c10 * g0 + c11 * g1 + c12 * g2),
            inverse * (c20 * g0 + c21 * g1 + c22 * g2),
        )
        h0, h1, h2 = (
            inverse * (c00 * h0 + c01 * h1 + c02 * h2),
            inverse * (c10 * h0 + c11 * h1 + c12 * h2),
            inverse * (c20 * h0 + c21 * h1 + c22 * h2),
        )
    norm = 1.0 / math.sqrt(max(e0 * e0 + e1 * e1 + e2 * e2, 1e-300))
    uv = macro.uv
    tx = w * uv[prim, 0, 0] + u * uv[prim, 1, 0] + v * uv[prim, 2, 0]
    ty = w * uv[prim, 0, 1] + u * uv[prim, 1, 1] + v * uv[prim, 2, 1]
    return tx, ty, e0 * norm, e1 * norm, e2 * norm, (n0, n1, n2, g0, g1, g2, h0, h1, h2)


@njit(**KERNEL)
def transmittance(world, buffer, time, ox, oy, oz, dx, dy, dz, near, tmax, skip_mesh, skip_distance):
    """Share of the light from distance ``tmax`` that comes through: surfaces stop it, fabrics where a fiber is."""
    macro = world.macro
    share = 1.0
    for _ in range(MAX_SURFACES):
        hit, t, prim, copy, mesh, u, v = trace_macro(
            world, buffer, time, ox, oy, oz, dx, dy, dz, near, tmax, skip_mesh, skip_distance
        )
        if not hit:
            return share
        material = macro.material[prim]
        tx, ty, nx, ny, nz, frame = surface_frame(macro, time, prim, copy, u, v)
        if macro.fabrics[material, FIRST_PATCH] < 0.0:
            share *= 1.0 - opacity_at(world.materials, world.textures, material, tx, ty)
            if share <= 0.0:
                return 0.0
            near = t * (1.0 + 1e-6) + 1e-9
            skip_distance = max(skip_distance, near) if skip_mesh >= 0 else 0.0
            continue
        faces = dx * nx + dy * ny + dz * nz
        ok, first, count, m, up, lx, ly, lz, ix, iy, back = enter_slab(
            macro, world.patches, material, tx, ty, nx, ny, nz, faces, frame, dx, dy, dz, t
        )
        if not ok:  # exactly edge-on: the cloth has no area here
            near, skip_mesh, skip_distance = t * (1.0 + 1e-6) + 1e-9, -1, 0.0
            continue
        px, py, pz = to_patch(m, dx, dy, dz)
        stretch = math.sqrt(px * px + py * py + pz * pz)
        blocked, through = slab_occluded(
            world.embree[1], world.patches.table, world.patches.handles, buffer, first, count, lx, ly, lz, ix, iy,
            px / stretch, py / stretch, pz / stretch, (tmax - t + back) * stretch,
        )  # fmt: skip
        if blocked:
            return 0.0
        exit_back, thickness = leave_slab(world.patches, first, up, pz)
        start = t - back + through / stretch - exit_back
        ox, oy, oz = ox + start * dx, oy + start * dy, oz + start * dz
        tmax -= start
        near, skip_mesh, skip_distance = 0.0, mesh, exit_back + 2.0 * thickness
        if tmax <= exit_back:
            return share
    return 0.0


@njit(**KERNEL, forceinline=True)
def light_share(
    world, buffer, out, time, first, count, m, up, slab_mesh, ox, oy, oz, lx, ly, lz, ix, iy, wx, wy, wz, reach
):  # fmt: skip
    """Share of a lamp's light that comes to a fiber: fibers of its own cloth stop it, then ``transmittance``.

    Counts its rays in ``out``, the film's channels of the pixel.

    Parameters
    ----------
    first, count, m, up, slab_mesh, lx, ly, lz, ix, iy:
        The cloth and the place in its tile, as ``enter_slab`` has them; ``ox, oy, oz`` is the same place in the world.
    wx, wy, wz, reach:
        Unit direction to the lamp, and how far.
    """
    patches = world.patches
    px, py, pz = to_patch(m, wx, wy, wz)
    stretch = math.sqrt(px * px + py * py + pz * pz)
    out[RAYS] += 1.0
    blocked, through = slab_occluded(
        world.embree[1], patches.table, patches.handles, buffer, first, count, lx, ly, lz, ix, iy, px / stretch,
        py / stretch, pz / stretch, reach * stretch,
    )  # fmt: skip
    if blocked:
        return 0.0
    if through >= reach * stretch:
        return 1.0
    back, thickness = leave_slab(patches, first, up, pz)
    start = through / stretch - back
    out[RAYS] += 1.0
    return transmittance(
        world, buffer, time, ox + start * wx, oy + start * wy, oz + start * wz, wx, wy, wz, 0.0, reach - start,
        slab_mesh, back + 2.0 * thickness,
    )  # fmt: skip
