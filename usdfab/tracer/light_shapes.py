"""Shapes that emit light: for each how to sample it from a point, how a ray hits it, and the density of the samples.

``light`` is a row of ``lights.py`` as a tuple. Samplers return (x, y, z, distance, pdf): unit direction, distance and
density over solid angle, 0 where nothing shines at the point. Hits return the distance along a ray, -1 for none, and
for flat shapes the cosine on the side that shines (negative: the dark back). Densities take the point that was sampled
from, and for shapes sampled by area the place that was hit, so that they agree with the samplers for any ray.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}
_INLINE: dict[str, Any] = {**_OPTIONS, "forceinline": True}

_FAR = 30.0
"""Rectangles whose squared distance is more than so many areas are sampled by area: cheaper, and nearly as good."""
_SMALL_SOLID_ANGLE = 1e-6
"""So are those that look smaller, edge-on: their solid angle would be a difference of large numbers."""


@njit(**_INLINE)
def frame(x, y, z):
    """Two unit vectors orthogonal to a unit vector (Duff et al. 2017)."""
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@njit(**_OPTIONS)
def sample_cone(x, y, z, one_minus_cos, u1, u2):
    """A direction uniform in a cone about (x, y, z): (x, y, z, cosine); its density is 1 / (2 pi one_minus_cos)."""
    drop = u1 * one_minus_cos
    cos = 1.0 - drop
    sin = math.sqrt(max(0.0, drop * (2.0 - drop)))
    ax, ay, az, bx, by, bz = frame(x, y, z)
    phi = 2.0 * math.pi * u2
    c, s = sin * math.cos(phi), sin * math.sin(phi)
    return cos * x + c * ax + s * bx, cos * y + c * ay + s * by, cos * z + c * az + s * bz, cos


# --- sphere: 5:8 centre, 8 radius; uniform in the cone that it fills; nothing is seen from inside ---------------------


@njit(**_INLINE)
def sphere_density(light, px, py, pz):
    """Density over solid angle from a point, 0 inside."""
    d2 = (light[5] - px) ** 2 + (light[6] - py) ** 2 + (light[7] - pz) ** 2
    sin2 = light[8] * light[8] / d2
    if not sin2 < 1.0:
        return 0.0
    return (1.0 + math.sqrt(1.0 - sin2)) / (2.0 * math.pi * sin2)


@njit(**_OPTIONS)
def sample_sphere(light, px, py, pz, u1, u2):
    """See the module."""
    pdf = sphere_density(light, px, py, pz)
    if pdf <= 0.0:
        return 0.0, 0.0, 1.0, 0.0, 0.0
    x, y, z = light[5] - px, light[6] - py, light[7] - pz
    d2 = x * x + y * y + z * z
    d = math.sqrt(d2)
    wx, wy, wz, cos = sample_cone(x / d, y / d, z / d, 1.0 / (2.0 * math.pi * pdf), u1, u2)
    under = light[8] * light[8] - d2 * max(0.0, 1.0 - cos * cos)
    return wx, wy, wz, d * cos - math.sqrt(max(0.0, under)), pdf


@njit(**_INLINE)
def hit_sphere(light, ox, oy, oz, dx, dy, dz):
    """See the module."""
    x, y, z = light[5] - ox, light[6] - oy, light[7] - oz
    along = x * dx + y * dy + z * dz
    d2 = x * x + y * y + z * z
    r2 = light[8] * light[8]
    under = r2 - (d2 - along * along)
    if under <= 0.0 or d2 <= r2 or along <= 0.0:
        return -1.0
    return along - math.sqrt(under)


# --- flat shapes: 9:12 and 12:15 edges or axes, 15:18 unit normal of the side that shines, 18 area --------------------


@njit(**_INLINE)
def _hit_plane(light, ox, oy, oz, dx, dy, dz):
    """(t, cosine, a, b): the place in the plane is 5:8 + a times the first edge + b times the second."""
    cos = -(dx * light[15] + dy * light[16] + dz * light[17])
    x, y, z = light[5] - ox, light[6] - oy, light[7] - oz
    if abs(cos) <= 1e-9:
        return -1.0, cos, 0.0, 0.0
    t = -(x * light[15] + y * light[16] + z * light[17]) / cos
    x, y, z = t * dx - x, t * dy - y, t * dz - z
    uu = light[9] ** 2 + light[10] ** 2 + light[11] ** 2
    vv = light[12] ** 2 + light[13] ** 2 + light[14] ** 2
    uv = light[9] * light[12] + light[10] * light[13] + light[11] * light[14]
    along_u = x * light[9] + y * light[10] + z * light[11]
    along_v = x * light[12] + y * light[13] + z * light[14]
    determinant = uu * vv - uv * uv  # the edges need not be at right angles
    return t, cos, (along_u * vv - along_v * uv) / determinant, (along_v * uu - along_u * uv) / determinant


@njit(**_INLINE)
def _to_place(light, x, y, z):
    """Sample by area: from the vector to a place of a flat shape to direction, distance and density."""
    d2 = x * x + y * y + z * z
    d = math.sqrt(d2)
    height = -(x * light[15] + y * light[16] + z * light[17])
    if height <= 1e-9 * d:
        return 0.0, 0.0, 1.0, 0.0, 0.0
    return x / d, y / d, z / d, d, d2 * d / (height * light[18])


@njit(**_INLINE)
def area_density(light, qx, qy, qz, cos):
    """Density over solid angle of a place sampled by area, from the vector to it and the cosine there."""
    return (qx * qx + qy * qy + qz * qz) / (cos * light[18])


@njit(**_INLINE)
def hit_rect(light, ox, oy, oz, dx, dy, dz):
    """(t, cosine), see the module. 5:8 is a corner."""
    t, cos, a, b = _hit_plane(light, ox, oy, oz, dx, dy, dz)
    return (t if 0.0 <= a <= 1.0 and 0.0 <= b <= 1.0 else -1.0), cos


@njit(**_INLINE)
def hit_disk(light, ox, oy, oz, dx, dy, dz):
    """(t, cosine), see the module. 5:8 is the centre."""
    t, cos, a, b = _hit_plane(light, ox, oy, oz, dx, dy, dz)
    return (t if a * a + b * b <= 1.0 else -1.0), cos


@njit(**_OPTIONS)
def sample_disk(light, px, py, pz, u1, u2):
    """See the module. Uniform by area: a linear map of the unit disk keeps ratios of areas."""
    radius, phi = math.sqrt(u1), 2.0 * math.pi * u2
    a, b = radius * math.cos(phi), radius * math.sin(phi)
    x = light[5] + a * light[9] + b * light[12] - px
    y = light[6] + a * light[10] + b * light[13] - py
    z = light[7] + a * light[11] + b * light[14] - pz
    return _to_place(light, x, y, z)


@njit(**_OPTIONS)
def _rect_view(light, px, py, pz):
    """A right-angled rectangle as a point sees it: (solid angle, height, x0, x1, y0, y1, lengths of the edges).

    In a frame along the edges whose origin is the point, the rectangle is [x0, x1] x [y0, y1] at ``height`` away. A
    corner rectangle [0, x] x [0, y] fills the solid angle asin(a b), a = x / sqrt(x^2 + height^2), b likewise; four of
    those add up. The solid angle is 0 where area sampling is to be used: far away, sheared (19 is 0), from behind.
    """
    x, y, z = light[5] - px, light[6] - py, light[7] - pz
    height = -(x * light[15] + y * light[16] + z * light[17])
    d2 = (light[20] - px) ** 2 + (light[21] - py) ** 2 + (light[22] - pz) ** 2
    if light[19] == 0.0 or d2 > _FAR * light[18] or height * height <= 1e-14 * light[18]:
        return 0.0, height, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0
    u = math.sqrt(light[9] ** 2 + light[10] ** 2 + light[11] ** 2)
    v = math.sqrt(light[12] ** 2 + light[13] ** 2 + light[14] ** 2)
    x0 = (x * light[9] + y * light[10] + z * light[11]) / u
    y0 = (x * light[12] + y * light[13] + z * light[14]) / v
    x1, y1 = x0 + u, y0 + v
    h2 = height * height
    a0, a1 = x0 / math.sqrt(x0 * x0 + h2), x1 / math.sqrt(x1 * x1 + h2)
    b0, b1 = y0 / math.sqrt(y0 * y0 + h2), y1 / math.sqrt(y1 * y1 + h2)
    angle = math.asin(a1 * b1) - math.asin(a1 * b0) - math.asin(a0 * b1) + math.asin(a0 * b0)
    if height <= 0.0 or angle < _SMALL_SOLID_ANGLE:
        angle = 0.0
    return angle, height, x0, x1, y0, y1, u, v


@njit(**_OPTIONS)
def rect_density(light, px, py, pz, qx, qy, qz, cos):
    """Density over solid angle from a point; (qx, qy, qz) is the vector to the place hit, ``cos`` the cosine there."""
    angle = _rect_view(light, px, py, pz)[0]
    return 1.0 / angle if angle > 0.0 else area_density(light, qx, qy, qz, cos)


@njit(**_OPTIONS)
def sample_rect(light, px, py, pz, u1, u2):
    """See the module. Uniform by solid angle on a rectangle, by area on a parallelogram and far away.

    The method of Urena, Fajardo and King, "An Area-Preserving Parametrization for Spherical Rectangles", 2013: a strip
    [x0, x] that holds the share u1 of the solid angle, then y by the projected arc; with asin in the place of their
    angles between planes. The strip up to a = x / sqrt(x^2 + h^2) has asin(a b1) - asin(a b0) = t, and by the sine rule
    a = sin t / sqrt(b0^2 + b1^2 - 2 b0 b1 cos t).
    """
    angle, h, x0, x1, y0, y1, u, v = _rect_view(light, px, py, pz)
    if angle <= 0.0:
        x = light[5] + u1 * light[9] + u2 * light[12] - px
        y = light[6] + u1 * light[10] + u2 * light[13] - py
        z = light[7] + u1 * light[11] + u2 * light[14] - pz
        return _to_place(light, x, y, z)
    a0 = x0 / math.sqrt(x0 * x0 + h * h)
    b0, b1 = y0 / math.sqrt(y0 * y0 + h * h), y1 / math.sqrt(y1 * y1 + h * h)
    t = u1 * angle + math.asin(a0 * b1) - math.asin(a0 * b0)
    # (b1 - b0)^2 + 2 b0 b1 (1 - cos t), without the difference of cosines
    half = math.sin(0.5 * t)
    a = math.sin(t) / math.sqrt(max((b1 - b0) ** 2 + 4.0 * b0 * b1 * half * half, 1e-300))
    a = min(max(a, -1.0), 1.0)
    x = min(max(h * a / math.sqrt(max(1.0 - a * a, 1e-30)), x0), x1)
    r2 = x * x + h * h
    c0, c1 = y0 / math.sqrt(r2 + y0 * y0), y1 / math.sqrt(r2 + y1 * y1)
    c = c0 + u2 * (c1 - c0)
    y = min(max(c * math.sqrt(r2 / max(1.0 - c * c, 1e-30)), y0), y1)
    d = math.sqrt(r2 + y * y)
    x, y, h = x / (d * u), y / (d * v), h / d
    return (
        x * light[9] + y * light[12] - h * light[15],
        x * light[10] + y * light[13] - h * light[16],
        x * light[11] + y * light[14] - h * light[17],
        d,
        1.0 / angle,
    )


# --- cylinder: 5:8 centre, 8 radius, 9:12 unit axis, 12 half its length; the side alone, seen from outside ------------
#
# In the plane across the axis a point at the distance D sees a circle, within asin(r / D) to both sides. The angle to
# the side is uniform in there, and of the stripe along the axis that it meets, the sine of the elevation: uniform by
# solid angle but for the stripes' different lengths. From inside it is invisible, as a sphere is.


@njit(**_INLINE)
def _cylinder_view(light, px, py, pz):
    """(height of the point along the axis, vector from the axis (3), D, angle to the side or 0 inside)."""
    x, y, z = px - light[5], py - light[6], pz - light[7]
    along = x * light[9] + y * light[10] + z * light[11]
    x, y, z = x - along * light[9], y - along * light[10], z - along * light[11]
    d = math.sqrt(x * x + y * y + z * z)
    return along, x, y, z, d, math.asin(light[8] / d) if d > light[8] * (1.0 + 1e-9) else 0.0


@njit(**_INLINE)
def _stripe(light, along, near):
    """Sines of the elevations of a stripe's ends, seen from the height ``along`` at the distance ``near``."""
    low, high = -light[12] - along, light[12] - along
    return low / math.sqrt(low * low + near * near), high / math.sqrt(high * high + near * near)


@njit(**_OPTIONS)
def cylinder_density(light, px, py, pz, qx, qy, qz):
    """Density over solid angle from a point; (qx, qy, qz) is the vector to the place on the side."""
    along, _x, _y, _z, _d, side = _cylinder_view(light, px, py, pz)
    rise = qx * light[9] + qy * light[10] + qz * light[11]
    x, y, z = qx - rise * light[9], qy - rise * light[10], qz - rise * light[11]
    low, high = _stripe(light, along, math.sqrt(x * x + y * y + z * z))
    return 0.5 / (side * (high - low)) if side > 0.0 and high > low else 0.0


@njit(**_OPTIONS)
def sample_cylinder(light, px, py, pz, u1, u2):
    """See the module."""
    along, vx, vy, vz, d, side = _cylinder_view(light, px, py, pz)
    psi = (2.0 * u2 - 1.0) * side
    # In the plane across: towards the axis, turned by psi, as far as the circle's near side.
    c, s = math.cos(psi), math.sin(psi)
    near = d * c - math.sqrt(max(light[8] * light[8] - d * d * s * s, 0.0))
    low, high = _stripe(light, along, near)
    if side <= 0.0 or not high > low:
        return 0.0, 0.0, 1.0, 0.0, 0.0
    sine = low + u1 * (high - low)
    cosine = math.sqrt(max(1.0 - sine * sine, 1e-30))
    c, s = -c * cosine / d, s * cosine / d
    tx, ty, tz = light[10] * vz - light[11] * vy, light[11] * vx - light[9] * vz, light[9] * vy - light[10] * vx
    x = c * vx + s * tx + sine * light[9]
    y = c * vy + s * ty + sine * light[10]
    z = c * vz + s * tz + sine * light[11]
    return x, y, z, near / cosine, 0.5 / (side * (high - low))


@njit(**_INLINE)
def hit_cylinder(light, ox, oy, oz, dx, dy, dz):
    """See the module: where the ray comes in from outside."""
    x, y, z = ox - light[5], oy - light[6], oz - light[7]
    o_along = x * light[9] + y * light[10] + z * light[11]
    d_along = dx * light[9] + dy * light[10] + dz * light[11]
    x, y, z = x - o_along * light[9], y - o_along * light[10], z - o_along * light[11]
    wx, wy, wz = dx - d_along * light[9], dy - d_along * light[10], dz - d_along * light[11]
    a = wx * wx + wy * wy + wz * wz
    b = x * wx + y * wy + z * wz
    c = x * x + y * y + z * z - light[8] * light[8]
    root = b * b - a * c
    if c <= 0.0 or b >= 0.0 or root <= 0.0:
        return -1.0
    t = c / (math.sqrt(root) - b)  # the smaller root, without cancellation
    return t if abs(o_along + t * d_along) <= light[12] else -1.0
