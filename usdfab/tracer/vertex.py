"""What a path needs at its ends: the camera's rays, shading frames of surfaces, tinted fibers. In kernels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.tracer.counted import mix, next_uniform, start_stream
from usdfab.tracer.intrinsics import KERNEL
from usdfab.tracer.textures import lookup
from usdfab.tracer.world import ALBEDO_MAP


@njit(**KERNEL, forceinline=True)
def pixel_shift(seed, pixel):
    """How far the R2 sequence (Roberts 2018) is shifted in a pixel: a hash."""
    shift = mix(np.uint64(pixel) + mix(np.uint64(seed)))
    shift_x = np.float64(shift >> np.uint64(40)) * 2.0**-24
    return shift_x, np.float64((shift >> np.uint64(16)) & np.uint64(0xFFFFFF)) * 2.0**-24


@njit(**KERNEL, forceinline=True)
def camera_sample(view, seed, shift_x, shift_y, row, column, sample):
    """One sample of a pixel: (stream, time, origin (3), direction (3)), the same whoever asks for it."""
    jx = shift_x + 0.7548776662466927 * (sample + 1)
    jy = shift_y + 0.5698402909980532 * (sample + 1)
    s = 2.0 * (column + jx - math.floor(jx)) / view.width - 1.0
    t = 1.0 - 2.0 * (row + jy - math.floor(jy)) / view.height
    stream = start_stream(seed, row * view.width + column, sample)
    time = u1 = u2 = 0.0
    if view.moves:
        stream, time = next_uniform(stream)
    if view.lens[0] > 0.0:
        stream, u1 = next_uniform(stream)
        stream, u2 = next_uniform(stream)
    ox, oy, oz, dx, dy, dz = camera_ray(view, time, s, t, u1, u2)
    return stream, time, ox, oy, oz, dx, dy, dz


@njit(**KERNEL)
def camera_ray(view, time, s, t, u1, u2):
    """Start and direction of the ray through film position (s, t) in [-1, 1]^2, in the world."""
    x, y = view.film[0] * (s + view.film[2]), view.film[1] * (t + view.film[3])
    ox = oy = 0.0
    z = -1.0
    if view.lens[0] > 0.0:
        radius, phi = view.lens[0] * math.sqrt(u1), 2.0 * math.pi * u2
        ox, oy = radius * math.cos(phi), radius * math.sin(phi)
        x, y, z = view.lens[1] * x - ox, view.lens[1] * y - oy, -view.lens[1]
    norm = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * norm, y * norm, z * norm
    m = view.to_world
    a, b = (1.0 - time, time) if view.moves else (1.0, 0.0)
    px, py, pz = a * m[0, 0, 3] + b * m[1, 0, 3], a * m[0, 1, 3] + b * m[1, 1, 3], a * m[0, 2, 3] + b * m[1, 2, 3]
    dx = dy = dz = 0.0
    for k in range(2):
        w = a if k == 0 else b
        if w == 0.0:
            continue
        dx += w * (m[k, 0, 0] * x + m[k, 0, 1] * y + m[k, 0, 2] * z)
        dy += w * (m[k, 1, 0] * x + m[k, 1, 1] * y + m[k, 1, 2] * z)
        dz += w * (m[k, 2, 0] * x + m[k, 2, 1] * y + m[k, 2, 2] * z)
        px += w * (m[k, 0, 0] * ox + m[k, 0, 1] * oy)
        py += w * (m[k, 1, 0] * ox + m[k, 1, 1] * oy)
        pz += w * (m[k, 2, 0] * ox + m[k, 2, 1] * oy)
    norm = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return px, py, pz, dx * norm, dy * norm, dz * norm


@njit(**KERNEL)
def shading_frame(nx, ny, nz, gx, gy, gz, hx, hy, hz, mapped, mx, my, mz):
    """Unit tangent, bitangent and normal for a surface: along the texture coordinates where a normal map needs it."""
    norm = 1.0 / math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
    nx, ny, nz = nx * norm, ny * norm, nz * norm
    if mapped:
        # dp/du and dp/dv are the dual basis of the gradients.
        tx, ty, tz = hy * nz - hz * ny, hz * nx - hx * nz, hx * ny - hy * nx
        bx, by, bz = ny * gz - nz * gy, nz * gx - nx * gz, nx * gy - ny * gx
        handed = 1.0 if gx * tx + gy * ty + gz * tz > 0.0 else -1.0
        tangent = handed / math.sqrt(max(tx * tx + ty * ty + tz * tz, 1e-300))
        bitangent = handed / math.sqrt(max(bx * bx + by * by + bz * bz, 1e-300))
        nx, ny, nz = (
            mx * tangent * tx + my * bitangent * bx + mz * nx,
            mx * tangent * ty + my * bitangent * by + mz * ny,
            mx * tangent * tz + my * bitangent * bz + mz * nz,
        )
        norm = 1.0 / math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
        nx, ny, nz = nx * norm, ny * norm, nz * norm
    # Duff et al. 2017.
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny, nx, ny, nz


@njit(**KERNEL, forceinline=True)
def to_local(s, x, y, z):
    return (
        s[0] * x + s[1] * y + s[2] * z,
        s[3] * x + s[4] * y + s[5] * z,
        s[6] * x + s[7] * y + s[8] * z,
    )


@njit(**KERNEL)
def tint_at(world, material, prim, u, v, tx, ty):
    """Factor of the fiber albedo from the mesh's colours and the fabric's albedo map: (r, g, b)."""
    r = g = b = 1.0
    macro = world.macro
    row = macro.tinted[prim]
    if row >= 0:
        w = 1.0 - u - v
        c = macro.tint
        r = w * c[row, 0, 0] + u * c[row, 1, 0] + v * c[row, 2, 0]
        g = w * c[row, 0, 1] + u * c[row, 1, 1] + v * c[row, 2, 1]
        b = w * c[row, 0, 2] + u * c[row, 1, 2] + v * c[row, 2, 2]
    image = int(macro.fabrics[material, ALBEDO_MAP])
    if image >= 0:
        lr, lg, lb = lookup(world.textures, image, tx, ty)
        r, g, b = r * lr, g * lg, b * lb
    return r, g, b


@njit(**KERNEL, forceinline=True)
def _absorption(sigma, inverse_q, tint, albedo):
    """Absorption of a fiber whose albedo coefficient is multiplied by ``tint`` (Chiang et al. 2015; at most 1)."""
    root = math.sqrt(sigma) - math.log(min(max(tint, 1e-4), 1.0 / max(albedo, 1e-4))) * inverse_q
    return root * root if root > 0.0 else 0.0


@njit(**KERNEL, forceinline=True)
def tint_fiber(p, albedo, row, r, g, b):
    """The packed fiber material ``p`` with its albedo coefficient multiplied."""
    q = albedo[row, 3]
    absorption = (
        _absorption(p[0], q, r, albedo[row, 0]),
        _absorption(p[1], q, g, albedo[row, 1]),
        _absorption(p[2], q, b, albedo[row, 2]),
    )
    return absorption + p[3:]
