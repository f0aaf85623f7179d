"""Lights: packed into one array, chosen, sampled and evaluated in kernels.

Row of the array: 0 kind, 1 power, 2:5 emission (RGB), then by kind:

- point: 5:8 position; emission is radiant intensity (W/sr)
- sphere: 5:8 centre, 8 radius; emission is radiance
- distant: 5:8 direction towards the light, 8 cosine of the half angle, 9:12 irradiance; emission is radiance
- rect: 5:8 corner, 9:12 and 12:15 edges, 15:18 unit normal (the side that shines), 18 area, 19 is 1 if the edges are at
  right angles; emission is radiance
- disk (or ellipse): 5:8 centre, 9:12 and 12:15 half axes, 15:19 as for rect
- cylinder: 5:8 centre, 8 radius, 9:12 unit axis, 12 half its length; emission is radiance
- dome: 5:14 rotation world -> dome (rows), 14 is 1 with a texture; emission is radiance or its multiplier

and of lights at a place 20:23 the middle, 23 the projected area over pi.

Visibility: rectangles and disks are opaque, their backs dark. Spheres and cylinders (tubes without ends) shine outward
and cannot be seen from inside: a ray from in there passes, as does one that enters a tube by its open end.

Choice: of several lights one is drawn at each shading point by what it may throw there at most, see ``_importance``.
Densities therefore depend on the point where the BSDF drew the direction, and ``hit_light`` and ``escaped_radiance``
take that point beside the ray, whose origin may have moved on (through a slab, or past a cut-out).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.tracer.dome import dome_value, image_distribution, sample_dome
from usdfab.tracer.light_shapes import (
    area_density,
    cylinder_density,
    hit_cylinder,
    hit_disk,
    hit_rect,
    hit_sphere,
    rect_density,
    sample_cone,
    sample_cylinder,
    sample_disk,
    sample_rect,
    sample_sphere,
    sphere_density,
)
from usdfab.usd.scene import (
    CylinderLight,
    DistantLight,
    DomeLight,
    Light,
    PointLight,
    RectLight,
    Scene,
    SphereLight,
)

POINT, SPHERE, DISTANT, RECT, DOME, DISK, CYLINDER = range(7)
COLUMNS = 24
_DELTA_COS = 1.0 - 1e-9
FAR = 1e30

_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}
_INLINE: dict[str, Any] = {**_OPTIONS, "forceinline": True}


class Lights(NamedTuple):
    """Packed lights. ``table`` (L, COLUMNS); the dome's texture with its distribution over rows and columns; whether
    no light has an extent, so that no ray can meet one."""

    table: NDArray[np.float64]
    image: NDArray[np.float32]
    rows: NDArray[np.float64]
    columns: NDArray[np.float32]
    deltas: bool


def pack_lights(scene: Scene, textures: Mapping[str, NDArray[np.float32]]) -> Lights:
    """Lights of a scene as arrays; ``textures`` maps dome texture paths to linear images (H, W, 3).

    Raises
    ------
    UsdfabError
        For a second textured dome, a texture that was not loaded, and a light without area or with numbers that are
        not finite.
    """
    table = np.zeros((len(scene.lights), COLUMNS))
    image = np.zeros((1, 1, 3), dtype=np.float32)
    rows, columns = np.zeros(2), np.zeros((1, 2), dtype=np.float32)
    textured = False
    for light, record in zip(scene.lights, table, strict=True):
        _pack(light, record)
        if isinstance(light, DomeLight) and record[14] == 1.0:
            if textured:
                raise UsdfabError("a second dome light with a texture", place=light.path, remedy="keep one of them")
            textured = True
            image = _texture(light, textures)
            rows, columns = image_distribution(image)
            record[1] *= image.mean(dtype=np.float64)
        if not np.isfinite(record).all():
            raise UsdfabError("the light has numbers that are not finite", place=light.path, remedy="repair it")
    deltas = (table[:, 0] == POINT) | ((table[:, 0] == DISTANT) & (table[:, 8] >= _DELTA_COS))
    return Lights(table, image, rows, columns, bool(deltas.all()))


def _pack(light: Light, record: NDArray[np.float64]) -> None:
    """Fill a row. Power is irradiance times squared distance, or irradiance for light from infinity."""
    if isinstance(light, PointLight):
        record[0], record[2:5], record[5:8] = POINT, light.intensity, light.position
        record[1], record[20:23], record[23] = np.max(light.intensity), light.position, 1e-12
    elif isinstance(light, DistantLight):
        cos = math.cos(light.half_angle)
        projected = math.pi * (1.0 - max(cos, 0.0) ** 2)  # of the part in front of a surface that faces the light
        record[0], record[5:8], record[8] = DISTANT, -np.asarray(light.direction), cos
        record[9:12] = light.irradiance
        record[2:5] = np.asarray(light.irradiance) / projected if cos < _DELTA_COS else 0.0
        record[1] = np.max(light.irradiance)
    elif isinstance(light, DomeLight):
        record[0], record[2:5] = DOME, light.radiance
        record[5:14] = np.linalg.inv(light.to_world[:3, :3]).ravel()
        record[14] = float(light.texture is not None or bool(light.texture_path))
        record[1] = math.pi * np.max(light.radiance)
    else:
        if isinstance(light, SphereLight):
            area = math.pi * light.radius * light.radius  # inf where a square would raise
            record[0], record[5:8], record[8] = SPHERE, light.center, light.radius
            record[20:23] = light.center
        elif isinstance(light, CylinderLight):
            half = float(np.linalg.norm(light.half))
            area = 4.0 * light.radius * half
            record[0], record[5:8], record[8] = CYLINDER, light.center, light.radius
            record[9:12], record[12] = light.half / (half or 1.0), half
            record[20:23] = light.center
        else:
            u, v = (light.edge_u, light.edge_v) if isinstance(light, RectLight) else (light.axis_u, light.axis_v)
            area = float(np.linalg.norm(np.cross(u, v)))
            record[9:12], record[12:15], record[15:18] = u, v, light.normal
            if isinstance(light, RectLight):
                record[0], record[5:8], record[20:23] = RECT, light.corner, light.corner + 0.5 * (u + v)
                record[19] = float(abs(np.dot(u, v)) <= 1e-9 * area)
            else:
                area *= math.pi
                record[0], record[5:8], record[20:23] = DISK, light.center, light.center
            record[18] = area
        if not area > 0.0:
            raise UsdfabError("the light has no area", place=light.path, remedy="give it a size above 0")
        record[2:5], record[1], record[23] = light.radiance, np.max(light.radiance) * area, area / math.pi


def _texture(light: DomeLight, textures: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    if light.texture is None and light.texture_path not in textures:
        raise UsdfabError(f"the texture {light.texture_path} was not loaded", place=light.path)
    image = textures[light.texture_path] if light.texture is None else light.texture
    return np.ascontiguousarray(image, dtype=np.float32)


# --- choice ----------------------------------------------------------------------------------------------------------


@njit(**_INLINE)
def _load(t, k):
    """Row k as a tuple: a view would count a reference, an atomic operation on one counter for all threads."""
    return (
        *(t[k, 0], t[k, 1], t[k, 2], t[k, 3], t[k, 4], t[k, 5], t[k, 6], t[k, 7], t[k, 8], t[k, 9], t[k, 10], t[k, 11]),
        *(t[k, 12], t[k, 13], t[k, 14], t[k, 15], t[k, 16], t[k, 17], t[k, 18], t[k, 19], t[k, 20], t[k, 21]),
        *(t[k, 22], t[k, 23]),
    )


@njit(**_INLINE)
def _importance(table, k, px, py, pz):
    """Irradiance that light k may throw at a point, on a surface that faces it: power / (distance^2 + area / pi).

    Right from far away, pi times the radiance close by; 0 behind a flat light.
    """
    kind = int(table[k, 0])
    if kind in (DISTANT, DOME):
        return table[k, 1]
    x, y, z = px - table[k, 20], py - table[k, 21], pz - table[k, 22]
    if kind in (RECT, DISK) and x * table[k, 15] + y * table[k, 16] + z * table[k, 17] <= 0.0:
        return 0.0
    return table[k, 1] / (x * x + y * y + z * z + table[k, 23])


@njit(**_OPTIONS)
def _choice(table, k, px, py, pz):
    """Probability that ``sample_light`` chooses light k at a point."""
    if len(table) == 1:
        return 1.0
    total = 0.0
    for other in range(len(table)):
        total += _importance(table, other, px, py, pz)
    return _importance(table, k, px, py, pz) / total if total > 0.0 else 0.0


@njit(**_OPTIONS)
def _choose(table, px, py, pz, u):
    """A light and the probability of choosing it, in one pass (reservoir sampling with one number)."""
    if len(table) == 1:
        return 0, 1.0
    chosen, weight, total = 0, 0.0, 0.0
    for k in range(len(table)):
        w = _importance(table, k, px, py, pz)
        if w <= 0.0:
            continue
        total += w
        share = w / total
        if u < share:
            chosen, weight = k, w
            u /= share
        else:
            u = (u - share) / (1.0 - share)
    return chosen, weight / total if total > 0.0 else 0.0


# --- what the path tracer calls --------------------------------------------------------------------------------------


@njit(**_OPTIONS)
def sample_light(lights, px, py, pz, u0, u1, u2):
    """Choose a light and a place on it, seen from a point.

    Returns
    -------
    (x, y, z, distance, r, g, b, pdf): unit direction, distance, radiance (or intensity / d^2, irradiance) divided by
    the density, and that density over solid angle including the choice of light; 0 for a light without extent.
    A black sample has r = g = b = 0.
    """
    table = lights.table
    k, choice = _choose(table, px, py, pz, u0)
    light = _load(table, k)
    kind = int(light[0])
    none = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if choice <= 0.0:
        return none
    r, g, b = light[2], light[3], light[4]
    distance = FAR
    if kind == POINT:
        x, y, z = light[5] - px, light[6] - py, light[7] - pz
        d2 = x * x + y * y + z * z
        if d2 <= 0.0:
            return none
        d = math.sqrt(d2)
        scale = 1.0 / (d2 * choice)
        return x / d, y / d, z / d, d, r * scale, g * scale, b * scale, 0.0
    if kind == DISTANT and light[8] >= _DELTA_COS:
        return light[5], light[6], light[7], FAR, light[9] / choice, light[10] / choice, light[11] / choice, 0.0
    if kind == DISTANT:
        x, y, z, _cos = sample_cone(light[5], light[6], light[7], 1.0 - light[8], u1, u2)
        pdf = 1.0 / (2.0 * math.pi * (1.0 - light[8]))
    elif kind == SPHERE:
        x, y, z, distance, pdf = sample_sphere(light, px, py, pz, u1, u2)
    elif kind == RECT:
        x, y, z, distance, pdf = sample_rect(light, px, py, pz, u1, u2)
    elif kind == DISK:
        x, y, z, distance, pdf = sample_disk(light, px, py, pz, u1, u2)
    elif kind == CYLINDER:
        x, y, z, distance, pdf = sample_cylinder(light, px, py, pz, u1, u2)
    elif light[14] == 0.0:
        x, y, z, _cos = sample_cone(0.0, 0.0, 1.0, 2.0, u1, u2)
        pdf = 0.25 / math.pi
    else:
        x, y, z = sample_dome(light, lights.rows, lights.columns, u1, u2)
        r, g, b, pdf = dome_value(light, lights.image, lights.rows, lights.columns, x, y, z)
    pdf *= choice
    if pdf <= 0.0:
        return none
    return x, y, z, distance, r / pdf, g / pdf, b / pdf, pdf


@njit(**_INLINE)
def _mis(bsdf_pdf, light_pdf):
    """Balance heuristic for a direction that the BSDF drew."""
    return bsdf_pdf / (bsdf_pdf + light_pdf)


@njit(**_OPTIONS)
def escaped_radiance(lights, x, y, z, bsdf_pdf, px, py, pz):
    """Weighted radiance (r, g, b) from domes and distant lights for a ray that left the scene.

    Parameters
    ----------
    x, y, z: float
        Unit direction.
    bsdf_pdf: float
        Density over solid angle with which the BSDF drew it; negative for a camera ray, which takes all.
    px, py, pz: float
        Where the BSDF drew it, the point for which ``sample_light`` would have been called; any for a camera ray.
    """
    table = lights.table
    r = g = b = 0.0
    for k in range(len(table)):
        kind = int(table[k, 0])
        if kind == DOME:
            light = _load(table, k)
            lr, lg, lb, pdf = light[2], light[3], light[4], 0.25 / math.pi
            if light[14] != 0.0:
                lr, lg, lb, pdf = dome_value(light, lights.image, lights.rows, lights.columns, x, y, z)
        elif kind == DISTANT and bsdf_pdf >= 0.0 and table[k, 8] < _DELTA_COS:
            light = _load(table, k)
            if x * light[5] + y * light[6] + z * light[7] < light[8]:
                continue
            lr, lg, lb, pdf = light[2], light[3], light[4], 1.0 / (2.0 * math.pi * (1.0 - light[8]))
        else:
            continue
        w = 1.0 if bsdf_pdf < 0.0 else _mis(bsdf_pdf, _choice(table, k, px, py, pz) * pdf)
        r, g, b = r + w * lr, g + w * lg, b + w * lb
    return r, g, b


@njit(**_INLINE)
def _hit(light, ox, oy, oz, dx, dy, dz):
    """(t, cosine) of a ray with an area light of any kind: t <= 0 for none, cosine < 0 for a dark back."""
    kind = int(light[0])
    if kind == SPHERE:
        return hit_sphere(light, ox, oy, oz, dx, dy, dz), 1.0
    if kind == RECT:
        return hit_rect(light, ox, oy, oz, dx, dy, dz)
    if kind == DISK:
        return hit_disk(light, ox, oy, oz, dx, dy, dz)
    if kind == CYLINDER:
        return hit_cylinder(light, ox, oy, oz, dx, dy, dz), 1.0
    return -1.0, 1.0


@njit(**_OPTIONS)
def light_blocks(lights, ox, oy, oz, dx, dy, dz, tmax):
    """Whether an area light, its dark back included, lies on a ray before ``tmax``."""
    table = lights.table
    for k in range(len(table)):
        t, _cos = _hit(_load(table, k), ox, oy, oz, dx, dy, dz)
        if 0.0 < t < tmax:
            return True
    return False


@njit(**_OPTIONS)
def hit_light(lights, ox, oy, oz, dx, dy, dz, tmax, bsdf_pdf, px, py, pz):
    """Nearest area light along a ray: (t, r, g, b) with weighted radiance; t = tmax and black where there is none.

    Parameters
    ----------
    bsdf_pdf, px, py, pz: float
        As for ``escaped_radiance``: density of the direction, and where it was drawn, on the ray or behind its origin.
    """
    table = lights.table
    best, cos, nearest = tmax, 0.0, -1
    for k in range(len(table)):
        t, c = _hit(_load(table, k), ox, oy, oz, dx, dy, dz)
        if 0.0 < t < best:
            best, cos, nearest = t, c, k
    if nearest < 0 or cos <= 0.0:
        return best, 0.0, 0.0, 0.0
    light = _load(table, nearest)
    w = 1.0
    if bsdf_pdf >= 0.0:
        kind = int(light[0])
        qx, qy, qz = ox + best * dx - px, oy + best * dy - py, oz + best * dz - pz
        if kind == SPHERE:
            pdf = sphere_density(light, px, py, pz)
        elif kind == RECT:
            pdf = rect_density(light, px, py, pz, qx, qy, qz, cos)
        elif kind == DISK:
            pdf = area_density(light, qx, qy, qz, cos)
        else:
            pdf = cylinder_density(light, px, py, pz, qx, qy, qz)
        w = _mis(bsdf_pdf, _choice(table, nearest, px, py, pz) * pdf)
    return best, w * light[2], w * light[3], w * light[4]
