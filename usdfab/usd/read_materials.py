"""Materials without fibers, reduced to constants: UsdPreviewSurface, else displayColor, else grey."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.scene import Array, Material
from usdfab.usd.stage import site

GREY = (0.5, 0.5, 0.5)
"""Colour of what has neither a material nor a displayColor."""


def read_material(prim: Usd.Prim, time: Usd.TimeCode) -> tuple[Material, list[str]]:
    """The UsdPreviewSurface of a Material prim with constant inputs, and warnings for what is not constant.

    A texture counts with its ``fallback`` colour; a material without a UsdPreviewSurface is grey.
    """
    place = str(prim.GetPath())
    source, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not source or source.GetIdAttr().Get() != "UsdPreviewSurface":
        return plain_material(place, GREY), [f"{place}: no UsdPreviewSurface, shown grey"]
    warnings: list[str] = []

    def value(name: str, fallback: object) -> np.ndarray:
        found = _constant(source.GetInput(name), time, place, warnings)
        return np.asarray(fallback if found is None else found, dtype=np.float64)

    color = _checked(prim, value("diffuseColor", (0.18, 0.18, 0.18)), "diffuseColor")
    roughness, metallic, opacity = (
        float(_checked(prim, value(name, fallback), name))
        for name, fallback in (("roughness", 0.5), ("metallic", 0.0), ("opacity", 1.0))
    )
    return Material(place, -1, color, roughness, metallic, opacity), warnings


def _constant(shade_input: UsdShade.Input, time: Usd.TimeCode, place: str, warnings: list[str]) -> object:
    """The input's value, through connections to interface inputs; a texture's fallback colour."""
    if not shade_input:
        return None
    for attribute in shade_input.GetValueProducingAttributes():
        if UsdShade.Utils.GetType(attribute.GetName()) != UsdShade.AttributeType.Output:
            return attribute.Get(time)
        shader = UsdShade.Shader(attribute.GetPrim())
        warnings.append(f"{place}: {shade_input.GetBaseName()} comes from {attribute.GetPath()}, taken as constant")
        fallback = shader.GetInput("fallback") if shader else None
        if fallback and fallback.Get(time) is not None:
            color = np.asarray(fallback.Get(time), dtype=float)
            return color[:3] if shade_input.GetTypeName().isArray or "3" in str(shade_input.GetTypeName()) else color[0]
        return None
    return shade_input.Get(time)


def _checked(prim: Usd.Prim, value: np.ndarray, name: str) -> np.ndarray:
    if not np.isfinite(value).all():
        raise UsdfabError(f"{name} is not finite", place=site(prim.GetStage(), prim))
    return value


def unbound_material(prim: Usd.Prim, time: Usd.TimeCode) -> Material:
    """The material of a mesh that has none: its mean displayColor and displayOpacity, else grey."""
    gprim = UsdGeom.Gprim(prim)
    color, opacity = gprim.GetDisplayColorAttr().Get(time), gprim.GetDisplayOpacityAttr().Get(time)
    rgb = np.asarray(color, dtype=float).reshape(-1, 3).mean(axis=0) if color is not None and len(color) else GREY
    alpha = float(np.mean(opacity)) if opacity is not None and len(opacity) else 1.0
    return plain_material(str(prim.GetPath()), _checked(prim, np.asarray(rgb, dtype=float), "displayColor"), alpha)


def plain_material(path: str, color: Array | tuple[float, float, float], opacity: float = 1.0) -> Material:
    """A matt surface of one colour."""
    return Material(path, -1, np.asarray(color, dtype=np.float64), 0.5, 0.0, opacity)
