"""Prims that hold fibers: BasisCurves as the most portable consumers need them, and the Xform they stand under.

Cubic B-splines, nonperiodic, of constant width and without normals are the same curve in USD, Blender, Mitsuba and
Embree; pinned curves, varying widths and normals are not.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

from usdfab.fabric import FabricParameters
from usdfab.usd.expand.curves import FiberCurves
from usdfab.usd.fabric_io import define_fabric_material
from usdfab.usd.scene import FabricSurface

FACTS = "userProperties:usdfab"
"""Text attribute on curves: what a program that drops schemas and the materials of curves needs to restore them."""


def define_root(
    stage: Usd.Stage, mesh: Usd.Prim, centre: np.ndarray, meters: float, time: Usd.TimeCode, purpose: str
) -> UsdGeom.Xform:
    """An Xform beside the mesh whose own space is world space moved to ``centre`` (metres)."""
    parent = mesh.GetParent()
    while parent.IsInstanceProxy() or parent.IsInstance() or parent.IsA(UsdGeom.Gprim) or not _is_drawn(parent):
        parent = parent.GetParent()
    name = f"{mesh.GetName()}_fibers"
    taken = [c.GetName() for c in parent.GetAllChildren()]
    unique = next(n for n in (name, *(f"{name}_{k}" for k in range(1, len(taken) + 2))) if n not in taken)
    root = UsdGeom.Xform.Define(stage, parent.GetPath().AppendChild(unique))
    # Not part of the model hierarchy, so that it may stand anywhere.
    Usd.ModelAPI(root).SetKind(Kind.Tokens.subcomponent)
    root.CreatePurposeAttr(purpose)
    # Undone as it is at the time at which the mesh was read: a parent that moves takes the fibers along.
    to_world = UsdGeom.XformCache(time).GetLocalToWorldTransform(parent)
    move = Gf.Matrix4d().SetTranslate(Gf.Vec3d(*map(float, centre / meters)))
    root.AddTransformOp().Set(move * to_world.GetInverse())
    return root


def _is_drawn(prim: Usd.Prim) -> bool:
    """Whether what stands below a prim is drawn where it stands: not below overs, classes and instancers."""
    while prim and not prim.IsPseudoRoot():
        if not prim.HasDefiningSpecifier() or prim.IsAbstract() or prim.IsA(UsdGeom.PointInstancer):
            return False
        prim = prim.GetParent()
    return True


def fabric_material(stage: Usd.Stage, root: UsdGeom.Xform, surface: FabricSurface, *, new: bool) -> UsdShade.Material:
    """The cloth's own material, or a new one below ``root`` where the fabric was given from outside."""
    if not new:
        return UsdShade.Material(stage.GetPrimAtPath(surface.path))
    looks = UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("Looks"))
    path = looks.GetPath().AppendChild("Fabric")
    return define_fabric_material(stage, path, surface.fabric, meters_per_uv=surface.meters_per_uv)


def author_curves(
    stage: Usd.Stage,
    path: Sdf.Path,
    curves: FiberCurves,
    meters: float,
    material: UsdShade.Material,
    facts: str,
) -> UsdGeom.BasisCurves:
    """One BasisCurves; points in stage units.

    ``displayColor`` is the fiber albedo: constant, one for each curve (uniform) or for each point (vertex).
    """
    tokens = UsdGeom.Tokens
    prim = UsdGeom.BasisCurves.Define(stage, path)
    prim.CreateTypeAttr(tokens.cubic)
    prim.CreateBasisAttr(tokens.bspline)
    prim.CreateWrapAttr(tokens.nonperiodic)
    prim.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(curves.counts.astype(np.int32)))
    points = np.ascontiguousarray(curves.points / meters, dtype=np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    width = 2.0 * curves.radius / meters
    prim.CreateWidthsAttr(Vt.FloatArray([width]))
    prim.SetWidthsInterpolation(tokens.constant)
    low, high = points.min(axis=0) - 0.5 * width, points.max(axis=0) + 0.5 * width
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32)))
    color = np.asarray(curves.color, dtype=np.float32)
    interpolation = tokens.uniform if len(color) == len(curves.counts) else tokens.vertex
    if (color == color[:1]).all():
        color, interpolation = color[:1], tokens.constant
    prim.CreateDisplayColorPrimvar(interpolation).Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(color)))
    primvars = UsdGeom.PrimvarsAPI(prim)
    for name, values in (("usdfab:yarn", curves.yarn), ("usdfab:fiber", curves.fiber)):
        primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.IntArray, tokens.uniform)
        primvar.Set(Vt.IntArray.FromNumpy(values.astype(np.int32)))
    prim.GetPrim().CreateAttribute(FACTS, Sdf.ValueTypeNames.String, custom=True).Set(facts)
    if material:
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    return prim


def fiber_facts(fabric: FabricParameters, system: str, material: str) -> str:
    """What ``FACTS`` holds for the fibers of one yarn system: JSON; lengths in metres, angles in radians."""
    yarn = fabric.system(system)  # type: ignore[arg-type]
    return json.dumps(
        {
            "fabric": fabric.name,
            "material": material,
            "system": system,
            "fiber_radius": yarn.effective_fiber_radius,
            "roughness_longitudinal": yarn.roughness_longitudinal,
            "roughness_azimuthal": yarn.roughness_azimuthal,
            "roughness_primary": yarn.roughness_primary,
            "ior": yarn.ior,
            "cuticle_tilt": yarn.cuticle_tilt,
        }
    )


def mean_color(curves: Iterable[FiberCurves]) -> np.ndarray:
    """(3,) the mean fiber albedo, every curve counting the same."""
    colors = [c.color if len(c.color) == len(c.counts) else c.color[c.offsets[:-1]] for c in curves]
    return np.concatenate(colors).mean(axis=0)
