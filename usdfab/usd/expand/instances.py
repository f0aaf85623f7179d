"""Pieces of tiles as a point instancer, or as one Xform each, over prototypes that all of them share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt
from scipy.spatial.transform import Rotation

from usdfab.fabric import FabricParameters
from usdfab.fibers.tiles import tile_variants
from usdfab.usd.expand.author import author_curves, fiber_facts, mean_color
from usdfab.usd.expand.curves import FiberCurves, piece_curves
from usdfab.usd.expand.divide import Tiling
from usdfab.usd.expand.frames import Poses
from usdfab.usd.expand.place import Pieces


@dataclass(frozen=True, eq=False)
class Cloth:
    """All that the prototypes of one fabric need: its tiling, the curves of each variant's tile, the overlap."""

    fabric: FabricParameters
    tiling: Tiling
    variants: Sequence[Sequence[FiberCurves]]
    overlap: float


@dataclass
class Written:
    """What was authored: ``curves`` and ``points`` are those of prototypes (or all of them where baked)."""

    instances: int = 0
    prototypes: int = 0
    curves: int = 0
    points: int = 0


def write_instancer(
    stage: Usd.Stage, root: UsdGeom.Xform, cloth: Cloth, pieces: Pieces, poses: Poses, centre: np.ndarray,
    meters: float, material: UsdShade.Material,
) -> Written:  # fmt: skip
    """A PointInstancer ``Patches`` below ``root`` with a copy of a prototype for each piece.

    Copies turn and scale; what they shear is in the points of prototypes, in steps.
    """
    instancer = UsdGeom.PointInstancer.Define(stage, root.GetPath().AppendChild("Patches"))
    Usd.ModelAPI(instancer).SetKind(Kind.Tokens.subcomponent)
    holder = instancer.GetPath().AppendChild("Prototypes")
    kinds = np.column_stack([_kinds(cloth, pieces), poses.shear])
    targets, index, written = _prototypes(stage, holder, cloth, kinds, poses.step, meters, material)
    instancer.CreatePrototypesRel().SetTargets(targets)
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(index.astype(np.int32)))
    positions = ((pieces.frames.centers - centre) / meters).astype(np.float32)
    instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(positions))
    if np.abs(poses.scales - 1.0).max() > 1e-5:
        instancer.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(poses.scales.astype(np.float32)))
    # scipy puts the real part last, as USD's quaternions do in memory.
    quaternions = Rotation.from_matrix(poses.rotations).as_quat().astype(np.float16)
    instancer.CreateOrientationsAttr(Vt.QuathArray.FromNumpy(quaternions))
    instancer.CreateIdsAttr(Vt.Int64Array.FromNumpy(np.arange(len(pieces), dtype=np.int64)))
    _tint(instancer, pieces.tint, cloth)
    # The extent first: once the prototypes are overs, USD no longer finds it.
    time = Usd.TimeCode.Default()
    instancer.CreateExtentAttr(instancer.ComputeExtentAtTime(time, time))
    stage.GetRootLayer().GetPrimAtPath(holder).specifier = Sdf.SpecifierOver
    written.instances = len(pieces)
    return written


def write_xforms(
    stage: Usd.Stage, root: UsdGeom.Xform, cloth: Cloth, pieces: Pieces, centre: np.ndarray, meters: float,
    material: UsdShade.Material,
) -> Written:  # fmt: skip
    """An Xform below ``root``/Patches for each piece: its whole affine frame, and a reference to a prototype.

    The Xforms are instanceable, the prototypes are not (Arnold would draw those once more at the origin).
    """
    parent = UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("Patches")).GetPath()
    holder = root.GetPath().AppendChild("Prototypes")
    kinds = np.column_stack([_kinds(cloth, pieces), np.zeros(len(pieces), dtype=np.int64)])
    targets, index, written = _prototypes(stage, holder, cloth, kinds, np.zeros(len(pieces)), meters, material)
    matrices = np.zeros((len(pieces), 4, 4))
    # USD's row vectors: the frame's columns are rows.
    matrices[:, :3, :3] = np.swapaxes(pieces.frames.linear, 1, 2)
    matrices[:, 3, :3] = (pieces.frames.centers - centre) / meters
    matrices[:, 3, 3] = 1.0
    tinted = bool(np.abs(pieces.tint - 1.0).max(initial=0.0) > 1e-4)
    layer = stage.GetRootLayer()
    order = Vt.TokenArray(["xformOp:transform"])
    references = [Sdf.Reference("", target) for target in targets]
    digits = len(str(len(pieces)))
    with Sdf.ChangeBlock():
        above = layer.GetPrimAtPath(parent)
        for k, (matrix, number) in enumerate(zip(matrices, index, strict=True)):
            spec = Sdf.PrimSpec(above, f"Patch_{k:0{digits}d}", Sdf.SpecifierDef, "Xform")
            spec.instanceable = True
            spec.referenceList.Prepend(references[number])
            op = Sdf.AttributeSpec(spec, "xformOp:transform", Sdf.ValueTypeNames.Matrix4d)
            op.default = Gf.Matrix4d(matrix.tolist())
            uniform = Sdf.VariabilityUniform
            Sdf.AttributeSpec(spec, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, uniform).default = order
            if tinted:
                tint = Sdf.AttributeSpec(spec, "primvars:usdfab:albedo", Sdf.ValueTypeNames.Color3fArray)
                tint.default = Vt.Vec3fArray([Gf.Vec3f(*map(float, pieces.tint[k]))])
    # A class, as nothing but references leads to it: an over would count as forgotten.
    layer.GetPrimAtPath(holder).specifier = Sdf.SpecifierClass
    written.instances = len(pieces)
    return written


def _kinds(cloth: Cloth, pieces: Pieces) -> np.ndarray:
    """(N, 4) variant, level and part of each piece: which prototype it needs."""
    variants = tile_variants(pieces.tile[:, 0], pieces.tile[:, 1], len(cloth.variants))
    return np.column_stack([variants, pieces.level, pieces.part])


def _tint(instancer: UsdGeom.PointInstancer, tint: np.ndarray, cloth: Cloth) -> None:
    """Colours of the copies, where the mesh or an albedo map gives them any: the factor, and what it makes of the mean
    fiber albedo."""
    if np.abs(tint - 1.0).max(initial=0.0) <= 1e-4:
        return
    primvars = UsdGeom.PrimvarsAPI(instancer)
    shown = np.minimum(tint * mean_color(cloth.variants[0]), 1.0)
    for name, values in (("usdfab:albedo", tint), ("displayColor", shown)):
        primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.varying)
        primvar.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32)))


def _prototypes(
    stage: Usd.Stage,
    holder: Sdf.Path,
    cloth: Cloth,
    kinds: np.ndarray,
    step: np.ndarray,
    meters: float,
    material: UsdShade.Material,
) -> tuple[list[Sdf.Path], np.ndarray, Written]:
    """Prototypes for rows (variant, level, part x, part y, shear): their paths, and (N,) which one each row needs.

    Shear is in the points: not every program has transforms that shear (Blender has none).
    """
    UsdGeom.Scope.Define(stage, holder)
    unique, where, index = np.unique(kinds, axis=0, return_index=True, return_inverse=True)
    written, targets = Written(prototypes=len(unique)), []
    for (variant, number, i, j, shear), row in zip(unique.tolist(), where.tolist(), strict=True):
        name = f"Variant{variant}" + (f"_Level{number}_{i}_{j}" if number else "")
        name += "" if shear == 0 else f"_Shear{'m' if shear < 0 else ''}{abs(shear)}"
        prototype = UsdGeom.Xform.Define(stage, holder.AppendChild(name)).GetPath()
        targets.append(prototype)
        level = cloth.tiling.levels[number]
        cells = (int(level.x[i]), int(level.x[i + 1])), (int(level.y[j]), int(level.y[j + 1]))
        for tile in cloth.variants[variant]:
            part = piece_curves(tile, cloth.tiling, cells, cloth.overlap)
            if len(part.counts) == 0:
                continue
            if shear:
                part.points[:, 0] += shear * step[row] * part.points[:, 1]
            facts = fiber_facts(cloth.fabric, part.system, str(material.GetPath()) if material else "")
            author_curves(stage, prototype.AppendChild(part.name), part, meters, material, facts)
            written.curves += len(part.counts)
            written.points += len(part.points)
    return targets, index.ravel(), written
