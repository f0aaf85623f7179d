"""UsdUVTexture networks as plain data: the image and how texture coordinates reach it.

After the UsdPreviewSurface specification. Its nodes that stand between a surface's input and the mesh:
UsdUVTexture <- UsdTransform2d (any number) <- UsdPrimvarReader_float2.
"""

from __future__ import annotations

import math
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from pxr import Usd, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.usd.assets import image_file
from usdfab.usd.problems import Problems
from usdfab.usd.scene import Array, Texture

LINEAR_SUFFIXES = (".exr", ".hdr")
"""Images that hold linear colour where nothing else is said."""
_WRAPS = {"repeat": "repeat", "clamp": "clamp", "mirror": "mirror", "black": "black", "useMetadata": "black"}
"""``useMetadata`` asks the image file, and is black where it says nothing, as in Hydra; files are not opened here."""
_CHANNELS = ("rgb", "r", "g", "b", "a")
_MAX_CHAIN = 32


def albedo_texture(file: str) -> Texture:
    """A colour image that repeats over uv, linear for ``LINEAR_SUFFIXES``, else sRGB."""
    return Texture(file, "rgb", ("repeat", "repeat"), _is_linear(file, True), np.ones(4), np.zeros(4), _identity())


def albedo_map(fabric: FabricParameters, path: str, problems: Problems) -> Texture | None:
    """A fabric's albedo map, over one unit of uv; a file that does not exist is a fault of the prim at ``path``."""
    if not fabric.albedo_map:
        return None
    if not Path(fabric.albedo_map).is_file():
        problem = f"the albedo map {fabric.albedo_map} does not exist"
        problems.fault(UsdfabError(problem, place=path), "the cloth has its yarns' colours")
        return None
    return albedo_texture(fabric.albedo_map)


def read_texture(
    shader: UsdShade.Shader, output: str, time: Usd.TimeCode, *, color: bool
) -> tuple[Texture | None, str, list[str]]:
    """The texture of a UsdUVTexture node.

    Parameters
    ----------
    output:
        Name of the output that is connected.
    color:
        Whether the input is a colour: an image whose colour space is ``auto`` is then sRGB unless its suffix says
        otherwise; for numbers and normals it is data.

    Returns
    -------
    texture:
        None where the node names no file.
    varname:
        The primvar that the coordinates come from; empty where the network does not say.
    warnings:
        One sentence each.

    Raises
    ------
    UsdfabError
        As ``image_file``, and for numbers that are not finite.
    """
    place = str(shader.GetPath())
    source = shader.GetInput("file")
    attributes = source.GetValueProducingAttributes() if source else []
    file = image_file(attributes[0], time) if attributes else ""
    if not file:
        return None, "", []
    space = str(value(shader, "sourceColorSpace", "auto", time))
    linear = {"raw": True, "sRGB": False}.get(space, _is_linear(file, color))
    warnings = [] if space in ("raw", "sRGB", "auto") else [f"{place}: colour space {space} is unknown, taken as auto"]
    wrap_s, wrap_t = (_WRAPS.get(str(value(shader, name, "useMetadata", time)), "black") for name in ("wrapS", "wrapT"))
    scale, bias = (_numbers(shader, name, 4, fallback, time) for name, fallback in (("scale", 1.0), ("bias", 0.0)))
    transform, varname, more = _coordinates(shader, time)
    channels = output if output in _CHANNELS else "rgb"
    return Texture(file, channels, (wrap_s, wrap_t), linear, scale, bias, transform), varname, warnings + more


def _is_linear(file: str, color: bool) -> bool:
    return not color or PurePath(file).suffix.lower() in LINEAR_SUFFIXES


def _identity() -> Array:
    return np.eye(2, 3)


def _coordinates(shader: UsdShade.Shader, time: Usd.TimeCode) -> tuple[Array, str, list[str]]:
    """(2, 3) transform of uv on the way to ``shader``'s ``st``, the primvar it comes from, and warnings."""
    place, transform, name = str(shader.GetPath()), np.eye(3), "st"
    for _ in range(_MAX_CHAIN):
        node = source_shader(shader.GetInput(name))
        kind = str(node.GetIdAttr().Get()) if node else ""
        if kind == "UsdTransform2d":
            transform = transform @ _transform_2d(node, time)
            shader, name = node, "in"
        elif kind == "UsdPrimvarReader_float2":
            return transform[:2], str(value(node, "varname", "", time)), []
        elif not kind:
            return transform[:2], "", []
        else:
            return (
                transform[:2],
                "",
                [f"{place}: texture coordinates from {kind} are not supported, left out"],
            )
    return transform[:2], "", [f"{place}: the texture coordinates run in a circle"]


def _transform_2d(node: UsdShade.Shader, time: Usd.TimeCode) -> Array:
    """(3, 3): scale, then counter-clockwise rotation in degrees, then translation."""
    scale, shift = (_numbers(node, n, 2, fallback, time) for n, fallback in (("scale", 1.0), ("translation", 0.0)))
    angle = math.radians(float(_numbers(node, "rotation", 1, 0.0, time)[0]))
    sine, cosine = math.sin(angle), math.cos(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    result = np.eye(3)
    result[:2, :2] = rotation @ np.diag(scale)
    result[:2, 2] = shift
    return result


# --- values of shader inputs -----------------------------------------------------------------------------------------


def source_shader(shade_input: UsdShade.Input) -> UsdShade.Shader | None:
    """The node whose output is connected to an input, through interfaces of materials and node graphs."""
    found = _producer(shade_input)
    return UsdShade.Shader(found.GetPrim()) if found and _is_output(found) else None


def source_output(shade_input: UsdShade.Input) -> str:
    """Base name of the output that is connected to an input; empty where none is."""
    found = _producer(shade_input)
    return UsdShade.Output(found).GetBaseName() if found and _is_output(found) else ""


def value(shader: UsdShade.Shader, name: str, fallback: Any, time: Usd.TimeCode) -> Any:
    """The constant value of a node's input, through interface inputs; ``fallback`` where it has none."""
    shade_input = shader.GetInput(name)
    found = _producer(shade_input)
    result = found.Get(time) if found and not _is_output(found) else None
    if result is None and shade_input:
        result = shade_input.GetAttr().Get(time)
    return fallback if result is None else result


def _producer(shade_input: UsdShade.Input | None) -> Usd.Attribute | None:
    attributes = shade_input.GetValueProducingAttributes() if shade_input else []
    return attributes[0] if attributes else None


def _is_output(attribute: Usd.Attribute) -> bool:
    return UsdShade.Utils.GetType(attribute.GetName()) == UsdShade.AttributeType.Output


def _numbers(shader: UsdShade.Shader, name: str, width: int, fallback: float, time: Usd.TimeCode) -> Array:
    place = f"{shader.GetPath()}.inputs:{name}"
    return as_numbers(value(shader, name, fallback, time), width, place)


def as_numbers(raw: object, width: int, place: str) -> Array:
    """(width,) floats; one number stands for all. ``UsdfabError`` at ``place`` for anything else."""
    try:
        numbers = np.asarray(raw, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise UsdfabError(f"expected numbers, got {raw!r}", place=place) from error
    if len(numbers) not in (1, width) or not np.isfinite(numbers).all():
        raise UsdfabError(f"expected {width} finite numbers, got {raw!r}", place=place)
    return np.broadcast_to(numbers, width).copy()
