"""The fiber BSDF as a Mitsuba plugin, `usdfab_fiber`, differentiable in its color, its roughness and its index.

    register_fiber_bsdf()                                     # once, after mi.set_variant
    mi.load_dict({"type": "bsplinecurve", "filename": "warp.txt", "bsdf": {
        "type": "usdfab_fiber", "albedo": {"type": "rgb", "value": [0.8, 0.4, 0.2]},
        "gamma_m": 0.5, "gamma_n": 0.05, "gamma_m0": 0.12, "eta": 1.55}})

========== ================ ==================================================================== ==============
property   type             meaning                                                              differentiable
========== ================ ==================================================================== ==============
albedo     rgb or texture   albedo coefficient C, linear RGB, (0, 1]; default 0.5                yes
gamma_m    float            longitudinal roughness, [0.01, 1]; default 0.5                       yes
gamma_n    float            azimuthal roughness, [0.01, 1]; default 0.1                          yes
gamma_m0   float            longitudinal roughness of the R lobe, [0.01, 1]; default 0.12        yes
eta        float            index of refraction against what is around, (1, inf); default 1.55   yes
tilt       float            cuticle tilt, rad, [-pi/8, pi/8]; default 0                          no, fixed
========== ================ ==================================================================== ==============

An rgb color is the parameter `albedo`; a texture (a color for each curve: `usdfab.mi.curve_color`, or what a shape's
attributes and uv give) keeps its own parameters below `albedo.`. As in all of Mitsuba, `params.update()` after
`dr.enable_grad` or a new value: what follows from the parameters is computed there, once.

Load scenes that hold it with ``mi.load_dict(..., parallel=False)``: plugins written in Python trace Dr.Jit code when
they are made, which several threads must not do at once.

The formulas, and how they differ from Mitsuba's `hair`, are in `usdfab.scattering.fiber_drjit`. The shading frame has t
along the fiber: `bsplinecurve`, not `linearcurve`, which has no tangent. Sampling is detached, so that the weight
carries the derivative of the value alone: unbiased with every integrator.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from usdfab.errors import UsdfabError
from usdfab.scattering.fiber_drjit import (
    PackedFiber,
    absorption_from_albedo,
    azimuth,
    eval_fiber,
    pack_fiber,
    prepare_fiber,
    sample_fiber,
)

__all__ = ["PLUGIN", "register_fiber_bsdf"]

PLUGIN = "usdfab_fiber"

_ROUGHNESS = {"gamma_m": 0.5, "gamma_n": 0.1, "gamma_m0": 0.12}

_registered: set[str] = set()


def register_fiber_bsdf() -> None:
    """Make the plugin known to the current variant of Mitsuba; again is harmless.

    Raises
    ------
    UsdfabError
        If no variant is set, or one that does not differentiate RGB with Dr.Jit.
    """
    variant = mi.variant()
    if variant not in ("llvm_ad_rgb", "cuda_ad_rgb"):
        raise UsdfabError(
            f"the fiber BSDF does not run in {variant or 'no variant'}",
            place="mitsuba variant",
            remedy="call mitsuba.set_variant with llvm_ad_rgb or cuda_ad_rgb first",
        )
    if variant not in _registered:
        mi.register_bsdf(PLUGIN, _plugin_class())
        _registered.add(variant)


def _number(props: Any, name: str, default: float, low: float, high: float, closed: bool = True) -> float:
    """A property within [low, high], or within (low, high) where it is not closed."""
    value = float(props.get(name, default))
    if not (low <= value <= high if closed else low < value < high):
        interval = f"[{low:.6g}, {high:.6g}]" if closed else f"({low:.6g}, {high:.6g})"
        raise UsdfabError(f"got {value}, expected a number in {interval}", place=name)
    return value


def _color(props: Any) -> Any:
    """The property `albedo`: a texture, or three floats in (0, 1]."""
    value = props.get("albedo", 0.5)
    if isinstance(value, mi.Texture):
        return value
    color = [float(value)] * 3 if isinstance(value, (int, float)) else [float(value[k]) for k in range(3)]
    if not all(0.0 < c <= 1.0 for c in color):
        raise UsdfabError(f"got {color}, expected values in (0, 1]", place="albedo")
    return mi.Color3f(color)


def _plugin_class() -> type:
    """The plugin for the variant that is set; `mi.BSDF` is another class in each."""

    class FiberBSDF(mi.BSDF):
        def __init__(self, props: Any) -> None:
            # Checked before there is an object: Dr.Jit traces all that exist, also those that an error left half made.
            albedo = _color(props)
            roughness = {name: _number(props, name, default, 0.01, 1.0) for name, default in _ROUGHNESS.items()}
            eta = _number(props, "eta", 1.55, 1.0, math.inf, closed=False)
            tilt = _number(props, "tilt", 0.0, -math.pi / 8, math.pi / 8)
            super().__init__(props)
            self.albedo, self.eta, self.tilt = albedo, mi.Float(eta), tilt
            for name, value in roughness.items():
                setattr(self, name, mi.Float(value))
            flags = mi.BSDFFlags
            self.m_components = [
                flags.GlossyReflection | flags.GlossyTransmission | flags.FrontSide | flags.BackSide
                | flags.Anisotropic | flags.NonSymmetric
            ]  # fmt: skip
            self.m_flags = self.m_components[0]
            self.parameters_changed([])

        def traverse(self, callback: Any) -> None:
            for name in ("albedo", *_ROUGHNESS, "eta"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            self.is_textured = isinstance(self.albedo, mi.Texture)
            color = mi.Color3f(1.0) if self.is_textured else self.albedo
            numbers = (self.gamma_m, self.gamma_n, self.gamma_m0, self.eta)
            packed = pack_fiber(color, *numbers, self.tilt)
            # Opaque: values are read from memory, a new one does not mean a new kernel.
            dr.make_opaque(color, *numbers, *packed.arrays())
            self.packed = packed

        def _material(self, si: Any, active: Any) -> PackedFiber:
            if not self.is_textured:
                return self.packed
            albedo = self.albedo.eval(si, active)
            return self.packed._replace(sigma=absorption_from_albedo(albedo, self.gamma_n))

        def _evaluate(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            p = self._material(si, active)
            # Mitsuba's wi goes to the viewer, its wo to the light: the formulas' wo and wi. The axis is t.
            prep = prepare_fiber(p, si.wi.x, si.wi.y, si.wi.z)
            cos_ti = dr.sqrt(dr.maximum(wo.x * wo.x + wo.z * wo.z, 1e-16))
            return eval_fiber(p, prep, wo.y, cos_ti, azimuth(wo.x, wo.z))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            if not ctx.is_enabled(mi.BSDFFlags.Glossy, 0):
                return mi.Color3f(0.0), mi.Float(0.0)
            value, pdf = self._evaluate(si, wo, active)
            return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            sample = dr.zeros(mi.BSDFSample3f)
            if not ctx.is_enabled(mi.BSDFFlags.Glossy, 0):
                return sample, mi.Color3f(0.0)
            p = self._material(si, active)
            prep = prepare_fiber(p, si.wi.x, si.wi.y, si.wi.z)
            with dr.suspend_grad():
                sin_ti, cos_ti, alpha = sample_fiber(p, prep, sample1, sample2.x, sample2.y)
                sin_alpha, cos_alpha = dr.sincos(alpha)
                sample.wo = mi.Vector3f(cos_ti * sin_alpha, sin_ti, cos_ti * cos_alpha)
            value, pdf = eval_fiber(p, prep, sin_ti, cos_ti, alpha)
            sample.pdf = dr.detach(pdf)
            sample.eta = 1.0
            sample.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            sample.sampled_component = 0
            valid = active & (sample.pdf > 0.0)
            return sample, dr.select(valid, value / dr.maximum(sample.pdf, 1e-30), 0.0)

        def to_string(self) -> str:
            values = "".join(f"  {name} = {getattr(self, name)},\n" for name in ("albedo", *_ROUGHNESS, "eta", "tilt"))
            return f"FiberBSDF[\n{values}]"

    return FiberBSDF
