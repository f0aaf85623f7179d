"""Cloth as fibers in a USD file: one patch of curves, instanced over the mesh. For renderers that know no usdfab.

The new file sublayers the user's stage and never flattens it. Beside each cloth mesh stands ``<Mesh>_fibers``: an Xform
with a PointInstancer, one copy of the patch for each cell of the uv plane whose centre lies on the mesh. The mesh is
made invisible. The patch is one BasisCurves for each yarn system and colour: cubic B-splines, nonperiodic, of constant
width and without normals (round tubes), prolonged so that each fiber ends where its continuation in the next copy
begins. Flyaways are BasisCurves of their own (``WarpFlyaways``, ``WeftFlyaways``) that end where they end. Prototypes
stand under an ``over``, so that they are not drawn themselves.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt
from scipy.spatial.transform import Rotation

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fibers import PATH_TRACING_VERTICES, FiberSystem, OpenCurves, Patch, generate_patch
from usdfab.usd.atomic import atomic_path, checked_output
from usdfab.usd.fabric_io import define_fabric_material
from usdfab.usd.placement import Placement, Region, estimate, place
from usdfab.usd.read_scene import read_scene, time_code
from usdfab.usd.scene import FabricSurface, Mesh, Scene
from usdfab.usd.stage import GENERATOR, open_stage, site, stage_name

MAX_INSTANCES = 5_000_000
"""More copies than this are refused unless asked for: some 300 MB in the file."""


@dataclass(frozen=True)
class Expansion:
    """What was written. ``curves`` and ``points`` are those of the prototypes, ``instances`` their copies."""

    path: Path
    meshes: tuple[str, ...]
    instances: int
    curves: int
    points: int
    warnings: tuple[str, ...]


def expand(
    source: str | Path,
    out: str | Path,
    fabric: FabricParameters | None = None,
    *,
    prim: str | None = None,
    region: Region | None = None,
    vertices_per_segment: int = PATH_TRACING_VERTICES,
    time: float | None = None,
    max_instances: int = MAX_INSTANCES,
    overwrite: bool = False,
) -> Expansion:
    """Write the cloth of a stage as instanced fibers.

    Parameters
    ----------
    source:
        A USD file with cloth meshes; ``out`` sublayers it by a relative path. Write ``.usdc``: the arrays are large.
    fabric:
        Replaces the fabrics that are bound (``read_scene``'s ``fabric_override``).
    prim:
        Only this cloth mesh.
    region:
        Only patch cells whose centre lies in ``(u0, v0, u1, v1)``, in the mesh's own texture coordinates.
    vertices_per_segment:
        Control points for each run of a yarn on one side.
    time:
        The mesh is read at this time code; the fibers do not move.

    Raises
    ------
    UsdfabError
        As ``read_scene``; if no cloth mesh is found, more than ``max_instances`` copies are needed or none is, or the
        file cannot be written.
    """
    checked_output(out, overwrite=overwrite)
    source_path, out_path = Path(source).resolve(), Path(out).resolve()
    if source_path == out_path:
        raise UsdfabError("the file to write is the file to read", place=str(out), remedy="choose another name")
    scene = read_scene(source, time=time, fabric_override=fabric, shutter=False, placements=False)
    surfaces = _surfaces(scene, prim)
    with atomic_path(out, overwrite=overwrite) as temporary:
        stage = _new_layer(source_path, temporary)
        writer = _Writer(stage, scene, time, override=fabric is not None, vertices=vertices_per_segment)
        for mesh, surface in surfaces:
            writer.add(mesh, surface, region, max_instances)
        for mesh in {mesh.path: mesh for mesh, _ in surfaces}.values():
            writer.hide(mesh)
        if writer.instances == 0:
            raise UsdfabError(
                "no patch cell has its centre on the cloth",
                place=stage_name(stage) if prim is None else f"{source}<{prim}>",
                remedy=f"a patch is {writer.patch_size}; is the cloth's scale or the region right?",
            )
        stage.GetRootLayer().Save()
        del stage
    names = tuple(dict.fromkeys(mesh.path for mesh, _ in surfaces))
    return Expansion(Path(out), names, writer.instances, writer.curves, writer.points, tuple(writer.warnings))


def _surfaces(scene: Scene, prim: str | None) -> list[tuple[Mesh, FabricSurface]]:
    """Each cloth mesh with its fabric."""
    found = []
    for mesh in scene.meshes:
        fabrics = sorted({scene.materials[m].fabric for m in np.unique(mesh.face_material)} - {-1})
        if prim is None or mesh.path == prim:
            found += [(mesh, scene.fabrics[f]) for f in fabrics]
    if not found:
        place = scene.path if prim is None else f"{scene.path}<{prim}>"
        remedy = "bind one with `usdfab bind`, or give a fabric"
        raise UsdfabError("there is no mesh with a fabric", place=place, remedy=remedy)
    return found


def _new_layer(source: Path, path: Path) -> Usd.Stage:
    """A stage over ``source`` with the same stage metadata."""
    layer = Sdf.Layer.CreateNew(str(path))
    layer.subLayerPaths.append(Path(os.path.relpath(source, path.parent)).as_posix())
    stage = Usd.Stage.Open(layer)
    base = open_stage(source)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.GetStageMetersPerUnit(base))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.GetStageUpAxis(base))
    if base.HasDefaultPrim():
        layer.defaultPrim = base.GetRootLayer().defaultPrim
    if base.HasAuthoredTimeCodeRange():
        stage.SetStartTimeCode(base.GetStartTimeCode())
        stage.SetEndTimeCode(base.GetEndTimeCode())
    layer.timeCodesPerSecond = base.GetTimeCodesPerSecond()
    layer.customLayerData = {"usdfab": {"generator": GENERATOR}}
    return stage


class _Writer:
    """Adds fibers beside meshes."""

    def __init__(self, stage: Usd.Stage, scene: Scene, time: float | None, *, override: bool, vertices: int) -> None:
        self.stage, self.scene, self.override, self.vertices = stage, scene, override, vertices
        self.time = time_code(stage, time)
        self.meters = UsdGeom.GetStageMetersPerUnit(stage)
        self.warnings = list(scene.warnings)
        self.instances = self.curves = self.points = 0
        self.patch_size = ""
        self.patches: dict[FabricParameters, Patch] = {}

    def add(self, mesh: Mesh, surface: FabricSurface, region: Region | None, limit: int) -> None:
        """Fibers for the faces of ``mesh`` that carry ``surface``."""
        patch = self._patch(surface.fabric)
        fabric_of_face = self._fabric_of_face(mesh)
        faces = fabric_of_face == next(k for k, s in enumerate(self.scene.fabrics) if s is surface)
        assert mesh.uv is not None, "a mesh with a fabric has uv"
        uv = mesh.uv[faces]
        cell = (patch.size[0] / surface.meters_per_uv, patch.size[1] / surface.meters_per_uv)
        about = estimate(uv, cell)
        if region is not None:
            about = min(about, max(region[2] - region[0], 0.0) * max(region[3] - region[1], 0.0) / (cell[0] * cell[1]))
        if self.instances + about > limit:
            raise UsdfabError(
                f"about {about:.3g} copies of the patch are needed, above {limit:g}",
                place=f"{self.scene.path}<{mesh.path}>",
                remedy="give a region, or a higher limit; `usdfab render` needs no copies",
            )
        normals = None if mesh.normals is None else mesh.normals[faces]
        placement = place(mesh.points[mesh.triangles][faces], uv, normals, cell, surface.meters_per_uv, region)
        if len(placement.positions) == 0:
            return
        self.instances += len(placement.positions)
        self._write(mesh, surface, patch, placement)

    def _patch(self, fabric: FabricParameters) -> Patch:
        if fabric not in self.patches:
            self.patches[fabric] = generate_patch(fabric, self.vertices)
        patch = self.patches[fabric]
        self.patch_size = f"{patch.size[0] * 1e3:.3g} x {patch.size[1] * 1e3:.3g} mm"
        return patch

    def _fabric_of_face(self, mesh: Mesh) -> np.ndarray:
        """(T,) index into ``Scene.fabrics``, or -1."""
        return np.array([m.fabric for m in self.scene.materials], dtype=int)[mesh.face_material]

    def hide(self, mesh: Mesh) -> None:
        """Make the mesh that the fibers replace invisible, or say why it stays."""
        prim = self.stage.GetPrimAtPath(mesh.path)
        if (self._fabric_of_face(mesh) < 0).any():
            self.warnings.append(f"{mesh.path}: only some faces are cloth, the mesh stays visible behind the fibers")
        elif prim.IsInstanceProxy():
            self.warnings.append(f"{mesh.path}: an instance cannot be hidden, the mesh stays visible")
        else:
            UsdGeom.Imageable(prim).MakeInvisible()

    # --- prims ---

    def _write(self, mesh: Mesh, surface: FabricSurface, patch: Patch, placement: Placement) -> None:
        centre = placement.positions.mean(axis=0)
        root = self._root(mesh, centre)
        instancer = UsdGeom.PointInstancer.Define(self.stage, root.GetPath().AppendChild("Patches"))
        prototypes = instancer.GetPath().AppendChild("Prototypes")
        material = self._material(root, surface)
        prototype = UsdGeom.Xform.Define(self.stage, prototypes.AppendChild("Patch"))
        for name, curves in _by_color(patch):
            self._curves(prototype.GetPath().AppendChild(name), curves, patch.size, material)
        instancer.CreatePrototypesRel().SetTargets([prototype.GetPath()])
        number = len(placement.positions)
        instancer.CreateProtoIndicesAttr(Vt.IntArray(number, 0))
        positions = (placement.positions - centre) / self.meters
        instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(positions.astype(np.float32)))
        instancer.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(placement.scales.astype(np.float32)))
        # scipy puts the real part last, as USD's quaternions do in memory.
        quaternions = Rotation.from_matrix(placement.rotations).as_quat().astype(np.float16)
        instancer.CreateOrientationsAttr(Vt.QuathArray.FromNumpy(quaternions))
        instancer.CreateIdsAttr(Vt.Int64Array.FromNumpy(np.arange(number, dtype=np.int64)))
        # The extent first: once the prototypes are overs, USD no longer finds it.
        time = Usd.TimeCode.Default()
        instancer.CreateExtentAttr(instancer.ComputeExtentAtTime(time, time))
        self.stage.GetRootLayer().GetPrimAtPath(prototypes).specifier = Sdf.SpecifierOver

    def _root(self, mesh: Mesh, centre: np.ndarray) -> UsdGeom.Xform:
        """An Xform beside the mesh whose own space is world space moved to ``centre`` (metres)."""
        parent = self.stage.GetPrimAtPath(mesh.path).GetParent()
        while parent.IsInstanceProxy() or parent.IsInstance() or parent.IsA(UsdGeom.Gprim):
            parent = parent.GetParent()
        name = mesh.path.rpartition("/")[2] + "_fibers"
        taken = [c.GetName() for c in parent.GetAllChildren()]
        unique = next(n for n in (name, *(f"{name}_{k}" for k in range(1, len(taken) + 2))) if n not in taken)
        root = UsdGeom.Xform.Define(self.stage, parent.GetPath().AppendChild(unique))
        # Undone as it is at the time at which the mesh was read: a parent that moves takes the fibers along.
        to_world = UsdGeom.XformCache(self.time).GetLocalToWorldTransform(parent)
        move = Gf.Matrix4d().SetTranslate(Gf.Vec3d(*map(float, centre / self.meters)))
        root.AddTransformOp().Set(move * to_world.GetInverse())
        return root

    def _material(self, root: UsdGeom.Xform, surface: FabricSurface) -> UsdShade.Material:
        """The cloth's own material, or a new one below ``root`` where the fabric was given from outside."""
        if not self.override:
            return UsdShade.Material(self.stage.GetPrimAtPath(surface.path))
        looks = UsdGeom.Scope.Define(self.stage, root.GetPath().AppendChild("Looks"))
        path = looks.GetPath().AppendChild("Fabric")
        return define_fabric_material(self.stage, path, surface.fabric, meters_per_uv=surface.meters_per_uv)

    def _curves(
        self, path: Sdf.Path, curves: FiberCurves, size: tuple[float, float], material: UsdShade.Material
    ) -> None:
        """One BasisCurves; the patch's centre is its origin, in stage units."""
        centred = (curves.points - np.array([size[0] / 2, size[1] / 2, 0.0])) / self.meters
        prim = UsdGeom.BasisCurves.Define(self.stage, path)
        tokens = UsdGeom.Tokens
        prim.CreateTypeAttr(tokens.cubic)
        prim.CreateBasisAttr(tokens.bspline)
        prim.CreateWrapAttr(tokens.nonperiodic)
        prim.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(curves.counts.astype(np.int32)))
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(centred, dtype=np.float32)))
        prim.CreateWidthsAttr(Vt.FloatArray([2.0 * curves.radius / self.meters]))
        prim.SetWidthsInterpolation(tokens.constant)
        prim.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(prim, Usd.TimeCode.Default()))
        prim.CreateDisplayColorAttr([Gf.Vec3f(*map(float, curves.color))])
        primvars = UsdGeom.PrimvarsAPI(prim)
        for name, values in (("usdfab:yarn", curves.yarn), ("usdfab:fiber", curves.fiber)):
            primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.IntArray, tokens.uniform)
            primvar.Set(Vt.IntArray.FromNumpy(values.astype(np.int32)))
        if material:
            UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
        else:
            self.warnings.append(f"{site(self.stage, path)}: no material is bound to the curves")
        self.curves += len(curves.counts)
        self.points += len(centred)


@dataclass(frozen=True, eq=False)
class FiberCurves:
    """Fibers of one system and colour: ``points`` (N, 3) metres, ``counts``, ``yarn``, ``fiber`` (curves,)."""

    points: np.ndarray
    counts: np.ndarray
    yarn: np.ndarray
    fiber: np.ndarray
    radius: float
    color: np.ndarray


def _by_color(patch: Patch) -> Iterator[tuple[str, FiberCurves]]:
    """``Warp`` and ``Weft``, or ``Warp_0``, ``Warp_1``, ... where their yarns have several colours.

    ``WarpFlyaways`` and the like follow; their fibers are numbered on from those of the yarn.
    """
    curves: list[tuple[str, FiberSystem | OpenCurves]] = [("Warp", patch.warp), ("Weft", patch.weft)]
    curves += [(f"{flyaways.system.capitalize()}Flyaways", flyaways) for flyaways in patch.flyaways]
    fibers = {system.system: int(system.fiber.max()) + 1 for system in patch.systems}
    for name, system in curves:
        colors, group = np.unique(system.albedo, axis=0, return_inverse=True)
        if isinstance(system, OpenCurves):
            points, offsets = system.pinned()
            fiber = fibers[system.system] + system.number
        else:
            points, offsets = spline_points(system)
            fiber = system.fiber
        counts = np.diff(offsets)
        for number, color in enumerate(colors):
            mine = group.ravel() == number
            chosen = points[np.repeat(mine, counts)]
            label = name if len(colors) == 1 else f"{name}_{number}"
            yield label, FiberCurves(chosen, counts[mine], system.yarn[mine], fiber[mine], system.radius, color)


def spline_points(system: FiberSystem) -> tuple[np.ndarray, np.ndarray]:
    """Control points and offsets of B-splines that cover exactly one period and join their neighbours smoothly.

    A nonperiodic cubic B-spline runs from its second knot to its last but one. With one control point of the curve
    before it and two of the curve after it, it runs from its own first vertex's knot to the knot of its successor's.
    """
    return system.extended(1, 2)
