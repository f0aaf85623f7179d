"""The two-scale path tracer as a Mitsuba integrator (Li et al. 2024, section 6; MODEL.md, section 10).

At *macro* scale a ray flies through a Mitsuba scene of meshes and lights, in which cloth is only triangles. Where it
meets a triangle of cloth it goes into that fabric's *slab* (`two_scale_slab`), a second Mitsuba scene that holds one
copy of each tile, and scatters on the fibers there until it leaves above or below. The same algorithm as the Numba
tracer's, written for Dr.Jit: all paths go through one loop, whose body is compiled once for a scene. Emitters and
surfaces without fabric are Mitsuba's own.

What differs: one of several lights is chosen with equal chances, as in Mitsuba's ``path``; a surface with opacity
scatters or lets through as Mitsuba's ``mask`` draws it.

Notation: ``d`` direction of flight, ``beta`` throughput, ``L`` radiance. Depth counts as in Mitsuba: 1 sees lights, 2
adds direct light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from usdfab.mi.two_scale_fiber import FiberOptics, FiberVertex, fiber_vertex
from usdfab.mi.two_scale_macro import INFINITE, MAX_SURFACES, NOBODY, MacroTracer, Shadow
from usdfab.mi.two_scale_slab import nowhere

RUSSIAN_ROULETTE_DEPTH = 5

SHADOW_ROULETTE = 4.0 * math.pi
"""From the second vertex on, light that would arrive with less than what isotropic scattering gives gets its shadow
ray by chance only, as in the tracer."""

SHADOW_SHARE = 1.0 - 1e-4
"""How much of the way to a light must be free."""


@dataclass
class Path:
    """What a path carries from vertex to vertex.

    ``origin``, ``d`` its ray in the macro scene; ``slab`` where it is in the fabric of ``mesh``, if ``inside``;
    ``skip_mesh`` is not met before ``skip_distance``; ``start`` where the BSDF drew the direction with density ``pdf``
    (negative: the camera, or without choice); ``layers`` passed since then.
    """

    active: Any
    L: Any
    beta: Any
    origin: Any
    d: Any
    inside: Any
    slab: Any
    mesh: Any
    tint: Any
    skip_mesh: Any
    skip_distance: Any
    start: Any
    pdf: Any
    depth: Any
    layers: Any


class Vertex(NamedTuple):
    """Where a path scatters: on a ``fiber``, or on a ``surface`` at ``si``, seen from ``side`` of its triangle."""

    fiber: Any
    surface: Any
    hair: FiberVertex
    si: Any
    side: Any

    @property
    def valid(self) -> Any:
        return self.fiber | self.surface


class Drawn(NamedTuple):
    """A direction that the BSDF drew. ``null``: the path passes through; ``delta``: it had no choice."""

    d: Any
    weight: Any
    pdf: Any
    null: Any
    delta: Any


def integrator_class() -> type:
    """The integrator for the variant that is set; `mi.SamplingIntegrator` is another class in each."""

    class TwoScaleIntegrator(mi.SamplingIntegrator):
        """Radiance along camera rays; three more channels hold its square, from which the noise follows.

        Parameters
        ----------
        bare:
            Whether any surface without fabric scatters.
        """

        def __init__(self, macro: MacroTracer, optics: FiberOptics, *, max_depth: int, bare: bool) -> None:
            super().__init__(mi.Properties())
            self.macro, self.optics = macro, optics
            self.fibers, self.cloth = macro.fibers, macro.cloth
            self.max_depth, self.bare = max_depth, bare

        def aov_names(self) -> list[str]:
            return ["square.R", "square.G", "square.B"]

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> tuple:
            def body(path: Path, sampler: Any) -> tuple[Path, Any]:
                si, surface, side = self._fly(scene, path)
                vertex = self._in_fabric(path, si, surface, side)
                light, radiance, value, pdf, drawn = self._scatter(scene, sampler, path, vertex)
                self._direct(scene, sampler, path, vertex, light, radiance, value, pdf)
                self._go_on(sampler, path, vertex, drawn)
                return path, sampler

            start = Path(
                active=mi.Bool(active), L=mi.Color3f(0.0), beta=mi.Color3f(1.0), origin=mi.Point3f(ray.o),
                d=mi.Vector3f(ray.d), inside=mi.Bool(False), slab=nowhere(), mesh=mi.UInt32(NOBODY),
                tint=mi.Color3f(1.0), skip_mesh=mi.UInt32(NOBODY), skip_distance=mi.Float(0.0),
                start=mi.Point3f(ray.o), pdf=mi.Float(-1.0), depth=mi.UInt32(1), layers=mi.UInt32(0),
            )  # fmt: skip
            path, _ = dr.while_loop(
                (start, sampler), cond=lambda path, _: path.active, body=body, labels=("path", "sampler"), label="path"
            )
            square = path.L * path.L
            return path.L, mi.Bool(active), [square.x, square.y, square.z]

        # --- The stages of the loop's body; they write into the path ---

        def _fly(self, scene: Any, path: Path) -> tuple[Any, Any, Any]:
            """Macro scale: to a light, a surface, or into a fabric. Returns (place, is it a surface, its side)."""
            outside = path.active & ~path.inside
            hit, cloth, mesh = self.macro.trace(
                scene, path.origin, path.d, mi.Float(INFINITE), path.skip_mesh, path.skip_distance, outside
            )
            cloth &= outside
            found = hit.found
            other = outside & ~cloth
            found.t = dr.select(hit.valid, found.t, INFINITE)
            si = found.compute_surface_interaction(mi.Ray3f(path.origin + hit.near * path.d, path.d), active=other)
            path.L += path.beta * self._emission(scene, path, si, other)
            surface = other & hit.valid
            path.active &= ~(other & ~hit.valid)
            side = -dr.sign(dr.dot(si.n, path.d))
            if self.bare:
                # The interpolated normal may look away: the triangle's own does not.
                away = surface & (side * si.wi.z <= 1e-4)
                si.sh_frame = dr.select(away, mi.Frame3f(si.n), si.sh_frame)
                si.wi = dr.select(away, si.to_local(-path.d), si.wi)
            else:
                path.active &= ~surface
                surface = mi.Bool(False)
            ok, slab, entry = self.cloth.enter(self.fibers, found.prim_index, found.prim_uv, path.d, hit.t, cloth)
            path.slab = dr.select(ok, slab, path.slab)
            path.mesh = dr.select(ok, mesh, path.mesh)
            if self.cloth.tinted:
                path.tint = dr.select(ok, self.cloth.tint(found.prim_index, found.prim_uv, ok), path.tint)
            edge_on = cloth & ~ok
            step = dr.select(ok, hit.t - entry, dr.select(edge_on, self.macro.beyond(hit.t), 0.0))
            path.origin = dr.fma(step, path.d, path.origin)
            path.skip_mesh = dr.select(edge_on, NOBODY, path.skip_mesh)
            path.inside |= ok
            return si, surface, side

        def _emission(self, scene: Any, path: Path, si: Any, active: Any) -> Any:
            """Weighted radiance of what the ray met, or of what is infinitely far away."""
            emitter = si.emitter(scene, active)
            active = active & (emitter != None)  # noqa: E711  (an array of pointers)
            start = dr.zeros(mi.Interaction3f)
            start.p = path.start
            drawn = active & (path.pdf >= 0.0)
            light_pdf = scene.pdf_emitter_direction(start, mi.DirectionSample3f(scene, si, start), drawn)
            total = path.pdf + light_pdf
            weight = dr.select(drawn & (total > 0.0), path.pdf / total, 1.0)
            return dr.select(active, weight * emitter.eval(si, active), 0.0)

        def _in_fabric(self, path: Path, si: Any, surface: Any, side: Any) -> Vertex:
            """To a fiber, or out of the fabric. Returns the vertex there, or on the surface met before."""
            within = path.active & path.inside
            direction = path.slab.to_patch(path.d)
            stretch = dr.norm(direction)
            fiber, distance, there, tile, prim, u = self.fibers.trace(path.slab, direction / stretch, within)
            path.slab = dr.select(within, there, path.slab)
            escaped = within & ~fiber
            back, thickness = self.fibers.thickness(path.slab, path.d, escaped)
            travel = dr.select(within, distance / stretch, 0.0) - dr.select(escaped, back, 0.0)
            path.origin = dr.fma(travel, path.d, path.origin)
            path.skip_mesh = dr.select(escaped, path.mesh, path.skip_mesh)
            path.skip_distance = dr.select(escaped, back + 2.0 * thickness, path.skip_distance)
            path.inside &= ~escaped
            path.layers += 1
            path.active &= path.layers < MAX_SURFACES
            path.active &= ~((fiber | surface) & (path.depth >= self.max_depth))
            fiber &= path.active
            surface &= path.active
            row = self.fibers.material(prim, fiber)
            tangent, normal = self.fibers.frame(path.slab, tile, prim, u, fiber)
            tint = path.tint if self.cloth.tinted else None
            hair = fiber_vertex(self.optics.material(row, tint, fiber), tangent, normal, -path.d)
            return Vertex(fiber, surface, hair, si, side)

        def _scatter(self, scene: Any, sampler: Any, path: Path, vertex: Vertex) -> tuple[Any, Any, Any, Any, Drawn]:
            """A direction to a light with (its radiance over density, the BSDF's value, its density), and one drawn."""
            fiber, surface, hair, si, side = vertex
            here = dr.zeros(mi.SurfaceInteraction3f)
            here.p = dr.select(fiber, path.origin, si.p)
            light, radiance = scene.sample_emitter_direction(here, sampler.next_2d(vertex.valid), False, vertex.valid)
            value, pdf = hair.eval(light.d)
            u0, u12 = sampler.next_1d(vertex.valid), sampler.next_2d(vertex.valid)
            d, weight, new_pdf = hair.sample(u0, u12.x, u12.y)
            if not self.bare:
                return light, radiance, value, pdf, Drawn(d, weight, new_pdf, mi.Bool(False), mi.Bool(False))
            own, own_pdf, drawn, own_weight = si.bsdf().eval_pdf_sample(
                mi.BSDFContext(), si, si.to_local(light.d), u0, u12, surface
            )
            value, pdf = dr.select(fiber, value, own), dr.select(fiber, pdf, own_pdf)
            d = dr.select(fiber, d, si.to_world(drawn.wo))
            weight, new_pdf = dr.select(fiber, weight, own_weight), dr.select(fiber, new_pdf, drawn.pdf)
            null = surface & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Null)
            delta = surface & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
            # No light through the triangle where only the interpolated normal sees it.
            value &= fiber | (side * dr.dot(si.n, light.d) > 0.0)
            weight &= fiber | null | (side * dr.dot(si.n, d) > 0.0)
            return light, radiance, value, pdf, Drawn(d, weight, new_pdf, null, delta)

        def _direct(
            self, scene: Any, sampler: Any, path: Path, vertex: Vertex, light: Any, radiance: Any, value: Any, pdf: Any
        ) -> None:
            """Direct light: next-event estimation."""
            lit = vertex.valid & (light.pdf != 0.0)
            value = path.beta * value * dr.select(light.delta, 1.0, light.pdf / (light.pdf + pdf))
            # Most vertices send next to nothing towards a lamp: these get their shadow ray by chance only.
            likely = dr.select(path.depth > 1, dr.minimum(dr.max(value) * SHADOW_ROULETTE, 1.0), 1.0)
            lit &= sampler.next_1d(vertex.valid) < likely
            arriving = dr.select(lit, value * radiance / likely, 0.0)
            lit &= dr.max(arriving) > 0.0
            origin = dr.select(vertex.fiber, path.origin, self.macro.offset(vertex.si, light.d))
            shadow = Shadow(
                lit, mi.Float(1.0), origin, light.dist * SHADOW_SHARE, vertex.fiber, path.slab, path.mesh,
                mi.UInt32(NOBODY), mi.Float(0.0), mi.UInt32(0),
            )  # fmt: skip
            path.L += dr.select(lit, arriving * self.macro.transmittance(scene, shadow, light.d), 0.0)

        def _go_on(self, sampler: Any, path: Path, vertex: Vertex, drawn: Drawn) -> None:
            """Next direction: BSDF sampling, Russian roulette."""
            valid, surface = vertex.valid, vertex.surface
            path.beta = dr.select(valid, path.beta * drawn.weight, path.beta)
            path.active &= ~(valid & ((drawn.pdf <= 0.0) | (dr.max(path.beta) <= 0.0)))
            scattered = valid & ~drawn.null
            path.start = dr.select(scattered, dr.select(vertex.fiber, path.origin, vertex.si.p), path.start)
            path.pdf = dr.select(scattered, dr.select(drawn.delta, -1.0, drawn.pdf), path.pdf)
            path.origin = dr.select(surface, self.macro.offset(vertex.si, drawn.d), path.origin)
            path.d = dr.select(valid, drawn.d, path.d)
            path.skip_mesh = dr.select(surface, NOBODY, path.skip_mesh)
            # At least one path in twenty ends at each vertex; throughput stays below 2.
            brightest = dr.max(path.beta)
            survive = dr.minimum(brightest, dr.minimum(dr.maximum(0.95, 0.5 * brightest), 1.0))
            survive = dr.select(scattered & (path.depth >= RUSSIAN_ROULETTE_DEPTH), survive, 1.0)
            path.active &= sampler.next_1d(valid) < survive
            path.beta /= dr.maximum(survive, 1e-6)
            path.depth = dr.select(scattered, path.depth + 1, path.depth)
            path.layers = dr.select(scattered, 0, path.layers)

        def to_string(self) -> str:
            return f"TwoScaleIntegrator[max_depth = {self.max_depth}]"

    return TwoScaleIntegrator
