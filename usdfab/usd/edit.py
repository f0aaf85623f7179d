"""Changing a fabric within its file: only what changes is authored, everything else in the file stays.

The new file is a copy of the old one's root layer, never flattened, with its relative paths made to fit the new place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Usd, UsdUtils

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters, edited
from usdfab.usd.atomic import atomic_path, checked_output
from usdfab.usd.colorways import (
    COLOR_ATTRIBUTES,
    COLORWAY,
    DIFFUSE,
    add_colorway_set,
    check_name,
    colorways,
    preview_path,
    select,
    set_color,
    set_value,
    variant_path,
)
from usdfab.usd.fabric_io import (
    TO_USD,
    check_texts,
    fabric_from_prim,
    fabric_values,
    find_fabric,
    meters_per_uv_from_prim,
    preview_color,
    preview_values,
    relative_path,
    write_fabric,
)
from usdfab.usd.schema_source import FABRIC_ATTRIBUTES, YARN_ATTRIBUTES, fabric_attribute_name, yarn_attribute_name
from usdfab.usd.stage import open_stage, readable, site, stage_name

_FILES = ("albedo_map", "neural_weights")
"""Fields that are paths: they read otherwise from another folder."""

Change = Callable[[FabricParameters], FabricParameters]


def edit_fabric(
    path: str | Path, settings: Mapping[str, str], out: str | Path, *, overwrite: bool = False
) -> FabricParameters:
    """Read the fabric of ``path``, apply ``settings`` (``usdfab.fabric.edited``), write it to ``out``, return it.

    Errors as ``change_fabric`` and ``usdfab.fabric.edited``.
    """
    return change_fabric(path, lambda fabric: edited(fabric, settings), out, overwrite=overwrite)


def change_fabric(
    path: str | Path, change: Change | None, out: str | Path, *, colorway: str = "", overwrite: bool = False
) -> FabricParameters:
    """Write the file ``path`` with its fabric changed to ``out``; return the new fabric.

    Everything else in the file stays: other prims, layers that it names, its metres per uv. In a fabric with
    colourways, colours change in the selected one only.

    Parameters
    ----------
    change:
        From the fabric (in the colourway ``colorway`` if there is one of that name) to the new one; None for no change.
    colorway:
        Put the new colours into this colourway, which is made where it does not exist, and select it. A fabric without
        colourways gets two, the first of which, ``original``, holds its colours from before.

    Raises
    ------
    UsdfabError
        As ``read_fabric`` and ``write_fabric``; for a colourway that does not exist where nothing changes; and if the
        change cannot take effect, since the fabric is in an instance or a stronger layer says otherwise.
    """
    checked_output(out, overwrite=overwrite)
    stage = open_stage(path)
    prim = find_fabric(stage)
    if prim.IsInstanceProxy():
        raise UsdfabError(
            "the fabric is within an instance", place=site(stage, prim), remedy="edit the file it is from"
        )
    names, selected = colorways(prim)
    if colorway:
        check_name(colorway)
        if change is None and colorway not in names:
            known = f"there are {', '.join(names)}" if names else "there are none"
            raise UsdfabError(f"no colourway '{colorway}', {known}", place=stage_name(stage), remedy="add --recolor")
        if colorway in names:
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                prim.GetVariantSets().GetVariantSet(COLORWAY).SetVariantSelection(colorway)
    before = fabric_from_prim(prim)
    after = before if change is None else change(before)
    if names and not (colorway or selected) and _colors(before) != _colors(after):
        raise UsdfabError("no colourway is selected", place=stage_name(stage), remedy="choose one with --colorway")
    if Ar.IsPackageRelativePath(stage.GetRootLayer().identifier) or stage.GetRootLayer().GetFileFormat().IsPackage():
        if colorway:
            raise UsdfabError("colourways cannot be added to a package", place=stage_name(stage), remedy="unpack it")
        write_fabric(after, out, meters_per_uv=meters_per_uv_from_prim(prim), overwrite=overwrite)
        return after
    layer = _copy(stage.GetRootLayer(), Path(out))
    if colorway and not names:
        add_colorway_set(layer, prim)
    if colorway:
        select(layer, prim.GetPath(), colorway)
    _author(
        layer,
        prim,
        before,
        after,
        Path(out),
        colorway or selected,
        new=bool(colorway) and colorway not in names,
    )
    if after.weave != before.weave:
        _preview_others(layer, stage, prim, after, set(names) - {colorway or selected})
    with atomic_path(out, overwrite=overwrite) as temporary:
        if not layer.Export(str(temporary)):
            raise OSError("USD could not export the layer")
        _check_effect(temporary, prim, after, stage_name(stage))
    return after


def _copy(source: Sdf.Layer, out: Path) -> Sdf.Layer:
    """A copy in memory whose relative paths are right for a file at ``out``."""
    layer = Sdf.Layer.CreateAnonymous(out.suffix.lower())
    with readable(source.realPath or source.identifier):
        layer.TransferContent(source)
    folder = out.parent
    if source.anonymous or folder.resolve() == Path(source.realPath).parent.resolve():
        return layer

    def moved(path: str) -> str:
        if not path or "://" in path or Path(path).is_absolute():
            return path
        absolute = source.ComputeAbsolutePath(path)
        # Other names may be found by a resolver's search path.
        local = path.startswith(".") or "<UDIM>" in path or Path(absolute.split("[")[0]).exists()
        return relative_path(absolute, folder) if local else path

    UsdUtils.ModifyAssetPaths(layer, moved)
    return layer


def _author(
    layer: Sdf.Layer,
    prim: Usd.Prim,
    before: FabricParameters,
    after: FabricParameters,
    out: Path,
    colorway: str,
    new: bool,
) -> None:
    """Author what differs or was lacking; colours into ``colorway`` if there is one, all of them if it is ``new``."""
    path = prim.GetPath()
    variant = variant_path(path, colorway) if colorway else path
    meters = meters_per_uv_from_prim(prim)
    moved: dict[str, Any] = {
        name: relative_path(getattr(after, name), out.parent)
        for name in _FILES
        if getattr(after, name) != getattr(before, name)
    }
    after = replace(after, **moved)
    old, values = fabric_values(before, meters), fabric_values(after, meters)
    check_texts(values)
    items: list[tuple[str, Any, Any, Any]] = [
        (fabric_attribute_name(a.name), a, old[a.name], values[a.name]) for a in FABRIC_ATTRIBUTES
    ]
    for system in SYSTEMS:
        pairs = before.system(system), after.system(system)
        items += [
            (yarn_attribute_name(system, a.name), a, *(getattr(yarn, a.field) for yarn in pairs))
            for a in YARN_ATTRIBUTES
        ]
    for name, attribute, was, value in items:
        is_color = name in COLOR_ATTRIBUTES
        found = prim.GetAttribute(name)
        lacking = not found.HasAuthoredValue() and bool(value or attribute.type_name != "asset")
        outdated = attribute.name == "schemaVersion" and found.Get() != value
        if was != value or lacking or outdated or (new and is_color):
            place = (variant if is_color else path).AppendProperty(name)
            type_name = Sdf.ValueTypeNames.Find(attribute.type_name)
            set_value(layer, place, type_name, TO_USD[attribute.type_name](value), uniform=True)
    preview = preview_path(prim)
    if preview is None:
        return
    was_shown = preview_values(before)
    for name, type_name, value in preview_values(after):
        is_color = f"inputs:{name}" == DIFFUSE
        if (name, type_name, value) not in was_shown or (new and is_color):
            place = preview.AppendProperty(f"inputs:{name}")
            if is_color:
                set_color(layer, place.ReplacePrefix(path, variant), value)
            else:
                set_value(layer, place, type_name, value, uniform=False)


def _preview_others(
    layer: Sdf.Layer, stage: Usd.Stage, prim: Usd.Prim, after: FabricParameters, names: set[str]
) -> None:
    """Author the preview's colour of the other colourways, which follows from the weave too."""
    preview = preview_path(prim)
    if preview is None:
        return
    place = preview.AppendProperty(DIFFUSE)
    for name in sorted(names):
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            prim.GetVariantSets().GetVariantSet(COLORWAY).SetVariantSelection(name)
        dyed = fabric_from_prim(prim)
        own = {
            s: replace(after.system(s), albedo=dyed.system(s).albedo, yarn_albedo=dyed.system(s).yarn_albedo)
            for s in SYSTEMS
        }
        target = place.ReplacePrefix(prim.GetPath(), variant_path(prim.GetPath(), name))
        set_color(layer, target, preview_color(after.with_systems(own)))


def _colors(fabric: FabricParameters) -> list[Any]:
    return [(fabric.system(s).albedo, fabric.system(s).yarn_albedo) for s in SYSTEMS]


def _check_effect(file: Path, prim: Usd.Prim, expected: FabricParameters, name: str) -> None:
    """``UsdfabError`` if the fabric that is read from ``file`` is not the expected one."""
    stage = Usd.Stage.Open(str(file))  # kept in a name: prims do not keep their stage alive
    written = fabric_from_prim(find_fabric(stage, prim.GetPath()))
    unseen: dict[str, Any] = dict.fromkeys(_FILES, "")
    if replace(written, **unseen) != replace(expected, **unseen):
        layers = {spec.layer.realPath for spec in prim.GetPrimStack()} - {prim.GetStage().GetRootLayer().realPath}
        where = f" ({', '.join(sorted(Path(p).name for p in layers if p))})" if layers else ""
        raise UsdfabError(
            f"another layer{where} decides the fabric's values",
            place=f"{name}<{prim.GetPath()}>",
            remedy="edit that file instead",
        )
