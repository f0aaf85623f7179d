"""What each pixel sees, in compiled loops: cloth with its frame and footprint, other surfaces, lights.

One row of the buffer per pixel, columns below. Cloth is a query in the making: its place and footprint in tiles, and
directions in its own frame, x along the weft, y along the warp, z towards the viewer. A cloth seen from behind is
another cloth, turned about its warp: x and u are reversed, and what was below is on top.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from usdfab.tracer.intrinsics import KERNEL, new_ray_buffer
from usdfab.tracer.lights import FAR, escaped_radiance, hit_light
from usdfab.tracer.surfaces import MAX_SURFACES, surface_frame, trace_macro
from usdfab.tracer.textures import lookup, opacity_at, surface_at
from usdfab.tracer.vertex import camera_ray
from usdfab.tracer.world import FIRST_PATCH, UV_SCALE

NOTHING, SURFACE, CLOTH = 0, 1, 2
"""Kinds of pixels."""

KIND, MATERIAL, FABRIC, BACK, PRIM, COPY = range(6)
TAGS = 6
"""Columns of the whole numbers: kind, material, fabric, whether seen from behind, triangle, copy."""

POSITION, FACE, FRAME, PLACE, SIZE, VIEW, TINT, UV, HIT, DEPTH = 0, 3, 6, 15, 17, 18, 21, 24, 26, 28
NUMBERS = 29
"""Columns of the numbers: position (3), the triangle's normal on the viewer's side (3), frame x, y, z (9), u and v of
the footprint in tiles, its side in tiles, direction to the viewer (3; of cloth in its frame, else in the world), factor
of the albedo (3), texture coordinates (2), barycentric coordinates (2), distance."""

LEAST_COSINE = 0.02
"""Of the view with the cloth: grazing rays are taken as this steep."""

LONGEST = 2.0
"""A footprint's side is at least its longer axis over this: beyond, it would leave out too much of the ellipse."""

OPTIONS: dict[str, Any] = {**KERNEL, "nogil": True}


@njit(**OPTIONS)
def pixel_footprint(xu, xv, yu, yv):
    """Side of the square footprint with Jacobian columns (xu, xv) and (yu, yv): tiles per pixel along x and y.

    As large as the parallelogram, but not less than its longer axis over ``LONGEST`` (singular values of the Jacobian).
    """
    area = abs(xu * yv - xv * yu)
    half = 0.5 * (xu * xu + xv * xv + yu * yu + yv * yv)
    longer = math.sqrt(half + math.sqrt(max(half * half - area * area, 0.0)))
    return max(math.sqrt(area), longer / LONGEST)


@njit(**OPTIONS)
def cloth_frame(frame, nx, ny, nz):
    """Unit axes (x, y, z; 9 numbers) of the cloth: z the shading normal, x and y as near to weft and warp as possible.

    ``frame``: shading normal and gradients of the cloth's x and y, as interpolated; n: the triangle's normal. Where
    texture coordinates are mirrored, so are the axes. All 0 where there are none.
    """
    mx, my, mz = frame[0], frame[1], frame[2]
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    if norm > 0.0:
        mx, my, mz = mx / norm, my / norm, mz / norm
    if norm <= 0.0 or mx * nx + my * ny + mz * nz < 0.1:
        mx, my, mz = nx, ny, nz
    gx, gy, gz, hx, hy, hz = frame[3], frame[4], frame[5], frame[6], frame[7], frame[8]
    dot = gx * mx + gy * my + gz * mz
    gx, gy, gz = gx - dot * mx, gy - dot * my, gz - dot * mz
    dot = hx * mx + hy * my + hz * mz
    hx, hy, hz = hx - dot * mx, hy - dot * my, hz - dot * mz
    cx, cy, cz = gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx
    area = cx * mx + cy * my + cz * mz
    size = max(gx * gx + gy * gy + gz * gz, hx * hx + hy * hy + hz * hz)
    if not (abs(area) > 1e-6 * size and size > 0.0):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    handed = 1.0 if area > 0.0 else -1.0
    norm = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz)
    gx, gy, gz = gx * norm, gy * norm, gz * norm
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    # y turned to where x should be; halfway between both is x.
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    x = gx + handed * (hy * mz - hz * my)
    y = gy + handed * (hz * mx - hx * mz)
    z = gz + handed * (hx * my - hy * mx)
    norm = 1.0 / math.sqrt(max(x * x + y * y + z * z, 1e-300))
    x, y, z = x * norm, y * norm, z * norm
    return (
        *(x, y, z),
        *(handed * (my * z - mz * y), handed * (mz * x - mx * z), handed * (mx * y - my * x)),
        *(mx, my, mz),
    )


@njit(**OPTIONS)
def mipped(textures, first, levels, u, v, size):
    """Value (r, g, b) of a texture with smaller copies at rows ``first + k``, averaged over ``size`` (units of uv)."""
    width, height = textures.table[first, 1], textures.table[first, 2]
    level = min(max(math.log2(max(size * max(width, height), 1e-9)), 0.0), levels - 1.0)
    lower = min(int(level), levels - 1)
    r, g, b = lookup(textures, first + lower, u, v)
    between = level - lower
    if between > 0.0:
        r1, g1, b1 = lookup(textures, first + lower + 1, u, v)
        r, g, b = r + between * (r1 - r), g + between * (g1 - g), b + between * (b1 - b)
    return r, g, b


@njit(**OPTIONS)
def fill(world, view, mips, repeats, jitter_x, jitter_y, shrink, x0, x1, y0, y1, tags, numbers, radiance):
    """See what the pixels of a window see; rays through the same place of each pixel.

    Parameters
    ----------
    mips: (fabrics, 2) int32
        First texture of the albedo's smaller and smaller copies, or -1, and how many there are.
    repeats: (fabrics, 2)
        Width and height of a tile in metres.
    jitter_x, jitter_y: float
        In the pixel, 0 to 1 from its upper left corner.
    shrink: float
        Factor of footprints: pixels of several samples share theirs among them.
    tags, numbers, radiance: (P, TAGS) int32, (P, NUMBERS) float64, (P, 3) float64
        Filled; rows of pixels one after the other. Radiance is of lights seen and of surfaces that glow.
    """
    buffer = new_ray_buffer(world.embree[2])
    macro = world.macro
    step_s, step_t = 2.0 / view.width, -2.0 / view.height
    pixel = 0
    for row in range(y0, y1):
        for column in range(x0, x1):
            s = 2.0 * (column + jitter_x) / view.width - 1.0
            t_film = 1.0 - 2.0 * (row + jitter_y) / view.height
            ox, oy, oz, dx, dy, dz = camera_ray(view, 0.0, s, t_film, 0.0, 0.0)
            tags[pixel, KIND] = NOTHING
            near = 0.0
            for _ in range(MAX_SURFACES):
                hit, t, prim, copy, _mesh, hu, hv = trace_macro(
                    world, buffer, 0.0, ox, oy, oz, dx, dy, dz, near, FAR, np.int64(-1), 0.0
                )
                t_light, r, g, b = hit_light(world.lights, ox, oy, oz, dx, dy, dz, t if hit else FAR, -1.0, ox, oy, oz)
                if t_light < (t if hit else FAR):
                    radiance[pixel, 0], radiance[pixel, 1], radiance[pixel, 2] = r, g, b
                    break
                if not hit:
                    r, g, b = escaped_radiance(world.lights, dx, dy, dz, -1.0, ox, oy, oz)
                    radiance[pixel, 0], radiance[pixel, 1], radiance[pixel, 2] = r, g, b
                    break
                material = np.int64(macro.material[prim])
                tx, ty, nx, ny, nz, frame = surface_frame(macro, 0.0, prim, copy, hu, hv)
                faces = dx * nx + dy * ny + dz * nz
                cloth = macro.fabrics[material, FIRST_PATCH] >= 0.0
                if not cloth and opacity_at(world.materials, world.textures, material, tx, ty) < 0.5:
                    near = t * (1.0 + 1e-6) + 1e-9
                    continue
                side = 1.0 if faces < 0.0 else -1.0
                out = numbers[pixel]
                out[POSITION], out[POSITION + 1], out[POSITION + 2] = ox + t * dx, oy + t * dy, oz + t * dz
                out[FACE], out[FACE + 1], out[FACE + 2] = side * nx, side * ny, side * nz
                out[UV], out[UV + 1], out[HIT], out[HIT + 1], out[DEPTH] = tx, ty, hu, hv, t
                tags[pixel, MATERIAL], tags[pixel, PRIM], tags[pixel, COPY] = material, prim, copy
                tags[pixel, BACK] = 0 if side > 0.0 else 1
                if not cloth:
                    tags[pixel, KIND] = SURFACE
                    out[VIEW], out[VIEW + 1], out[VIEW + 2] = -dx, -dy, -dz
                    _surface, r, g, b = surface_at(world.materials, world.textures, material, tx, ty)
                    radiance[pixel, 0], radiance[pixel, 1], radiance[pixel, 2] = r, g, b
                    break
                axes = cloth_frame(frame, nx, ny, nz)
                if axes[8] == 0.0 and axes[7] == 0.0 and axes[6] == 0.0:  # no usable texture coordinates here
                    near = t * (1.0 + 1e-6) + 1e-9
                    continue
                fabric = int(macro.fabrics[material, FIRST_PATCH])
                scale = macro.fabrics[material, UV_SCALE]
                tags[pixel, KIND], tags[pixel, FABRIC] = CLOTH, fabric
                for k in range(9):
                    turned = side < 0.0 and (k < 3 or k > 5)
                    out[FRAME + k] = -axes[k] if turned else axes[k]
                wx = -(dx * out[FRAME] + dy * out[FRAME + 1] + dz * out[FRAME + 2])
                wy = -(dx * out[FRAME + 3] + dy * out[FRAME + 4] + dz * out[FRAME + 5])
                wz = -(dx * out[FRAME + 6] + dy * out[FRAME + 7] + dz * out[FRAME + 8])
                if wz < LEAST_COSINE:
                    wz = LEAST_COSINE
                    norm = math.sqrt((1.0 - wz * wz) / max(wx * wx + wy * wy, 1e-12))
                    wx, wy = wx * norm, wy * norm
                out[VIEW], out[VIEW + 1], out[VIEW + 2] = wx, wy, wz

                # Ray differentials (Igehy 1999): the neighbours' rays on the triangle's plane.
                across = t * faces
                metres = np.zeros(4)
                for k in range(2):
                    _x, _y, _z, ex, ey, ez = camera_ray(
                        view, 0.0, s + (step_s if k == 0 else 0.0), t_film + (step_t if k == 1 else 0.0), 0.0, 0.0
                    )
                    slope = ex * nx + ey * ny + ez * nz
                    if abs(slope) < 0.02 * abs(faces):
                        slope = math.copysign(0.02 * abs(faces) + 1e-12, faces)
                    far = across / slope
                    px, py, pz = far * ex - t * dx, far * ey - t * dy, far * ez - t * dz
                    metres[2 * k] = frame[3] * px + frame[4] * py + frame[5] * pz
                    metres[2 * k + 1] = frame[6] * px + frame[7] * py + frame[8] * pz
                width, height = repeats[fabric, 0], repeats[fabric, 1]
                out[SIZE] = shrink * pixel_footprint(
                    metres[0] / width, metres[1] / height, metres[2] / width, metres[3] / height
                )
                u, v = tx * scale / width, ty * scale / height
                u, v = u - math.floor(u), v - math.floor(v)
                out[PLACE], out[PLACE + 1] = (1.0 - u if side < 0.0 else u), v

                r = g = b = 1.0
                tinted = macro.tinted[prim]
                if tinted >= 0:
                    w = 1.0 - hu - hv
                    c = macro.tint
                    r = w * c[tinted, 0, 0] + hu * c[tinted, 1, 0] + hv * c[tinted, 2, 0]
                    g = w * c[tinted, 0, 1] + hu * c[tinted, 1, 1] + hv * c[tinted, 2, 1]
                    b = w * c[tinted, 0, 2] + hu * c[tinted, 1, 2] + hv * c[tinted, 2, 2]
                if mips[fabric, 0] >= 0:
                    size = shrink * pixel_footprint(metres[0], metres[1], metres[2], metres[3]) / scale
                    ar, ag, ab = mipped(world.textures, mips[fabric, 0], mips[fabric, 1], tx, ty, size)
                    r, g, b = r * ar, g * ag, b * ab
                out[TINT], out[TINT + 1], out[TINT + 2] = r, g, b
                break
            pixel += 1
