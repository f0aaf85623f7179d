"""A path tracer to be read, and to test the fast one against: one flat cloth, every ray against every fiber.

What it leaves out: Embree, hierarchies, tiles that wrap, slabs and meshes, multiple importance sampling, Russian
roulette, threads. What it shares with the fast tracer: the fiber BSDF (``scattering.fiber_numba``), which has its own
tests, and the points on the splines. When to use it: in tests, with a few dozen fibers; its time grows with the number
of segments, and it finds lights by next-event estimation only.

The cloth lies in z = 0 of the world and repeats for ever; the place ``origin`` of the cloth is at the world's origin.
A fiber is a chain of cylinders, each cut off at both ends by the plane normal to the spline's tangent there: what
Embree draws up to the square of the angle of a bend.

Notation: ``o``, ``d`` start and direction of a ray, ``beta`` throughput, ``wi`` direction to the light. All in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fibers import Patch, generate_patch
from usdfab.scattering.fiber_numba import (
    eval_fiber,
    fiber_angles,
    fiber_direction,
    fiber_frame,
    load_fiber,
    pack_fiber,
    prepare_fiber,
    sample_fiber,
)
from usdfab.tracer.patch_scene import spline_vertices
from usdfab.usd.scene import Camera, DistantLight, DomeLight, Light, PointLight, RectLight

_EPSILON = 5e-3
"""Shortest ray, in fiber radii."""
_POINT, _DISTANT, _RECT, _DOME = 0, 1, 2, 3


class Fibers(NamedTuple):
    """Cylinders of one patch, arrays over S segments: ends ``a``, ``b`` and unit tangents there (S, 3), ``radius``,
    row of ``materials``. ``low``, ``high`` (3,) bound them; the patch repeats with period ``size`` (2,)."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    tangent_a: NDArray[np.float64]
    tangent_b: NDArray[np.float64]
    radius: NDArray[np.float64]
    material: NDArray[np.int64]
    materials: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    size: NDArray[np.float64]


def reference_fibers(fabric: FabricParameters, patch: Patch | None = None) -> Fibers:
    """The segments of a fabric's patch (or of the given one), each once."""
    patch = patch or generate_patch(fabric)
    columns: list[list[NDArray]] = [[] for _ in range(6)]
    materials: list[NDArray] = []
    for system in patch.systems:
        yarn = fabric.system(system.system)
        points, tangents, offsets = spline_vertices(system)
        # One vertex before each curve and three after it serve the fast tracer; a curve's own n segments follow.
        own = np.concatenate([np.arange(first + 1, last - 3) for first, last in zip(offsets, offsets[1:], strict=False)])
        curve = np.repeat(np.arange(system.curves), np.diff(offsets) - 4)
        parts = (points[own], points[own + 1], tangents[own], tangents[own + 1], np.full(len(own), system.radius))
        for column, part in zip(columns, (*parts, curve + len(materials)), strict=True):
            column.append(part)
        for color in system.albedo:
            roughness = yarn.roughness_longitudinal, yarn.roughness_azimuthal, yarn.roughness_primary
            materials.append(pack_fiber(np.maximum(color, 1e-4), *roughness, yarn.ior, yarn.cuticle_tilt))
    a, b, tangent_a, tangent_b, radius, material = (np.concatenate(c) for c in columns)
    low = np.minimum(a, b).min(axis=0) - radius.max()
    high = np.maximum(a, b).max(axis=0) + radius.max()
    size = np.asarray(patch.size)
    return Fibers(a, b, tangent_a, tangent_b, radius, material, np.stack(materials), low, high, size)


@njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _hit_segment(fibers, k, o, d):  # type: ignore[no-untyped-def]
    """Distance at which a ray enters cylinder k from outside, and the place along it in [0, 1]; inf if it does not."""
    a, b = fibers.a[k], fibers.b[k]
    length = math.sqrt(_dot(b - a, b - a))
    axis = (b - a) / length
    # |o + t d - a| across the axis equals the radius: a quadratic equation in t, whose smaller root is the way in.
    m = o - a
    d_across, m_across = d - _dot(d, axis) * axis, m - _dot(m, axis) * axis
    qa, qb = _dot(d_across, d_across), _dot(d_across, m_across)
    root = qb * qb - qa * (_dot(m_across, m_across) - fibers.radius[k] ** 2)
    if qa <= 0.0 or root < 0.0:
        return math.inf, 0.0
    t = (-qb - math.sqrt(root)) / qa
    place = m + t * d
    if _dot(place, fibers.tangent_a[k]) < 0.0 or _dot(place + a - b, fibers.tangent_b[k]) >= 0.0:
        return math.inf, 0.0
    return t, min(max(_dot(place, axis) / length, 0.0), 1.0)


@njit(cache=True)
def trace(fibers, o, d):  # type: ignore[no-untyped-def]
    """Nearest fiber along a ray: (distance or inf, segment, place along it, shift of its copy of the patch).

    Every copy of the patch is tried that the ray can touch between the cloth's lowest and highest place.
    """
    best, segment, along, shift = math.inf, -1, 0.0, np.zeros(3)
    if abs(d[2]) < 1e-9:
        return best, segment, along, shift
    t0, t1 = (fibers.low[2] - o[2]) / d[2], (fibers.high[2] - o[2]) / d[2]
    start, end = o + max(min(t0, t1), 0.0) * d, o + max(t0, t1) * d
    if max(t0, t1) <= 0.0:
        return best, segment, along, shift
    copies = np.zeros((2, 2), dtype=np.int64)
    for x in range(2):
        copies[x, 0] = math.floor((min(start[x], end[x]) - fibers.high[x]) / fibers.size[x])
        copies[x, 1] = math.ceil((max(start[x], end[x]) - fibers.low[x]) / fibers.size[x])
    for i in range(copies[0, 0], copies[0, 1] + 1):
        for j in range(copies[1, 0], copies[1, 1] + 1):
            moved = np.array([i * fibers.size[0], j * fibers.size[1], 0.0])
            for k in range(len(fibers.a)):
                t, place = _hit_segment(fibers, k, o - moved, d)
                if _EPSILON * fibers.radius[k] < t < best:
                    best, segment, along, shift = t, k, place, moved
    return best, segment, along, shift


@njit(cache=True)
def _sample_light(light, o):  # type: ignore[no-untyped-def]
    """Direction to a place on the light, its distance, and radiance over density (or what stands for it)."""
    kind, color = int(light[0]), light[1:4]
    if kind == _POINT:
        way = light[4:7] - o
        distance = math.sqrt(_dot(way, way))
        return way / distance, distance, color / distance**2
    if kind == _DISTANT:
        return -light[4:7], math.inf, color
    if kind == _RECT:
        way = light[4:7] + np.random.random() * light[7:10] + np.random.random() * light[10:13] - o
        distance = math.sqrt(_dot(way, way))
        wi = way / distance
        area = np.cross(light[7:10], light[10:13])
        cosine = max(-_dot(wi, light[13:16]), 0.0)
        return wi, distance, color * cosine * math.sqrt(_dot(area, area)) / distance**2
    # A dome of one colour: all directions alike.
    z, phi = 2.0 * np.random.random() - 1.0, 2.0 * math.pi * np.random.random()
    sine = math.sqrt(1.0 - z * z)
    return np.array([sine * math.cos(phi), sine * math.sin(phi), z]), math.inf, 4.0 * math.pi * color


@njit(cache=True)
def _radiance(fibers, lights, o, d, max_depth):  # type: ignore[no-untyped-def]
    """One sample of the radiance that comes along a ray, against ``d``."""
    radiance, beta = np.zeros(3), np.ones(3)
    for depth in range(1, max_depth + 1):
        t, k, s, shift = trace(fibers, o, d)
        if k < 0:
            if depth == 1:  # seen directly; later vertices have counted it by next-event estimation
                for light in lights:
                    if light[0] == _DOME:
                        radiance += light[1:4]
            break
        if depth == max_depth:
            break
        # The fiber's frame at the hit: axis along the spline, normal across it.
        o = o + t * d
        axis = (1.0 - s) * fibers.tangent_a[k] + s * fibers.tangent_b[k]
        axis /= math.sqrt(_dot(axis, axis))
        normal = o - shift - (fibers.a[k] + s * (fibers.b[k] - fibers.a[k]))
        normal -= _dot(normal, axis) * axis
        normal /= math.sqrt(_dot(normal, normal))
        ax, ay, az = axis
        nx, ny, nz = normal
        material = load_fiber(fibers.materials, fibers.material[k])
        sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -d[0], -d[1], -d[2])
        prepared = prepare_fiber(material, h, sin_to, cos_to)

        # Direct light from every light.
        for light in lights:
            wi, distance, emitted = _sample_light(light, o)
            sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wi[0], wi[1], wi[2])
            red, green, blue, _pdf = eval_fiber(material, prepared, sin_ti, cos_ti, phi)
            if trace(fibers, o, wi)[0] > distance * (1.0 - 1e-9):
                radiance += beta * np.array([red, green, blue]) * emitted

        # Onward in a direction that the BSDF draws.
        u0, u1, u2, u3 = np.random.random(), np.random.random(), np.random.random(), np.random.random()
        sin_ti, cos_ti, phi, red, green, blue, pdf = sample_fiber(material, prepared, u0, u1, u2, u3)
        if pdf <= 0.0:
            break
        beta *= np.array([red, green, blue])
        x, y, z = fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi)
        d = np.array([x, y, z])
    return radiance


@njit(cache=True)
def _render(fibers, lights, to_world, film, origin, width, height, spp, max_depth, seed):  # type: ignore[no-untyped-def]
    np.random.seed(seed)
    mean, squares = np.zeros((height, width, 3)), np.zeros((height, width, 3))
    start = to_world[:3, 3] + origin
    for row in range(height):
        for column in range(width):
            for _ in range(spp):
                s = 2.0 * (column + np.random.random()) / width - 1.0
                t = 1.0 - 2.0 * (row + np.random.random()) / height
                d = np.array([film[0] * (s + film[2]), film[1] * (t + film[3]), -1.0])
                d /= math.sqrt(_dot(d, d))
                x, y, z = to_world[0, :3], to_world[1, :3], to_world[2, :3]
                sample = _radiance(fibers, lights, start, np.array([_dot(x, d), _dot(y, d), _dot(z, d)]), max_depth)
                mean[row, column] += sample / spp
                squares[row, column] += sample**2 / spp
    return mean, (squares - mean**2) / max(spp - 1, 1)


def render_reference(
    fibers: Fibers,
    camera: Camera,
    lights: tuple[Light, ...],
    resolution: tuple[int, int],
    spp: int,
    max_depth: int,
    origin: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Render the flat cloth ``fibers``.

    Parameters
    ----------
    lights:
        Point lights, distant lights without extent, rectangles, domes of one colour.
    resolution: (width, height) in pixels
    origin: (2,) metres
        The place of the cloth at the world's origin.

    Returns
    -------
    pixels, variance: (H, W, 3)
        Linear, at exposure 0, and the variance of the pixels.

    Cost: about 10 ns for each ray, segment and copy of the patch.
    """
    shift = np.array([*origin, 0.0])
    packed = np.stack([_pack(light, shift) for light in lights])
    film = np.r_[camera.tan_half, camera.offset]
    to_world = np.ascontiguousarray(camera.to_world, dtype=float)
    mean, variance = _render(fibers, packed, to_world, film, shift, *resolution, spp, max_depth, seed)
    return mean, variance


def _pack(light: Light, shift: NDArray) -> NDArray[np.float64]:
    row = np.zeros(16)
    if isinstance(light, PointLight):
        row[0], row[1:4], row[4:7] = _POINT, light.intensity, light.position + shift
    elif isinstance(light, DistantLight) and light.half_angle == 0.0:
        row[0], row[1:4], row[4:7] = _DISTANT, light.irradiance, light.direction
    elif isinstance(light, RectLight):
        row[0], row[1:4], row[4:7] = _RECT, light.radiance, light.corner + shift
        row[7:10], row[10:13], row[13:16] = light.edge_u, light.edge_v, light.normal
    elif isinstance(light, DomeLight) and light.texture is None and not light.texture_path:
        row[0], row[1:4] = _DOME, light.radiance
    else:
        raise UsdfabError(f"the reference path tracer has no {type(light).__name__} of this kind", place=light.path)
    return row
