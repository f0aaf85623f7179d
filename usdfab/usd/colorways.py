"""Colourways: one fabric in several colours, as a native variant set of its Material.

The variant set ``colorway`` overrides the yarns' albedo attributes and the preview surface's diffuse colour, so that
every USD program can list and choose the colourways. Local opinions are stronger than variants in USD; the colours are
therefore moved from the Material into the variants, the first of which (``original``) holds those from before.
"""

from __future__ import annotations

import re

from pxr import Gf, Sdf, Usd, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS
from usdfab.usd.schema_source import YARN_ATTRIBUTES, yarn_attribute_name

COLORWAY = "colorway"
"""Name of the variant set."""

ORIGINAL = "original"
"""Name of the variant that holds the colours from before there were colourways."""

DIFFUSE = "inputs:diffuseColor"

COLOR_ATTRIBUTES = frozenset(
    yarn_attribute_name(system, a.name)
    for system in SYSTEMS
    for a in YARN_ATTRIBUTES
    if a.field in ("albedo", "yarn_albedo")
)
"""Attributes of the Material that a colourway holds."""


def colorways(prim: Usd.Prim) -> tuple[tuple[str, ...], str]:
    """Names of a fabric's colourways, ``original`` first, and the selected one (empty for none)."""
    found = prim.GetVariantSets()
    if not found.HasVariantSet(COLORWAY):
        return (), ""
    own = found.GetVariantSet(COLORWAY)
    return tuple(sorted(own.GetVariantNames(), key=lambda n: (n != ORIGINAL, n))), str(own.GetVariantSelection())


def check_name(name: str) -> None:
    """``UsdfabError`` if a colourway cannot be called so."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]*", name):
        raise UsdfabError(
            f"'{name}' is no name for a colourway", place="--colorway", remedy="use letters, digits, _ and -"
        )


def variant_path(path: Sdf.Path, name: str) -> Sdf.Path:
    """Where in a layer the opinions of a colourway stand."""
    return path.AppendVariantSelection(COLORWAY, name)


def preview_path(prim: Usd.Prim) -> Sdf.Path | None:
    """The fabric's UsdPreviewSurface, where it lies below the fabric; else None."""
    source, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not source or source.GetIdAttr().Get() != "UsdPreviewSurface":
        return None
    path = source.GetPath()
    return path if path.HasPrefix(prim.GetPath()) else None


def add_colorway_set(layer: Sdf.Layer, prim: Usd.Prim) -> None:
    """Make the variant set in ``layer`` and move the colours of ``prim`` into its variant ``original``."""
    path = prim.GetPath()
    places = [path.AppendProperty(name) for name in sorted(COLOR_ATTRIBUTES)]
    preview = preview_path(prim)
    if preview is not None:
        places.append(preview.AppendProperty(DIFFUSE))
    for place in places:
        attribute = prim.GetStage().GetAttributeAtPath(place)
        target = place.ReplacePrefix(path, variant_path(path, ORIGINAL))
        if layer.GetAttributeAtPath(place):
            _owner(layer, target.GetParentPath())
            Sdf.CopySpec(layer, place, layer, target)
            owner = layer.GetPrimAtPath(place.GetPrimPath())
            owner.RemoveProperty(owner.properties[place.name])
        elif attribute and attribute.Get() is not None:
            set_value(layer, target, attribute.GetTypeName(), attribute.Get(), uniform=place.GetPrimPath() == path)


def select(layer: Sdf.Layer, path: Sdf.Path, name: str) -> None:
    """Author the selection of a colourway."""
    Sdf.CreatePrimInLayer(layer, path).variantSelections[COLORWAY] = name


def set_value(layer: Sdf.Layer, path: Sdf.Path, type_name: Sdf.ValueTypeName, value: object, *, uniform: bool) -> None:
    """Author one attribute's default in a layer, in a variant too; prims above it become overs where they are not."""
    owner = _owner(layer, path.GetParentPath())
    spec = layer.GetAttributeAtPath(path)
    if not spec:
        variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
        spec = Sdf.AttributeSpec(owner, path.name, type_name, variability)
    spec.default = value


def _owner(layer: Sdf.Layer, path: Sdf.Path) -> Sdf.PrimSpec:
    """The prim spec at ``path``, made where there is none, in a variant too (``Sdf.CreatePrimInLayer`` makes none)."""
    if path.IsPrimVariantSelectionPath():
        spec = _owner(layer, path.GetParentPath())
        set_name, name = path.GetVariantSelection()
        # A layer's variants count only if the same layer names their set.
        if set_name not in spec.variantSetNameList.GetAddedOrExplicitItems():
            spec.variantSetNameList.Prepend(set_name)
        own = spec.variantSets.get(set_name) or Sdf.VariantSetSpec(spec, set_name)
        variant = own.variants.get(name) or Sdf.VariantSpec(own, name)
        return variant.primSpec
    if not path.ContainsPrimVariantSelection():
        return Sdf.CreatePrimInLayer(layer, path)
    found = layer.GetPrimAtPath(path)
    return found or Sdf.PrimSpec(_owner(layer, path.GetParentPath()), path.name, Sdf.SpecifierOver)


def set_color(layer: Sdf.Layer, path: Sdf.Path, color: tuple[float, float, float]) -> None:
    """Author a shader's colour input."""
    set_value(layer, path, Sdf.ValueTypeNames.Color3f, Gf.Vec3f(*color), uniform=False)
