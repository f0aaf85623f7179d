"""usdfab's rules about fabrics, curves and cloth: a prim to its issues."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import PARAMETER_BY_NAME
from usdfab.fabric.fabric import checked_value
from usdfab.usd.fabric_io import fabric_from_prim, is_fabric, meters_per_uv_from_prim
from usdfab.usd.issue import Issue, error, warning
from usdfab.usd.primvars import UV_NAMES
from usdfab.usd.registration import FABRIC_API, YARN_API
from usdfab.usd.schema_source import (
    FABRIC_ATTRIBUTES,
    SCHEMA_VERSION,
    YARN_ATTRIBUTES,
    SchemaAttribute,
    fabric_attribute_name,
    yarn_attribute_name,
)
from usdfab.usd.stage import site


def yarn_instances(prim: Usd.Prim) -> list[str]:
    """Names of the yarn systems that are applied to a prim."""
    prefix = f"{YARN_API}:"
    return [name[len(prefix) :] for name in prim.GetAppliedSchemas() if name.startswith(prefix)]


def applied(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:material``, ``usdfab:instance``, ``usdfab:systems``: what carries the schemas, and whole."""
    instances, fabric = yarn_instances(prim), is_fabric(prim)
    if not instances and not fabric:
        return
    if prim.GetTypeName() != "Material" and not prim.IsAbstract():
        kind = prim.GetTypeName() or "prim without type"
        yield error(prim, prim, "material", f"{FABRIC_API} and {YARN_API} belong on a Material, not on a {kind}")
    unknown = sorted(set(instances) - {"warp", "weft"})
    if unknown:
        yield error(prim, prim, "instance", f"unknown yarn system {', '.join(unknown)}; use warp and weft")
    missing = [s for s in ("warp", "weft") if s not in instances]
    if missing or not fabric:
        names = [f"{YARN_API}:{s}" for s in missing] + ([] if fabric else [FABRIC_API])
        yield error(prim, prim, "systems", f"the fabric is not whole, apply {', '.join(names)}")


def values(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:value``, ``usdfab:authored``, ``usdfab:weaveSize``, ``usdfab:fabric``: the parameters themselves."""
    if not is_fabric(prim) or prim.GetTypeName() != "Material":
        return
    wrong = False
    version = prim.GetAttribute(fabric_attribute_name("schemaVersion")).Get()
    version = version if isinstance(version, int) else SCHEMA_VERSION
    for name, attribute in attributes(prim):
        path = prim.GetPath().AppendProperty(name)
        usd_attribute = prim.GetAttribute(name)
        value = usd_attribute.Get() if usd_attribute else None
        # Files of another version hold other attributes: the defaults of those that came later do no harm.
        expected = attribute.since <= version <= SCHEMA_VERSION and attribute.type_name != "asset"
        if expected and value is not None and not usd_attribute.HasAuthoredValue():
            message = "not authored; programs that do not know usdfab's schema cannot see it"
            yield warning(path, prim, "authored", message, "write the fabric again with `usdfab edit`")
        problem = "the attribute is missing" if value is None else _value_problem(attribute, value)
        if problem:
            wrong = True
            yield error(path, prim, "value", problem)
    for issue in _weave_size(prim) if not wrong else ():
        wrong = True
        yield issue
    if not wrong and set(yarn_instances(prim)) >= {"warp", "weft"}:
        try:
            fabric_from_prim(prim)
            meters_per_uv_from_prim(prim)
        except UsdfabError as found:
            place = found.place or site(prim.GetStage(), prim)
            yield Issue("error", place, "usdfab:fabric", found.problem, found.remedy)


def _weave_size(prim: Usd.Prim) -> Iterator[Issue]:
    matrix = prim.GetAttribute(fabric_attribute_name("weave:matrix"))
    size = np.atleast_1d(prim.GetAttribute(fabric_attribute_name("weave:size")).Get())
    number = np.size(matrix.Get())
    if size.shape != (2,):
        yield error(prim, prim, "weaveSize", f"expected two numbers, got {size.size}")
    elif number != int(size[0]) * int(size[1]):
        picks, ends = map(int, size)
        message = f"the matrix has {number} values, the size {picks} x {ends} asks for {picks * ends}"
        yield error(matrix, prim, "weaveSize", message)


def attributes(prim: Usd.Prim) -> Iterator[tuple[str, SchemaAttribute]]:
    """Full name and declaration of each attribute that the schemas applied to a prim bring."""
    for attribute in FABRIC_ATTRIBUTES:
        yield fabric_attribute_name(attribute.name), attribute
    for system in yarn_instances(prim):
        if system in ("warp", "weft"):
            for attribute in YARN_ATTRIBUTES:
                yield yarn_attribute_name(system, attribute.name), attribute


def _value_problem(attribute: SchemaAttribute, value: object) -> str:
    """What is wrong with a value, or an empty string."""
    try:
        if attribute in YARN_ATTRIBUTES:
            checked_value(PARAMETER_BY_NAME[attribute.field], value)
            return ""
        if attribute.hard is None:
            return ""
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
    except UsdfabError as found:
        return found.problem
    except (TypeError, ValueError):
        return f"expected a value of type {attribute.type_name}, got {reprlib.repr(value)}"
    low, high = attribute.hard
    bad = numbers[~(np.isfinite(numbers) & (numbers >= low) & (numbers <= high))]
    return f"{bad[0]:g} is not between {low:g} and {high:g}" if len(bad) else ""


def preview(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:preview``: viewers that know no fibers need a UsdPreviewSurface."""
    if not is_fabric(prim) or prim.GetTypeName() != "Material":
        return
    source, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not source or source.GetIdAttr().Get() != "UsdPreviewSurface":
        message = "no UsdPreviewSurface on outputs:surface, other viewers show nothing"
        yield error(prim, prim, "preview", message, "write the fabric again with `usdfab edit`")


def curves(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:extent``, ``usdfab:curveCounts``, ``usdfab:widths``: curves and instancers that viewers can draw."""
    if not (prim.IsA(UsdGeom.Curves) or prim.IsA(UsdGeom.PointInstancer)):
        return
    boundable = UsdGeom.Boundable(prim)
    extent = boundable.GetExtentAttr()
    authored = extent.Get(Usd.TimeCode.EarliestTime()) if extent.HasAuthoredValue() else None
    if authored is None or len(authored) != 2 or not np.isfinite(np.asarray(authored)).all():
        yield error(prim, prim, "extent", "no authored extent, viewers cull or drop the prim", "author it")
    elif np.abs(np.asarray(authored)).max() >= 1e37:
        yield error(extent, prim, "extent", "the extent is infinite; compute it before the prototypes become overs")
    if not prim.IsA(UsdGeom.BasisCurves):
        return
    curves, time = UsdGeom.BasisCurves(prim), Usd.TimeCode.EarliestTime()
    counts = np.asarray(curves.GetCurveVertexCountsAttr().Get(time) or [], dtype=np.int64)
    points = curves.GetPointsAttr().Get(time)
    number = 0 if points is None else len(points)
    if counts.sum() != number:
        message = f"the curves ask for {int(counts.sum())} points, there are {number}"
        yield error(curves.GetCurveVertexCountsAttr(), prim, "curveCounts", message)
    yield from _widths(curves, counts, number, time)


def _widths(curves: UsdGeom.BasisCurves, counts: np.ndarray, points: int, time: Usd.TimeCode) -> Iterator[Issue]:
    tokens, prim = UsdGeom.Tokens, curves.GetPrim()
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("widths")
    attribute = primvar.GetAttr() if primvar else curves.GetWidthsAttr()
    widths = attribute.Get(time)
    if widths is None:
        yield error(prim, prim, "widths", "no widths, viewers draw lines", "author constant or vertex widths")
        return
    interpolation = primvar.GetInterpolation() if primvar else curves.GetWidthsInterpolation()
    expected = {tokens.constant: 1, tokens.uniform: len(counts), tokens.vertex: points}.get(interpolation)
    if expected is None:
        message = f"{interpolation} widths are drawn differently by every program; use constant or vertex"
        yield warning(attribute, prim, "widths", message)
    elif len(widths) != expected:
        message = f"{len(widths)} {interpolation} widths, expected {expected}"
        yield error(attribute, prim, "widths", message)


def cloth(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:uv``: a mesh that carries a fabric should say by texture coordinates where its yarns run."""
    if not prim.IsA(UsdGeom.Mesh):
        return
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    if material and is_fabric(material.GetPrim()):
        api = UsdGeom.PrimvarsAPI(prim)
        textured = any(
            p.GetTypeName().role == Sdf.ValueRoleNames.TextureCoordinate for p in api.GetPrimvarsWithValues()
        )
        if not textured and not any(api.HasPrimvar(name) for name in UV_NAMES):
            message = "the cloth has no texture coordinates, renderers unwrap it as they like; add 'st'"
            yield warning(prim, prim, "uv", message)
