"""Materials without fibers: UsdPreviewSurface with its textures, else displayColor, else grey."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.problems import Problems
from usdfab.usd.read_textures import as_numbers, read_texture, source_output, source_shader, value
from usdfab.usd.scene import Array, Material, Texture

GREY = (0.5, 0.5, 0.5)
"""Colour of what has neither a material nor a displayColor."""

_FALLBACKS = {
    "diffuseColor": (0.18, 0.18, 0.18),
    "emissiveColor": (0.0, 0.0, 0.0),
    "specularColor": (0.0, 0.0, 0.0),
    "metallic": (0.0,),
    "roughness": (0.5,),
    "clearcoat": (0.0,),
    "clearcoatRoughness": (0.01,),
    "opacity": (1.0,),
    "opacityThreshold": (0.0,),
    "ior": (1.5,),
    "normal": (0.0, 0.0, 1.0),
}
"""UsdPreviewSurface's inputs that usdfab knows, with its specification's defaults."""
_COLORS = ("diffuseColor", "emissiveColor", "specularColor")


@dataclass(frozen=True, eq=False)
class Look:
    """A material, and the names of the primvars from which its textures read their coordinates."""

    material: Material
    uv_names: tuple[str, ...] = ()


def read_material(prim: Usd.Prim, time: Usd.TimeCode, problems: Problems) -> Look:
    """The UsdPreviewSurface of a Material prim.

    An input that is not finite or of the wrong type, and a texture whose image is missing, are faults: the input then
    has its default, the texture its ``fallback``. Other nodes than UsdUVTexture count with a constant value. A material
    without a UsdPreviewSurface is grey.
    """
    place = str(prim.GetPath())
    source, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not source or source.GetIdAttr().Get() != "UsdPreviewSurface":
        problems.warn(f"{place}: no UsdPreviewSurface, shown grey")
        return Look(plain_material(place, GREY))
    constants: dict[str, Array] = {}
    textures: dict[str, Texture] = {}
    names: list[str] = []
    for name, fallback in _FALLBACKS.items():
        constants[name] = np.array(fallback)
        with problems.tolerating(place, f"{name} is {_text(constants[name])}"):
            constants[name], texture, varname = _input(source, name, time, problems)
            if texture:
                textures[name] = texture
                names.append(varname)
    displacement = source.GetInput("displacement")
    if displacement and (source_shader(displacement) or displacement.Get(time)):
        problems.warn(f"{place}: displacement is not supported, left out")
    specular = bool(value(source, "useSpecularWorkflow", 0, time))
    for unused in ("specularColor",) if not specular else ("metallic",):
        textures.pop(unused, None)
    constant = {name: float(numbers[0]) for name, numbers in constants.items() if len(numbers) == 1}
    if (constants["normal"] != (0.0, 0.0, 1.0)).any() and "normal" not in textures:
        problems.warn(f"{place}: a constant normal is not supported, left out")
    material = Material(
        place, -1, constants["diffuseColor"], constant["roughness"],
        0.0 if specular else constant["metallic"], constant["opacity"],
        emissive=constants["emissiveColor"],
        specular_color=constants["specularColor"] if specular else None,
        clearcoat=constant["clearcoat"], clearcoat_roughness=constant["clearcoatRoughness"],
        ior=constant["ior"], opacity_threshold=constant["opacityThreshold"], textures=textures,
    )  # fmt: skip
    return Look(material, tuple(dict.fromkeys(n for n in names if n)))


def _input(
    source: UsdShade.Shader, name: str, time: Usd.TimeCode, problems: Problems
) -> tuple[Array, Texture | None, str]:
    """An input's constant, its texture, and the primvar that the texture's coordinates come from."""
    fallback = _FALLBACKS[name]
    shade_input, place = source.GetInput(name), f"{source.GetPath()}.inputs:{name}"
    node = source_shader(shade_input) if shade_input else None
    numbers = partial(as_numbers, width=len(fallback), place=place)
    if node is None:
        return numbers(value(source, name, fallback, time)), None, ""
    constant = _fallback_of(node, source_output(shade_input), fallback, time)
    if node.GetIdAttr().Get() != "UsdUVTexture":
        problems.warn(f"{source.GetPath()}: {name} comes from {node.GetPath()}, taken as constant")
        return numbers(constant), None, ""
    texture, varname = None, ""
    with problems.tolerating(place, f"{name} is {_text(np.asarray(constant, dtype=float))}"):
        color = name in _COLORS
        texture, varname, warnings = read_texture(node, source_output(shade_input), time, color=color)
        problems.warn(*warnings)
        if texture is None:
            problems.warn(f"{source.GetPath()}: {name} comes from {node.GetPath()}, which names no image")
    return numbers(constant), texture, varname


def _fallback_of(
    node: UsdShade.Shader, output: str, default: tuple[float, ...], time: Usd.TimeCode
) -> tuple[float, ...]:
    """What a texture or reader gives where it cannot read: its ``fallback``, in the channels that are connected."""
    try:
        raw = np.asarray(value(node, "fallback", (), time), dtype=float).ravel()
    except (TypeError, ValueError):
        return default
    if len(raw) == 4 and output in ("r", "g", "b", "a"):
        return (float(raw["rgba".index(output)]),) * len(default)
    if len(raw) < len(default):
        return default
    return tuple(float(v) for v in raw[: len(default)])


def _text(numbers: Array) -> str:
    return ", ".join(f"{v:g}" for v in np.atleast_1d(numbers))


def unbound_material(prim: Usd.Prim, time: Usd.TimeCode, problems: Problems) -> Material:
    """The material of a mesh that has none: its mean displayColor and displayOpacity, else grey."""
    path, api = str(prim.GetPath()), UsdGeom.PrimvarsAPI(prim)
    rgb, alpha = np.array(GREY), 1.0
    with problems.tolerating(path, "the mesh is shown grey"):
        rgb = _mean(api, "displayColor", rgb, time)
        alpha = float(_mean(api, "displayOpacity", np.ones(1), time)[0])
    return plain_material(path, rgb, alpha)


def _mean(api: UsdGeom.PrimvarsAPI, name: str, fallback: Array, time: Usd.TimeCode) -> Array:
    primvar = api.FindPrimvarWithInheritance(name)
    raw = primvar.ComputeFlattened(time) if primvar and primvar.HasValue() else None
    if raw is None or np.size(raw) == 0:
        return fallback
    found = np.asarray(raw, dtype=np.float64).reshape(-1, len(fallback)).mean(axis=0)
    if not np.isfinite(found).all():
        raise UsdfabError("a value is not finite", place=f"{api.GetPrim().GetPath()}.primvars:{name}")
    return found


def plain_material(path: str, color: Array | tuple[float, float, float], opacity: float = 1.0) -> Material:
    """A matt surface of one colour, without a reflection (an index of 1)."""
    return Material(path, -1, np.asarray(color, dtype=np.float64), 0.5, 0.0, opacity, ior=1.0)
