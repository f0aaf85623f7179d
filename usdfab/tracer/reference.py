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
from itertools import pairwise
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
from usdfab.tracer.knots import spline_vertices
from usdfab.usd.scene import Camera, DistantLight, DomeLight, Light, PointLight, RectLight

_EPSILON = 5e-3
"""Shortest ray, in fiber radii."""
_POINT, _DISTANT, _RECT, _DOME = 0, 1, 2, 3


class Fibers(NamedTuple):
    """Cylinders of one patch, arrays over S segments: start ``a`` and unit ``axis`` (S, 3), ``length``, the spline's
    unit tangents at both ends (S, 3), ``radius``, row of ``materials``. ``low`` and ``high`` (3,) bound them; the patch
    repeats with period ``size`` (2,)."""

    a: NDArray[np.float64]
    axis: NDArray[np.float64]
    length: NDArray[np.float64]
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
        own = np.concatenate([np.arange(first + 1, last - 3) for first, last in pairwise(offsets)])
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
    length = np.linalg.norm(b - a, axis=1)
    axis, size = (b - a) / length[:, None], np.asarray(patch.size)
    return Fibers(a, axis, length, tangent_a, tangent_b, radius, material, np.stack(materials), low, high, size)


@njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _plus(a, s, b):
    """a + s b; vectors are tuples where every segment comes by, which costs no memory."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@njit(cache=True)
def _hit_segment(a, axis, length, tangent_a, tangent_b, radius, o, d):
    """Distance at which a ray enters a cylinder from outside, and the place along it in [0, 1]; inf if it does not."""
    # |o + t d - a| across the axis equals the radius: a quadratic equation in t, whose smaller root is the way in.
    m = _plus(o, -1.0, a)
    d_across, m_across = _plus(d, -_dot(d, axis), axis), _plus(m, -_dot(m, axis), axis)
    qa, qb = _dot(d_across, d_across), _dot(d_across, m_across)
    root = qb * qb - qa * (_dot(m_across, m_across) - radius * radius)
    if qa <= 0.0 or root < 0.0:
        return math.inf, 0.0
    t = (-qb - math.sqrt(root)) / qa
    place = _plus(m, t, d)
    if _dot(place, tangent_a) < 0.0 or _dot(_plus(place, -length, axis), tangent_b) >= 0.0:
        return math.inf, 0.0
    return t, min(max(_dot(place, axis) / length, 0.0), 1.0)


@njit(cache=True)
def _row(x, k):
    return x[k, 0], x[k, 1], x[k, 2]


@njit(cache=True)
def trace(fibers, origin, direction):
    """Nearest fiber along a ray: (distance or inf, segment, place along it, shift of its copy of the patch).

    Every copy of the patch is tried that the ray can touch between the cloth's lowest and highest place.
    """
    o, d = (origin[0], origin[1], origin[2]), (direction[0], direction[1], direction[2])
    best, segment, along, shift = math.inf, -1, 0.0, np.zeros(3)
    if abs(d[2]) < 1e-9:
        return best, segment, along, shift
    t0, t1 = (fibers.low[2] - o[2]) / d[2], (fibers.high[2] - o[2]) / d[2]
    start, end = max(min(t0, t1), 0.0), max(t0, t1)
    x0, x1 = min(o[0] + start * d[0], o[0] + end * d[0]), max(o[0] + start * d[0], o[0] + end * d[0])
    first = math.ceil((x0 - fibers.high[0]) / fibers.size[0])
    last = math.floor((x1 - fibers.low[0]) / fibers.size[0])
    for n in range(last - first + 1 if end > 0.0 else 0):
        # A column of copies, the nearest first, and the part [t0, t1] of the ray that is above or below it.
        i = first + n if d[0] > 0.0 else last - n
        t0, t1 = start, end
        if d[0] != 0.0:
            ta = (fibers.low[0] + i * fibers.size[0] - o[0]) / d[0]
            tb = (fibers.high[0] + i * fibers.size[0] - o[0]) / d[0]
            t0, t1 = max(min(ta, tb), start), min(max(ta, tb), end)
        if t0 > best:
            break
        y0, y1 = min(o[1] + t0 * d[1], o[1] + t1 * d[1]), max(o[1] + t0 * d[1], o[1] + t1 * d[1])
        lower = math.ceil((y0 - fibers.high[1]) / fibers.size[1])
        upper = math.floor((y1 - fibers.low[1]) / fibers.size[1])
        for j in range(lower, upper + 1):
            moved = (i * fibers.size[0], j * fibers.size[1], 0.0)
            from_here = _plus(o, -1.0, moved)
            for k in range(len(fibers.a)):
                ends = _row(fibers.tangent_a, k), _row(fibers.tangent_b, k)
                a, axis = _row(fibers.a, k), _row(fibers.axis, k)
                t, place = _hit_segment(a, axis, fibers.length[k], *ends, fibers.radius[k], from_here, d)
                if _EPSILON * fibers.radius[k] < t < best:
                    best, segment, along, shift = t, k, place, np.array(moved)
    return best, segment, along, shift


@njit(cache=True)
def _sample_light(rng, light, o):
    """Direction to a place on the light, its distance, and radiance over density (or what stands for it)."""
    kind, color = int(light[0]), light[1:4]
    if kind == _POINT:
        way = light[4:7] - o
        distance = math.sqrt(_dot(way, way))
        return way / distance, distance, color / distance**2
    if kind == _DISTANT:
        return -light[4:7], math.inf, color
    if kind == _RECT:
        way = light[4:7] + rng.random() * light[7:10] + rng.random() * light[10:13] - o
        distance = math.sqrt(_dot(way, way))
        wi = way / distance
        area = np.cross(light[7:10], light[10:13])
        cosine = max(-_dot(wi, light[13:16]), 0.0)
        return wi, distance, color * cosine * math.sqrt(_dot(area, area)) / distance**2
    # A dome of one colour: all directions alike.
    z, phi = 2.0 * rng.random() - 1.0, 2.0 * math.pi * rng.random()
    sine = math.sqrt(1.0 - z * z)
    return np.array([sine * math.cos(phi), sine * math.sin(phi), z]), math.inf, 4.0 * math.pi * color


@njit(cache=True)
def _radiance(rng, fibers, lights, o, d, max_depth):
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
        normal = o - shift - (fibers.a[k] + s * fibers.length[k] * fibers.axis[k])
        normal -= _dot(normal, axis) * axis
        normal /= math.sqrt(_dot(normal, normal))
        ax, ay, az = axis
        nx, ny, nz = normal
        material = load_fiber(fibers.materials, fibers.material[k])
        sin_to, cos_to, h, ex, ey, ez, fx, fy, fz = fiber_frame(ax, ay, az, nx, ny, nz, -d[0], -d[1], -d[2])
        prepared = prepare_fiber(material, h, sin_to, cos_to)

        # Direct light from every light.
        for light in lights:
            wi, distance, emitted = _sample_light(rng, light, o)
            sin_ti, cos_ti, phi = fiber_angles(ax, ay, az, ex, ey, ez, fx, fy, fz, wi[0], wi[1], wi[2])
            red, green, blue, _pdf = eval_fiber(material, prepared, sin_ti, cos_ti, phi)
            if trace(fibers, o, wi)[0] >= distance:  # infinity for light from infinity that meets nothing
                radiance += beta * np.array([red, green, blue]) * emitted

        # Onward in a direction that the BSDF draws.
        u0, u1, u2, u3 = rng.random(), rng.random(), rng.random(), rng.random()
        sin_ti, cos_ti, phi, red, green, blue, pdf = sample_fiber(material, prepared, u0, u1, u2, u3)
        if pdf <= 0.0:
            break
        beta *= np.array([red, green, blue])
        x, y, z = fiber_direction(ax, ay, az, ex, ey, ez, fx, fy, fz, sin_ti, cos_ti, phi)
        d = np.array([x, y, z])
    return radiance


@njit(cache=True)
def _render(rng, fibers, lights, to_world, film, origin, width, height, spp, max_depth):
    mean, squares = np.zeros((height, width, 3)), np.zeros((height, width, 3))
    start = to_world[:3, 3] + origin
    for row in range(height):
        for column in range(width):
            for _ in range(spp):
                s = 2.0 * (column + rng.random()) / width - 1.0
                t = 1.0 - 2.0 * (row + rng.random()) / height
                d = np.array([film[0] * (s + film[2]), film[1] * (t + film[3]), -1.0])
                d /= math.sqrt(_dot(d, d))
                x, y, z = to_world[0, :3], to_world[1, :3], to_world[2, :3]
                sample = _radiance(
                    rng, fibers, lights, start, np.array([_dot(x, d), _dot(y, d), _dot(z, d)]), max_depth
                )
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
    mean, variance = _render(
        np.random.default_rng(seed), fibers, packed, to_world, film, shift, *resolution, spp, max_depth
    )
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
