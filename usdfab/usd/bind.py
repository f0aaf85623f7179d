"""Putting a fabric on the cloth of a user's stage, by a new layer of overs.

The new layer sublayers the stage (nothing is copied or flattened), references the fabric's Material into the stage's
scope of materials, and authors standard ``material:binding`` relationships: any USD program shows the preview surface,
usdfab the fibers. How the fabric is turned and scaled stands in primvars (``usdfab.usd.orientation``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.assets import relative_asset
from usdfab.usd.atomic import atomic_path, checked_output
from usdfab.usd.bind_targets import FAMILY, Target, collection_target, default_targets, listed, prim_target
from usdfab.usd.fabric_io import fabric_from_prim, find_fabric
from usdfab.usd.orientation import ROTATION, SCALE
from usdfab.usd.problems import Problems
from usdfab.usd.schema_source import fabric_attribute_name
from usdfab.usd.stage import GENERATOR, open_stage, stage_name

SCOPES = ("Looks", "Materials", "materials", "mtl", "Material", "Shaders")
"""Names under which stages keep materials; the first that exists is used, else the first is made."""
_OWN = {"subLayers", "subLayerOffsets", "primChildren", "layerRelocates", "owner", "hasOwnedSubLayers", "comment"}
"""Metadata of the user's layer that say nothing about the stage."""


@dataclass(frozen=True)
class Bound:
    """What was written: the file, the Material's path in it, and what it is bound to (prims and collections).

    ``meshes`` are the paths of meshes and subsets that shall show the fabric.
    """

    path: Path
    material: str
    targets: tuple[str, ...]
    meshes: tuple[str, ...]
    warnings: tuple[str, ...]


def bind(
    source: str | Path,
    fabric: str | Path,
    out: str | Path,
    *,
    prims: Sequence[str] = (),
    collections: Sequence[str] = (),
    every: bool = False,
    material: str | None = None,
    variants: Mapping[str, str] | None = None,
    rotate: float | None = None,
    scale: float | None = None,
    meters_per_uv: float | None = None,
    stronger: bool = False,
    overwrite: bool = False,
) -> Bound:
    """Write a stage like ``source`` whose cloth wears a fabric.

    Parameters
    ----------
    source, fabric:
        USD files. ``material`` is the path of the Material in ``fabric``, where that holds several.
    out:
        The layer to write; it names both by relative paths.
    prims, collections:
        Prim paths (meshes, subsets of faces, anything that holds meshes) and collections (``/Prim.collection:name``).
        Without either: the only mesh that looks like cloth, or with ``every`` all that do.
    variants:
        Selections of the Material's variant sets, e.g. of a colourway.
    rotate: degrees
        Turns the fabric from u towards v. None authors nothing.
    scale:
        Yarns and weave are so many times larger than life. None authors nothing.
    meters_per_uv: metres
        Length of one unit of uv on the cloth, in place of what the fabric says.
    stronger:
        Win against bindings further down (``bindMaterialAs = strongerThanDescendants``).

    Raises
    ------
    UsdfabError
        If a file cannot be read or written, ``out`` is one of the stage's own layers, a prim, collection or material
        does not exist or is not fit, there is more than one candidate, or a number is out of range.
    """
    _check_numbers(rotate, scale, meters_per_uv)
    checked_output(out, overwrite=overwrite)
    base = open_stage(source)
    cloth = open_stage(fabric)
    _keep_inputs(out, base, cloth)
    origin = find_fabric(cloth, material)
    fabric_from_prim(origin)
    # What USD itself stumbles over is an error of the user's, like the rest.
    with Problems(strict=True).tolerating(str(source), ""):
        targets = [prim_target(base, path) for path in dict.fromkeys(prims)]
        targets += [collection_target(base, text) for text in dict.fromkeys(collections)]
        targets = targets or default_targets(base, every=every)
        with atomic_path(out, overwrite=overwrite) as temporary:
            stage, warnings = _new_layer(base, temporary)
            writer = _Writer(stage, relative_asset(fabric, temporary.parent), origin.GetPath())
            writer.select(variants or {})
            for target in targets:
                writer.bind(target, stronger=stronger, rotate=rotate, scale=scale)
            if meters_per_uv is not None:
                attribute = writer.material.GetPrim().GetAttribute(fabric_attribute_name("metersPerUv"))
                attribute.Set(float(meters_per_uv))
            warnings += writer.warnings
            warnings += [text for target in targets for text in _overruled(writer, target)]
            path, meshes = str(writer.material.GetPath()), tuple(dict.fromkeys(writer.meshes))
            stage.GetRootLayer().Save()
            del stage, writer
        return Bound(Path(out), path, tuple(t.path for t in targets), meshes, tuple(dict.fromkeys(warnings)))


def _check_numbers(rotate: float | None, scale: float | None, meters_per_uv: float | None) -> None:
    if rotate is not None and not math.isfinite(rotate):
        raise UsdfabError(f"{rotate} is not an angle in degrees", place="rotate")
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UsdfabError(f"{scale} is not a factor above 0", place="scale")
    if meters_per_uv is not None and not (math.isfinite(meters_per_uv) and meters_per_uv >= 0):
        raise UsdfabError(f"{meters_per_uv} is not a length of 0 or more", place="meters-per-uv")


def _keep_inputs(out: str | Path, *stages: Usd.Stage) -> None:
    """Refuse to write onto any layer that is read."""
    target = Path(out).resolve()
    for stage in stages:
        for layer in stage.GetUsedLayers():
            if layer.realPath and Path(layer.realPath).resolve() == target:
                raise UsdfabError("the file to write is one that is read", place=str(out), remedy="choose another name")


# --- the layer -------------------------------------------------------------------------------------------------------


def _new_layer(base: Usd.Stage, path: Path) -> tuple[Usd.Stage, list[str]]:
    """A stage over ``base`` in a new file that opens as ``base`` does, and warnings."""
    warnings = []
    layer, root = Sdf.Layer.CreateNew(str(path)), base.GetRootLayer()
    layer.subLayerPaths.append(relative_asset(root.realPath, path.parent))
    for key in root.pseudoRoot.ListInfoKeys():
        if key not in _OWN:
            layer.pseudoRoot.SetInfo(key, _moved(root, path.parent, root.pseudoRoot.GetInfo(key)))
    layer.customLayerData = {**root.customLayerData, "usdfab": {"generator": GENERATOR}}
    stage = Usd.Stage.Open(layer)
    if not base.HasAuthoredMetadata("metersPerUnit"):
        meters = UsdGeom.GetStageMetersPerUnit(base)
        warnings.append(f"{stage_name(base)}: metersPerUnit is not authored, {meters:g} it is, as USD has it")
        UsdGeom.SetStageMetersPerUnit(stage, meters)
    if not base.HasAuthoredMetadata("upAxis"):
        UsdGeom.SetStageUpAxis(stage, UsdGeom.GetStageUpAxis(base))
    roots = [p for p in base.GetPseudoRoot().GetChildren() if not p.IsAbstract()]
    if not base.GetDefaultPrim() and len(roots) == 1:
        stage.SetDefaultPrim(stage.GetPrimAtPath(roots[0].GetPath()))
    elif not base.GetDefaultPrim():
        warnings.append(f"{stage_name(base)}: the stage has no default prim and several roots; the fabric is in /Looks")
    return stage, warnings


def _moved(root: Sdf.Layer, folder: Path, value: object) -> object:
    """Metadata as seen from another folder: relative files are named anew."""
    if isinstance(value, Sdf.AssetPath) and value.path.startswith("."):
        return Sdf.AssetPath(relative_asset(root.ComputeAbsolutePath(value.path), folder))
    return value


class _Writer:
    """Authors the Material and its bindings into the root layer of ``stage``."""

    def __init__(self, stage: Usd.Stage, asset: str, origin: Sdf.Path) -> None:
        self.stage, self.warnings = stage, list[str]()
        self.meshes: list[str] = []
        self.material = self._material(asset, origin)

    def _material(self, asset: str, origin: Sdf.Path) -> UsdShade.Material:
        scope = self._scope()
        name = next(n for n in _names(origin.name) if not self.stage.GetPrimAtPath(scope.AppendChild(n)))
        prim = UsdShade.Material.Define(self.stage, scope.AppendChild(name)).GetPrim()
        prim.GetReferences().AddReference(asset, origin)
        return UsdShade.Material(prim)

    def select(self, variants: Mapping[str, str]) -> None:
        """Author selections of the Material's variant sets."""
        prim = self.material.GetPrim()
        for name, chosen in variants.items():
            known = prim.GetVariantSets().GetNames()
            if name not in known:
                remedy = f"it has {', '.join(known)}" if known else "it has none"
                raise UsdfabError(f"the fabric has no variant set '{name}'", place="variant", remedy=remedy)
            there = prim.GetVariantSet(name).GetVariantNames()
            if chosen not in there:
                remedy = f"use one of {', '.join(there)}"
                raise UsdfabError(f"the variant set '{name}' has no '{chosen}'", place="variant", remedy=remedy)
            prim.GetVariantSet(name).SetVariantSelection(chosen)

    def _scope(self) -> Sdf.Path:
        """Where materials are kept: in the default prim, so that they travel with it."""
        default = self.stage.GetDefaultPrim()
        closed = not default or default.IsInstance() or not default.IsActive() or default.IsAbstract()
        parent = Sdf.Path.absoluteRootPath if closed else default.GetPath()
        for name in SCOPES:
            if _holds_materials(self.stage.GetPrimAtPath(parent.AppendChild(name))):
                return parent.AppendChild(name)
        free = next(n for n in _names(SCOPES[0]) if not self.stage.GetPrimAtPath(parent.AppendChild(n)))
        return UsdGeom.Scope.Define(self.stage, parent.AppendChild(free)).GetPath()

    def bind(self, target: Target, *, stronger: bool, rotate: float | None, scale: float | None) -> None:
        """Author one binding."""
        prim = self.stage.GetPrimAtPath(target.prim.GetPath())
        holders = [self.stage.GetPrimAtPath(p.GetPath()) for p in target.holders()]
        if prim.IsA(UsdGeom.Subset):
            prim = self._material_subset(UsdGeom.Subset(prim))
            holders = [prim]
            self.meshes.append(str(prim.GetPath()))
        else:
            self.meshes += [str(m.GetPath()) for m in target.meshes]
        tokens = UsdShade.Tokens
        strength = tokens.strongerThanDescendants if stronger else tokens.fallbackStrength
        api = UsdShade.MaterialBindingAPI.Apply(prim)
        if target.collection is None:
            api.Bind(self.material, strength)
        else:
            owner = self.stage.GetPrimAtPath(target.collection.GetPrimPath())
            name = target.collection.name.removeprefix("collection:")
            api.Bind(Usd.CollectionAPI(owner, name), self.material, self.material.GetPrim().GetName(), strength)
        for holder in holders:
            primvars = UsdGeom.PrimvarsAPI(holder)
            for name, number in ((ROTATION, rotate), (SCALE, scale)):
                if number is not None:
                    primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Double, UsdGeom.Tokens.constant)
                    primvar.Set(float(number))

    def _material_subset(self, subset: UsdGeom.Subset) -> Usd.Prim:
        """The subset, in the family that materials are bound by; a new one beside it where it is of another family."""
        prim, family = subset.GetPrim(), subset.GetFamilyNameAttr().Get()
        mesh = UsdGeom.Imageable(prim.GetParent())
        if family and family != FAMILY:
            name = next(n for n in _names(f"{prim.GetName()}_fabric") if not mesh.GetPrim().GetChild(n))
            path = mesh.GetPath().AppendChild(name)
            copy = UsdGeom.Subset.Define(self.stage, path)
            copy.CreateElementTypeAttr(UsdGeom.Tokens.face)
            indices = subset.GetIndicesAttr()
            for time in (Usd.TimeCode.Default(), *map(Usd.TimeCode, indices.GetTimeSamples())):
                value = indices.Get(time)
                if value is not None:
                    copy.CreateIndicesAttr().Set(value, time)
            self.warnings.append(f"{prim.GetPath()}: a subset of the family '{family}', bound as its copy {path}")
            subset, prim = copy, copy.GetPrim()
        if subset.GetFamilyNameAttr().Get() != FAMILY:
            subset.CreateFamilyNameAttr().Set(FAMILY)
        if UsdGeom.Subset.GetFamilyType(mesh, FAMILY) == UsdGeom.Tokens.unrestricted:
            UsdGeom.Subset.SetFamilyType(mesh, FAMILY, UsdGeom.Tokens.nonOverlapping)
        self.warnings += self._shared_faces(subset)
        return prim

    @staticmethod
    def _shared_faces(subset: UsdGeom.Subset) -> Iterator[str]:
        """A warning for each other subset with a material that has some of the same faces."""
        mesh, mine = subset.GetPrim().GetParent(), set(subset.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime()) or ())
        for other in UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets():
            if other.GetPrim() != subset.GetPrim():
                shared = mine & set(other.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime()) or ())
                if shared:
                    yield f"{subset.GetPath()}: {len(shared)} faces are in {other.GetPath()} too; one of both wins"


def _holds_materials(prim: Usd.Prim) -> bool:
    """Whether a prim is a scope into which another material can go."""
    if not prim or not prim.IsActive() or prim.IsInstance() or prim.IsInstanceProxy() or not prim.IsDefined():
        return False
    return prim.GetTypeName() in ("", "Scope", "Xform")


def _names(name: str) -> Iterator[str]:
    """``name``, ``name_1``, ``name_2``, ..."""
    clean = Tf.MakeValidIdentifier(re.sub(r"\W+", "_", name)) or "Fabric"
    yield clean
    for number in range(1, 100_000):
        yield f"{clean}_{number}"


# --- what wins -------------------------------------------------------------------------------------------------------


def _overruled(writer: _Writer, target: Target) -> Iterator[str]:
    """Warnings for meshes (and subsets below them) that show another material than the one that was bound."""
    stage, ours = writer.stage, writer.material.GetPath()
    winners: dict[tuple[str, str, str], list[str]] = {}
    subsets: list[str] = []
    for mesh in target.meshes:
        prim = stage.GetPrimAtPath(mesh.GetPath())
        for purpose in (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview):
            material, relationship = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
            if prim.IsA(UsdGeom.Subset) and str(prim.GetPath()) not in writer.meshes:
                continue
            if material and material.GetPath() == ours:
                continue
            where = str(relationship.GetPath()) if relationship else "nothing"
            key = (where, str(material.GetPath()) if material else "nothing", str(purpose))
            winners.setdefault(key, []).append(str(prim.GetPath()))
        subsets += [
            str(s.GetPath())
            for s in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
            if UsdShade.MaterialBindingAPI(s).GetDirectBinding().GetMaterialPath() not in (Sdf.Path(), ours)
        ]
    general = {where for where, _, purpose in winners if not purpose}
    for (where, winner, purpose), paths in winners.items():
        if purpose and where in general:
            continue
        what = f" in programs that ask for the purpose '{purpose}'" if purpose else ""
        remedy = "bind with --stronger, or the mesh itself" if target.collection is None else "bind the mesh itself"
        yield f"{listed(paths)}: {where} wins and shows {winner}{what}; {remedy}"
    if subsets and not target.prim.IsA(UsdGeom.Subset):
        yield f"{listed(subsets)}: faces with materials of their own keep them"
