"""Lights: packed into one array, sampled and evaluated in kernels.

Row of the array: 0 kind, 1 probability of being chosen, 2:5 emission (RGB), then by kind:

- point: 5:8 position; emission is radiant intensity (W/sr)
- sphere: 5:8 centre, 8 radius; emission is radiance
- distant: 5:8 direction towards the light, 8 cosine of the half angle, 9:12 irradiance; emission is radiance
- rect: 5:8 corner, 9:12 and 12:15 edges, 15:18 unit normal (the side that shines), 18 area; emission is radiance
- dome: 5:14 rotation world -> dome (rows), 14 is 1 with a texture; emission is radiance or its multiplier

The dome texture: pole along +y of the dome's frame, middle towards +z, left quarter towards +x (``usd.scene``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.usd.scene import DistantLight, DomeLight, PointLight, RectLight, Scene, SphereLight

POINT, SPHERE, DISTANT, RECT, DOME = 0, 1, 2, 3, 4
COLUMNS = 19
_DELTA_COS = 1.0 - 1e-9
FAR = 1e30


class Lights(NamedTuple):
    """Packed lights. ``table`` (L, COLUMNS); the dome's texture with its distribution over rows and columns."""

    table: NDArray[np.float64]
    image: NDArray[np.float64]
    rows: NDArray[np.float64]
    columns: NDArray[np.float64]


def pack_lights(scene: Scene, textures: dict[str, NDArray[np.float32]], center: NDArray, extent: float) -> Lights:
    """Lights of a scene as arrays.

    ``textures`` maps dome texture paths to linear images (H, W, 3). ``center`` and ``extent`` of the geometry (metres)
    decide how often each light is chosen: by the light it would throw there.
    """
    table = np.zeros((len(scene.lights), COLUMNS))
    power = np.zeros(len(scene.lights))
    image = np.zeros((1, 1, 3))
    rows, columns = np.zeros(2), np.zeros((1, 2))
    textured = False
    for row, (light, record) in enumerate(zip(scene.lights, table, strict=True)):
        if isinstance(light, PointLight):
            record[0], record[2:5], record[5:8] = POINT, light.intensity, light.position
            power[row] = np.max(light.intensity) / _distance2(light.position, center, extent)
        elif isinstance(light, SphereLight):
            record[0], record[2:5], record[5:8], record[8] = SPHERE, light.radiance, light.center, light.radius
            power[row] = np.max(light.radiance) * math.pi * light.radius**2 / _distance2(light.center, center, extent)
        elif isinstance(light, DistantLight):
            cos = math.cos(light.half_angle)
            solid_angle = math.pi * (1.0 - cos * cos)
            record[0], record[5:8], record[8] = DISTANT, -np.asarray(light.direction), cos
            record[9:12] = light.irradiance
            record[2:5] = np.asarray(light.irradiance) / solid_angle if cos < _DELTA_COS else 0.0
            power[row] = np.max(light.irradiance)
        elif isinstance(light, RectLight):
            area = float(np.linalg.norm(np.cross(light.edge_u, light.edge_v)))
            record[0], record[2:5], record[5:8] = RECT, light.radiance, light.corner
            record[9:12], record[12:15], record[15:18], record[18] = light.edge_u, light.edge_v, light.normal, area
            middle = light.corner + 0.5 * (light.edge_u + light.edge_v)
            power[row] = np.max(light.radiance) * area / _distance2(middle, center, extent)
        elif isinstance(light, DomeLight):
            record[0], record[2:5] = DOME, light.radiance
            record[5:14] = np.linalg.inv(light.to_world[:3, :3]).ravel()
            power[row] = math.pi * np.max(light.radiance)
            if light.texture is not None or light.texture_path:
                if textured:
                    raise UsdfabError("a second dome light with a texture", place=light.path, remedy="keep one of them")
                textured = True
                image = _texture(light, textures)
                record[14] = 1.0
                rows, columns = image_distribution(image)
                power[row] *= image.mean()
    total = power.sum()
    if len(table):
        table[:, 1] = power / total if total > 0 else 1.0 / len(table)
    return Lights(table, image, rows, columns)


def _texture(light: DomeLight, textures: dict[str, NDArray[np.float32]]) -> NDArray[np.float64]:
    if light.texture is None and light.texture_path not in textures:
        raise UsdfabError(f"the texture {light.texture_path} was not loaded", place=light.path)
    image = np.asarray(textures[light.texture_path] if light.texture is None else light.texture, dtype=float)
    return np.ascontiguousarray(image)


def _distance2(position: NDArray, center: NDArray, extent: float) -> float:
    return float(max(np.sum((np.asarray(position) - center) ** 2), 0.01 * extent * extent, 1e-12))


def image_distribution(image: NDArray) -> tuple[NDArray, NDArray]:
    """Cumulative distributions for drawing texels by luminance times solid angle: rows (H+1,), columns (H, W+1)."""
    height = image.shape[0]
    sine = np.sin((np.arange(height) + 0.5) * math.pi / height)
    weight = image.max(axis=2) * sine[:, None] + 1e-9 * sine[:, None]
    columns = np.zeros((height, image.shape[1] + 1))
    columns[:, 1:] = np.cumsum(weight, axis=1)
    rows = np.r_[0.0, np.cumsum(columns[:, -1])]
    columns /= columns[:, -1:]
    return rows / rows[-1], columns


@njit(cache=True)
def _texel(cdf, u):
    """Index and place within it for a uniform number."""
    k = min(max(np.searchsorted(cdf, u, side="right") - 1, 0), len(cdf) - 2)
    width = cdf[k + 1] - cdf[k]
    return k, (u - cdf[k]) / width if width > 0.0 else 0.5


@njit(cache=True)
def _frame(x, y, z):
    """Two unit vectors orthogonal to a unit vector (Duff et al. 2017)."""
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@njit(cache=True)
def _dome_uv(light, x, y, z):
    """Texture coordinates in [0, 1]: u around the pole, v from the top, and the sine of the polar angle."""
    lx = light[5] * x + light[6] * y + light[7] * z
    ly = light[8] * x + light[9] * y + light[10] * z
    lz = light[11] * x + light[12] * y + light[13] * z
    norm = math.sqrt(lx * lx + ly * ly + lz * lz)
    polar = math.acos(min(1.0, max(-1.0, ly / norm)))
    u = 0.5 - math.atan2(lx, lz) / (2.0 * math.pi)
    return u - math.floor(u), polar / math.pi, math.sin(polar)


@njit(cache=True)
def _dome_value(lights, light, x, y, z):
    """Radiance from a direction and the solid-angle density with which ``sample_light`` draws it (choice excluded)."""
    if light[14] == 0.0:
        return light[2], light[3], light[4], 0.25 / math.pi
    u, v, sine = _dome_uv(light, x, y, z)
    height, width = lights.image.shape[0], lights.image.shape[1]
    i, j = min(int(v * height), height - 1), min(int(u * width), width - 1)
    texel = lights.image[i, j]
    density = (lights.rows[i + 1] - lights.rows[i]) * height * (lights.columns[i, j + 1] - lights.columns[i, j]) * width
    pdf = density / (2.0 * math.pi * math.pi * max(sine, 1e-9))
    return light[2] * texel[0], light[3] * texel[1], light[4] * texel[2], pdf


@njit(cache=True)
def sample_light(lights, px, py, pz, u0, u1, u2):
    """Choose a light and a place on it, seen from a point.

    Returns
    -------
    (x, y, z, distance, r, g, b, pdf): unit direction, distance, radiance (or intensity / d^2, irradiance) divided by
    the density, and that density over solid angle including the choice of light; 0 for a light without extent.
    A black sample has r = g = b = 0.
    """
    table = lights.table
    chosen = 0
    while chosen < len(table) - 1 and u0 >= table[chosen, 1]:
        u0 -= table[chosen, 1]
        chosen += 1
    light = table[chosen]
    choice = light[1]
    kind = int(light[0])
    none = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if choice <= 0.0:
        return none
    if kind == POINT:
        x, y, z = light[5] - px, light[6] - py, light[7] - pz
        d2 = x * x + y * y + z * z
        d = math.sqrt(d2)
        scale = 1.0 / (d2 * choice)
        return x / d, y / d, z / d, d, light[2] * scale, light[3] * scale, light[4] * scale, 0.0
    if kind == SPHERE:
        x, y, z = light[5] - px, light[6] - py, light[7] - pz
        d2 = x * x + y * y + z * z
        r2 = light[8] * light[8]
        if d2 <= r2:
            return none
        d = math.sqrt(d2)
        x, y, z = x / d, y / d, z / d
        one_minus_cos = r2 / d2 / (1.0 + math.sqrt(1.0 - r2 / d2))
        pdf = choice / (2.0 * math.pi * one_minus_cos)
        cos = 1.0 - u1 * one_minus_cos
        sin = math.sqrt(max(0.0, 1.0 - cos * cos))
        ax, ay, az, bx, by, bz = _frame(x, y, z)
        phi = 2.0 * math.pi * u2
        c, s = sin * math.cos(phi), sin * math.sin(phi)
        wx, wy, wz = cos * x + c * ax + s * bx, cos * y + c * ay + s * by, cos * z + c * az + s * bz
        distance = d * cos - math.sqrt(max(0.0, r2 - d2 * sin * sin))
        return wx, wy, wz, distance, light[2] / pdf, light[3] / pdf, light[4] / pdf, pdf
    if kind == DISTANT:
        x, y, z, cos_max = light[5], light[6], light[7], light[8]
        if cos_max >= _DELTA_COS:
            return x, y, z, FAR, light[9] / choice, light[10] / choice, light[11] / choice, 0.0
        pdf = choice / (2.0 * math.pi * (1.0 - cos_max))
        cos = 1.0 - u1 * (1.0 - cos_max)
        sin = math.sqrt(max(0.0, 1.0 - cos * cos))
        ax, ay, az, bx, by, bz = _frame(x, y, z)
        phi = 2.0 * math.pi * u2
        c, s = sin * math.cos(phi), sin * math.sin(phi)
        wx, wy, wz = cos * x + c * ax + s * bx, cos * y + c * ay + s * by, cos * z + c * az + s * bz
        return wx, wy, wz, FAR, light[2] / pdf, light[3] / pdf, light[4] / pdf, pdf
    if kind == RECT:
        x = light[5] + u1 * light[9] + u2 * light[12] - px
        y = light[6] + u1 * light[10] + u2 * light[13] - py
        z = light[7] + u1 * light[11] + u2 * light[14] - pz
        d2 = x * x + y * y + z * z
        d = math.sqrt(d2)
        x, y, z = x / d, y / d, z / d
        cos = -(x * light[15] + y * light[16] + z * light[17])
        if cos <= 1e-9:
            return none
        pdf = choice * d2 / (cos * light[18])
        return x, y, z, d, light[2] / pdf, light[3] / pdf, light[4] / pdf, pdf
    # Dome.
    if light[14] == 0.0:
        cos = 1.0 - 2.0 * u1
        sin = math.sqrt(max(0.0, 1.0 - cos * cos))
        phi = 2.0 * math.pi * u2
        x, y, z = sin * math.cos(phi), sin * math.sin(phi), cos
    else:
        i, fi = _texel(lights.rows, u1)
        j, fj = _texel(lights.columns[i], u2)
        polar = math.pi * (i + fi) / lights.image.shape[0]
        around = 2.0 * math.pi * ((j + fj) / lights.image.shape[1] - 0.5)
        sin = math.sin(polar)
        lx, ly, lz = -sin * math.sin(around), math.cos(polar), sin * math.cos(around)
        # The dome's rotation is orthogonal up to scale: its inverse is the transpose, renormalised.
        x = light[5] * lx + light[8] * ly + light[11] * lz
        y = light[6] * lx + light[9] * ly + light[12] * lz
        z = light[7] * lx + light[10] * ly + light[13] * lz
        norm = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / norm, y / norm, z / norm
    r, g, b, pdf = _dome_value(lights, light, x, y, z)
    pdf *= choice
    if pdf <= 0.0:
        return none
    return x, y, z, FAR, r / pdf, g / pdf, b / pdf, pdf


@njit(cache=True, inline="always")
def _mis(bsdf_pdf, light_pdf):
    """Balance heuristic for a direction that the BSDF drew; a negative density stands for a camera ray."""
    return 1.0 if bsdf_pdf < 0.0 else bsdf_pdf / (bsdf_pdf + light_pdf)


@njit(cache=True)
def escaped_radiance(lights, x, y, z, bsdf_pdf):
    """Weighted radiance from domes and distant lights for a ray that left the scene."""
    r = g = b = 0.0
    for k in range(len(lights.table)):
        light = lights.table[k]
        kind = int(light[0])
        if kind == DOME:
            lr, lg, lb, pdf = _dome_value(lights, light, x, y, z)
        elif kind == DISTANT and bsdf_pdf >= 0.0 and light[8] < _DELTA_COS:
            if x * light[5] + y * light[6] + z * light[7] < light[8]:
                continue
            lr, lg, lb, pdf = light[2], light[3], light[4], 1.0 / (2.0 * math.pi * (1.0 - light[8]))
        else:
            continue
        w = _mis(bsdf_pdf, light[1] * pdf)
        r, g, b = r + w * lr, g + w * lg, b + w * lb
    return r, g, b


@njit(cache=True)
def hit_light(lights, ox, oy, oz, dx, dy, dz, tmax, bsdf_pdf):
    """Nearest area light along a ray: (t, r, g, b) with weighted radiance; t = tmax and black where there is none."""
    best, r, g, b = tmax, 0.0, 0.0, 0.0
    for k in range(len(lights.table)):
        light = lights.table[k]
        kind = int(light[0])
        if kind == SPHERE:
            x, y, z = light[5] - ox, light[6] - oy, light[7] - oz
            along = x * dx + y * dy + z * dz
            d2 = x * x + y * y + z * z
            r2 = light[8] * light[8]
            under = r2 - (d2 - along * along)
            if under <= 0.0 or d2 <= r2:
                continue
            t = along - math.sqrt(under)
            if t <= 0.0 or t >= best:
                continue
            one_minus_cos = r2 / d2 / (1.0 + math.sqrt(1.0 - r2 / d2))
            w = _mis(bsdf_pdf, light[1] / (2.0 * math.pi * one_minus_cos))
            best, r, g, b = t, w * light[2], w * light[3], w * light[4]
        elif kind == RECT:
            cos = -(dx * light[15] + dy * light[16] + dz * light[17])
            x, y, z = light[5] - ox, light[6] - oy, light[7] - oz
            if abs(cos) <= 1e-9:
                continue
            t = -(x * light[15] + y * light[16] + z * light[17]) / cos
            if t <= 0.0 or t >= best:
                continue
            x, y, z = t * dx - x, t * dy - y, t * dz - z
            uu = light[9] ** 2 + light[10] ** 2 + light[11] ** 2
            vv = light[12] ** 2 + light[13] ** 2 + light[14] ** 2
            uv = light[9] * light[12] + light[10] * light[13] + light[11] * light[14]
            along_u = x * light[9] + y * light[10] + z * light[11]
            along_v = x * light[12] + y * light[13] + z * light[14]
            determinant = uu * vv - uv * uv  # the edges need not be at right angles
            u = (along_u * vv - along_v * uv) / determinant
            v = (along_v * uu - along_u * uv) / determinant
            if u < 0.0 or u > 1.0 or v < 0.0 or v > 1.0:
                continue
            if cos <= 0.0:  # its dark back: opaque
                best, r, g, b = t, 0.0, 0.0, 0.0
                continue
            w = _mis(bsdf_pdf, light[1] * t * t / (cos * light[18]))
            best, r, g, b = t, w * light[2], w * light[3], w * light[4]
    return best, r, g, b
