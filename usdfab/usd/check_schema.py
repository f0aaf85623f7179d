"""Rules about names, types and tokens: what is misspelt, of another type, or on a prim that does not know it."""

from __future__ import annotations

import difflib
from collections.abc import Iterator

from pxr import Sdf, Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.check_rules import attributes, yarn_instances
from usdfab.usd.fabric_io import is_fabric
from usdfab.usd.issue import Issue, error, warning
from usdfab.usd.orientation import ROTATION, SCALE, read_orientation
from usdfab.usd.primvars import ALBEDO
from usdfab.usd.registration import FABRIC_API
from usdfab.usd.schema_source import (
    FABRIC_ATTRIBUTES,
    NAMESPACE,
    SCHEMA_VERSION,
    YARN_ATTRIBUTES,
    fabric_attribute_name,
    yarn_attribute_name,
)

PRIMVARS = (ALBEDO, ROTATION, SCALE)
_TYPES = {fabric_attribute_name(a.name): a.type_name for a in FABRIC_ATTRIBUTES} | {
    yarn_attribute_name(system, a.name): a.type_name for system in ("warp", "weft") for a in YARN_ATTRIBUTES
}


def names(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:api``, ``usdfab:name``: attributes of ours that no schema on the prim declares."""
    authored = [p for p in prim.GetAuthoredPropertyNames() if p.startswith(f"{NAMESPACE}:")]
    if not authored:
        return
    if not is_fabric(prim):
        known = [name for name in authored if name in _TYPES]
        if known and not yarn_instances(prim) and not prim.IsAbstract():
            text = f"{len(known)} attributes of a fabric ({known[0]}, ...), but {FABRIC_API} is not applied"
            yield error(prim, prim, "api", text, f"add {FABRIC_API} to the prim's apiSchemas")
        return
    version = prim.GetAttribute(fabric_attribute_name("schemaVersion")).Get()
    if isinstance(version, int) and version > SCHEMA_VERSION:
        return
    declared = {name for name, _ in attributes(prim)}
    for name in authored:
        # Those of a yarn system that is not applied are told as that.
        if name in declared or name in _TYPES:
            continue
        near = difflib.get_close_matches(name, sorted(_TYPES), n=1, cutoff=0.75)
        remedy = f"is {near[0]} meant?" if near and near[0] != name else "take it out, or write it with userProperties:"
        text = "no schema on this prim has such an attribute, it is not used"
        yield warning(prim.GetPath().AppendProperty(name), prim, "name", text, remedy)


def types(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:type``: attributes that are authored with another type than the schema's."""
    if not is_fabric(prim):
        return
    for name, attribute in attributes(prim):
        found = prim.GetAttribute(name)
        specs = found.GetPropertyStack(Usd.TimeCode.Default()) if found and found.IsAuthored() else []
        wrong = [s for s in specs if isinstance(s, Sdf.AttributeSpec) and str(s.typeName) != attribute.type_name]
        if wrong:
            text = f"authored as {wrong[0].typeName} in {wrong[0].layer.GetDisplayName()}"
            yield error(found, prim, "type", text, f"the schema's type is {attribute.type_name}")


def tokens(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:token``: values that the schema of a mesh, a subset, curves or a fabric does not allow."""
    if not (is_fabric(prim) or prim.IsA(UsdGeom.PointBased) or prim.IsA(UsdGeom.Subset)):
        return
    for attribute in prim.GetAuthoredAttributes():
        if attribute.GetTypeName() != Sdf.ValueTypeNames.Token or not attribute.HasMetadata("allowedTokens"):
            continue
        allowed, value = [str(t) for t in attribute.GetMetadata("allowedTokens")], attribute.Get()
        if value is not None and str(value) not in allowed:
            yield error(attribute, prim, "token", f"'{value}' is not allowed", f"use {', '.join(allowed)}")


def primvars(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:primvar``: misspelt primvars of ours, and orientations that cannot be read."""
    prefix = "primvars:"
    for name in prim.GetAuthoredPropertyNames():
        if not name.startswith(f"{prefix}{NAMESPACE}:") or name.endswith(":indices"):
            continue
        short = name.removeprefix(prefix)
        near = difflib.get_close_matches(short, PRIMVARS, n=1, cutoff=0.8)
        if near and short not in PRIMVARS:
            place = prim.GetPath().AppendProperty(name)
            yield warning(place, prim, "primvar", "no such primvar is known, it is not used", f"is {near[0]} meant?")
        elif short in (ROTATION, SCALE):
            try:
                read_orientation(prim, Usd.TimeCode.EarliestTime())
            except UsdfabError as found:
                yield Issue("error", found.place, "usdfab:primvar", found.problem, found.remedy)
