"""The two-scale path tracer: one Numba kernel, one path after the other (Li et al. 2024, section 6).

Two places a ray can be. At *macro* scale it flies through the world and meets meshes and lights (``surfaces.py``).
Inside a *slab* it flies through one fabric's tile, which repeats for ever (``slab.py``). A ray that meets a mesh with a
fabric goes into that fabric's slab, and comes back to macro scale when it leaves the slab above or below. Places are
kept in both spaces, so that a flat sample is traced exactly; shading happens in the world.

Notation: ``d`` direction of flight in the world, ``beta`` throughput, ``L`` radiance. Fibers follow the conventions of
``scattering.fiber_numba``; depth counts as in Mitsuba: 1 sees lights, 2 adds direct light.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.scattering.fiber_numba import (
    FIBER_SIZE,
    PREPARED_FIBER,
    eval_fiber,
    fiber_angles,
    fiber_direction,
    fiber_frame,
    load_fiber,
    prepare_fiber,
    sample_fiber,
    sample_fiber_lobe,
)
from usdfab.scattering.fiber_numba_grad import PREPARED_SLOPES, prepare_slopes
from usdfab.scattering.fiber_numba_tt import azimuth_scale, eval_fiber_tt
from usdfab.scattering.surface_numba import PREPARED_SURFACE, eval_surface, prepare_surface, sample_surface
from usdfab.tracer.aimed import AZIMUTH, LEAST, NARROW, NO_FLIGHT, aim, aimed_light, fiber_at, flight_from, share_aimed
from usdfab.tracer.counted import next_uniform
from usdfab.tracer.film import ALBEDO, ALPHA, DEPTH, DIRECT, FIBER_ID, NORMAL, RAYS, SAMPLES, UV, YARN_ID
from usdfab.tracer.intrinsics import ENTRY, KERNEL, PRIM, borrow, new_ray_buffer
from usdfab.tracer.lights import FAR, escaped_radiance, hit_light, light_blocks, sample_light
from usdfab.tracer.radiance_cache import borrowed_cache, box_at
from usdfab.tracer.slab import HIT, enter_slab, inverse_columns, leave_slab, to_patch, trace_slab
from usdfab.tracer.surfaces import MAX_SURFACES, light_share, surface_frame, trace_macro, transmittance
from usdfab.tracer.tangents import radius_at
from usdfab.tracer.tape import start_tape, tape_direct, tape_light, tape_scatter
from usdfab.tracer.textures import normal_at, opacity_at, surface_at
from usdfab.tracer.vertex import camera_sample, pixel_shift, shading_frame, tint_at, tint_fiber, to_local
from usdfab.tracer.world import ALBEDO_MAP, FIRST_CURVE, FIRST_PATCH, MATERIAL, YARN, borrowed

RUSSIAN_ROULETTE_DEPTH = 5
SHADOW_ROULETTE = 4.0 * math.pi
"""From the second vertex on, light that would arrive with less than what isotropic scattering gives gets its shadow
ray by chance only.

Fibers scatter into narrow lobes: at most vertices next to nothing goes towards a lamp, and the few that matter make the
noise. So the rays that are saved here (nine of ten) cost hardly any variance.
"""

_NO_FIBER = (0.0,) * FIBER_SIZE
_NOT_PREPARED = (0.0,) * PREPARED_FIBER
_NO_SURFACE = (0.0,) * PREPARED_SURFACE
_NO_SLOPES = (0.0,) * PREPARED_SLOPES
"""Of the right types, for variables that a fiber or a surface sets and nobody else reads."""


@njit(**KERNEL)
def trace_path(world, buffer, stream, time, ox, oy, oz, dx, dy, dz, max_depth, set_ids, out, tape, cache):
    """Radiance along a camera ray. Adds to ``out``, the film's channels of the pixel.

    With a ``Tape`` it adds derivatives to that; with None Numba leaves all of that out of what it compiles. The path is
    the same either way; its weights are not, but in the mean: with lamps that have an extent, and with narrow lobes,
    whose light only paths without a tape aim (``aimed.py``). With a ``RadianceCache`` the path ends there, or fills it.
    """
    macro, patches, lights = world.macro, world.patches, world.lights
    light_count = len(lights.table)
    beta_r = beta_g = beta_b = 1.0
    total_r = total_g = total_b = 0.0
    direct_r = direct_g = direct_b = 0.0
    bsdf_pdf = -1.0
    # Where the BSDF drew the direction: light sampling is judged from there.
    sx, sy, sz = ox, oy, oz
    in_slab = False
    nowhere = np.int64(-1)
    near, skip_mesh, skip_distance = 0.0, nowhere, 0.0
    first_patch, variants, patch, up = 0, 1, 0, 1.0
    lx, ly, lz, ix, iy = 0.0, 0.0, 0.0, np.int64(0), np.int64(0)
    m = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    inverse = m
    tinted, tint_r, tint_g, tint_b = False, 1.0, 1.0, 1.0
    slab_mesh = nowhere
    first = True
    travelled = 0.0
    flight, sent = NO_FLIGHT, False
    tx = ty = 0.0
    box = nowhere
    if tape is not None:
        start_tape(tape)

    for depth in range(1, max_depth + 1):
        # Next interaction: a fiber, a surface, or light.
        fiber = False
        finished = False
        prim, material, hu, hv, gx, gy, gz = np.int64(0), np.int64(0), 0.0, 0.0, 0.0, 0.0, 1.0
        frame = m
        straight = sent
        for _ in range(MAX_SURFACES):
            if in_slab:
                px, py, pz = to_patch(m, dx, dy, dz)
                stretch = math.sqrt(px * px + py * py + pz * pz)
                outcome, t, lx, ly, lz, ix, iy, patch = trace_slab(
                    world.embree[0], patches.table, patches.handles, buffer, first_patch, variants, lx, ly, lz, ix, iy,
                    px / stretch, py / stretch, pz / stretch,
                )  # fmt: skip
                out[RAYS] += 1.0
                t /= stretch
                travelled += t
                ox, oy, oz = ox + t * dx, oy + t * dy, oz + t * dz
                if outcome == HIT:
                    fiber = True
                    break
                in_slab = False
                straight = False
                back, thickness = leave_slab(patches, first_patch, up, pz)
                ox, oy, oz = ox - back * dx, oy - back * dy, oz - back * dz
                travelled -= back
                near, skip_mesh, skip_distance = 0.0, slab_mesh, back + 2.0 * thickness
            hit, t, prim, copy, mesh, hu, hv = trace_macro(
                world, buffer, time, ox, oy, oz, dx, dy, dz, near, FAR, skip_mesh, skip_distance
            )
            out[RAYS] += 1.0
            t_light, er, eg, eb = hit_light(lights, ox, oy, oz, dx, dy, dz, t if hit else FAR, bsdf_pdf, sx, sy, sz)
            at_light = t_light < (t if hit else FAR)
            if not at_light and not hit:
                er, eg, eb = escaped_radiance(lights, dx, dy, dz, bsdf_pdf, sx, sy, sz)
            if at_light or not hit:
                er, eg, eb = beta_r * er, beta_g * eg, beta_b * eb
                total_r, total_g, total_b = total_r + er, total_g + eg, total_b + eb
                if tape is not None:
                    tape_light(tape, er, eg, eb)
                if depth <= 2:
                    direct_r, direct_g, direct_b = direct_r + er, direct_g + eg, direct_b + eb
                if first and at_light:
                    out[ALPHA] += 1.0
                    out[DEPTH] += travelled + t_light
                finished = True
                break
            material = np.int64(macro.material[prim])
            tx, ty, gx, gy, gz, frame = surface_frame(macro, time, prim, copy, hu, hv)
            faces = dx * gx + dy * gy + dz * gz
            if macro.fabrics[material, FIRST_PATCH] < 0.0:
                opacity = opacity_at(world.materials, world.textures, material, tx, ty)
                if opacity < 1.0:
                    stream, u0 = next_uniform(stream)
                    if u0 >= opacity:
                        near = t * (1.0 + 1e-6) + 1e-9
                        continue
                ox, oy, oz = ox + t * dx, oy + t * dy, oz + t * dz
                travelled += t
                break
            in_slab, first_patch, variants, m, up, lx, ly, lz, ix, iy, back = enter_slab(
                macro, patches, material, tx, ty, gx, gy, gz, faces, frame, dx, dy, dz, t
            )
            if not in_slab:  # exactly edge-on: the cloth has no area here
                near, skip_mesh, skip_distance = t * (1.0 + 1e-6) + 1e-9, nowhere, 0.0
                continue
            inverse = inverse_columns(m)
            slab_mesh = mesh
            tinted, tint_r, tint_g, tint_b = False, 1.0, 1.0, 1.0
            if macro.tinted[prim] >= 0 or macro.fabrics[material, ALBEDO_MAP] >= 0.0:
                tinted = True
                tint_r, tint_g, tint_b = tint_at(world, material, prim, hu, hv, tx, ty)
            step = t - back
            ox, oy, oz = ox + step * dx, oy + step * dy, oz + step * dz
            travelled += step
        else:
            finished = True
        if finished:
            break

        # Shading frame at the interaction.
        _floats, words, _address = buffer
        h = sin_to = cos_to = radius = 0.0
        curve = nowhere
        fiber_material, prepared, surface, slopes = _NO_FIBER, _NOT_PREPARED, _NO_SURFACE, _NO_SLOPES
        row = nowhere
        shading = m
        ax = ay = az = ex = ey = ez = fx = fy = fz = 0.0
        wox = woy = woz = 0.0
        if fiber:
            if straight:
                radius = radius_at(patches.records, patch, np.int64(words[PRIM])) / up
            curve, ax, ay, az, nx, ny, nz = fiber_at(patches, buffer, patch, m, inverse)
            owner = patches.curves[int(patches.table[patch, FIRST_CURVE]) + curve]
            row = np.int64(owner[MATERIAL])
            fiber_material = load_fiber(patches.materials, row if first else row + patches.later)
            if tinted:
                fiber_material = tint_fiber(fiber_material, patches.albedo, row, tint_r, tint_g, tint_b)
            sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -dx, -dy, -dz)
            prepared = prepare_fiber(fiber_material, h, sin_to, cos_to)
            if tape is not None:
                slopes = prepare_slopes(fiber_material, prepared, h, cos_to)
            if first:
                out[ALBEDO] += min(tint_r * patches.albedo[row, 0], 1.0)
                out[ALBEDO + 1] += min(tint_g * patches.albedo[row, 1], 1.0)
                out[ALBEDO + 2] += min(tint_b * patches.albedo[row, 2], 1.0)
                if set_ids:
                    out[FIBER_ID] = 1 + curve
                    out[YARN_ID] = owner[YARN]
        else:
            packed, er, eg, eb = surface_at(world.materials, world.textures, material, tx, ty)
            mapped, qx, qy, qz = normal_at(world.materials, world.textures, material, tx, ty)
            side = 1.0 if dx * gx + dy * gy + dz * gz < 0.0 else -1.0
            er, eg, eb = beta_r * er, beta_g * eg, beta_b * eb
            total_r, total_g, total_b = total_r + er, total_g + eg, total_b + eb
            if tape is not None:
                tape_light(tape, er, eg, eb)
            if depth <= 2:
                direct_r, direct_g, direct_b = direct_r + er, direct_g + eg, direct_b + eb
            gx, gy, gz = side * gx, side * gy, side * gz
            shading = shading_frame(
                side * frame[0], side * frame[1], side * frame[2], frame[3], frame[4], frame[5], frame[6], frame[7],
                frame[8], mapped, side * qx, side * qy, qz,
            )  # fmt: skip
            wox, woy, woz = to_local(shading, -dx, -dy, -dz)
            if woz <= 1e-4:
                # The interpolated normal looks away: the triangle's own does not.
                shading = shading_frame(gx, gy, gz, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, False, 0.0, 0.0, 1.0)
                wox, woy, woz = to_local(shading, -dx, -dy, -dz)
            nx, ny, nz = shading[6], shading[7], shading[8]
            surface = prepare_surface(packed, max(woz, 1e-4))
            # Embree's single precision counts from the world's origin.
            near, skip_mesh, skip_distance = 1e-6 * (1.0 + travelled + abs(ox) + abs(oy) + abs(oz)), nowhere, 0.0
            if first:
                out[ALBEDO], out[ALBEDO + 1] = out[ALBEDO] + packed[0], out[ALBEDO + 1] + packed[1]
                out[ALBEDO + 2] += packed[2]
        if first:
            out[NORMAL], out[NORMAL + 1], out[NORMAL + 2] = out[NORMAL] + nx, out[NORMAL + 1] + ny, out[NORMAL + 2] + nz
            out[DEPTH] += travelled
            out[ALPHA] += 1.0
            out[UV], out[UV + 1] = out[UV] + tx, out[UV + 1] + ty
            first = False
        if depth >= max_depth:
            break
        if cache is not None:  # noqa: SIM102
            if fiber and depth >= cache.depth and box < 0:
                box = box_at(cache, row, m[6] * dx + m[7] * dy + m[8] * dz > 0.0, lx, ly, lz)
                if len(cache.sums) == 0:
                    total_r += beta_r * cache.radiance[box, 0]
                    total_g += beta_g * cache.radiance[box, 1]
                    total_b += beta_b * cache.radiance[box, 2]
                    break
                sums = cache.sums[box]
                sums[0], sums[1], sums[2] = sums[0] - total_r, sums[1] - total_g, sums[2] - total_b
                sums[3], sums[4], sums[5] = sums[3] + beta_r, sums[4] + beta_g, sums[5] + beta_b

        # Direct light: next-event estimation.
        if light_count > 0:
            stream, u0 = next_uniform(stream)
            stream, u1 = next_uniform(stream)
            stream, u2 = next_uniform(stream)
            wx, wy, wz, distance, lr, lg, lb, light_pdf = sample_light(lights, ox, oy, oz, u0, u1, u2)
            if lr > 0.0 or lg > 0.0 or lb > 0.0:
                if fiber:
                    sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wx, wy, wz)
                    fr, fg, fb, pdf = eval_fiber(fiber_material, prepared, sin_ti, cos_ti, phi)
                else:
                    qx, qy, qz = to_local(shading, wx, wy, wz)
                    fr, fg, fb, pdf = eval_surface(surface, qx, qy, qz, wox, woy, woz)
                    if wx * gx + wy * gy + wz * gz <= 0.0:
                        fr = fg = fb = 0.0
                weight = 1.0 if light_pdf == 0.0 else light_pdf / (light_pdf + pdf)
                fr, fg, fb = beta_r * fr * weight, beta_g * fg * weight, beta_b * fb * weight
                likely = max(fr, fg, fb) * SHADOW_ROULETTE
                if likely < 1.0 and depth > 1:
                    stream, u3 = next_uniform(stream)
                    likely = 1.0 / likely if u3 < likely else 0.0
                else:
                    likely = 1.0
                cr, cg, cb = likely * fr * lr, likely * fg * lg, likely * fb * lb
                reach = distance * (1.0 - 1e-6)
                # Area lights stand in each other's way, as they do for rays that the BSDF draws.
                if cr + cg + cb > 0.0 and not light_blocks(lights, ox, oy, oz, wx, wy, wz, reach):
                    if fiber:
                        share = light_share(
                            world, buffer, out, time, first_patch, variants, m, up, slab_mesh, ox, oy, oz, lx, ly, lz,
                            ix, iy, wx, wy, wz, reach,
                        )  # fmt: skip
                    else:
                        out[RAYS] += 1.0
                        share = transmittance(world, buffer, time, ox, oy, oz, wx, wy, wz, near, reach, nowhere, 0.0)
                    if tape is None and straight and share > 0.0:
                        fr, fg, fb = eval_fiber_tt(fiber_material, prepared, sin_ti, cos_ti, phi)
                        if fr + fg + fb > 0.0:
                            stream, left = share_aimed(
                                world, buffer, stream, (first_patch, variants), m, inverse, flight,
                                (patch, ix, iy, curve), fiber_material, radius, max(beta_r, beta_g, beta_b),
                                (u0, u1, u2), out,
                            )  # fmt: skip
                            cr = max(cr - left * likely * beta_r * fr * lr, 0.0)
                            cg = max(cg - left * likely * beta_g * fg * lg, 0.0)
                            cb = max(cb - left * likely * beta_b * fb * lb, 0.0)
                    cr, cg, cb = share * cr, share * cg, share * cb
                    total_r, total_g, total_b = total_r + cr, total_g + cg, total_b + cb
                    if tape is not None:
                        tape_light(tape, cr, cg, cb)
                        if fiber:
                            sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wx, wy, wz)
                            tape_direct(tape, row, fiber_material, prepared, slopes, sin_ti, cos_ti, phi, cr, cg, cb)
                    if depth == 1:
                        direct_r, direct_g, direct_b = direct_r + cr, direct_g + cg, direct_b + cb
                if tape is None and straight:
                    aimed = aim(
                        fiber_material, prepared, h, cos_to, sin_ti, cos_ti, phi, (ex, ey, ez), (fx, fy, fz), dx, dy,
                        dz, math.sqrt((ox - sx) ** 2 + (oy - sy) ** 2 + (oz - sz) ** 2), radius, flight,
                        flight[AZIMUTH],
                    )  # fmt: skip
                    # Calls cost their arguments, so only where it pays.
                    if max(beta_r, beta_g, beta_b) * aimed[0] >= LEAST:
                        stream, cr, cg, cb = aimed_light(
                            world, buffer, stream, time, (first_patch, variants), m, inverse, up, slab_mesh, flight,
                            (patch, ix, iy, curve), fiber_material, prepared, aimed, (beta_r, beta_g, beta_b),
                            (u0, u1, u2), out,
                        )  # fmt: skip
                        total_r, total_g, total_b = total_r + cr, total_g + cg, total_b + cb

        # Next direction: BSDF sampling.
        sx, sy, sz = ox, oy, oz
        sent = False
        stream, u0 = next_uniform(stream)
        stream, u1 = next_uniform(stream)
        stream, u2 = next_uniform(stream)
        if fiber:
            stream, u3 = next_uniform(stream)
            if lights.deltas:
                sin_ti, cos_ti, phi, wr, wg, wb = sample_fiber_lobe(fiber_material, prepared, u0, u1, u2, u3)
                bsdf_pdf = 1.0
            else:
                sin_ti, cos_ti, phi, wr, wg, wb, bsdf_pdf = sample_fiber(fiber_material, prepared, u0, u1, u2, u3)
                if tape is not None:
                    # The same direction, weighed as the tape knows it.
                    _s, _c, _p, wr, wg, wb = sample_fiber_lobe(fiber_material, prepared, u0, u1, u2, u3)
            scale = azimuth_scale(fiber_material)
            sent = lights.deltas and scale < NARROW
            if tape is None and sent:
                flight = flight_from(
                    (ax, ay, az, ex, ey, ez, fx, fy, fz), sin_ti, cos_ti, phi, scale, u0, prepared, ox, oy, oz, lx,
                    ly, lz, ix, iy,
                )  # fmt: skip
            if tape is not None:
                tape_scatter(tape, row, fiber_material, prepared, slopes, u0, sin_ti, cos_ti, phi)
            dx, dy, dz = fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi)
        else:
            qx, qy, qz, wr, wg, wb, bsdf_pdf = sample_surface(surface, wox, woy, woz, u0, u1, u2)
            dx = qx * shading[0] + qy * shading[3] + qz * shading[6]
            dy = qx * shading[1] + qy * shading[4] + qz * shading[7]
            dz = qx * shading[2] + qy * shading[5] + qz * shading[8]
            if dx * gx + dy * gy + dz * gz <= 0.0:
                break
        beta_r, beta_g, beta_b = beta_r * wr, beta_g * wg, beta_b * wb
        if bsdf_pdf <= 0.0 or beta_r + beta_g + beta_b <= 0.0:
            break
        if depth >= RUSSIAN_ROULETTE_DEPTH:
            # At least one path in twenty ends at each vertex: that costs less noise than long tails cost time. In white
            # surroundings throughput would then grow for ever, so it is held at 2.
            beta = max(beta_r, beta_g, beta_b)
            survive = min(beta, max(0.95, 0.5 * beta), 1.0)
            stream, u0 = next_uniform(stream)
            if u0 >= survive:
                break
            beta_r, beta_g, beta_b = beta_r / survive, beta_g / survive, beta_b / survive
    if cache is not None:  # noqa: SIM102  Numba leaves out a branch that asks for nothing else
        if box >= 0 and len(cache.sums) > 0:
            sums = cache.sums[box]
            sums[0], sums[1], sums[2] = sums[0] + total_r, sums[1] + total_g, sums[2] + total_b
    out[0], out[1], out[2] = out[0] + total_r, out[1] + total_g, out[2] + total_b
    out[DIRECT], out[DIRECT + 1] = out[DIRECT] + direct_r, out[DIRECT + 1] + direct_g
    out[DIRECT + 2] += direct_b
    return total_r, total_g, total_b


@njit(**ENTRY, nogil=True)
def render_tile(world, view, seed, window, first_sample, samples, max_depth, film, squares, cache):
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
    cache:
        A ``RadianceCache`` to fill or to end paths at, or None.
    """
    memory = new_ray_buffer(world.embree[2])
    buffer = (borrow(memory[0]), borrow(memory[1]), memory[2])
    world, store = borrowed(world), borrowed_cache(cache)
    for row in range(window[1], window[3]):
        for column in range(window[0], window[2]):
            shift_x, shift_y = pixel_shift(seed, row * view.width + column)
            out = borrow(film[row - window[1], column - window[0]])
            square = borrow(squares[row - window[1], column - window[0]])
            for sample in range(first_sample, first_sample + samples):
                stream, time, ox, oy, oz, dx, dy, dz = camera_sample(view, seed, shift_x, shift_y, row, column, sample)
                red, green, blue = trace_path(
                    world, buffer, stream, time, ox, oy, oz, dx, dy, dz, max_depth, sample == 0, out, None, store
                )
                out[SAMPLES] += 1.0
                square[0] += red * red
                square[1] += green * green
                square[2] += blue * blue
    memory[1][0] = np.uint32(0)  # Numba frees an array after its last use: this is after the last ray
