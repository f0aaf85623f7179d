"""Macro scale of the two-scale integrator, in Dr.Jit: rays against meshes, and whether light gets through cloth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from usdfab.mi.two_scale_enter import ClothTables
from usdfab.mi.two_scale_slab import FiberScene

MAX_SURFACES = 64
"""Layers of fabric or of transparent surface that a ray may pass between two vertices."""

SURFACE_OFFSET = 1e-5
"""Rays start this times the place's largest coordinate off a surface: a hundred times what float32 resolves."""

INFINITE = float("inf")

NOBODY = 0xFFFFFFFF
"""Number of no mesh."""


@dataclass
class Shadow:
    """A ray to a light, of which ``share`` has come through so far; ``left`` is how far it still is.

    ``slab`` is where it is in the fabric of ``mesh``, if ``inside``; ``skip_mesh`` is not met before ``skip_distance``.
    """

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


class MacroTracer:
    """Rays in the scene of meshes.

    Parameters
    ----------
    cloth_shape:
        The shape of the scene that is made of ``cloth``'s triangles, in their order.
    reach:
        Radius of the scene, macro units.
    masked:
        Whether any surface lets light through.
    """

    def __init__(self, fibers: FiberScene, cloth: ClothTables, cloth_shape: Any, *, reach: float, masked: bool) -> None:
        self.fibers, self.cloth, self.masked = fibers, cloth, masked
        self.cloth_shape = mi.ShapePtr(cloth_shape)
        # A number in memory: the frames of an animation share one program.
        self.tiny = dr.opaque(mi.Float, 1e-6 * reach)

    def beyond(self, t: Any) -> Any:
        """A little farther than a hit at ``t``: where the search goes on behind it."""
        return t * (1.0 + 1e-5) + self.tiny

    def trace(
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
            hit.near = dr.select(passed, self.beyond(t), hit.near)
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

    def offset(self, si: Any, d: Any) -> Any:
        """Where a ray from a surface starts."""
        size = dr.max(dr.abs(si.p)) * SURFACE_OFFSET + self.tiny
        return si.p + dr.mulsign(size, dr.dot(si.n, d)) * si.n

    def transmittance(self, scene: Any, shadow: Shadow, w: Any) -> Any:
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
            hit, cloth, mesh = self.trace(scene, s.origin, w, s.left, s.skip_mesh, s.skip_distance, outside)
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
            beyond = self.beyond(hit.t)
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
