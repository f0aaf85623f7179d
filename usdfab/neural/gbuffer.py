"""What each pixel sees, in compiled loops over sixteen pixels: cloth with its frame and footprint, surfaces, lights.

Pixels are taken in tiles of 4 x 4, one vector each; the buffer has columns, one after the other in flat arrays: column
``c`` of pixel ``p`` at ``c * count + p``. Cloth is a query in the making: its place and footprint in repeats of the
weave, and directions in its own frame, x along the weft, y along the warp, z towards the viewer. A cloth seen from
behind is another cloth, turned about its warp: x and u are reversed, and what was below is on top.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.neural.packets import INSTANCE, PRIM as HIT_PRIM, REACH, U, V, intersect_packet
from usdfab.neural.simd import (
    LANES,
    bits_of,
    gather,
    invert,
    lanes,
    load,
    most,
    root,
    size_of,
    spread,
    spread_integer,
    store,
    to_floats,
    where,
)
from usdfab.neural.simd_math import INLINE, dot, fraction, inverse_length
from usdfab.tracer.intrinsics import ENTRY
from usdfab.tracer.lights import FAR, escaped_radiance, hit_light
from usdfab.tracer.surfaces import MAX_SURFACES, surface_frame, trace_macro
from usdfab.tracer.textures import lookup, opacity_at, surface_at
from usdfab.tracer.world import FIRST_PATCH

SIDE = 4
"""Of the tiles of pixels."""

NOTHING, SURFACE, CLOTH = 0, 1, 2
"""Kinds of pixels."""

KIND, MATERIAL, FABRIC, BACK, PRIM, COPY = range(6)
TAGS = 6
"""Columns of the whole numbers: kind, material, fabric, whether seen from behind, triangle, copy."""

POSITION, FACE, FRAME, PLACE, SIZE, VIEW, TINT, HIT, DEPTH = 0, 3, 6, 15, 17, 18, 21, 24, 26
NUMBERS = 27
"""Columns of the numbers: position (3), the triangle's normal on the viewer's side (3), frame x, y, z (9), u and v of
the footprint in tiles, its side in tiles, direction to the viewer (3; of cloth in its frame, else in the world), factor
of the albedo (3), barycentric coordinates (2), distance."""

CORNER, NORMAL, TILE_UV, RECORD = 0, 27, 30, 36
"""Columns of ``Cloth.triangles``."""

PLAIN, WOVEN, GLOWING, PASSED = 0, 1, 2, 3
"""Kinds of triangles: opaque surface, cloth, opaque surface with emission, those that a ray may have to pass."""

LEAST_COSINE = 0.02
"""Of the view with the cloth: grazing rays are taken as this steep."""

LONGEST = 2.0
"""A footprint's side is at least its longer axis over this: beyond, it would leave out too much of the ellipse."""

OPTIONS: dict[str, Any] = {**ENTRY, "nogil": True}


class Cloth(NamedTuple):
    """What the kernels read of triangles and fabrics besides the tracer's world.

    Parameters
    ----------
    triangles: (T RECORD,) float32
        Of each corner the shading normal and the gradients of the cloth's x and y (3 x 9), the unit normal of the
        triangle (3), u and v of the corners in repeats of the weave (3 x 2), counted from near the first corner.
    kinds: (T,) int32
        ``PLAIN``, ``WOVEN``, ``GLOWING`` or ``PASSED``.
    fabric: (T,) int32
        Of woven triangles.
    repeats: (2 fabrics,) float32
        Width and height of a repeat in metres.
    mips: (fabrics, 2) int32
        First texture of the albedo's smaller and smaller copies, or -1, and how many there are.
    tinted, cutouts, bodies: bool
        Whether any cloth has colours or a picture on it, any triangle is ``PASSED``, any light has an extent.
    packets: (2,) uint64
        Addresses of rtcIntersect16 and rtcOccluded16.
    """

    triangles: NDArray[np.float32]
    kinds: NDArray[np.int32]
    fabric: NDArray[np.int32]
    repeats: NDArray[np.float32]
    mips: NDArray[np.int32]
    tinted: bool
    cutouts: bool
    bodies: bool
    packets: tuple[np.uint64, np.uint64]


@njit(**INLINE)
def pixel_footprint(xu, xv, yu, yv):
    """Side of the square footprint with Jacobian columns (xu, xv) and (yu, yv): tiles per pixel along x and y.

    As large as the parallelogram, but not less than its longer axis over ``LONGEST`` (singular values of the Jacobian).
    """
    area = size_of(xu * yv - xv * yu)
    half = 0.5 * (xu * xu + xv * xv + yu * yu + yv * yv)
    longer = root(half + root(most((half - area) * (half + area), 0.0)))
    return most(root(area), longer * (1.0 / LONGEST))


@njit(**INLINE)
def cloth_frame(mx, my, mz, gx, gy, gz, hx, hy, hz, nx, ny, nz):
    """Unit axes (x, y, z; 9 numbers) of the cloth: z the shading normal, x and y as near to weft and warp as possible.

    m: shading normal as interpolated; g, h: gradients of the cloth's x and y; n: the triangle's normal. Where texture
    coordinates are mirrored, so are the axes. All 0 where there are none.
    """
    norm = inverse_length(mx, my, mz)
    mx, my, mz = mx * norm, my * norm, mz * norm
    away = dot(mx, my, mz, nx, ny, nz) < 0.1
    mx, my, mz = where(away, nx, mx), where(away, ny, my), where(away, nz, mz)
    d = dot(gx, gy, gz, mx, my, mz)
    gx, gy, gz = gx - d * mx, gy - d * my, gz - d * mz
    d = dot(hx, hy, hz, mx, my, mz)
    hx, hy, hz = hx - d * mx, hy - d * my, hz - d * mz
    area = dot(gy * hz - gz * hy, gz * hx - gx * hz, gx * hy - gy * hx, mx, my, mz)
    flat = invert(size_of(area) > 1e-6 * most(dot(gx, gy, gz, gx, gy, gz), dot(hx, hy, hz, hx, hy, hz)))
    handed = where(area > 0.0, spread(1.0), -1.0)
    norm = inverse_length(gx, gy, gz)
    gx, gy, gz = gx * norm, gy * norm, gz * norm
    norm = handed * inverse_length(hx, hy, hz)
    # y turned to where x should be; halfway between both is x.
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    x, y, z = gx + (hy * mz - hz * my), gy + (hz * mx - hx * mz), gz + (hx * my - hy * mx)
    norm = where(flat, 0.0, inverse_length(x, y, z))
    x, y, z = x * norm, y * norm, z * norm
    return (
        *(x, y, z),
        *(handed * (my * z - mz * y), handed * (mz * x - mx * z), handed * (mx * y - my * x)),
        *(where(flat, 0.0, mx), where(flat, 0.0, my), where(flat, 0.0, mz)),
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
def _behind(world, cloth, packet, buffer, lane, ox, oy, oz, dx, dy, dz, hit):
    """Finish one lane of a packet: past what it may pass, to (kind, r, g, b) with the radiance of lights it meets.

    The hit's fields in the packet are those of what it shows in the end.
    """
    floats, words, _address = packet
    t = np.float64(floats[REACH + lane]) if hit else FAR
    prim, copy = np.int64(words[HIT_PRIM + lane]), np.int64(words[INSTANCE + lane])
    hu, hv = np.float64(floats[U + lane]), np.float64(floats[V + lane])
    for _ in range(MAX_SURFACES):
        t_light, r, g, b = hit_light(world.lights, ox, oy, oz, dx, dy, dz, t, -1.0, ox, oy, oz)
        if t_light < t:
            return NOTHING, r, g, b
        if not hit:
            r, g, b = escaped_radiance(world.lights, dx, dy, dz, -1.0, ox, oy, oz)
            return NOTHING, r, g, b
        floats[REACH + lane], floats[U + lane], floats[V + lane] = t, hu, hv
        words[HIT_PRIM + lane], words[INSTANCE + lane] = prim, copy
        kind = cloth.kinds[prim]
        if kind in (WOVEN, PLAIN):
            return (CLOTH if kind == WOVEN else SURFACE), 0.0, 0.0, 0.0
        material = np.int64(world.macro.material[prim])
        if world.macro.fabrics[material, FIRST_PATCH] < 0.0:
            tx, ty, _nx, _ny, _nz, _frame = surface_frame(world.macro, 0.0, prim, copy, hu, hv)
            if kind == GLOWING or opacity_at(world.materials, world.textures, material, tx, ty) >= 0.5:
                _surface, r, g, b = surface_at(world.materials, world.textures, material, tx, ty)
                return SURFACE, r, g, b
        hit, t, prim, copy, _mesh, hu, hv = trace_macro(
            world, buffer, 0.0, ox, oy, oz, dx, dy, dz, t * (1.0 + 1e-6) + 1e-9, FAR, np.int64(-1), 0.0
        )
    return NOTHING, 0.0, 0.0, 0.0


@njit(**OPTIONS)
def _copied_frame(world, lane, prim, copy, u, v, scratch):
    """Normal, gradients and the triangle's normal of a lane that shows a copy, into columns of ``scratch``."""
    _tx, _ty, nx, ny, nz, frame = surface_frame(world.macro, 0.0, prim, copy, u, v)
    for k in range(9):
        scratch[k * LANES + lane] = frame[k]
    scratch[9 * LANES + lane], scratch[10 * LANES + lane], scratch[11 * LANES + lane] = nx, ny, nz


@njit(**OPTIONS)
def _tint(world, cloth, lane, tags, numbers, count, pixel, fabric, metres):
    """Factors of the albedo in a pixel: colours on the mesh, and the picture averaged over the footprint."""
    macro, prim = world.macro, tags[PRIM * count + pixel]
    hu, hv = numbers[HIT * count + pixel], numbers[(HIT + 1) * count + pixel]
    w = 1.0 - hu - hv
    r = g = b = 1.0
    tinted = macro.tinted[prim]
    if tinted >= 0:
        c = macro.tint
        r = w * c[tinted, 0, 0] + hu * c[tinted, 1, 0] + hv * c[tinted, 2, 0]
        g = w * c[tinted, 0, 1] + hu * c[tinted, 1, 1] + hv * c[tinted, 2, 1]
        b = w * c[tinted, 0, 2] + hu * c[tinted, 1, 2] + hv * c[tinted, 2, 2]
    if cloth.mips[fabric, 0] >= 0:
        uv = macro.uv
        tx = w * uv[prim, 0, 0] + hu * uv[prim, 1, 0] + hv * uv[prim, 2, 0]
        ty = w * uv[prim, 0, 1] + hu * uv[prim, 1, 1] + hv * uv[prim, 2, 1]
        scale = macro.fabrics[tags[MATERIAL * count + pixel], 2]
        ar, ag, ab = mipped(
            world.textures, cloth.mips[fabric, 0], cloth.mips[fabric, 1], tx, ty, metres[lane] / scale
        )  # fmt: skip
        r, g, b = r * ar, g * ag, b * ab
    numbers[TINT * count + pixel], numbers[(TINT + 1) * count + pixel] = r, g
    numbers[(TINT + 2) * count + pixel] = b


@njit(**INLINE)
def _put(numbers, count, column, pixel, x, y, z):
    store(numbers, column * count + pixel, x)
    store(numbers, (column + 1) * count + pixel, y)
    store(numbers, (column + 2) * count + pixel, z)


@njit(**OPTIONS)
def fill(world, cloth, view, jitter_x, jitter_y, shrink, x0, x1, y0, y1, packet, buffer, tags, numbers, radiance):
    """See what the pixels of a window see; rays through the same place of each pixel.

    Parameters
    ----------
    jitter_x, jitter_y: float
        In the pixel, 0 to 1 from its upper left corner.
    shrink: float
        Factor of footprints: pixels of several samples share theirs among them.
    tags, numbers, radiance: (TAGS P,) int32, (NUMBERS P,) float32, (3 P,) float32
        Filled; P pixels of whole tiles, rows of tiles one after the other. Radiance is of lights seen and of surfaces
        that glow.
    """
    across = (x1 - x0 + SIDE - 1) // SIDE
    count = across * ((y1 - y0 + SIDE - 1) // SIDE) * LANES
    m, film = view.to_world, view.film
    ox, oy, oz = m[0, 0, 3], m[0, 1, 3], m[0, 2, 3]
    near = spread(0.0)
    scratch, metres = np.zeros(12 * LANES, dtype=np.float32), np.zeros(LANES, dtype=np.float32)
    # Steps of the direction, before it is made one long, from a pixel to the next in x and in y.
    ax, ay = film[0] * 2.0 / view.width, film[1] * -2.0 / view.height
    axx, axy, axz = m[0, 0, 0] * ax, m[0, 1, 0] * ax, m[0, 2, 0] * ax
    ayx, ayy, ayz = m[0, 0, 1] * ay, m[0, 1, 1] * ay, m[0, 2, 1] * ay
    for pixel in range(0, count, LANES):
        tile = pixel // LANES
        left, top = x0 + SIDE * (tile % across), y0 + SIDE * (tile // across)
        column, row = (lanes() & (SIDE - 1)) + left, (lanes() >> 2) + top
        alive = (column < x1) & (row < y1)
        x = film[0] * ((to_floats(column) + jitter_x) * (2.0 / view.width) + (film[2] - 1.0))
        y = film[1] * ((to_floats(row) + jitter_y) * (-2.0 / view.height) + (film[3] + 1.0))
        dx = x * m[0, 0, 0] + y * m[0, 0, 1] - m[0, 0, 2]
        dy = x * m[0, 1, 0] + y * m[0, 1, 1] - m[0, 1, 2]
        dz = x * m[0, 2, 0] + y * m[0, 2, 1] - m[0, 2, 2]
        unit = inverse_length(dx, dy, dz)
        dx, dy, dz = dx * unit, dy * unit, dz * unit
        hit = intersect_packet(
            cloth.packets[0], world.embree[3], packet, alive, spread(ox), spread(oy), spread(oz), dx, dy, dz, near
        )
        floats, words, _address = packet
        copied = bits_of(hit & (load(words, INSTANCE) >= 0))
        if copied:
            for lane in range(LANES):
                if copied >> lane & 1:
                    words[HIT_PRIM + lane] += world.macro.first[words[INSTANCE + lane]]
        prim = where(hit, load(words, HIT_PRIM), 0)
        store(words, HIT_PRIM, prim)
        kinds = gather(cloth.kinds, prim)
        woven, plain = hit & (kinds == WOVEN), hit & (kinds == PLAIN)
        store(tags, KIND * count + pixel, where(woven, spread_integer(CLOTH), where(plain, spread_integer(SURFACE), 0)))
        for c in range(3):
            store(radiance, c * count + pixel, spread(0.0))
        rest = bits_of(alive if cloth.bodies else alive & invert(woven | plain))
        if rest:
            store(scratch, 0, dx)
            store(scratch, LANES, dy)
            store(scratch, 2 * LANES, dz)
            some = bits_of(hit)
            for lane in range(LANES):
                if rest >> lane & 1:
                    kind, r, g, b = _behind(
                        world, cloth, packet, buffer, lane, ox, oy, oz, np.float64(scratch[lane]),
                        np.float64(scratch[LANES + lane]), np.float64(scratch[2 * LANES + lane]), some >> lane & 1 == 1,
                    )  # fmt: skip
                    tags[KIND * count + pixel + lane] = kind
                    radiance[pixel + lane], radiance[count + pixel + lane] = r, g
                    radiance[2 * count + pixel + lane] = b
            woven = load(tags, KIND * count + pixel) == CLOTH
            prim = load(words, HIT_PRIM)
        seen = load(tags, KIND * count + pixel) > NOTHING
        if bits_of(seen) == 0:
            continue

        # --- Where, on what ---
        u, v, t = load(floats, U), load(floats, V), load(floats, REACH)
        store(tags, PRIM * count + pixel, prim)
        store(tags, COPY * count + pixel, load(words, INSTANCE))
        store(tags, MATERIAL * count + pixel, gather(world.macro.material, prim))
        _put(numbers, count, POSITION, pixel, ox + t * dx, oy + t * dy, oz + t * dz)
        store(numbers, HIT * count + pixel, u)
        store(numbers, (HIT + 1) * count + pixel, v)
        store(numbers, DEPTH * count + pixel, t)
        base = prim * RECORD
        w = 1.0 - u - v
        for k in range(9):
            value = w * gather(cloth.triangles, base + k) + u * gather(cloth.triangles, base + (k + 9))
            store(scratch, k * LANES, value + v * gather(cloth.triangles, base + (k + 18)))
        for k in range(3):
            store(scratch, (9 + k) * LANES, gather(cloth.triangles, base + (NORMAL + k)))
        copied = bits_of(seen & (load(words, INSTANCE) >= 0))
        if copied:
            for lane in range(LANES):
                if copied >> lane & 1:
                    _copied_frame(
                        world, lane, words[HIT_PRIM + lane], words[INSTANCE + lane], np.float64(floats[U + lane]),
                        np.float64(floats[V + lane]), scratch,
                    )  # fmt: skip
        gx, gy, gz = load(scratch, 3 * LANES), load(scratch, 4 * LANES), load(scratch, 5 * LANES)
        hx, hy, hz = load(scratch, 6 * LANES), load(scratch, 7 * LANES), load(scratch, 8 * LANES)
        nx, ny, nz = load(scratch, 9 * LANES), load(scratch, 10 * LANES), load(scratch, 11 * LANES)
        faces = dot(dx, dy, dz, nx, ny, nz)
        back = faces >= 0.0
        side = where(back, spread(-1.0), 1.0)
        store(tags, BACK * count + pixel, where(back, spread_integer(1), 0))
        _put(numbers, count, FACE, pixel, side * nx, side * ny, side * nz)
        if bits_of(woven) == 0:
            _put(numbers, count, VIEW, pixel, -1.0 * dx, -1.0 * dy, -1.0 * dz)
            continue

        # --- The cloth's frame and the viewer in it ---
        xx, xy, xz, yx, yy, yz, zx, zy, zz = cloth_frame(
            load(scratch, 0), load(scratch, LANES), load(scratch, 2 * LANES), gx, gy, gz, hx, hy, hz, nx, ny, nz
        )
        _put(numbers, count, FRAME, pixel, side * xx, side * xy, side * xz)
        _put(numbers, count, FRAME + 3, pixel, yx, yy, yz)
        _put(numbers, count, FRAME + 6, pixel, side * zx, side * zy, side * zz)
        wx, wy = -1.0 * side * dot(dx, dy, dz, xx, xy, xz), -1.0 * dot(dx, dy, dz, yx, yy, yz)
        wz = -1.0 * side * dot(dx, dy, dz, zx, zy, zz)
        grazing = wz < LEAST_COSINE
        norm = where(grazing, math.sqrt(1.0 - LEAST_COSINE**2) / root(most(wx * wx + wy * wy, 1e-12)), 1.0)
        wx, wy, wz = norm * wx, norm * wy, where(grazing, LEAST_COSINE, wz)
        _put(
            numbers, count, VIEW, pixel, where(woven, wx, -1.0 * dx), where(woven, wy, -1.0 * dy),
            where(woven, wz, -1.0 * dz),
        )  # fmt: skip

        # --- Ray differentials (Igehy 1999): the neighbours' rays, d + e, on the triangle's plane ---
        least_slope = 0.02 * size_of(faces) + 1e-12
        fabric = where(woven, gather(cloth.fabric, prim), 0)
        width, height = gather(cloth.repeats, fabric * 2), gather(cloth.repeats, fabric * 2 + 1)
        xu, xv = _step(axx * unit, axy * unit, axz * unit, dx, dy, dz, t, nx, ny, nz, faces, least_slope,
                       gx, gy, gz, hx, hy, hz)  # fmt: skip
        yu, yv = _step(ayx * unit, ayy * unit, ayz * unit, dx, dy, dz, t, nx, ny, nz, faces, least_slope,
                       gx, gy, gz, hx, hy, hz)  # fmt: skip
        store(numbers, SIZE * count + pixel, shrink * pixel_footprint(xu / width, xv / height, yu / width, yv / height))
        tu = w * gather(cloth.triangles, base + TILE_UV) + u * gather(cloth.triangles, base + (TILE_UV + 2))
        tv = w * gather(cloth.triangles, base + (TILE_UV + 1)) + u * gather(cloth.triangles, base + (TILE_UV + 3))
        tu = fraction(tu + v * gather(cloth.triangles, base + (TILE_UV + 4)))
        tv = fraction(tv + v * gather(cloth.triangles, base + (TILE_UV + 5)))
        store(numbers, PLACE * count + pixel, where(back, fraction(1.0 - tu), tu))
        store(numbers, (PLACE + 1) * count + pixel, tv)
        store(tags, FABRIC * count + pixel, fabric)
        _put(numbers, count, TINT, pixel, spread(1.0), spread(1.0), spread(1.0))
        if cloth.tinted:
            store(metres, 0, shrink * pixel_footprint(xu, xv, yu, yv))
            some = bits_of(woven)
            for lane in range(LANES):
                if some >> lane & 1:
                    number = tags[FABRIC * count + pixel + lane]
                    _tint(world, cloth, lane, tags, numbers, count, pixel + lane, number, metres)


@njit(**INLINE)
def _step(ex, ey, ez, dx, dy, dz, t, nx, ny, nz, faces, least_slope, gx, gy, gz, hx, hy, hz):
    """Metres of cloth (along x, along y) from where the ray d meets the plane to where d + e does.

    The difference of two nearly equal places, written out so that singles lose nothing.
    """
    tilt = dot(ex, ey, ez, nx, ny, nz)
    slope = faces + tilt
    grazing = size_of(slope) < least_slope
    slope = where(grazing, where(faces < 0.0, -1.0 * least_slope, least_slope), slope)
    tilt = where(grazing, slope - faces, tilt)
    far = t / slope
    px = far * (faces * ex - tilt * dx)
    py = far * (faces * ey - tilt * dy)
    pz = far * (faces * ez - tilt * dz)
    return dot(gx, gy, gz, px, py, pz), dot(hx, hy, hz, px, py, pz)
