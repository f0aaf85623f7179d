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
from typing import Any

import drjit as dr
import mitsuba as mi

from usdfab.mi.two_scale_enter import ClothTables
from usdfab.mi.two_scale_fiber import FiberOptics, fiber_vertex
from usdfab.mi.two_scale_slab import FiberScene, Slab, nowhere

RUSSIAN_ROULETTE_DEPTH = 5
SHADOW_ROULETTE = 4.0 * math.pi
"""From the second vertex on, light that would arrive with less than what isotropic scattering gives gets its shadow
ray by chance only, as in the tracer."""

MAX_SURFACES = 64
"""Layers of fabric or of transparent surface that a ray may pass between two vertices."""

SURFACE_OFFSET = 1e-5
"""Rays start this times the place's largest coordinate off a surface: a hundred times what float32 resolves."""

SHADOW_SHARE = 1.0 - 1e-4
"""How much of the way to a light must be free."""

INFINITE = float("inf")


@dataclass
class Path:
    """What a path carries from vertex to vertex.

    ``origin``, ``d`` its ray in the macro scene; ``slab`` where it is in a fabric, if ``inside``; the cloth's own mesh
    ``skip_mesh`` is not met before ``skip_distance``; ``from_`` where the BSDF drew the direction with density ``pdf``
    (negative: the camera, or without choice).
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
    from_: Any
    pdf: Any
    depth: Any
    layers: Any


@dataclass
class Shadow:
    """A ray to a light, of which ``share`` has come through so far; ``left`` is how far it still is."""

    pending: Any
    share: Any
    origin: Any
    left: Any
    inside: Any
    slab: Any
    mesh: Any
    skip_mesh: Any
    skip_distance: Any
    layers: Any


@dataclass
class MacroHit:
    """What a ray met: ``near`` is where the search began, ``t`` the distance from the ray's origin."""

    pending: Any
    valid: Any
    near: Any
    t: Any
    found: Any


NOBODY = 0xFFFFFFFF
"""Number of no mesh."""


def integrator_class() -> type:
    """The integrator for the variant that is set; `mi.SamplingIntegrator` is another class in each."""

    class TwoScaleIntegrator(mi.SamplingIntegrator):
        """Radiance along camera rays; three more channels hold its square, from which the noise follows.

        Parameters
        ----------
        cloth_shape:
            The shape of the macro scene that is made of ``cloth``'s triangles, in their order.
        reach:
            Radius of the scene, macro units.
        bare, masked:
            Whether any surface without fabric scatters, and whether any lets light through.
        """

        def __init__(
            self,
            fibers: FiberScene,
            optics: FiberOptics,
            cloth: ClothTables,
            cloth_shape: Any,
            *,
            reach: float,
            max_depth: int,
            bare: bool,
            masked: bool,
        ) -> None:
            super().__init__(mi.Properties())
            self.fibers, self.optics, self.cloth = fibers, optics, cloth
            self.cloth_shape = mi.ShapePtr(cloth_shape)
            self.tiny = 1e-6 * reach
            self.max_depth, self.bare, self.masked = max_depth, bare, masked

        def aov_names(self) -> list[str]:
            return ["square.R", "square.G", "square.B"]

        # --- Macro scale ---

        def _trace_macro(
            self, scene: Any, o: Any, d: Any, tmax: Any, skip_mesh: Any, skip_distance: Any, active: Any
        ) -> tuple[MacroHit, Any, Any]:
            """(nearest hit, those of ``skip_mesh`` nearer than ``skip_distance`` left out; is it cloth; its mesh)."""

            def owner(found: Any, valid: Any) -> tuple[Any, Any]:
                cloth = valid & (found.shape == self.cloth_shape)
                return cloth, self.cloth.mesh(found.prim_index, cloth)

            def body(hit: MacroHit, steps: Any) -> tuple[MacroHit, Any]:
                ray = mi.Ray3f(o + hit.near * d, d)
                ray.maxt = tmax - hit.near
                found = scene.ray_intersect_preliminary(ray, coherent=False, active=hit.pending)
                valid = hit.pending & found.is_valid()
                t = hit.near + found.t
                cloth, mesh = owner(found, valid)
                passed = cloth & (mesh == skip_mesh) & (t < skip_distance)
                hit.t = dr.select(valid, t, hit.t)
                hit.found = dr.select(hit.pending, found, hit.found)
                hit.valid = dr.select(hit.pending, valid & ~passed, hit.valid)
                hit.near = dr.select(passed, t * (1.0 + 1e-5) + self.tiny, hit.near)
                hit.pending = passed & (hit.near < tmax) & (steps < MAX_SURFACES)
                return hit, steps + 1

            start = MacroHit(
                mi.Bool(active), mi.Bool(False), mi.Float(0.0), mi.Float(INFINITE),
                dr.zeros(mi.PreliminaryIntersection3f),
            )  # fmt: skip
            hit, _ = dr.while_loop(
                (start, mi.UInt32(0)), cond=lambda hit, _: hit.pending, body=body, labels=("hit", "steps"),
                label="meshes",
            )  # fmt: skip
            cloth, mesh = owner(hit.found, hit.valid)
            return hit, cloth, mesh

        def _offset(self, si: Any, d: Any) -> Any:
            """Where a ray from a surface starts."""
            size = dr.max(dr.abs(si.p)) * SURFACE_OFFSET + self.tiny
            return si.p + dr.mulsign(size, dr.dot(si.n, d)) * si.n

        # --- Light ---

        def _transmittance(self, scene: Any, shadow: Shadow, w: Any) -> Any:
            """Share of a light that comes through: surfaces stop it, fabrics where a fiber is."""

            def body(s: Shadow) -> tuple[Shadow]:
                # In a fabric.
                within = s.pending & s.inside
                direction = s.slab.to_patch(w)
                stretch = dr.norm(direction)
                blocked, passed = self.fibers.occluded(s.slab, direction / stretch, s.left * stretch, within)
                arrived = within & ~blocked & (passed >= s.left * stretch)
                s.share = dr.select(blocked & within, 0.0, s.share)
                s.pending &= ~(within & blocked) & ~arrived
                escaped = within & s.pending
                back, thickness = self.fibers.thickness(s.slab, w, escaped)
                start = dr.select(escaped, passed / stretch - back, 0.0)
                s.origin = dr.fma(start, w, s.origin)
                s.left -= start
                s.skip_mesh = dr.select(escaped, s.mesh, s.skip_mesh)
                s.skip_distance = dr.select(escaped, back + 2.0 * thickness, s.skip_distance)
                s.inside &= ~escaped
                s.pending &= ~(escaped & (s.left <= back))

                # At macro scale.
                outside = s.pending & ~s.inside
                hit, cloth, mesh = self._trace_macro(scene, s.origin, w, s.left, s.skip_mesh, s.skip_distance, outside)
                s.pending &= ~(outside & ~hit.valid)
                surface = outside & hit.valid & ~cloth
                cloth &= outside
                if self.masked:
                    ray = mi.Ray3f(s.origin + hit.near * w, w)
                    si = hit.found.compute_surface_interaction(ray, active=surface)
                    through = si.bsdf().eval_null_transmission(si, surface)
                    s.share = dr.select(surface, s.share * dr.mean(through), s.share)
                    s.pending &= ~(surface & (s.share <= 0.0))
                else:
                    s.share = dr.select(surface, 0.0, s.share)
                    s.pending &= ~surface
                found = hit.found
                ok, slab, entry = self.cloth.enter(self.fibers, found.prim_index, found.prim_uv, w, hit.t, cloth)
                s.slab = dr.select(ok, slab, s.slab)
                s.mesh = dr.select(ok, mesh, s.mesh)
                s.inside |= ok
                # Past a surface, and past cloth that is exactly edge-on.
                beyond = hit.t * (1.0 + 1e-5) + self.tiny
                step = dr.select(ok, hit.t - entry, dr.select(cloth | surface, beyond, 0.0))
                step = dr.select(s.pending, step, 0.0)
                s.origin = dr.fma(step, w, s.origin)
                s.left -= step
                s.skip_mesh = dr.select(cloth & ~ok, NOBODY, s.skip_mesh)
                s.skip_distance = dr.select(cloth | surface, s.skip_distance - step, s.skip_distance)
                s.layers += 1
                gone = s.layers >= MAX_SURFACES
                s.share = dr.select(s.pending & gone, 0.0, s.share)
                s.pending &= ~gone & ((s.left > 0.0) | s.inside)
                return (s,)

            (done,) = dr.while_loop(
                (dr.copy(shadow),), cond=lambda s: s.pending, body=body, labels=("shadow",), label="transmittance"
            )
            return done.share

        def _emission(self, scene: Any, path: Path, si: Any, active: Any) -> Any:
            """Weighted radiance of what the ray met, or of what is infinitely far away."""
            emitter = si.emitter(scene, active)
            active = active & (emitter != None)  # noqa: E711  (an array of pointers)
            start = dr.zeros(mi.Interaction3f)
            start.p = path.from_
            sample = mi.DirectionSample3f(scene, si, start)
            drawn = active & (path.pdf >= 0.0)
            light_pdf = scene.pdf_emitter_direction(start, sample, drawn)
            total = path.pdf + light_pdf
            weight = dr.select(drawn & (total > 0.0), path.pdf / total, 1.0)
            return dr.select(active, weight * emitter.eval(si, active), 0.0)

        # --- Paths ---

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> tuple:
            context = mi.BSDFContext()

            def body(path: Path, sampler: Any) -> tuple[Path, Any]:
                # Macro scale: light, a surface, or into a fabric.
                outside = path.active & ~path.inside
                hit, cloth, mesh = self._trace_macro(
                    scene, path.origin, path.d, mi.Float(INFINITE), path.skip_mesh, path.skip_distance, outside
                )
                cloth &= outside
                found = hit.found
                other = outside & ~cloth
                found.t = dr.select(hit.valid, found.t, INFINITE)
                at = mi.Ray3f(path.origin + hit.near * path.d, path.d)
                si = found.compute_surface_interaction(at, active=other)
                path.L += path.beta * self._emission(scene, path, si, other)
                surface = other & hit.valid
                path.active &= ~(other & ~hit.valid)
                if self.bare:
                    # The interpolated normal may look away: the triangle's own does not.
                    side = -dr.sign(dr.dot(si.n, path.d))
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
                step = dr.select(ok, hit.t - entry, dr.select(edge_on, hit.t * (1.0 + 1e-5) + self.tiny, 0.0))
                path.origin = dr.fma(step, path.d, path.origin)
                path.skip_mesh = dr.select(edge_on, NOBODY, path.skip_mesh)
                path.inside |= ok

                # In a fabric: a fiber, or out of it.
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

                # A vertex.
                path.active &= ~((fiber | surface) & (path.depth >= self.max_depth))
                fiber &= path.active
                surface &= path.active
                vertex = fiber | surface
                row = self.fibers.material(prim, fiber)
                tangent, normal = self.fibers.frame(path.slab, tile, prim, u, fiber)
                tint = path.tint if self.cloth.tinted else None
                hair = fiber_vertex(self.optics.material(row, tint, fiber), tangent, normal, -path.d)

                # Direct light: next-event estimation.
                here = dr.zeros(mi.SurfaceInteraction3f)
                here.p = dr.select(fiber, path.origin, si.p)
                light, radiance = scene.sample_emitter_direction(here, sampler.next_2d(vertex), False, vertex)
                lit = vertex & (light.pdf != 0.0)
                value, pdf = hair.eval(light.d)
                u0, u12 = sampler.next_1d(vertex), sampler.next_2d(vertex)
                d, weight, new_pdf = hair.sample(u0, u12.x, u12.y)
                null = mi.Bool(False)
                if self.bare:
                    bsdf = si.bsdf()
                    own, own_pdf, drawn, own_weight = bsdf.eval_pdf_sample(
                        context, si, si.to_local(light.d), u0, u12, surface
                    )
                    value, pdf = dr.select(fiber, value, own), dr.select(fiber, pdf, own_pdf)
                    d = dr.select(fiber, d, si.to_world(drawn.wo))
                    weight, new_pdf = dr.select(fiber, weight, own_weight), dr.select(fiber, new_pdf, drawn.pdf)
                    null = surface & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Null)
                    # No light through the triangle where only the interpolated normal sees it.
                    value &= fiber | (side * dr.dot(si.n, light.d) > 0.0)
                    weight &= fiber | null | (side * dr.dot(si.n, d) > 0.0)
                share = dr.select(light.delta, 1.0, light.pdf / (light.pdf + pdf))
                value = path.beta * value * share
                # Most vertices send next to nothing towards a lamp: these get their shadow ray by chance only.
                likely = dr.select(path.depth > 1, dr.minimum(dr.max(value) * SHADOW_ROULETTE, 1.0), 1.0)
                lit &= sampler.next_1d(vertex) < likely
                arriving = dr.select(lit, value * radiance / likely, 0.0)
                lit &= dr.max(arriving) > 0.0
                reach = light.dist * SHADOW_SHARE
                shadow = Shadow(
                    lit, mi.Float(1.0), dr.select(fiber, path.origin, self._offset(si, light.d)), reach,
                    mi.Bool(fiber), path.slab, mi.UInt32(path.mesh), mi.UInt32(NOBODY), mi.Float(0.0), mi.UInt32(0),
                )  # fmt: skip
                path.L += dr.select(lit, arriving * self._transmittance(scene, shadow, light.d), 0.0)

                # Next direction: BSDF sampling.
                path.beta = dr.select(vertex, path.beta * weight, path.beta)
                path.active &= ~(vertex & ((new_pdf <= 0.0) | (dr.max(path.beta) <= 0.0)))
                scattered = vertex & ~null
                path.from_ = dr.select(scattered, here.p, path.from_)
                path.pdf = dr.select(scattered, new_pdf, path.pdf)
                if self.bare:
                    delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
                    path.pdf = dr.select(scattered & surface & delta, -1.0, path.pdf)
                path.origin = dr.select(surface, self._offset(si, d), path.origin)
                path.d = dr.select(vertex, d, path.d)
                path.skip_mesh = dr.select(surface, NOBODY, path.skip_mesh)
                # At least one path in twenty ends at each vertex; throughput stays below 2.
                brightest = dr.max(path.beta)
                survive = dr.minimum(brightest, dr.minimum(dr.maximum(0.95, 0.5 * brightest), 1.0))
                survive = dr.select(scattered & (path.depth >= RUSSIAN_ROULETTE_DEPTH), survive, 1.0)
                path.active &= sampler.next_1d(vertex) < survive
                path.beta /= dr.maximum(survive, 1e-6)
                path.depth = dr.select(scattered, path.depth + 1, path.depth)
                path.layers = dr.select(scattered, 0, path.layers)
                return path, sampler

            start = Path(
                active=mi.Bool(active), L=mi.Color3f(0.0), beta=mi.Color3f(1.0), origin=mi.Point3f(ray.o),
                d=mi.Vector3f(ray.d), inside=mi.Bool(False), slab=nowhere(), mesh=mi.UInt32(NOBODY),
                tint=mi.Color3f(1.0), skip_mesh=mi.UInt32(NOBODY), skip_distance=mi.Float(0.0),
                from_=mi.Point3f(ray.o), pdf=mi.Float(-1.0), depth=mi.UInt32(1), layers=mi.UInt32(0),
            )  # fmt: skip
            path, _ = dr.while_loop(
                (start, sampler), cond=lambda path, _: path.active, body=body, labels=("path", "sampler"), label="path"
            )
            square = path.L * path.L
            return path.L, mi.Bool(active), [square.x, square.y, square.z]

        def to_string(self) -> str:
            return f"TwoScaleIntegrator[max_depth = {self.max_depth}]"

    return TwoScaleIntegrator
