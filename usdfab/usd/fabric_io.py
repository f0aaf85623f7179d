"""Fabrics as USD: a Material prim that carries every parameter, and a preview surface for viewers that know no fibers.

A fabric file holds the Material ``/Looks/Fabric`` in the Scope ``/Looks``, its default prim (a bare Material as default
prim fails asset checkers). Other stages reference ``@fabric.usda@</Looks/Fabric>``, or the whole scope by
``@fabric.usda@``. All lengths are in metres whatever the stage's units.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters, Provenance, Weave, YarnParameters
from usdfab.usd.atomic import checked_output, export_layer
from usdfab.usd.registration import FABRIC_API, YARN_API, require_schema
from usdfab.usd.schema_source import (
    FABRIC_ATTRIBUTES,
    SCHEMA_VERSION,
    YARN_ATTRIBUTES,
    SchemaAttribute,
    fabric_attribute_name,
    yarn_attribute_name,
)
from usdfab.usd.stage import new_stage, open_stage, site, stage_name

LOOKS_PATH = "/Looks"
FABRIC_PATH = "/Looks/Fabric"
Color = tuple[float, float, float]


# --- writing ---------------------------------------------------------------------------------------------------------


def write_fabric(
    fabric: FabricParameters, path: str | Path, *, meters_per_uv: float = 0.0, overwrite: bool = False
) -> Path:
    """Write ``fabric`` as a USD file (``.usda``, ``.usdc`` or ``.usd``) and return its path.

    Parameters
    ----------
    meters_per_uv: metres
        Length on the cloth of one unit of its texture coordinates; 0 leaves it to be measured on each surface.

    Raises
    ------
    UsdfabError
        If the file exists (unless ``overwrite``), cannot be written, or a text in the fabric cannot be stored.
    """
    checked_output(path, overwrite=overwrite)
    fabric = with_relative_files(fabric, Path(path).parent)
    stage = new_stage()
    stage.SetDefaultPrim(UsdGeom.Scope.Define(stage, LOOKS_PATH).GetPrim())
    define_fabric_material(stage, FABRIC_PATH, fabric, meters_per_uv=meters_per_uv)
    return export_layer(stage.GetRootLayer(), path, overwrite=overwrite)


def with_relative_files(fabric: FabricParameters, folder: Path) -> FabricParameters:
    """The fabric with the files that it names as seen from ``folder``."""
    return replace(
        fabric, albedo_map=relative_path(fabric.albedo_map, folder),
        neural_weights=relative_path(fabric.neural_weights, folder),
    )  # fmt: skip


def relative_path(file: str, folder: Path) -> str:
    """``file`` as seen from ``folder``, with forward slashes, so that both can be moved together."""
    if not file:
        return ""
    try:
        found = Path(os.path.relpath(Path(file).absolute(), folder.absolute())).as_posix()
    except ValueError:  # on another drive
        return Path(file).absolute().as_posix()
    return found if found.startswith(".") else f"./{found}"


def define_fabric_material(
    stage: Usd.Stage, path: str | Sdf.Path, fabric: FabricParameters, *, meters_per_uv: float = 0.0
) -> UsdShade.Material:
    """Define a Material at ``path`` that carries ``fabric``; every attribute is authored, also at its default.

    Files are authored only where there are any, relative ones as they are: relative to the layer.

    Authors both API schemas with all attributes, and ``outputs:surface`` connected to a UsdPreviewSurface called
    ``Preview`` (``preview_color``, ``preview_roughness``).

    Raises
    ------
    UsdfabError
        If the path is taken by a prim that is not a Material, a text holds characters that USD cannot store, or
        ``meters_per_uv`` is negative or not finite.
    """
    require_schema()
    path = Sdf.Path(path)
    prim = stage.GetPrimAtPath(path)
    if prim and prim.GetTypeName() not in ("", "Material"):
        raise UsdfabError(f"a {prim.GetTypeName()} is in the fabric's place", place=site(stage, path))
    if not (np.isfinite(meters_per_uv) and meters_per_uv >= 0):
        raise UsdfabError(f"{meters_per_uv} is not a length of 0 or more", place="meters_per_uv")
    values = fabric_values(fabric, meters_per_uv)
    check_texts(values)
    material = UsdShade.Material.Define(stage, path)
    prim = material.GetPrim()
    prim.ApplyAPI(FABRIC_API)
    for attribute in FABRIC_ATTRIBUTES:
        # An empty asset path is a broken reference to USD's validators.
        if attribute.type_name != "asset" or values[attribute.name]:
            _author(prim, fabric_attribute_name(attribute.name), attribute, values[attribute.name])
    for system in SYSTEMS:
        prim.ApplyAPI(YARN_API, system)
        yarn = fabric.system(system)
        for attribute in YARN_ATTRIBUTES:
            _author(prim, yarn_attribute_name(system, attribute.name), attribute, getattr(yarn, attribute.field))
    _define_preview(stage, material, fabric)
    return material


def fabric_values(fabric: FabricParameters, meters_per_uv: float) -> dict[str, Any]:
    """Python values of all ``FABRIC_ATTRIBUTES`` by their names."""
    values = {a.name: getattr(fabric.provenance, a.field) for a in FABRIC_ATTRIBUTES if a.group == "Provenance"}
    return values | {
        "schemaVersion": SCHEMA_VERSION,
        "name": fabric.name,
        "weave:name": fabric.weave.name,
        "weave:size": (fabric.weave.picks, fabric.weave.ends),
        "weave:matrix": fabric.weave.matrix.astype(int).ravel().tolist(),
        "sampleSize": fabric.size,
        "seed": fabric.seed,
        "variants": fabric.variants,
        "metersPerUv": meters_per_uv,
        "albedoMap": fabric.albedo_map,
        "neural:weights": fabric.neural_weights,
    }


def check_texts(values: Mapping[str, Any]) -> None:
    """``UsdfabError`` if a text among the values holds characters that USD files cannot store."""
    for name, value in values.items():
        for text in [value] if isinstance(value, str) else value if isinstance(value, tuple) else []:
            if not isinstance(text, str):
                continue
            bad = [c for c in text if (ord(c) < 32 and c not in "\n\t") or 0xD800 <= ord(c) < 0xE000 or ord(c) == 127]
            if bad:
                raise UsdfabError(
                    f"the text holds {bad[0]!r}, which USD files cannot store", place=name, remedy="remove it"
                )


TO_USD: dict[str, Any] = {
    "int": int,
    "double": float,
    "string": str,
    "asset": Sdf.AssetPath,
    "int2": lambda v: Gf.Vec2i(*map(int, v)),
    "double2": lambda v: Gf.Vec2d(*map(float, v)),
    "color3d": lambda v: Gf.Vec3d(*map(float, v)),
    "int[]": lambda v: Vt.IntArray(v),
    "string[]": lambda v: Vt.StringArray(v),
    "color3d[]": lambda v: Vt.Vec3dArray([Gf.Vec3d(*map(float, c)) for c in v]),
}
"""From a Python value to USD's, by the attribute's type name."""


def _author(prim: Usd.Prim, name: str, attribute: SchemaAttribute, value: Any) -> None:
    type_name = Sdf.ValueTypeNames.Find(attribute.type_name)
    created = prim.CreateAttribute(name, type_name, custom=False, variability=Sdf.VariabilityUniform)
    created.Set(TO_USD[attribute.type_name](value))


def _weighted(fabric: FabricParameters, warp: float, weft: float) -> float:
    """The mean of one value per system, weighted by how often each is on top at a crossing."""
    share = fabric.weave.weft_cover()
    return (1.0 - share) * warp + share * weft


def preview_color(fabric: FabricParameters) -> Color:
    """A simple estimate of the cloth's colour, linear Rec. 709: the mean over one repeat of the top yarn's albedo C.

    C is the fiber's albedo *coefficient*. Light that scatters many times between fibers makes cloth darker and more
    saturated than C, gaps show what is behind; neither is counted, so a viewer shows a somewhat pale cloth.
    """
    picks, ends = fabric.repeat()
    matrix = fabric.weave.tiled(picks // fabric.weave.picks, ends // fabric.weave.ends).matrix.astype(float)
    weft, warp = (np.asarray(fabric.system(s).colors()) for s in ("weft", "warp"))
    weft_rows, warp_columns = weft[np.arange(picks) % len(weft)], warp[np.arange(ends) % len(warp)]
    top = matrix.mean(axis=1) @ weft_rows / picks + (1.0 - matrix).mean(axis=0) @ warp_columns / ends
    return cast(Color, tuple(float(c) for c in np.clip(top, 0.0, 1.0)))


def preview_roughness(fabric: FabricParameters) -> float:
    """Roughness for the preview surface, in [0, 1]: sqrt(gamma_M) of the systems, weighted by how much is on top.

    A rule of thumb, not a measurement: 0.7 for spun yarns (gamma_M = 0.5), 0.3 for bright filament (0.1).
    """
    warp, weft = (float(np.sqrt(fabric.system(s).roughness_longitudinal)) for s in SYSTEMS)
    return _weighted(fabric, warp, weft)


def preview_values(fabric: FabricParameters) -> list[tuple[str, Sdf.ValueTypeName, Any]]:
    """Name, type and value of the preview surface's inputs; colours as tuples."""
    types = Sdf.ValueTypeNames
    return [
        ("diffuseColor", types.Color3f, preview_color(fabric)),
        ("roughness", types.Float, preview_roughness(fabric)),
        ("metallic", types.Float, 0.0),
        ("ior", types.Float, _weighted(fabric, fabric.warp.ior, fabric.weft.ior)),
        ("opacity", types.Float, 1.0),
    ]


def _define_preview(stage: Usd.Stage, material: UsdShade.Material, fabric: FabricParameters) -> None:
    shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Preview"))
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, type_name, value in preview_values(fabric):
        shader.CreateInput(name, type_name).Set(Gf.Vec3f(*value) if isinstance(value, tuple) else value)
    surface = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface)


# --- reading ---------------------------------------------------------------------------------------------------------


def fabric_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Every prim that carries a fabric, in stage order, instances included."""
    return [p for p in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()) if is_fabric(p)]


def is_fabric(prim: Usd.Prim) -> bool:
    """Whether usdfab's fabric schema is applied to ``prim``."""
    return bool(prim) and FABRIC_API in prim.GetAppliedSchemas()


def read_fabric(source: str | Path | Usd.Stage, prim_path: str | Sdf.Path | None = None) -> FabricParameters:
    """The fabric of a file or stage; exactly what ``write_fabric`` was given.

    Parameters
    ----------
    prim_path:
        The Material, where the stage holds several fabrics.

    Raises
    ------
    UsdfabError
        If the file is missing or not USD, holds no fabric or several, or an attribute is missing, not finite or out
        of range; the place is then ``file</prim.attribute>``.
    """
    stage = open_stage(source)
    return fabric_from_prim(find_fabric(stage, prim_path))


def read_meters_per_uv(source: str | Path | Usd.Stage, prim_path: str | Sdf.Path | None = None) -> float:
    """Metres per unit of uv that the fabric asks for; 0 where it is to be measured. Errors as ``read_fabric``."""
    stage = open_stage(source)
    return meters_per_uv_from_prim(find_fabric(stage, prim_path))


def find_fabric(stage: Usd.Stage, prim_path: str | Sdf.Path | None = None) -> Usd.Prim:
    """The prim that carries the stage's only fabric, or the one at ``prim_path``. Errors as ``read_fabric``."""
    require_schema()
    if prim_path is not None:
        try:
            prim = stage.GetPrimAtPath(prim_path)
        except (Tf.ErrorException, RuntimeError) as error:
            raise UsdfabError(f"'{prim_path}' is not a prim path", place=stage_name(stage)) from error
        if not prim:
            raise UsdfabError("there is no such prim", place=f"{stage_name(stage)}<{prim_path}>")
        if not is_fabric(prim):
            raise UsdfabError("this prim is not a usdfab fabric", place=site(stage, prim))
        return prim
    prims = fabric_prims(stage)
    if not prims:
        raise UsdfabError(
            "there is no fabric in this stage",
            place=stage_name(stage),
            remedy="make one with `usdfab fit photo.png` or `usdfab new plain`",
        )
    if len(prims) > 1:
        names = ", ".join(str(p.GetPath()) for p in prims)
        raise UsdfabError(f"there are several fabrics ({names})", place=stage_name(stage), remedy="name one of them")
    return prims[0]


def fabric_from_prim(prim: Usd.Prim) -> FabricParameters:
    """The fabric that ``prim`` carries. Errors as ``read_fabric``."""
    values = {a.name: _read(prim, fabric_attribute_name(a.name), a) for a in FABRIC_ATTRIBUTES}
    if values["schemaVersion"] > SCHEMA_VERSION:
        place = _attribute_site(prim, fabric_attribute_name("schemaVersion"))
        raise UsdfabError(f"version {values['schemaVersion']} is newer than this usdfab", place=place, remedy="update")
    provenance = {a.field: values[a.name] for a in FABRIC_ATTRIBUTES if a.group == "Provenance"}
    provenance = {k: tuple(v) if not isinstance(v, str) else v for k, v in provenance.items()}
    with _at(prim, fabric_attribute_name("weave:matrix")):
        weave = Weave(_weave_matrix(prim, values), values["weave:name"])
    yarns = {system: _yarn_from_prim(prim, system) for system in SYSTEMS}
    places = {"size": "sampleSize", "seed": "seed", "variants": "variants"}
    with _at(prim, {field: fabric_attribute_name(name) for field, name in places.items()}):
        return FabricParameters(
            weave, values["sampleSize"], yarns["warp"], yarns["weft"], values["seed"], values["name"],
            Provenance(**provenance), values["variants"], values["albedoMap"],
            values["neural:weights"],
        )  # fmt: skip


def meters_per_uv_from_prim(prim: Usd.Prim) -> float:
    """``usdfab:metersPerUv`` of a fabric prim, checked: finite and not negative."""
    attribute = next(a for a in FABRIC_ATTRIBUTES if a.name == "metersPerUv")
    name = fabric_attribute_name(attribute.name)
    value = float(_read(prim, name, attribute))
    if not (np.isfinite(value) and value >= 0):
        raise UsdfabError(f"{value} is not a length of 0 or more", place=_attribute_site(prim, name))
    return value


def _weave_matrix(prim: Usd.Prim, values: Mapping[str, Any]) -> np.ndarray:
    picks, ends = values["weave:size"]
    matrix = np.asarray(values["weave:matrix"], dtype=int)
    if picks < 1 or ends < 1 or len(matrix) != picks * ends:
        raise UsdfabError(
            f"the matrix has {len(matrix)} values, the size {picks} x {ends} asks for {picks * ends}",
            place=_attribute_site(prim, fabric_attribute_name("weave:matrix")),
        )
    return matrix.reshape(picks, ends)


def _yarn_from_prim(prim: Usd.Prim, system: str) -> YarnParameters:
    names = {a.field: yarn_attribute_name(system, a.name) for a in YARN_ATTRIBUTES}
    values = {a.field: _read(prim, names[a.field], a) for a in YARN_ATTRIBUTES}
    with _at(prim, names):
        return YarnParameters(**{f.name: values[f.name] for f in fields(YarnParameters)})


_FROM_USD: dict[str, Any] = {
    "int": int,
    "double": float,
    "string": str,
    "asset": lambda v: str(v.resolvedPath or v.path),
    "int2": lambda v: (int(v[0]), int(v[1])),
    "double2": lambda v: (float(v[0]), float(v[1])),
    "color3d": lambda v: (float(v[0]), float(v[1]), float(v[2])),
    "int[]": lambda v: tuple(int(x) for x in v),
    "string[]": lambda v: tuple(str(x) for x in v),
    "color3d[]": lambda v: tuple((float(c[0]), float(c[1]), float(c[2])) for c in v),
}


def _read(prim: Usd.Prim, name: str, attribute: SchemaAttribute) -> Any:
    place = _attribute_site(prim, name)
    found = prim.GetAttribute(name)
    value = found.Get() if found else None
    if value is None:
        raise UsdfabError("the attribute is missing", place=place, remedy="write the fabric again with usdfab")
    try:
        if attribute.type_name == "asset" and value.path and not value.resolvedPath:
            # A missing file too is named as seen from the layer that names it.
            return found.GetPropertyStack(Usd.TimeCode.Default())[0].layer.ComputeAbsolutePath(value.path)
        return _FROM_USD[attribute.type_name](value)
    except (AttributeError, TypeError, ValueError, IndexError) as error:
        expected = attribute.type_name
        raise UsdfabError(f"expected a value of type {expected}, got {value!r}", place=place) from error


def _attribute_site(prim: Usd.Prim, name: str) -> str:
    return f"{stage_name(prim.GetStage())}<{prim.GetPath()}.{name}>"


@contextmanager
def _at(prim: Usd.Prim, name: str | Mapping[str, str]) -> Iterator[None]:
    """Turns errors of the fabric's own checks into errors that name the attribute's place in the file.

    ``name``: the attribute, or a mapping to it from the place that the fabric's own error names.
    """
    try:
        yield
    except UsdfabError as error:
        if "<" in error.place:
            raise
        attribute = name if isinstance(name, str) else name.get(error.place, "")
        place = _attribute_site(prim, attribute) if attribute else site(prim.GetStage(), prim)
        raise UsdfabError(error.problem, place=place, remedy=error.remedy) from error
