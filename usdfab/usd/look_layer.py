"""Baked maps as the look of a fabric's Material, for programs that know no fibers.

The look goes into a new layer over the fabric's file, which stays as it is: the same Material then holds the fabric's
schema, a UsdPreviewSurface with textures on ``outputs:surface`` and, if wanted, MaterialX' OpenPBR on
``outputs:mtlx:surface`` (``look_materialx.py``). One unit of texture coordinates is ``meters_per_uv`` metres of cloth,
so that the yarns of the maps lie where the fibers are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from usdfab.errors import UsdfabError
from usdfab.usd.assets import relative_asset
from usdfab.usd.atomic import checked_output, export_layer
from usdfab.usd.fabric_io import find_fabric, meters_per_uv_from_prim
from usdfab.usd.look_materialx import define_open_pbr
from usdfab.usd.registration import FABRIC_API
from usdfab.usd.schema_source import fabric_attribute_name
from usdfab.usd.stage import GENERATOR, open_stage, site

COVERED = 0.9995
"""Cloth that covers more than this gets no opacity texture: transparency costs viewers much."""

Color = tuple[float, float, float]


@dataclass(frozen=True)
class MapLook:
    """What the layer needs to know of baked maps.

    Parameters
    ----------
    files:
        By map: albedo, roughness, normal, opacity are wired where they are given.
    size: (2,) metres
        Of cloth that a map shows.
    signed_normals:
        Whether the normal map holds [-1, 1] (EXR) instead of codes of [0, 1].
    linear_albedo:
        Whether the albedo map is linear (EXR) instead of sRGB.
    albedo, roughness, opacity:
        Means of the maps, where the texture cannot be read.
    ior:
        Index of refraction.
    transmittance: (3,)
        Share of light that fibers let through, gaps left out.
    fuzz:
        Share of what is seen that is flyaways.
    facts:
        Plain data about the maps, kept in the layer.
    """

    files: Mapping[str, Path]
    size: tuple[float, float]
    signed_normals: bool
    linear_albedo: bool
    albedo: Color
    roughness: float
    opacity: float
    ior: float
    transmittance: Color
    fuzz: float
    facts: Mapping[str, Any]


def cloth_scale(source: str | Path | Usd.Stage, prim: str | None = None, meters_per_uv: float | None = None) -> float:
    """Metres of cloth for one unit of texture coordinates: what is asked for, what the fabric says, else 1.

    Raises
    ------
    UsdfabError
        As ``find_fabric``, and for a length that is not above 0.
    """
    if meters_per_uv is not None:
        if not 0.0 < meters_per_uv < float("inf"):
            raise UsdfabError(f"{meters_per_uv} is not a length above 0", place="--meters-per-uv")
        return meters_per_uv
    stage = open_stage(source)
    return meters_per_uv_from_prim(find_fabric(stage, prim)) or 1.0


def write_look(
    source: str | Path,
    out: str | Path,
    look: MapLook,
    *,
    prim: str | None = None,
    meters_per_uv: float | None = None,
    materialx: bool = False,
    overwrite: bool = False,
) -> Path:
    """Write a layer that sublayers ``source`` and gives its fabric the look of the maps. Returns ``out``.

    Parameters
    ----------
    prim:
        The Material, where the file holds several fabrics.
    meters_per_uv:
        As ``cloth_scale``; if given, the fabric's own ``metersPerUv`` is overridden too, so that fibers and maps agree.

    Raises
    ------
    UsdfabError
        As ``find_fabric`` and ``export_layer``; for a Material inside an instance, which no layer can change.
    """
    target = checked_output(out, overwrite=overwrite)
    stage = open_stage(source)
    material = find_fabric(stage, prim)
    if material.IsInstanceProxy() or material.IsInPrototype():
        raise UsdfabError("this fabric is inside an instance", place=site(stage, material), remedy="export its file")
    if Path(source).resolve() == target.resolve():
        raise UsdfabError("the output is the fabric itself", place=str(target), remedy="choose another name")
    scale = cloth_scale(stage, prim, meters_per_uv)
    layer = _layer_over(stage, source, target, look)
    over = Usd.Stage.Open(layer)
    wanted = UsdShade.Material(over.GetPrimAtPath(material.GetPath()))
    paths = {name: relative_asset(file, target.parent) for name, file in look.files.items()}
    if meters_per_uv is not None:
        wanted.GetPrim().GetAttribute(fabric_attribute_name("metersPerUv")).Set(float(scale))
    _define_preview(wanted, look, paths, scale)
    if materialx:
        define_open_pbr(wanted, look, paths, scale)
    return export_layer(_relocated(layer, source, target), target, overwrite=overwrite)


def without_fibers(stage: Usd.Stage) -> list[str]:
    """Take the fabric schema from all Materials, in the stage's edit target: what a program without usdfab sees.

    Returns the paths of the Materials.
    """
    changed = []
    for prim in stage.Traverse():
        if FABRIC_API in prim.GetAppliedSchemas():
            prim.SetMetadata("apiSchemas", Sdf.TokenListOp.CreateExplicit([]))
            changed.append(str(prim.GetPath()))
    return changed


def _layer_over(stage: Usd.Stage, source: str | Path, target: Path, look: MapLook) -> Sdf.Layer:
    """An anonymous layer over ``source``, with the metadata that is not composed from sublayers."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.subLayerPaths.append(str(Path(source).resolve()))  # made relative when it is written
    root = stage.GetRootLayer()
    if root.defaultPrim:
        layer.defaultPrim = root.defaultPrim
    layer.pseudoRoot.SetInfo("metersPerUnit", UsdGeom.GetStageMetersPerUnit(stage))
    layer.pseudoRoot.SetInfo("upAxis", UsdGeom.GetStageUpAxis(stage))
    layer.pseudoRoot.SetInfo("kilogramsPerUnit", stage.GetMetadata("kilogramsPerUnit") or 1.0)
    for key in ("startTimeCode", "endTimeCode", "timeCodesPerSecond", "framesPerSecond"):
        if root.pseudoRoot.HasInfo(key):
            layer.pseudoRoot.SetInfo(key, root.pseudoRoot.GetInfo(key))
    layer.customLayerData = {"usdfab": {"generator": GENERATOR, "maps": _storable(look.facts)}}
    return layer


def _relocated(layer: Sdf.Layer, source: str | Path, target: Path) -> Sdf.Layer:
    """A copy (stages hold the layer itself) whose sublayer is seen from the target."""
    copy = Sdf.Layer.CreateAnonymous(".usda")
    copy.TransferContent(layer)
    copy.subLayerPaths[0] = relative_asset(source, target.parent)
    return copy


def _storable(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data as values that USD's dictionaries hold: lists of numbers become arrays."""
    return {key: Vt.DoubleArray(value) if isinstance(value, list) else value for key, value in facts.items()}


def _define_preview(material: UsdShade.Material, look: MapLook, paths: Mapping[str, str], scale: float) -> None:
    """UsdPreviewSurface <- UsdUVTexture <- UsdTransform2d <- UsdPrimvarReader_float2."""
    types = Sdf.ValueTypeNames
    stage, path = material.GetPrim().GetStage(), material.GetPath()

    def node(name: str, kind: str) -> UsdShade.Shader:
        shader = UsdShade.Shader.Define(stage, path.AppendChild(name))
        shader.CreateIdAttr(kind)
        return shader

    source, _, _ = material.ComputeSurfaceSource()
    usable = source and source.GetIdAttr().Get() == "UsdPreviewSurface" and source.GetPath().GetParentPath() == path
    surface = source if usable else node("Preview", "UsdPreviewSurface")
    if not usable:
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))

    reader = node("MapCoordinates", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    reader.CreateInput("fallback", types.Float2).Set(Gf.Vec2f(0.0))
    tiling = node("MapTiling", "UsdTransform2d")
    tiling.CreateInput("in", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    tiling.CreateInput("scale", types.Float2).Set(Gf.Vec2f(scale / look.size[0], scale / look.size[1]))
    place = tiling.CreateOutput("result", types.Float2)

    def texture(name: str, map_name: str, space: str, fallback: tuple[float, ...]) -> UsdShade.Shader:
        shader = node(name, "UsdUVTexture")
        shader.CreateInput("file", types.Asset).Set(Sdf.AssetPath(paths[map_name]))
        shader.CreateInput("sourceColorSpace", types.Token).Set(space)
        shader.CreateInput("wrapS", types.Token).Set("repeat")
        shader.CreateInput("wrapT", types.Token).Set("repeat")
        shader.CreateInput("fallback", types.Float4).Set(Gf.Vec4f(*fallback))
        shader.CreateInput("st", types.Float2).ConnectToSource(place)
        return shader

    def connect(name: str, type_name: Sdf.ValueTypeName, shader: UsdShade.Shader, output: str) -> None:
        kind = types.Float3 if output == "rgb" else types.Float
        surface.CreateInput(name, type_name).ConnectToSource(shader.CreateOutput(output, kind))

    if "albedo" in paths:
        space = "raw" if look.linear_albedo else "sRGB"
        connect("diffuseColor", types.Color3f, texture("AlbedoMap", "albedo", space, (*look.albedo, 1.0)), "rgb")
    if "roughness" in paths:
        shader = texture("RoughnessMap", "roughness", "raw", (look.roughness,) * 3 + (1.0,))
        connect("roughness", types.Float, shader, "r")
    if "normal" in paths:
        shader = texture("NormalMap", "normal", "raw", (0.5, 0.5, 1.0, 1.0))
        one, shift = (1.0, 0.0) if look.signed_normals else (2.0, -1.0)
        shader.CreateInput("scale", types.Float4).Set(Gf.Vec4f(one, one, one, 1.0))
        shader.CreateInput("bias", types.Float4).Set(Gf.Vec4f(shift, shift, shift, 0.0))
        if look.signed_normals:
            shader.GetInput("fallback").Set(Gf.Vec4f(0.0, 0.0, 1.0, 1.0))
        connect("normal", types.Normal3f, shader, "rgb")
    if "opacity" in paths and look.opacity < COVERED:
        shader = texture("OpacityMap", "opacity", "raw", (look.opacity,) * 3 + (1.0,))
        connect("opacity", types.Float, shader, "r")
    surface.CreateInput("ior", types.Float).Set(look.ior)
    surface.CreateInput("metallic", types.Float).Set(0.0)
