"""Rules about what a prim points at: files that are missing, bindings that lead nowhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from pxr import Sdf, Usd, UsdShade

from usdfab.usd.assets import UDIM
from usdfab.usd.issue import Issue, error, warning

MAX_SAMPLES = 100
"""So many time samples of an attribute are looked at."""
_ASSET = (Sdf.ValueTypeNames.Asset, Sdf.ValueTypeNames.AssetArray)


def missing_files(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:asset``: files that an attribute names and that are not there; ``usdfab:absolute``: absolute paths."""
    for attribute in prim.GetAuthoredAttributes():
        if attribute.GetTypeName() not in _ASSET:
            continue
        said: set[str] = set()
        for time in (Usd.TimeCode.Default(), *map(Usd.TimeCode, attribute.GetTimeSamples()[:MAX_SAMPLES])):
            value = attribute.Get(time)
            for path in [value] if isinstance(value, Sdf.AssetPath) else value if value is not None else ():
                if not isinstance(path, Sdf.AssetPath) or not path.path or path.path in said:
                    continue
                said.add(path.path)
                if is_missing(attribute, path):
                    message = f"the file {path.path} does not exist ({absolute(attribute, path)})"
                    yield error(attribute, prim, "asset", message, "put the file there, or correct the path")
                elif Path(path.path).is_absolute():
                    message = f"the path {path.path} is absolute, it breaks when the files are moved"
                    yield warning(attribute, prim, "absolute", message, "write it relative to the layer")


def absolute(attribute: Usd.Attribute, path: Sdf.AssetPath) -> str:
    """The path seen from the layer that names it."""
    stack = attribute.GetPropertyStack(Usd.TimeCode.EarliestTime())
    return str(stack[0].layer.ComputeAbsolutePath(path.path)) if stack else str(path.path)


def is_missing(attribute: Usd.Attribute, path: Sdf.AssetPath) -> bool:
    """Whether no file is found; for a set of UDIM tiles, not a single one."""
    if UDIM not in path.path:
        # Other schemes than files (http:, omniverse:) cannot be looked up here.
        return not path.resolvedPath and not re.match(r"[a-zA-Z][\w+.-]+:", path.path)
    pattern = Path(absolute(attribute, path))
    tile = re.compile(re.escape(pattern.name).replace(re.escape(UDIM), r"1\d{3}"))
    folder = pattern.parent
    return not folder.is_dir() or not any(tile.fullmatch(file.name) for file in folder.iterdir())


def bindings(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:binding``: material bindings whose material or collection does not exist or is none."""
    stage = prim.GetStage()
    for relationship in prim.GetAuthoredRelationships():
        if not relationship.GetName().startswith(UsdShade.Tokens.materialBinding):
            continue
        targets = relationship.GetTargets()
        if not targets and not relationship.HasAuthoredTargets():
            continue
        for path in targets:
            found = stage.GetPrimAtPath(path.GetPrimPath())
            if not found:
                message, remedy = (
                    f"bound to {path}, which does not exist",
                    "is a reference missing, or a name misspelt?",
                )
                yield error(relationship, prim, "binding", message, remedy)
            elif path.IsPrimPath() and not found.IsA(UsdShade.Material):
                kind = found.GetTypeName() or "prim without type"
                yield error(relationship, prim, "binding", f"bound to {path}, a {kind}", "bind a Material")
            elif path.IsPropertyPath() and path.name.startswith("collection:"):
                names = [f"collection:{c.GetName()}" for c in Usd.CollectionAPI.GetAll(found)]
                if path.name not in names:
                    remedy = f"apply CollectionAPI to {found.GetPath()}"
                    yield error(relationship, prim, "binding", f"bound to {path}, which is no collection", remedy)
