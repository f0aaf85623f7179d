"""Paths of light through fibers in Dr.Jit, forward for the picture and backward for the gradient.

``radiance`` is a path tracer: at each hit a light is sampled and the fiber's BSDF is, detached from its parameters.
``gradient`` backpropagates along such paths. Path replay (Vicini et al. 2021) traces every path twice, once for its
radiance and once for its derivatives, because a path's hits are too much to keep in memory for all pixels. But the
hits of the few paths that a core works on are not: here a path writes what its BSDF was asked at each hit
(``Vertex``) to memory of its own thread, then walks back over it, from the last hit to the first, with

    L_k = f_k E_k + (f_k' / p_k') / q_k (G_k + L_k+1)

    f_k, f_k'  value of the BSDF (times cosine) towards the light sample and the next vertex
    E_k        sampled light that arrives, over the sample's density, with its weight; 0 in shadow
    p_k', q_k  density of the direction to the next vertex, probability that the path went on
    G_k        light that shines at the end of that direction, with its weight

of which f_k and f_k' are differentiated with the adjoint beta_k dJ/dL_0. Nothing is traced or drawn a second time and
nothing is divided out or subtracted. Derivatives are kept by path, too, and added up at its end.

References: Vicini, Speierer, Jakob, Path replay backpropagation, ACM TOG 40(4), 2021 (detached sampling, attached
values); Chiang et al. 2015 by `usdfab.scattering.fiber_drjit`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from usdfab.mi.fiber_tables import LEAF_COUNT, Tables, leaf_values, with_leaves
from usdfab.scattering.fiber_drjit import PackedFiber, azimuth, eval_fiber, prepare_fiber, sample_fiber

ROULETTE_FROM = 5
"""Vertices before paths may end by chance, as in Mitsuba's integrators."""

GO_ON = 0.95
"""Largest probability with which a path goes on."""


class Stage:
    """What paths run in; not a dataclass, whose fields Dr.Jit's loops would take for variables.

    Parameters
    ----------
    scene:
        Mitsuba's scene.
    fibers:
        Its one shape of curves.
    color_of_segment: UInt32
        The row in ``Optics.albedo`` of each segment of a curve.
    colors, warp_colors:
        Number of rows, and how many of them, the first ones, are the warp's.
    alone:
        Nothing but fibers can be hit, and no light: all lights are points and directions.
    vertices:
        Most hits of a path.
    """

    def __init__(
        self, scene: Any, fibers: Any, color_of_segment: Any, colors: int, warp_colors: int, alone: bool, vertices: int
    ) -> None:
        self.scene = scene
        self.fibers = fibers
        self.color_of_segment = color_of_segment
        self.colors = colors
        self.warp_colors = warp_colors
        self.alone = alone
        self.vertices = vertices


class Vertex(NamedTuple):
    """What is needed of a hit to differentiate it; directions in its frame (axis y, normal z)."""

    color: Any  # row in the albedos
    viewer: Any  # direction to where the path comes from, three components
    light_direction: Any  # of the light sample: sine and cosine of inclination, azimuth
    light: Any  # E
    next_direction: Any  # to the next vertex: sine and cosine of inclination, azimuth
    beta: Any  # throughput up to here
    go_on: Any  # 1 / q


def material(stage: Stage, tables: Tables, color: Any) -> PackedFiber:
    """The fiber material of each lane, from its row in the albedos."""
    is_warp = color < stage.warp_colors

    def choose(a: Any, b: Any) -> Any:
        return tuple(map(choose, a, b)) if isinstance(a, tuple) else dr.select(is_warp, a, b)

    warp, weft = tables.systems
    fields = {
        name: choose(getattr(warp, name), getattr(weft, name)) for name in warp._fields if name not in ("sigma", "tilt")
    }
    return warp._replace(sigma=dr.gather(mi.Color3f, tables.sigma, color), **fields)


@dr.syntax
def trace(
    stage: Stage, tables: Tables, ray: Any, seeds: tuple[Any, Any], memory: Any, glow: Any, recording: bool
) -> tuple[Any, Any, Any, Any]:
    """Trace paths: their radiance, or what ``walk_back`` needs of them.

    Parameters
    ----------
    ray: Ray3f
        From the camera.
    seeds: UInt32, UInt32
        State and stream of each path's random numbers.
    memory, glow: Local
        Where vertices (``Vertex``), and light that paths run into after them (G), are written if ``recording``.

    Returns
    -------
    radiance: Color3f
        0 if ``recording``.
    count: UInt32
        Vertices of each path.
    memory, glow:
        As given.
    """
    rng = mi.PCG32(1, seeds[0], seeds[1])
    ray = mi.Ray3f(ray)
    radiance, beta = mi.Color3f(0.0), mi.Color3f(1.0)
    active = mi.Bool(True)
    count = mi.UInt32(0)
    # Of the vertex before, for the weight of light that a path runs into.
    before, density = dr.zeros(mi.Interaction3f), mi.Float(0.0)

    while dr.hint(active, max_iterations=stage.vertices + 1, label="fiber paths"):
        hit = stage.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active)
        active &= si.is_valid() if stage.alone else True
        if dr.hint(not stage.alone, mode="scalar"):
            first = count == 0
            shone = _shone_upon(stage.scene, si, before, density, first, active)
            if dr.hint(recording, mode="scalar"):
                glow.write(shone, dr.maximum(count, 1) - 1, active & ~first)
            else:
                radiance += dr.select(active, beta * shone, 0.0)
            active &= si.is_valid() & (si.shape == mi.ShapePtr(stage.fibers)) & (count < stage.vertices)

        # One hit in about 10^5 has a normal, but a tangent that is not a number: paths end there.
        active &= dr.isfinite(si.wi.x) & dr.isfinite(si.wi.y)
        color = dr.gather(mi.UInt32, stage.color_of_segment, si.prim_index, active)
        packed = material(stage, tables, color)
        prepared = prepare_fiber(packed, si.wi.x, si.wi.y, si.wi.z)

        # --- A light ---
        number = rng.next_float32()
        if dr.hint(stage.alone, mode="scalar"):
            point = mi.Point2f(number, 0.5)
        else:
            point = mi.Point2f(number, rng.next_float32())
        sample, light = stage.scene.sample_emitter_direction(si, point, True, active)
        local = si.to_local(sample.d)
        cosine = dr.sqrt(dr.maximum(local.x * local.x + local.z * local.z, 1e-16))
        to_light = mi.Vector3f(local.y, cosine, azimuth(local.x, local.z))
        value, pdf = eval_fiber(packed, prepared, *to_light)
        if dr.hint(not stage.alone, mode="scalar"):
            light *= dr.select(sample.delta, 1.0, _power_weight(sample.pdf, pdf))
        light = dr.select(active & (sample.pdf > 0.0), light, 0.0)

        # --- The next vertex ---
        u = rng.next_float32(), rng.next_float32(), rng.next_float32()
        to_next = mi.Vector3f(*sample_fiber(packed, prepared, *u))
        passed, density = eval_fiber(packed, prepared, *to_next)
        ahead = dr.select(density > 0.0, passed / dr.maximum(density, 1e-30), 0.0)
        onward = beta * ahead
        brightest = dr.max(onward)
        go_on = dr.select(count >= ROULETTE_FROM, dr.minimum(brightest, GO_ON), 1.0)
        inverse = dr.rcp(dr.maximum(go_on, 1e-30))

        if dr.hint(recording, mode="scalar"):
            memory.write(tuple(Vertex(color, si.wi, to_light, light, to_next, beta, inverse)), count, active)
            if dr.hint(not stage.alone, mode="scalar"):
                glow.write(mi.Color3f(0.0), count, active)
        else:
            radiance += dr.select(active, beta * value * light, 0.0)
        count += dr.select(active, 1, 0)
        beta = onward * inverse
        active &= (rng.next_float32() < go_on) & (brightest > 0.0)
        if dr.hint(stage.alone, mode="scalar"):
            active &= count < stage.vertices
        else:
            before = mi.Interaction3f(si)
        sin_alpha, cos_alpha = dr.sincos(to_next.z)
        ray = si.spawn_ray(si.to_world(mi.Vector3f(to_next.y * sin_alpha, to_next.x, to_next.y * cos_alpha)))
    return radiance, count, memory, glow


def empty_memory(stage: Stage) -> tuple[Any, Any]:
    """For ``trace``: memory for vertices and, where there are lights to run into, for their light."""
    direction, color = mi.Vector3f, mi.Color3f
    vertex = Vertex(
        mi.UInt32(0), direction(0), direction(0), color(0), direction(0), color(0), mi.Float(0)
    )  # fmt: skip
    memory = dr.alloc_local(tuple, stage.vertices, tuple(vertex))
    return memory, None if stage.alone else dr.alloc_local(color, stage.vertices, color(0))


@dr.syntax
def walk_back(stage: Stage, tables: Tables, adjoint: Any, count: Any, memory: Any, glow: Any) -> tuple[list[Any], Any]:
    """Derivatives of J along traced paths, where dJ/dL_0 is ``adjoint``.

    Returns
    -------
    leaves: Float
        2 * LEAF_COUNT arrays, by path: with respect to ``leaf_values`` of warp and weft.
    colors:
        With respect to the absorptions: Local of ``stage.colors`` Color3f by path.
    """
    count = mi.UInt32(count)
    incoming = mi.Color3f(0.0)  # L of the vertex ahead
    warp = [mi.Float(0.0) for _ in range(LEAF_COUNT)]
    weft = [mi.Float(0.0) for _ in range(LEAF_COUNT)]
    colors = dr.alloc_local(mi.Color3f, stage.colors, mi.Color3f(0.0))

    while dr.hint(count > 0, max_iterations=stage.vertices, label="back along fiber paths"):
        count -= 1
        vertex = Vertex(*memory.read(count))
        if dr.hint(not stage.alone, mode="scalar"):
            incoming += glow.read(count)
        packed = material(stage, tables, vertex.color)
        with dr.resume_grad():
            sigma = mi.Color3f(packed.sigma)
            leaves = [mi.Float(leaf) for leaf in leaf_values(packed)]
            dr.enable_grad(sigma, leaves)
            packed = with_leaves(packed._replace(sigma=sigma), leaves)
            prepared = prepare_fiber(packed, *vertex.viewer)
            value, _ = eval_fiber(packed, prepared, *vertex.light_direction)
            passed, density = eval_fiber(packed, prepared, *vertex.next_direction)
            density = dr.detach(density)
            inverse = dr.select(density > 0.0, vertex.go_on / dr.maximum(density, 1e-30), 0.0)
            radiance = value * vertex.light + passed * inverse * incoming
            dr.backward_from(dr.dot(adjoint * vertex.beta, radiance))
            incoming = dr.detach(radiance)
        is_warp = vertex.color < stage.warp_colors
        for k in range(LEAF_COUNT):
            derivative = dr.grad(leaves[k])
            warp[k] += dr.select(is_warp, derivative, 0.0)
            weft[k] += dr.select(is_warp, 0.0, derivative)
        colors.write(colors.read(vertex.color) + dr.grad(sigma), vertex.color)
    return [*warp, *weft], colors


def _power_weight(a: Any, b: Any) -> Any:
    """Weight of a sample of density ``a`` that could have had ``b`` as well: power heuristic, Veach 1997."""
    a2 = a * a
    return dr.select(a > 0.0, a2 / dr.maximum(a2 + b * b, 1e-38), 0.0)


def _shone_upon(scene: Any, si: Any, before: Any, density: Any, first: Any, active: Any) -> Any:
    """Light from what a ray runs into, with its weight against having been sampled from the vertex before."""
    sample = mi.DirectionSample3f(scene, si=si, ref=before)
    other = scene.pdf_emitter_direction(before, sample, active & ~first)
    weight = dr.select(first, 1.0, _power_weight(density, other))
    return dr.select(active, weight * sample.emitter.eval(si, active), 0.0)
