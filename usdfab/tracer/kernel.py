"""The two-scale path tracer: one Numba kernel, one path after the other (Li et al. 2024, section 6).

Two places a ray can be. At *macro* scale it flies through the world and meets meshes and lights. Inside a *slab* it
flies through one fabric's tile, which repeats for ever. A ray that meets a mesh with a fabric goes into that fabric's
slab through a similarity transform fixed at the hit (``Slab``): the patch's x axis along dp/du, its z axis along the
normal, its scale from the uv density. It comes back to macro scale when it leaves the slab above or below. Places are
kept in both spaces, so that a flat sample is traced exactly.

Notation: ``d`` direction of flight in the world, ``beta`` throughput, ``L`` radiance. Fibers follow the conventions of
``scattering.fiber_numba``; depth counts as in Mitsuba: 1 sees lights, 2 adds direct light.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.scattering.fiber_numba import (
    eval_fiber,
    fiber_angles,
    fiber_direction,
    fiber_frame,
    load_fiber,
    prepare_fiber,
    sample_fiber,
)
from usdfab.tracer.counted import mix, next_uniform, start_stream
from usdfab.tracer.film import SAMPLES
from usdfab.tracer.intrinsics import (
    ARGS_FILTER,
    ARGS_PLAIN,
    NG,
    PRIM,
    TFAR,
    U,
    V,
    borrow,
    intersect,
    new_ray_buffer,
    occluded,
)
from usdfab.tracer.lights import FAR, Lights, escaped_radiance, hit_light, sample_light
from usdfab.tracer.macro_scene import Macro

MAX_TILES = 256
"""Tile borders a ray may cross before it counts as having left; only rays within 1e-3 of the plane get there."""
MAX_SURFACES = 64
"""Fabric layers that a shadow ray may pass."""
import os
RUSSIAN_ROULETTE_DEPTH = int(os.environ.get('RRD','5'))
SHADOW=float(os.environ.get('SH','1e30'))
RRK=float(os.environ.get('RRK','1'))

ESCAPED_UP, ESCAPED_DOWN, HIT = 1, -1, 0


class Patches(NamedTuple):
    """All tiles of a scene.

    ``table`` (P, 8): width, height, lowest z, highest z, epsilon, first segment, first vertex, units per metre.

    ``handles`` (P,) Embree scenes; the other arrays are those of ``PatchScene``, one patch after the other.
    """

    table: NDArray[np.float64]
    handles: NDArray[np.uint64]
    tangents: NDArray[np.float32]
    segment_vertex: NDArray[np.int32]
    segment_material: NDArray[np.int32]
    materials: NDArray[np.float64]
    albedo: NDArray[np.float64]


class World(NamedTuple):
    """Everything the kernel reads. ``embree`` holds addresses: rtcIntersect1, rtcOccluded1, filter, macro scene."""

    macro: Macro
    patches: Patches
    lights: Lights
    embree: tuple[np.uint64, np.uint64, np.uint64, np.uint64]


class View(NamedTuple):
    """A pinhole camera. ``to_world`` (3, 4); ``film`` = tangents of the half angles and film offset; image size."""

    to_world: NDArray[np.float64]
    film: NDArray[np.float64]
    width: int
    height: int


# --- the slab --------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _enter_slab(macro, patches, prim, u, v, dx, dy, dz, t):
    """The similarity from world to patch at a hit on a fabric, and where the ray enters the slab.

    Returns
    -------
    (ok, patch, scale, rotation (9 numbers, rows T, B, N), place in the tile (3), world distance stepped back)
    """
    w = 1.0 - u - v
    patch = int(macro.surfaces[macro.material[prim], 0])
    table = patches.table[patch]
    uv = macro.uv[prim]
    px = table[7] * (w * uv[0, 0] + u * uv[1, 0] + v * uv[2, 0])
    py = table[7] * (w * uv[0, 1] + u * uv[1, 1] + v * uv[2, 1])
    g = macro.geometric[prim]
    n = macro.normals[prim]
    nx = w * n[0, 0] + u * n[1, 0] + v * n[2, 0]
    ny = w * n[0, 1] + u * n[1, 1] + v * n[2, 1]
    nz = w * n[0, 2] + u * n[1, 2] + v * n[2, 2]
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    side = dx * g[0] + dy * g[1] + dz * g[2]
    if norm > 0.0:
        nx, ny, nz = nx / norm, ny / norm, nz / norm
    # The interpolated normal must see the ray from the same side as the triangle does, and not at a grazing angle.
    across = dx * nx + dy * ny + dz * nz
    if norm <= 0.0 or across * side <= 0.0 or abs(across) < 0.02:
        nx, ny, nz, across = g[0], g[1], g[2], side
    tangent = macro.tangents[prim]
    tx = w * tangent[0, 0] + u * tangent[1, 0] + v * tangent[2, 0]
    ty = w * tangent[0, 1] + u * tangent[1, 1] + v * tangent[2, 1]
    tz = w * tangent[0, 2] + u * tangent[1, 2] + v * tangent[2, 2]
    dot = tx * nx + ty * ny + tz * nz
    tx, ty, tz = tx - dot * nx, ty - dot * ny, tz - dot * nz
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    ok = norm > 1e-12 and abs(across) > 1e-5
    if not ok:
        tx, ty, tz, norm = 1.0, 0.0, 0.0, 1.0
    tx, ty, tz = tx / norm, ty / norm, tz / norm
    sign = macro.sign[prim]
    bx, by, bz = sign * (ny * tz - nz * ty), sign * (nz * tx - nx * tz), sign * (nx * ty - ny * tx)

    scale = table[7] * macro.scale[prim]
    # Step back from the mid-surface to the side of the slab that the ray comes from.
    border = table[3] if across < 0.0 else -table[2]
    thickness = table[3] - table[2]
    back = min(border / (scale * max(abs(across), 1e-9)), t, 20.0 * thickness / scale)
    along = back * scale
    lx = px - along * (dx * tx + dy * ty + dz * tz)
    ly = py - along * (dx * bx + dy * by + dz * bz)
    lz = -along * across
    lx -= table[0] * math.floor(lx / table[0])
    ly -= table[1] * math.floor(ly / table[1])
    return ok, patch, scale, (tx, ty, tz, bx, by, bz, nx, ny, nz), lx, ly, lz, back


@njit(cache=True)
def _step(table, lx, ly, lz, dx, dy, dz):
    """Distance to the border of the tile or slab, and which: 0 x, 1 y, 2 z."""
    t, axis = FAR, 2
    if dz > 0.0:
        t = (table[3] - lz) / dz
    elif dz < 0.0:
        t = (table[2] - lz) / dz
    t = max(t, 0.0)
    if dx != 0.0:
        tx = ((table[0] if dx > 0.0 else 0.0) - lx) / dx
        if tx < t:
            t, axis = max(tx, 0.0), 0
    if dy != 0.0:
        ty = ((table[1] if dy > 0.0 else 0.0) - ly) / dy
        if ty < t:
            t, axis = max(ty, 0.0), 1
    return t, axis


@njit(cache=True)
def _wrap(table, axis, lx, ly, dx, dy):
    """Place at the start of the next tile after crossing a border."""
    if axis == 0:
        lx = 0.0 if dx > 0.0 else table[0]
    elif axis == 1:
        ly = 0.0 if dy > 0.0 else table[1]
    return lx, ly


@njit(cache=True)
def _trace_slab(world, buffer, patch, lx, ly, lz, dx, dy, dz):
    """Nearest fiber along a ray in patch space.

    Returns (outcome, distance, place in its tile (3)); on ``HIT`` the hit's other fields are in the buffer.
    """
    table = world.patches.table[patch]
    total, near = 0.0, table[4]
    for _ in range(MAX_TILES):
        t, axis = _step(table, lx, ly, lz, dx, dy, dz)
        if t > near and intersect(
            world.embree[0], world.patches.handles[patch], buffer, lx, ly, lz, dx, dy, dz, near, t, ARGS_FILTER
        ):
            hit = np.float64(buffer[0][TFAR])
            return HIT, total + hit, lx + hit * dx, ly + hit * dy, lz + hit * dz
        total += t
        near = max(near - t, 0.0)
        lx, ly, lz = lx + t * dx, ly + t * dy, lz + t * dz
        if axis == 2:
            break
        lx, ly = _wrap(table, axis, lx, ly, dx, dy)
    return (ESCAPED_UP if dz > 0.0 else ESCAPED_DOWN), total, lx, ly, lz


@njit(cache=True)
def _slab_occluded(world, buffer, patch, lx, ly, lz, dx, dy, dz, tmax):
    """Whether a fiber lies on a ray in patch space before it leaves the slab: (occluded, distance to the exit)."""
    table = world.patches.table[patch]
    total, near = 0.0, table[4]
    for _ in range(MAX_TILES):
        t, axis = _step(table, lx, ly, lz, dx, dy, dz)
        end = min(t, tmax - total)
        if end > near and occluded(
            world.embree[1], world.patches.handles[patch], buffer, lx, ly, lz, dx, dy, dz, near, end, ARGS_FILTER
        ):
            return True, total
        total += t
        if total >= tmax:
            break
        near = max(near - t, 0.0)
        lx, ly, lz = lx + t * dx, ly + t * dy, lz + t * dz
        if axis == 2:
            break
        lx, ly = _wrap(table, axis, lx, ly, dx, dy)
    return False, total


@njit(cache=True)
def _leave_slab(table, scale, across):
    """World distance by which a ray that leaves a slab steps back along itself, to about the mid-surface.

    Meshes that lie within the cloth's thickness (the body under a garment) are then met, and the cloth's own mesh is
    skipped up to ``back`` plus twice the thickness.
    """
    thickness = table[3] - table[2]
    return min(max(table[3], -table[2]) / (scale * max(abs(across), 1e-9)), 4.0 * thickness / scale), thickness / scale


# --- macro scale -----------------------------------------------------------------------------------------------------


@njit(cache=True)
def _trace_macro(world, buffer, ox, oy, oz, dx, dy, dz, near, tmax, skip_mesh, skip_distance):
    """Nearest triangle, those of ``skip_mesh`` nearer than ``skip_distance`` left out: (hit, t, prim, u, v)."""
    for _ in range(MAX_SURFACES):
        if not intersect(world.embree[0], world.embree[3], buffer, ox, oy, oz, dx, dy, dz, near, tmax, ARGS_PLAIN):
            return False, tmax, 0, 0.0, 0.0
        floats, words, _address = buffer
        t, prim = np.float64(floats[TFAR]), np.int64(words[PRIM])
        if t < skip_distance and world.macro.mesh[prim] == skip_mesh:
            near = t * (1.0 + 1e-6) + 1e-9
            continue
        return True, t, prim, np.float64(floats[U]), np.float64(floats[V])
    return False, tmax, 0, 0.0, 0.0


@njit(cache=True)
def _macro_visible(world, buffer, ox, oy, oz, dx, dy, dz, near, tmax, skip_mesh, skip_distance):
    """Whether light comes through from ``tmax``: surfaces block it, fabrics where a fiber is in the way."""
    for _ in range(MAX_SURFACES):
        hit, t, prim, u, v = _trace_macro(world, buffer, ox, oy, oz, dx, dy, dz, near, tmax, skip_mesh, skip_distance)
        if not hit:
            return True
        if world.macro.surfaces[world.macro.material[prim], 0] < 0.0:
            return False
        ok, patch, scale, r, lx, ly, lz, back = _enter_slab(world.macro, world.patches, prim, u, v, dx, dy, dz, t)
        if not ok:
            return False
        px = dx * r[0] + dy * r[1] + dz * r[2]
        py = dx * r[3] + dy * r[4] + dz * r[5]
        pz = dx * r[6] + dy * r[7] + dz * r[8]
        blocked, through = _slab_occluded(world, buffer, patch, lx, ly, lz, px, py, pz, (tmax - t + back) * scale)
        if blocked:
            return False
        exit_back, thickness = _leave_slab(world.patches.table[patch], scale, pz)
        start = t - back + through / scale - exit_back
        ox, oy, oz = ox + start * dx, oy + start * dy, oz + start * dz
        tmax -= start
        near, skip_mesh, skip_distance = 0.0, world.macro.mesh[prim], exit_back + 2.0 * thickness
        if tmax <= exit_back:
            return True
    return False


# --- paths -----------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _lambert_sample(nx, ny, nz, u0, u1):
    """A cosine-distributed direction about a unit normal."""
    radius, phi = math.sqrt(u0), 2.0 * math.pi * u1
    a, b, c = radius * math.cos(phi), radius * math.sin(phi), math.sqrt(max(0.0, 1.0 - u0))
    sign = math.copysign(1.0, nz)
    k = -1.0 / (sign + nz)
    m = nx * ny * k
    x = a * (1.0 + sign * nx * nx * k) + b * m + c * nx
    y = a * sign * m + b * (sign + ny * ny * k) + c * ny
    z = -a * sign * nx - b * ny + c * nz
    return x, y, z


@njit(cache=True)
def _trace_path(world, buffer, stream, ox, oy, oz, dx, dy, dz, max_depth, out):
    """Radiance along a camera ray. Adds to ``out``: RGB, albedo (3), normal (3), depth, alpha, rays traced."""
    macro, patches, lights = world.macro, world.patches, world.lights
    light_count = len(lights.table)
    beta_r = beta_g = beta_b = 1.0
    total_r = total_g = total_b = 0.0
    bsdf_pdf = -1.0
    in_slab = False
    near, skip_mesh, skip_distance = 0.0, -1, 0.0
    patch, scale, lx, ly, lz = 0, 1.0, 0.0, 0.0, 0.0
    r = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    slab_mesh = -1
    first = True
    travelled = 0.0

    for depth in range(1, max_depth + 1):
        # Next interaction: a fiber, a surface, or light.
        fiber = False
        finished = False
        prim, hu, hv = 0, 0.0, 0.0
        for _ in range(MAX_SURFACES):
            if in_slab:
                px = dx * r[0] + dy * r[1] + dz * r[2]
                py = dx * r[3] + dy * r[4] + dz * r[5]
                pz = dx * r[6] + dy * r[7] + dz * r[8]
                outcome, t, lx, ly, lz = _trace_slab(world, buffer, patch, lx, ly, lz, px, py, pz)
                out[11] += 1.0
                t /= scale
                travelled += t
                ox, oy, oz = ox + t * dx, oy + t * dy, oz + t * dz
                if outcome == HIT:
                    fiber = True
                    break
                in_slab = False
                back, thickness = _leave_slab(patches.table[patch], scale, pz)
                ox, oy, oz = ox - back * dx, oy - back * dy, oz - back * dz
                travelled -= back
                near, skip_mesh, skip_distance = 0.0, slab_mesh, back + 2.0 * thickness
            hit, t, prim, hu, hv = _trace_macro(
                world, buffer, ox, oy, oz, dx, dy, dz, near, FAR, skip_mesh, skip_distance
            )
            out[11] += 1.0
            t_light, er, eg, eb = hit_light(lights, ox, oy, oz, dx, dy, dz, t if hit else FAR, bsdf_pdf)
            if t_light < (t if hit else FAR):
                total_r, total_g, total_b = total_r + beta_r * er, total_g + beta_g * eg, total_b + beta_b * eb
                if first:
                    out[10] += 1.0
                finished = True
                break
            if not hit:
                er, eg, eb = escaped_radiance(lights, dx, dy, dz, bsdf_pdf)
                total_r, total_g, total_b = total_r + beta_r * er, total_g + beta_g * eg, total_b + beta_b * eb
                finished = True
                break
            if macro.surfaces[macro.material[prim], 0] < 0.0:
                ox, oy, oz = ox + t * dx, oy + t * dy, oz + t * dz
                travelled += t
                break
            ok, patch, scale, r, lx, ly, lz, back = _enter_slab(macro, patches, prim, hu, hv, dx, dy, dz, t)
            slab_mesh = macro.mesh[prim]
            in_slab = ok
            step = t - back if ok else t
            ox, oy, oz = ox + step * dx, oy + step * dy, oz + step * dz
            travelled += step
            if not ok:  # exactly edge-on: the cloth has no area here
                near, skip_mesh, skip_distance = 0.0, slab_mesh, 1e-6
        else:
            finished = True
        if finished:
            break

        # Shading frame at the interaction.
        floats, words, _address = buffer
        if fiber:
            table = patches.table[patch]
            segment = int(table[5]) + np.int64(words[PRIM])
            vertex = int(table[6]) + patches.segment_vertex[segment]
            s = np.float64(floats[U])
            a, b = patches.tangents[vertex], patches.tangents[vertex + 1]
            ax = (1.0 - s) * a[0] + s * b[0]
            ay = (1.0 - s) * a[1] + s * b[1]
            az = (1.0 - s) * a[2] + s * b[2]
            norm = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
            ax, ay, az = ax * norm, ay * norm, az * norm
            nx, ny, nz = np.float64(floats[NG]), np.float64(floats[NG + 1]), np.float64(floats[NG + 2])
            # Embree's normal belongs to the straight segment; h wants it in the plane normal to the spline's tangent.
            dot = nx * ax + ny * ay + nz * az
            nx, ny, nz = nx - dot * ax, ny - dot * ay, nz - dot * az
            norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx * norm, ny * norm, nz * norm
            material = load_fiber(patches.materials, patches.segment_material[segment])
            px = dx * r[0] + dy * r[1] + dz * r[2]
            py = dx * r[3] + dy * r[4] + dz * r[5]
            pz = dx * r[6] + dy * r[7] + dz * r[8]
            sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -px, -py, -pz)
            prepared = prepare_fiber(material, h, sin_to, cos_to)
            if first:
                colour = patches.albedo[patches.segment_material[segment]]
                out[3], out[4], out[5] = out[3] + colour[0], out[4] + colour[1], out[5] + colour[2]
                out[6] += nx * r[0] + ny * r[3] + nz * r[6]
                out[7] += nx * r[1] + ny * r[4] + nz * r[7]
                out[8] += nx * r[2] + ny * r[5] + nz * r[8]
        else:
            w = 1.0 - hu - hv
            n = macro.normals[prim]
            nx = w * n[0, 0] + hu * n[1, 0] + hv * n[2, 0]
            ny = w * n[0, 1] + hu * n[1, 1] + hv * n[2, 1]
            nz = w * n[0, 2] + hu * n[1, 2] + hv * n[2, 2]
            norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            g = macro.geometric[prim]
            side = 1.0 if dx * g[0] + dy * g[1] + dz * g[2] < 0.0 else -1.0
            nx, ny, nz = nx * norm * side, ny * norm * side, nz * norm * side
            gx, gy, gz = g[0] * side, g[1] * side, g[2] * side
            row = macro.surfaces[macro.material[prim]]
            base_r, base_g, base_b = row[1], row[2], row[3]
            near, skip_mesh, skip_distance = 1e-6 * (1.0 + travelled), -1, 0.0
            if first:
                out[3], out[4], out[5] = out[3] + base_r, out[4] + base_g, out[5] + base_b
                out[6], out[7], out[8] = out[6] + nx, out[7] + ny, out[8] + nz
        if first:
            out[9] += travelled
            out[10] += 1.0
            first = False
        if depth >= max_depth:
            break

        # Direct light: next-event estimation.
        if light_count > 0:
            stream, u0 = next_uniform(stream)
            stream, u1 = next_uniform(stream)
            stream, u2 = next_uniform(stream)
            wx, wy, wz, distance, lr, lg, lb, light_pdf = sample_light(lights, ox, oy, oz, u0, u1, u2)
            if lr > 0.0 or lg > 0.0 or lb > 0.0:
                if fiber:
                    qx = wx * r[0] + wy * r[1] + wz * r[2]
                    qy = wx * r[3] + wy * r[4] + wz * r[5]
                    qz = wx * r[6] + wy * r[7] + wz * r[8]
                    sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, qx, qy, qz)
                    fr, fg, fb, pdf = eval_fiber(material, prepared, sin_ti, cos_ti, phi)
                else:
                    cos = wx * nx + wy * ny + wz * nz
                    if wx * gx + wy * gy + wz * gz <= 0.0:
                        cos = 0.0
                    pdf = max(cos, 0.0) / math.pi
                    fr, fg, fb = base_r * pdf, base_g * pdf, base_b * pdf
                    qx = qy = qz = 0.0
                weight = 1.0 if light_pdf == 0.0 else light_pdf / (light_pdf + pdf)
                fr, fg, fb = beta_r * fr * weight, beta_g * fg * weight, beta_b * fb * weight
                keep = max(fr, fg, fb) * SHADOW
                if keep < 1.0:
                    stream, u0 = next_uniform(stream)
                    keep = 1.0 / keep if u0 < keep else 0.0
                else:
                    keep = 1.0
                cr, cg, cb = keep * fr * lr, keep * fg * lg, keep * fb * lb
                reach = distance * (1.0 - 1e-6)
                # Area lights stand in each other's way, as they do for rays that the BSDF draws.
                if cr + cg + cb > 0.0 and hit_light(lights, ox, oy, oz, wx, wy, wz, reach, -1.0)[0] >= reach:
                    out[11] += 1.0
                    if fiber:
                        blocked, through = _slab_occluded(world, buffer, patch, lx, ly, lz, qx, qy, qz, reach * scale)
                        visible = not blocked
                        if visible and through < reach * scale:
                            back, thickness = _leave_slab(patches.table[patch], scale, qz)
                            start = through / scale - back
                            out[11] += 1.0
                            visible = _macro_visible(
                                world, buffer, ox + start * wx, oy + start * wy, oz + start * wz, wx, wy, wz,
                                0.0, reach - start, slab_mesh, back + 2.0 * thickness,
                            )  # fmt: skip
                    else:
                        visible = _macro_visible(world, buffer, ox, oy, oz, wx, wy, wz, near, reach, -1, 0.0)
                    if visible:
                        total_r, total_g, total_b = total_r + cr, total_g + cg, total_b + cb

        # Next direction: BSDF sampling.
        stream, u0 = next_uniform(stream)
        stream, u1 = next_uniform(stream)
        if fiber:
            stream, u2 = next_uniform(stream)
            stream, u3 = next_uniform(stream)
            sin_ti, cos_ti, phi, wr, wg, wb, bsdf_pdf = sample_fiber(material, prepared, u0, u1, u2, u3)
            px, py, pz = fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi)
            dx = px * r[0] + py * r[3] + pz * r[6]
            dy = px * r[1] + py * r[4] + pz * r[7]
            dz = px * r[2] + py * r[5] + pz * r[8]
        else:
            dx, dy, dz = _lambert_sample(nx, ny, nz, u0, u1)
            bsdf_pdf = max(dx * nx + dy * ny + dz * nz, 0.0) / math.pi
            if dx * gx + dy * gy + dz * gz <= 0.0:
                break
            wr, wg, wb = base_r, base_g, base_b
        beta_r, beta_g, beta_b = beta_r * wr, beta_g * wg, beta_b * wb
        if bsdf_pdf <= 0.0 or beta_r + beta_g + beta_b <= 0.0:
            break
        if depth >= RUSSIAN_ROULETTE_DEPTH:
            survive = min(0.95, RRK * max(beta_r, beta_g, beta_b))
            stream, u0 = next_uniform(stream)
            if u0 >= survive:
                break
            beta_r, beta_g, beta_b = beta_r / survive, beta_g / survive, beta_b / survive
    out[0], out[1], out[2] = out[0] + total_r, out[1] + total_g, out[2] + total_b
    return total_r, total_g, total_b


@njit(cache=True)
def _borrowed(world):
    """The world with arrays that are not reference-counted."""
    m, p, l = world.macro, world.patches, world.lights
    macro = Macro(borrow(m.points), borrow(m.geometric), borrow(m.normals), borrow(m.tangents), borrow(m.uv), borrow(m.scale), borrow(m.sign), borrow(m.material), borrow(m.mesh), borrow(m.surfaces))
    patches = Patches(borrow(p.table), borrow(p.handles), borrow(p.tangents), borrow(p.segment_vertex), borrow(p.segment_material), borrow(p.materials), borrow(p.albedo))
    lights = Lights(borrow(l.table), borrow(l.image), borrow(l.rows), borrow(l.columns))
    return World(macro, patches, lights, world.embree)


@njit(cache=True, nogil=True)
def render_tile(world, view, seed, window, first_sample, samples, max_depth, film, squares):
    """Add samples to the pixels of ``window`` (x0, y0, x1, y1).

    Runs without Python's lock, so that threads can share the work; a pixel belongs to one call at a time and its
    samples are added in order, so the sum is the same bit for bit however tiles are shared out.

    Parameters
    ----------
    window:
        In pixels of the whole image, upper ends excluded.
    film: (y1 - y0, x1 - x0, CHANNELS)
        Sums over samples, see ``film.py``; a view of the window's own pixels.
    squares: (y1 - y0, x1 - x0, 3)
        Sums of the squares of RGB.
    """
    width, height = view.width, view.height
    m = view.to_world
    memory = new_ray_buffer(world.embree[2])
    buffer = (borrow(memory[0]), borrow(memory[1]), memory[2])
    world = _borrowed(world)
    for row in range(window[1], window[3]):
        for column in range(window[0], window[2]):
            pixel = row * width + column
            # Places in the pixel: the R2 sequence (Roberts 2018), shifted by a hash of the pixel.
            shift = mix(np.uint64(pixel) + mix(np.uint64(seed)))
            shift_x = np.float64(shift >> np.uint64(40)) * 2.0**-24
            shift_y = np.float64((shift >> np.uint64(16)) & np.uint64(0xFFFFFF)) * 2.0**-24
            out = film[row - window[1], column - window[0]]
            square = squares[row - window[1], column - window[0]]
            for sample in range(first_sample, first_sample + samples):
                jx = shift_x + 0.7548776662466927 * (sample + 1)
                jy = shift_y + 0.5698402909980532 * (sample + 1)
                s = 2.0 * (column + jx - math.floor(jx)) / width - 1.0
                t = 1.0 - 2.0 * (row + jy - math.floor(jy)) / height
                x = view.film[0] * (s + view.film[2])
                y = view.film[1] * (t + view.film[3])
                norm = 1.0 / math.sqrt(x * x + y * y + 1.0)
                x, y, z = x * norm, y * norm, -norm
                dx = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
                dy = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
                dz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
                stream = start_stream(seed, pixel, sample)
                red, green, blue = _trace_path(
                    world, buffer, stream, m[0, 3], m[1, 3], m[2, 3], dx, dy, dz, max_depth, out
                )
                out[SAMPLES] += 1.0
                square[0] += red * red
                square[1] += green * green
                square[2] += blue * blue
