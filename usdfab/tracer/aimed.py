"""Less noise from narrow lobes: light that is seen through a fiber, averaged over where the ray meets the fiber.

What a fiber transmits towards a lamp is zero for nearly all offsets h at which a path meets it, and large for a few. A
path comes to the fiber from another one, which scattered it by an azimuth x with density p(x), x from the middle of the
lobe that was drawn. A turn of x by a few hundredths is enough to meet the same fiber at another h. So at each vertex a
second azimuth x1 is drawn, near x and such that the fiber transmits towards the lamp, a second ray is traced, and the
light that it finds counts instead of the light that the path finds itself.

With g(x) the light found and S(x, y) = 1 where rays x and y meet the same fiber and ``aim`` holds, and u(x|y) = p(x) /
P(y) for |x - y| <= d, P(y) being the integral of p over that window, the estimator is

    g(x1) S(x, x1) p(x1) / (P(x1) q(x1|x)) + g(x) (1 - S(y, x)),    x ~ p,  x1 ~ q(.|x),  y ~ u(.|x)

The first term has the mean of g(x) w(x), w(x) the integral of u(y|x) S(y, x) over y; the second that of
g(x) (1 - w(x)): together that of g, whatever q is and whatever ``aim`` expects. S(y, x) is a mean over several y: only
light that was found needs it. All of this is for the transmitted lobe (TT) alone, and for lamps without extent.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from usdfab.scattering.elementary_numba import fast_asin, fast_atan2, fast_exp, fast_log, fast_sincos
from usdfab.scattering.fiber_numba import drawn_lobe, fiber_angles, fiber_direction, fiber_frame, prepare_fiber
from usdfab.scattering.fiber_numba_tt import (
    attenuation_tt,
    azimuth_scale,
    eval_fiber_tt,
    longitudinal_tt,
    middle_tt,
    modified_eta2,
    turn_tt,
    turn_tt_slope,
)
from usdfab.tracer.counted import next_uniform
from usdfab.tracer.film import RAYS
from usdfab.tracer.intrinsics import KERNEL, NG, PRIM, U
from usdfab.tracer.lights import light_blocks, sample_light
from usdfab.tracer.slab import HIT, to_patch, trace_slab
from usdfab.tracer.surfaces import light_share
from usdfab.tracer.tangents import tangent_at

_WINDOW = 6.0
"""d, in scales of the azimuthal logistic."""
_WINDOW_REST = 0.3
"""d for the lobe without azimuth, rad."""
_UNIFORM = 0.06
"""Share of x1 that is uniform in the window."""
_WIDER = 1.15
"""What x1 is drawn from, in scales of what is expected: straight fibers are an approximation."""
_LEAST_TURN = 0.5
"""Least turn of what is transmitted, per turn of the ray, with which it pays to aim."""
LEAST = 0.02 / (4.0 * math.pi)
"""Least expected light, for a lamp that gives 1, with which it pays to aim."""
_ROULETTE = 4.0 * math.pi
"""Expected light, times this, is the chance that the second ray is traced, if that is under 1."""
_ROULETTE_LEAST = 0.02
_TURNS = 4
"""Rays y for light found."""

NARROW = 0.06
"""Largest scale of the azimuthal logistic, rad, that is worth the second ray."""

NO_FLIGHT = (0.0,) * 23
"""A flight is how a ray left a fiber: axis, e and f there (9), sine and cosine of its inclination, middle of the lobe
drawn, azimuth from there, scale, number of the lobe, place in the world (3), in the tile (3), and tile (2)."""
_SIN, _COS, _MIDDLE, AZIMUTH, _SCALE, _LOBE, _WORLD, _PLACE, _TILE = 9, 10, 11, 12, 13, 14, 15, 18, 21


@njit(**KERNEL, forceinline=True)
def _wrapped(angle):
    """An angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@njit(**KERNEL)
def flight_from(axes, sin_ti, cos_ti, phi, scale, u0, prepared, ox, oy, oz, lx, ly, lz, ix, iy):
    """The flight of a direction that ``sample_fiber_lobe`` drew with ``u0``; ``axes`` (9) are axis, e and f."""
    lobe, middle = drawn_lobe(prepared, u0)
    x = _wrapped(phi - middle)
    return (
        *axes, sin_ti, cos_ti, middle, x, scale, np.float64(lobe), ox, oy, oz, lx, ly, lz, np.float64(ix),
        np.float64(iy),
    )  # fmt: skip


@njit(**KERNEL, forceinline=True)
def fiber_at(patches, buffer, patch, m, inverse):
    """The fiber that the buffer's hit is on, in the world.

    Returns
    -------
    (curve of the patch, unit axis (3), unit normal in the plane normal to it (3))
    """
    floats, words, _address = buffer
    curve, qx, qy, qz = tangent_at(patches.records, patch, np.int64(words[PRIM]), np.float64(floats[U]))
    # Tangents are vectors, normals covectors.
    ax = qx * inverse[0] + qy * inverse[3] + qz * inverse[6]
    ay = qx * inverse[1] + qy * inverse[4] + qz * inverse[7]
    az = qx * inverse[2] + qy * inverse[5] + qz * inverse[8]
    norm = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * norm, ay * norm, az * norm
    qx, qy, qz = np.float64(floats[NG]), np.float64(floats[NG + 1]), np.float64(floats[NG + 2])
    nx = qx * m[0] + qy * m[3] + qz * m[6]
    ny = qx * m[1] + qy * m[4] + qz * m[7]
    nz = qx * m[2] + qy * m[5] + qz * m[8]
    # Embree's normal belongs to the straight segment; h wants it in the plane normal to the spline's tangent.
    dot = nx * ax + ny * ay + nz * az
    nx, ny, nz = nx - dot * ax, ny - dot * ay, nz - dot * az
    norm = 1.0 / math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
    return curve, ax, ay, az, nx * norm, ny * norm, nz * norm


@njit(**KERNEL, forceinline=True)
def _half_window(lobe, scale):
    """d of the lobe that was drawn."""
    return _WINDOW * scale if lobe < 3 else _WINDOW_REST


@njit(**KERNEL, forceinline=True)
def _below(x):
    """The logistic's distribution function of x <= 0 or so."""
    e = math.exp(min(x, 700.0))
    return e / (1.0 + e)


@njit(**KERNEL)
def density_in_window(lobe, scale, x):
    """p(x) / P(x), per radian; ``lobe`` 3 has no azimuth."""
    d = _half_window(lobe, scale)
    if lobe == 3:
        return 0.5 / d
    x = -abs(x)
    e = fast_exp(x / scale)
    mass = _below(min(x + d, math.pi) / scale) - _below(max(x - d, -math.pi) / scale)
    return e / ((1.0 + e) * (1.0 + e) * scale * mass)


@njit(**KERNEL)
def draw_in_window(lobe, scale, x, u):
    """y with density u(y|x)."""
    d = _half_window(lobe, scale)
    if lobe == 3:
        return x + (2.0 * u - 1.0) * d
    side = -1.0 if x > 0.0 else 1.0
    x = -abs(x)
    low, high = max(x - d, -math.pi), min(x + d, math.pi)
    a, b = _below(low / scale), _below(high / scale)
    q = min(max(a + u * (b - a), 1e-300), 1.0 - 1e-16)
    return side * min(max(scale * fast_log(q / (1.0 - q)), low), high)


@njit(**KERNEL)
def draw_aimed(lobe, scale, x, middle, width, u, choice):
    """x1 and q(x1|x): a logistic around where ``aim`` says, or anywhere in the window."""
    d = _half_window(lobe, scale)
    low, high = x - d, x + d
    if lobe < 3:
        low, high = max(low, -math.pi), min(high, math.pi)
    w = _WIDER * width
    a = 1.0 / (1.0 + math.exp(min((middle - low) / w, 700.0)))
    b = 1.0 / (1.0 + math.exp(max((middle - high) / w, -700.0)))
    if choice < _UNIFORM:
        x1 = low + u * (high - low)
    else:
        q = min(max(a + u * (b - a), 1e-15), 1.0 - 1e-15)
        x1 = min(max(middle + w * fast_log(q / (1.0 - q)), low), high)
    e = fast_exp(-abs(x1 - middle) / w)
    return x1, _UNIFORM / (high - low) + (1.0 - _UNIFORM) * e / ((1.0 + e) * (1.0 + e) * w * (b - a))


@njit(**KERNEL, forceinline=True)
def _in_reach(h, cos_to, missing, eta2, lever, radius, turn, d):
    """Whether a turn by d can change what is transmitted by the angle that is missing; most lights are too far off."""
    reach = 1.3 * d * turn / cos_to
    moved = reach * lever / radius
    end = min(abs(h) + moved, 0.99)
    return abs(missing) <= -turn_tt_slope(end, eta2) * moved + reach


@njit(**KERNEL)
def _offset_towards(h, psi, eta2, ratio):
    """The offset at which a fiber transmits towards a light, by Newton's method.

    A fiber is a straight cylinder here: from L away of its axis, r its radius, h is seen under the angle asin(h r / L).

    Parameters
    ----------
    h: float
        Offset at which it was met.
    psi: float
        Azimuth of the light from straight on, rad.
    eta2, ratio: float
        Square of the modified index of refraction, and r / L.

    Returns
    -------
    (turn of the ray around the fiber, rad, and of what it transmits less that of the light, per turn of the ray); the
    second is 0 where there is no such offset.
    """
    start = fast_asin(ratio * h)
    for _ in range(4):
        turn = fast_asin(ratio * h) - start
        error = turn_tt(h, eta2) + turn - psi
        follow = ratio / math.sqrt(1.0 - ratio * ratio * h * h)
        slope = turn_tt_slope(h, eta2) + follow
        if abs(error) < 0.01:
            return turn, abs(slope) / follow
        h = min(max(h - error / min(slope, -0.2), -0.99), 0.99)
    return 0.0, 0.0


@njit(**KERNEL)
def _azimuth_of_turn(flight, azimuth, e, f, turn):
    """How the flight's azimuth has to change so that its ray turns as far around a fiber.

    Returns
    -------
    (step of the azimuth, rad, and turn per radian of it there); the second is 0 where no azimuth does it.
    """
    s, c = fast_sincos(turn)
    gx, gy, gz = c * f[0] - s * e[0], c * f[1] - s * e[1], c * f[2] - s * e[2]
    # The direction's part along g is a + b cos + c sin of the azimuth, and has to be 0.
    constant = flight[_SIN] * (flight[0] * gx + flight[1] * gy + flight[2] * gz)
    cosine = flight[_COS] * (flight[3] * gx + flight[4] * gy + flight[5] * gz)
    sine = flight[_COS] * (flight[6] * gx + flight[7] * gy + flight[8] * gz)
    size = math.sqrt(cosine * cosine + sine * sine)
    if size <= abs(constant):
        return 0.0, 0.0
    center, opening = fast_atan2(sine, cosine) - azimuth, 0.5 * math.pi + fast_asin(constant / size)
    one, two = _wrapped(center + opening), _wrapped(center - opening)
    step = one if abs(one) < abs(two) else two
    dx, dy, dz = fiber_direction(*flight[:11], azimuth + step)
    gx, gy, gz = c * e[0] + s * f[0], c * e[1] + s * f[1], c * e[2] + s * f[2]
    length = -(dx * gx + dy * gy + dz * gz)
    if length < 0.02:
        return 0.0, 0.0
    return step, math.sqrt(size * size - constant * constant) / length


@njit(**KERNEL)
def aim(p, prep, h, cos_to, sin_ti, cos_ti, phi, e, f, dx, dy, dz, distance, radius, flight, x):
    """Which azimuth would have met the fiber so that it transmits towards the light.

    Parameters
    ----------
    p, prep, h, cos_to:
        Material of the fiber that was met, its vertex of ``prepare_fiber``, and how it was met, as given to that.
    sin_ti, cos_ti, phi:
        The light, as for ``eval_fiber``.
    e, f, distance, radius:
        Frame of the fiber that was met, length of the ray, and the fiber's radius.
    dx, dy, dz, flight, x:
        Direction of the ray, how it left the fiber before, and its azimuth there.

    Returns
    -------
    (expected light for light 1, middle and scale of the azimuths that bring it); light 0 where the window has none.
    """
    nothing = (0.0, 0.0, 1.0)
    if cos_to < 0.02:
        return nothing
    lever = distance * cos_to + radius * math.sqrt(max(1.0 - h * h, 0.0))
    eta2 = modified_eta2(p, cos_to)
    # The derivative of a direction by its azimuth is its cross product with the axis.
    turn = abs(
        f[0] * (flight[1] * dz - flight[2] * dy)
        + f[1] * (flight[2] * dx - flight[0] * dz)
        + f[2] * (flight[0] * dy - flight[1] * dx)
    )
    lobe, scale = flight[_LOBE], flight[_SCALE]
    d = _half_window(lobe, scale)
    if not _in_reach(h, cos_to, _wrapped(middle_tt(prep) - phi), eta2, lever, radius, turn, d):
        return nothing
    ratio = radius / math.sqrt(lever * lever + radius * radius * h * h)
    if ratio >= 0.999:
        return nothing
    turn, bends = _offset_towards(h, _wrapped(phi - math.pi), eta2, ratio)
    if bends == 0.0:
        return nothing
    step, turns = _azimuth_of_turn(flight, flight[_MIDDLE] + x, e, f, turn)
    # How fast what is transmitted turns with the azimuth.
    steep = bends * turns
    middle = x + step
    if steep < _LEAST_TURN or abs(step) > d or (lobe < 3 and abs(middle) > math.pi):
        return nothing
    m = longitudinal_tt(p, prep, sin_ti, cos_ti)
    width = azimuth_scale(p) / steep
    if lobe == 3:
        return m * density_in_window(lobe, scale, middle) / steep, middle, width
    # Two logistics, nearly as if they were normal distributions: their product, and its integral.
    both = math.sqrt(scale * scale + width * width)
    value = m * density_in_window(0, both, middle) / steep
    return value, middle * scale * scale / (both * both), scale * width / both


@njit(**KERNEL)
def _turned(world, buffer, cloth, m, inverse, flight, x, hit):
    """The ray of a flight turned to azimuth x.

    Returns
    -------
    (whether it meets the fiber ``hit``, direction (3), world distance, place in the tile (3), axis (3), normal (3))
    """
    patches = world.patches
    dx, dy, dz = fiber_direction(*flight[:11], flight[_MIDDLE] + x)
    px, py, pz = to_patch(m, dx, dy, dz)
    stretch = math.sqrt(px * px + py * py + pz * pz)
    outcome, t, lx, ly, lz, ix, iy, patch = trace_slab(
        world.embree[0], patches.table, patches.handles, buffer, cloth[0], cloth[1], flight[_PLACE],
        flight[_PLACE + 1], flight[_PLACE + 2], np.int64(flight[_TILE]), np.int64(flight[_TILE + 1]), px / stretch,
        py / stretch, pz / stretch,
    )  # fmt: skip
    same = outcome == HIT and patch == hit[0] and ix == hit[1] and iy == hit[2]
    ax, ay, az, nx, ny, nz = 0.0, 0.0, 1.0, 1.0, 0.0, 0.0
    if same:
        curve, ax, ay, az, nx, ny, nz = fiber_at(patches, buffer, patch, m, inverse)
        same = curve == hit[3]
    return same, dx, dy, dz, t / stretch, lx, ly, lz, ax, ay, az, nx, ny, nz


@njit(**KERNEL)
def share_aimed(world, buffer, stream, cloth, m, inverse, flight, hit, p, radius, beta, lamp, out):
    """Mean of S(y, x) over a few y: how much of the light found here is left to those who aim.

    Parameters
    ----------
    cloth, hit:
        First patch and number of variants; patch, tile (2) and curve of the fiber that was met.
    p, radius, beta:
        Its material and radius, and the path's largest throughput.
    lamp: (3,)
        The numbers that chose the lamp.

    Returns
    -------
    (stream, share)
    """
    share = 0.0
    for _ in range(_TURNS):
        stream, u = next_uniform(stream)
        y = draw_in_window(flight[_LOBE], flight[_SCALE], flight[AZIMUTH], u)
        out[RAYS] += 1.0
        same, dx, dy, dz, t, _lx, _ly, _lz, ax, ay, az, nx, ny, nz = _turned(
            world, buffer, cloth, m, inverse, flight, y, hit
        )
        if not same:
            continue
        sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -dx, -dy, -dz)
        wx, wy, wz, _distance, lr, lg, lb, _pdf = sample_light(
            world.lights, flight[_WORLD] + t * dx, flight[_WORLD + 1] + t * dy, flight[_WORLD + 2] + t * dz,
            lamp[0], lamp[1], lamp[2],
        )  # fmt: skip
        if lr + lg + lb <= 0.0:
            continue
        sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wx, wy, wz)
        prep = prepare_fiber(p, h, sin_to, cos_to)
        value, _middle, _width = aim(
            p, prep, h, cos_to, sin_ti, cos_ti, phi, (ex, ey, ez), (fx, fy, fz), dx, dy, dz, t, radius, flight, y
        )
        if beta * value >= LEAST:
            share += 1.0 / _TURNS
    return stream, share


@njit(**KERNEL)
def aimed_light(
    world, buffer, stream, time, cloth, m, inverse, up, slab_mesh, flight, hit, p, prepared, aimed, beta, lamp, out
):
    """The first term: what the fiber transmits of the lamp's light, where it does so.

    Parameters
    ----------
    cloth, hit, p, lamp:
        As for ``share_aimed``.
    prepared, aimed, beta:
        ``prepare_fiber`` of the vertex, what ``aim`` says, and the path's throughput (3).

    Returns
    -------
    (stream, radiance (3))
    """
    value, middle, width = aimed
    red, green, blue = attenuation_tt(prepared)
    likely = _ROULETTE * value * max(beta[0] * red, beta[1] * green, beta[2] * blue)
    likely = min(max(likely, _ROULETTE_LEAST), 1.0)
    stream, u0 = next_uniform(stream)
    stream, u1 = next_uniform(stream)
    stream, u2 = next_uniform(stream)
    nothing = (stream, 0.0, 0.0, 0.0)
    if u0 >= likely:
        return nothing
    x1, q = draw_aimed(flight[_LOBE], flight[_SCALE], flight[AZIMUTH], middle, width, u1, u2)
    out[RAYS] += 1.0
    same, dx, dy, dz, t, lx, ly, lz, ax, ay, az, nx, ny, nz = _turned(world, buffer, cloth, m, inverse, flight, x1, hit)
    if not same:
        return nothing
    ox, oy, oz = flight[_WORLD] + t * dx, flight[_WORLD + 1] + t * dy, flight[_WORLD + 2] + t * dz
    wx, wy, wz, distance, lr, lg, lb, _pdf = sample_light(world.lights, ox, oy, oz, lamp[0], lamp[1], lamp[2])
    sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -dx, -dy, -dz)
    sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wx, wy, wz)
    fr, fg, fb = eval_fiber_tt(p, prepare_fiber(p, h, sin_to, cos_to), sin_ti, cos_ti, phi)
    fr, fg, fb = beta[0] * fr * lr, beta[1] * fg * lg, beta[2] * fb * lb
    reach = distance * (1.0 - 1e-6)
    if fr + fg + fb <= 0.0 or light_blocks(world.lights, ox, oy, oz, wx, wy, wz, reach):
        return nothing
    share = light_share(
        world, buffer, out, time, cloth[0], cloth[1], m, up, slab_mesh, ox, oy, oz, lx, ly, lz, hit[1], hit[2], wx, wy,
        wz, reach,
    )  # fmt: skip
    share *= density_in_window(flight[_LOBE], flight[_SCALE], x1) / (q * likely)
    return stream, share * fr, share * fg, share * fb
