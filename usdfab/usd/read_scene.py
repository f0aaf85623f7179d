"""A USD stage at one time as a :class:`~usdfab.usd.scene.Scene`: metres, world space, triangles, no ``pxr``."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.usd.fabric_io import fabric_from_prim, is_fabric, meters_per_uv_from_prim
from usdfab.usd.read_lights import is_light, matrix, read_light
from usdfab.usd.read_materials import read_material, unbound_material
from usdfab.usd.read_mesh import RawMesh, read_mesh
from usdfab.usd.scene import Array, Camera, FabricSurface, Light, Material, Mesh, Scene
from usdfab.usd.stage import open_stage, site, stage_name

_PURPOSES = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


def read_scene(
    source: str | Path | Usd.Stage,
    time: float | None = None,
    camera: str | None = None,
    fabric_override: FabricParameters | None = None,
) -> Scene:
    """What a renderer needs of a stage.

    Visible prims of purpose ``default`` and ``render`` are read, instances included. Lights, cameras and meshes that
    usdfab does not support are named in ``Scene.warnings``, as are other shapes (spheres, curves, point instancers).

    Parameters
    ----------
    time:
        Time code; None is the stage's start, where it has one, else the earliest sample.
    camera:
        Path of a camera, which then comes first in ``Scene.cameras``.
    fabric_override:
        Replaces every bound fabric. If no mesh has one, it goes on the meshes that have texture coordinates and no
        material at all; if there is none of these either, on the only mesh with texture coordinates.

    Raises
    ------
    UsdfabError
        If the stage cannot be opened, is empty or has no mesh; for a mesh that carries a fabric but no texture
        coordinates (or coordinates without area); points that are not finite, indices out of range, primvars of the
        wrong length; a missing camera; and when there is no mesh, or no single one, for ``fabric_override``.
    """
    stage = open_stage(source)
    reader = _Reader(stage, time_code(stage, time))
    reader.collect()
    if not reader.raw_meshes:
        empty = not any(True for _ in stage.TraverseAll())
        problem = "the stage is empty" if empty else "there is no visible mesh in this stage"
        raise UsdfabError(problem, place=stage_name(stage), remedy="usdfab renders polygon meshes")
    cameras = _chosen_first(stage, reader.cameras, camera)
    meshes = reader.resolve(fabric_override)
    return Scene(
        stage_name(stage),
        meshes,
        tuple(reader.materials),
        tuple(reader.fabrics),
        cameras,
        tuple(reader.lights),
        tuple(reader.warnings + reader.left_out()),
        str(UsdGeom.GetStageUpAxis(stage)),
    )


def time_code(stage: Usd.Stage, time: float | None) -> Usd.TimeCode:
    """The time code that ``read_scene`` reads at: ``time``, or the stage's start, or the earliest sample."""
    if time is not None:
        if not math.isfinite(time):
            raise UsdfabError(f"{time} is not a time code", place="time")
        return Usd.TimeCode(time)
    return Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()


def _chosen_first(stage: Usd.Stage, cameras: list[Camera], wanted: str | None) -> tuple[Camera, ...]:
    if wanted is None:
        return tuple(cameras)
    chosen = [c for c in cameras if c.path == wanted]
    if not chosen:
        names = ", ".join(c.path for c in cameras)
        remedy = f"choose one of {names}" if names else "the stage has no perspective camera"
        raise UsdfabError("there is no such camera", place=f"{stage_name(stage)}<{wanted}>", remedy=remedy)
    return (*chosen, *(c for c in cameras if c.path != wanted))


class _Reader:
    """Collects a stage's prims, then gives meshes their materials and fabrics."""

    def __init__(self, stage: Usd.Stage, time: Usd.TimeCode) -> None:
        self.stage, self.time = stage, time
        self.meters = UsdGeom.GetStageMetersPerUnit(stage)
        self.transforms = UsdGeom.XformCache(time)
        self.raw_meshes: list[RawMesh] = []
        self.cameras: list[Camera] = []
        self.lights: list[Light] = []
        self.materials: list[Material] = []
        self.fabrics: list[FabricSurface] = []
        self.warnings = [f"composition: {_one_line(e)}" for e in stage.GetCompositionErrors()]
        self.unsupported: Counter[str] = Counter()
        self.material_index: dict[Sdf.Path, int] = {}

    # --- the prims ---

    def collect(self) -> None:
        """Read meshes, cameras and lights."""
        if not (math.isfinite(self.meters) and self.meters > 0):
            raise UsdfabError(f"metersPerUnit is {self.meters}", place=stage_name(self.stage), remedy="author it")
        prims = iter(Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()))
        for prim in prims:
            imageable = UsdGeom.Imageable(prim)
            if imageable and imageable.GetVisibilityAttr().Get(self.time) == UsdGeom.Tokens.invisible:
                prims.PruneChildren()
            elif prim.IsA(UsdGeom.PointInstancer):
                # Its prototypes may lie below it and are not shapes of their own.
                self.unsupported["PointInstancer"] += 1
                prims.PruneChildren()
            elif imageable and imageable.ComputePurpose() in _PURPOSES:
                self._read(prim)

    def _read(self, prim: Usd.Prim) -> None:
        to_world = matrix(self.transforms.GetLocalToWorldTransform(prim))
        if is_light(prim):
            light, warnings = read_light(prim, to_world, self.meters, self.time)
            self.warnings += warnings
            self.lights += [light] if light else []
        if prim.IsA(UsdGeom.Mesh):
            mesh, warnings = read_mesh(prim, to_world, self.meters, self.time)
            self.warnings += warnings
            self.raw_meshes += [mesh] if mesh else []
        elif prim.IsA(UsdGeom.Camera):
            self._read_camera(prim, to_world)
        elif prim.IsA(UsdGeom.Gprim):
            self.unsupported[prim.GetTypeName()] += 1

    def left_out(self) -> list[str]:
        """A warning for each type of shape that was met and not read."""
        return [f"{count} prims of type {kind} are not supported, left out" for kind, count in self.unsupported.items()]

    def _read_camera(self, prim: Usd.Prim, to_world: Array) -> None:
        camera = UsdGeom.Camera(prim)
        place = str(prim.GetPath())
        if camera.GetProjectionAttr().Get(self.time) != UsdGeom.Tokens.perspective:
            self.warnings.append(f"{place}: only perspective cameras are supported, left out")
            return
        aperture, offset = (
            np.array([float(a.Get(self.time)) for a in pair])
            for pair in (
                (camera.GetHorizontalApertureAttr(), camera.GetVerticalApertureAttr()),
                (camera.GetHorizontalApertureOffsetAttr(), camera.GetVerticalApertureOffsetAttr()),
            )
        )
        focal = float(camera.GetFocalLengthAttr().Get(self.time))
        exposure = math.log2(max(float(camera.ComputeLinearExposureScale(self.time)), 1e-300))
        u, scale, vt = np.linalg.svd(to_world[:3, :3])
        numbers = np.array([focal, *aperture, *offset, exposure, *scale])
        if not np.isfinite(numbers).all() or focal <= 0 or (aperture <= 0).any() or scale[-1] == 0:
            raise UsdfabError("focal length, apertures and transform must be above 0", place=site(self.stage, prim))
        rigid = np.eye(4)
        rigid[:3, :3] = u @ vt
        rigid[:3, 3] = to_world[:3, 3] * self.meters
        self.cameras.append(Camera(place, rigid, aperture / (2.0 * focal), 2.0 * offset / aperture, exposure))

    # --- materials and fabrics ---

    def resolve(self, override: FabricParameters | None) -> tuple[Mesh, ...]:
        """The meshes with their materials; fills ``materials`` and ``fabrics``."""
        extra = set() if override is None else self._override_targets()
        return tuple(
            Mesh(
                str(raw.prim.GetPath()), raw.points, raw.triangles, raw.normals, raw.uv,
                self._face_materials(raw, override, number in extra), raw.double_sided,
            )
            for number, raw in enumerate(self.raw_meshes)
        )  # fmt: skip

    def _override_targets(self) -> set[int]:
        """Numbers of the meshes that get the override although no fabric is bound to them (see ``read_scene``)."""
        if any(is_fabric(m) for raw in self.raw_meshes for m in raw.materials if m):
            return set()
        with_uv = [i for i, raw in enumerate(self.raw_meshes) if raw.uv is not None]
        free = [i for i in with_uv if not any(self.raw_meshes[i].materials)]
        if free:
            return set(free)
        if len(with_uv) == 1:
            return set(with_uv)
        names = ", ".join(str(self.raw_meshes[i].prim.GetPath()) for i in with_uv)
        raise UsdfabError(
            f"which mesh is cloth? All have other materials ({names})" if names else "no mesh has texture coordinates",
            place=stage_name(self.stage),
            remedy="bind the fabric to a mesh with `usdfab bind`" if names else "add a primvar 'st' to the cloth",
        )

    def _face_materials(self, raw: RawMesh, override: FabricParameters | None, force: bool) -> np.ndarray:
        """(T,) int32 indices into ``materials``."""
        index = np.zeros(len(raw.materials), dtype=np.int32)
        for slot, prim in enumerate(raw.materials):
            faces = raw.slot == slot
            if not faces.any():
                continue
            if force or (prim and is_fabric(prim)):
                index[slot] = self._add_fabric(raw, prim, faces, override)
            elif prim:
                index[slot] = self._shared_material(prim)
            else:
                index[slot] = self._append(unbound_material(raw.prim, self.time))
        return index[raw.slot]

    def _append(self, material: Material) -> int:
        self.materials.append(material)
        return len(self.materials) - 1

    def _shared_material(self, prim: Usd.Prim) -> int:
        if prim.GetPath() not in self.material_index:
            material, warnings = read_material(prim, self.time)
            self.warnings += warnings
            self.material_index[prim.GetPath()] = self._append(material)
        return self.material_index[prim.GetPath()]

    def _add_fabric(
        self, raw: RawMesh, prim: Usd.Prim | None, faces: np.ndarray, override: FabricParameters | None
    ) -> int:
        """A FabricSurface and its material for the triangles ``faces`` of one mesh."""
        bound = prim is not None and is_fabric(prim)
        fabric = override if override is not None else fabric_from_prim(prim)
        meters = meters_per_uv_from_prim(prim) if bound else 0.0
        measured = meters_per_uv(raw, faces, self.stage)
        path = str(prim.GetPath()) if prim else str(raw.prim.GetPath())
        self.fabrics.append(FabricSurface(path, fabric, meters or measured))
        is_surface = prim is not None and UsdShade.Material(prim)
        look, _ = read_material(prim, self.time) if is_surface else (unbound_material(raw.prim, self.time), [])
        return self._append(
            Material(path, len(self.fabrics) - 1, look.base_color, look.roughness, look.metallic, look.opacity)
        )


def meters_per_uv(raw: RawMesh, faces: np.ndarray, stage: Usd.Stage) -> float:
    """sqrt(area on the surface / area in uv) over the triangles ``faces``; errors for a mesh without usable uv."""
    place = site(stage, raw.prim)
    if raw.uv is None:
        raise UsdfabError(
            "the mesh carries a fabric but has no texture coordinates",
            place=place,
            remedy="add a primvar 'st' (texCoord2f[], vertex or faceVarying), in your modelling program: unwrap it",
        )
    uv = raw.uv[faces]
    edges = uv[:, 1:] - uv[:, :1]
    uv_area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum()
    area = raw.areas()[faces].sum()
    if not (uv_area > 0 and area > 0):
        raise UsdfabError(
            "the texture coordinates of the cloth cover no area" if area > 0 else "the cloth has no area",
            place=place,
            remedy="unwrap the mesh anew",
        )
    return float(np.sqrt(area / uv_area))


def _one_line(error: object) -> str:
    return " ".join(str(error).split())
