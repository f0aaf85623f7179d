"""Fibers in the two-scale integrator: the optics of a hit from tables, its frame, values and samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from usdfab.mi.two_scale_tiles import FiberMaterial
from usdfab.scattering.fiber_drjit import (
    PackedFiber,
    PreparedFiber,
    absorption_from_albedo,
    azimuth,
    eval_fiber,
    pack_fiber,
    prepare_fiber,
    sample_fiber,
)

Pick = Callable[[Any, Any], Any]


def _pick(values: Any) -> Pick:
    """An array of constants, or of three, as a function of (row, active); nothing is looked up where all are equal."""
    dr.eval(values)
    numbers = np.array(values).reshape(-1, dr.width(values))
    if np.all(numbers == numbers[:, :1]):
        kind = type(values)
        constant = kind(*(float(n) for n in numbers[:, 0]))
        dr.make_opaque(constant)
        return lambda row, active: constant
    if isinstance(values, mi.Color3f):
        packed = dr.ravel(values)
        return lambda row, active: dr.gather(mi.Color3f, packed, row, active)
    return lambda row, active: dr.gather(mi.Float, values, row, active)


class FiberOptics:
    """All fiber materials of a scene on the device."""

    def __init__(self, materials: Sequence[FiberMaterial]) -> None:
        rows = np.array([(*m.albedo, m.gamma_m, m.gamma_n, m.gamma_m0, m.eta, m.tilt) for m in materials])
        albedo = mi.Color3f(*(mi.Float(rows[:, k]) for k in range(3)))
        gamma_m, gamma_n, gamma_m0, eta, tilt = (mi.Float(rows[:, k]) for k in range(3, 8))
        # One tilt is a part of the program.
        same = bool(np.all(rows[:, 7] == rows[0, 7]))
        packed = pack_fiber(albedo, gamma_m, gamma_n, gamma_m0, eta, 0.0)
        self._fields = [
            tuple(_pick(one) for one in field) if isinstance(field, tuple) else _pick(field) for field in packed[:-1]
        ]
        self._tilt: float | Pick = float(rows[0, 7]) if same else _pick(tilt)
        self._albedo, self._gamma_n = _pick(albedo), _pick(gamma_n)

    def material(self, row: Any, tint: Any | None, active: Any) -> PackedFiber:
        """The material of a row, its albedo coefficient multiplied by ``tint`` (at most 1)."""
        fields: list[Any] = [
            tuple(pick(row, active) for pick in field) if isinstance(field, tuple) else field(row, active)
            for field in self._fields
        ]
        fields.append(self._tilt if isinstance(self._tilt, float) else self._tilt(row, active))
        packed = PackedFiber._make(fields)
        if tint is None:
            return packed
        albedo = self._albedo(row, active) * dr.maximum(tint, 1e-4)
        return packed._replace(sigma=absorption_from_albedo(albedo, self._gamma_n(row, active)))


class FiberVertex(NamedTuple):
    """A hit on a fiber, ready to be evaluated: its material and its frame (along the fiber: t)."""

    material: PackedFiber
    prepared: PreparedFiber
    frame: Any

    def eval(self, direction: Any) -> tuple[Any, Any]:
        """Value times cosine, and density, of light from ``direction``."""
        w = self.frame.to_local(direction)
        cos_ti = dr.sqrt(dr.maximum(w.x * w.x + w.z * w.z, 1e-16))
        return eval_fiber(self.material, self.prepared, w.y, cos_ti, azimuth(w.x, w.z))

    def sample(self, u0: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
        """(direction, value over density, density)."""
        sin_ti, cos_ti, alpha = sample_fiber(self.material, self.prepared, u0, u1, u2)
        sin_alpha, cos_alpha = dr.sincos(alpha)
        direction = self.frame.to_world(mi.Vector3f(cos_ti * sin_alpha, sin_ti, cos_ti * cos_alpha))
        value, pdf = eval_fiber(self.material, self.prepared, sin_ti, cos_ti, alpha)
        return direction, dr.select(pdf > 0.0, value / dr.maximum(pdf, 1e-30), 0.0), pdf


def fiber_vertex(material: PackedFiber, tangent: Any, normal: Any, viewer: Any) -> FiberVertex:
    """A hit on a fiber seen from the unit direction ``viewer``, with orthogonal unit tangent and normal."""
    frame = mi.Frame3f(dr.cross(tangent, normal), tangent, normal)
    w = frame.to_local(viewer)
    return FiberVertex(material, prepare_fiber(material, w.x, w.y, w.z), frame)
