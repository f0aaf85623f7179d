"""UsdPreviewSurface as a Mitsuba plugin, `usdfab_surface`: the same formulas as the tracer's, for compiled variants.

    register_surface_bsdf()                                   # once, after mi.set_variant
    mi.load_dict({"type": "twosided", "bsdf": {"type": "usdfab_surface", "base_color": {...}, "roughness": 0.4}},
                 parallel=False)

=================== ================ ===================================================================
property            type             meaning
=================== ================ ===================================================================
base_color          rgb or texture   diffuseColor; default 0.18
roughness, metallic float or texture the first of a texture's colours; defaults 0.5 and 0
specular_color      rgb or texture   F0 of the specular workflow, in which metallic is ignored; optional
ior                 float            default 1.5
clearcoat           float            default 0
clearcoat_roughness float            default 0.01
=================== ================ ===================================================================

Light above the horizon only: wrap it in `twosided`. Opacity and emission are Mitsuba's `mask` and `area`.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from usdfab.scattering.surface_drjit import PreparedSurface, eval_surface, prepare_surface, sample_surface

__all__ = ["SURFACE", "register_surface_bsdf"]

SURFACE = "usdfab_surface"

_registered: set[str] = set()


def register_surface_bsdf() -> None:
    """Make the plugin known to the current variant of Mitsuba, one with Dr.Jit; again is harmless."""
    if mi.variant() not in _registered:
        mi.register_bsdf(SURFACE, _plugin_class())
        _registered.add(mi.variant())


def _input(props: Any, name: str, default: Any) -> Any:
    """A texture, a number or a colour."""
    value = props.get(name, default)
    if value is None or isinstance(value, (mi.Texture, int, float)):
        return value
    return mi.Color3f([float(value[k]) for k in range(3)])


def _plugin_class() -> type:
    class SurfaceBSDF(mi.BSDF):
        def __init__(self, props: Any) -> None:
            base = _input(props, "base_color", 0.18)
            roughness, metallic = _input(props, "roughness", 0.5), _input(props, "metallic", 0.0)
            specular_color = _input(props, "specular_color", None)
            ior = float(props.get("ior", 1.5))
            coat, coat_roughness = float(props.get("clearcoat", 0.0)), float(props.get("clearcoat_roughness", 0.01))
            super().__init__(props)
            self.base, self.roughness, self.metallic, self.specular_color = base, roughness, metallic, specular_color
            self.f0 = ((1.0 - ior) / (1.0 + ior)) ** 2
            self.coat, self.coat_roughness = coat, coat_roughness
            self.specular = specular_color is not None or self.f0 > 0.0 or metallic != 0.0
            flags = mi.BSDFFlags
            self.m_components = [flags.GlossyReflection | flags.FrontSide]
            self.m_flags = self.m_components[0]

        def traverse(self, callback: Any) -> None:
            for name in ("base", "roughness", "metallic", "specular_color"):
                value = getattr(self, name)
                if isinstance(value, mi.Texture):
                    callback.put(name, value, mi.ParamFlags.NonDifferentiable)

        def _color(self, value: Any, si: Any, active: Any) -> Any:
            return mi.Color3f(value.eval(si, active) if isinstance(value, mi.Texture) else value)

        def _prepare(self, si: Any, active: Any) -> PreparedSurface:
            workflow = self.specular_color is not None
            metallic = 0.0 if workflow else self.metallic
            return prepare_surface(
                self._color(self.base, si, active),
                self._color(self.roughness, si, active).x,
                self._color(metallic, si, active).x,
                self._color(self.specular_color if workflow else self.f0, si, active),
                si.wi.z,
                specular=self.specular, coat=self.coat, coat_roughness=self.coat_roughness, coat_f0=self.f0,
            )  # fmt: skip

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            # Mitsuba's wi goes to the viewer, its wo to the light: the formulas' wo and wi.
            value, pdf = eval_surface(self._prepare(si, active), wo, si.wi)
            return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            prep = self._prepare(si, active)
            sample = dr.zeros(mi.BSDFSample3f)
            sample.wo = sample_surface(prep, si.wi, sample1, sample2.x, sample2.y)
            value, pdf = eval_surface(prep, sample.wo, si.wi)
            sample.pdf = dr.select(active, pdf, 0.0)
            sample.eta = 1.0
            sample.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            sample.sampled_component = 0
            valid = active & (pdf > 0.0)
            return sample, dr.select(valid, value / dr.maximum(pdf, 1e-30), 0.0)

        def to_string(self) -> str:
            return f"SurfaceBSDF[base_color = {self.base}, roughness = {self.roughness}]"

    return SurfaceBSDF
