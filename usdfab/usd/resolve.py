"""Placed mesh prims to the meshes, materials and fabrics of a scene.

Copies of one prim with the same materials and colours are read once. From ``SHARED`` copies on they become one mesh
with placements; fewer are meshes of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.usd.bake import Baked, bake, bake_many
from usdfab.usd.collect import Placed, canonical
from usdfab.usd.fabric_io import fabric_from_prim, is_fabric, meters_per_uv_from_prim
from usdfab.usd.frames import Shutter
from usdfab.usd.orientation import ROTATION, SCALE, Orientation, read_orientation
from usdfab.usd.primvars import ALBEDO, Values
from usdfab.usd.problems import Problems
from usdfab.usd.read_materials import Look, plain_material, read_material, unbound_material
from usdfab.usd.read_mesh import Bindings, Cage, read_bindings, read_cage
from usdfab.usd.read_textures import albedo_map
from usdfab.usd.scene import Array, FabricSurface, Material, Mesh
from usdfab.usd.stage import site, stage_name
from usdfab.usd.tessellate import Triangles, levels, tessellate
from usdfab.usd.unwrap import unwrap_faces

SHARED = 4
"""From so many copies on, a mesh is stored once."""
_INHERITED = (ALBEDO, ROTATION, SCALE, "displayColor", "displayOpacity")


@dataclass(eq=False)
class _Shape:
    """A mesh prim with all its copies."""

    prim: Usd.Prim
    bindings: Bindings
    places: list[Placed] = field(default_factory=list)
    cage: Cage | None = None
    unwrapped: bool = False

    @property
    def path(self) -> str:
        return str(self.prim.GetPath())


@dataclass(frozen=True, eq=False)
class _Copies:
    """Copies of a shape, (K, 4, 4) in metres, and the prim that gives the mesh its name."""

    prim: Usd.Prim
    to_world: Array
    to_world_close: Array | None


class Resolver:
    """Makes meshes of placed prims; collects ``materials`` and ``fabrics`` on the way."""

    def __init__(
        self,
        stage: Usd.Stage,
        shutter: Shutter,
        problems: Problems,
        *,
        share: bool,
        subdivision: int | None,
        by_path: bool = False,
    ) -> None:
        self.stage, self.shutter, self.problems = stage, shutter, problems
        self.share, self.subdivision, self.by_path = share, subdivision, by_path
        self.meters = UsdGeom.GetStageMetersPerUnit(stage)
        self.materials: list[Material] = []
        self.fabrics: list[FabricSurface] = []
        self._looks: dict[Sdf.Path, Look] = {}
        self._index: dict[Sdf.Path, int] = {}
        self._parameters: dict[Sdf.Path, FabricParameters | None] = {}

    def resolve(self, placed: list[Placed], override: FabricParameters | None) -> tuple[Mesh, ...]:
        """The meshes with their materials. ``override``: as ``read_scene``'s ``fabric_override``."""
        shapes = [shape for shape in self._shapes(placed) if self._read(shape)]
        extra = set() if override is None or not shapes else self._override_targets(shapes)
        meshes: list[Mesh] = []
        for number, shape in enumerate(shapes):
            with self.problems.tolerating(shape.path, "the mesh is left out"):
                meshes += self._meshes(shape, override, number in extra)
        return tuple(meshes)

    # --- shapes ---

    def _shapes(self, placed: list[Placed]) -> list[_Shape]:
        """Copies gathered by what they are copies of, and by what materials and colours they have."""
        shapes: dict[object, _Shape] = {}
        for place in placed:
            with self.problems.tolerating(str(place.prim.GetPath()), "the mesh is left out"):
                bindings = read_bindings(place.prim, self.shutter.frame, self.problems)
                looks = tuple(canonical(m) if m else None for m in bindings.materials)
                key = (place.source, looks, self._inherited(place.prim))
                shapes.setdefault(key, _Shape(place.prim, bindings)).places.append(place)
        return list(shapes.values())

    def _inherited(self, prim: Usd.Prim) -> tuple[bytes, ...]:
        """Colours and orientation that a prim inherits from its ancestors, which may differ between copies."""
        api, found = UsdGeom.PrimvarsAPI(prim), []
        for name in _INHERITED:
            primvar = api.FindPrimvarWithInheritance(name)
            if primvar and primvar.HasValue() and primvar.GetAttr().GetPrim() != prim:
                found.append(name.encode() + np.asarray(primvar.Get(self.shutter.frame)).tobytes())
        return tuple(found)

    def _read(self, shape: _Shape) -> bool:
        """Read the cage of a shape; False where there is none to draw."""
        names = [name for m in shape.bindings.materials if m for name in self._look(m).uv_names]
        with self.problems.tolerating(shape.path, "the mesh is left out"):
            shape.cage = read_cage(shape.prim, self.meters, self.shutter, self.problems, tuple(names))
        return shape.cage is not None

    def _copies(self, shape: _Shape) -> list[_Copies]:
        """The copies in metres, without those that have no regular transform; together where they are to be shared."""
        opened = np.concatenate([p.to_world for p in shape.places])
        closes = [p.to_world_close for p in shape.places if p.to_world_close is not None]
        closed = np.concatenate(closes) if closes else opened
        prims = [p.prim for p in shape.places for _ in range(len(p.to_world))]
        both = np.stack([opened, closed])
        finite = np.isfinite(both).all(axis=(0, 2, 3))
        determinant = np.linalg.det(np.where(finite[:, None, None], both, np.eye(4)))
        regular = finite & (determinant != 0.0).all(axis=0)
        if not regular.all():
            problem = "the transform is singular" if finite.all() else "the transform is not finite"
            count, instead = int((~regular).sum()), "the mesh is left out"
            if len(regular) > 1:
                instead = f"{count} of {len(regular)} copies are left out"
            if finite.all() and shape.places[0].copied:
                # Copies scaled to nothing are a usual way to hide them.
                self.problems.warn(f"{shape.path}: {problem}; {instead}")
            else:
                self.problems.fault(UsdfabError(problem, place=site(self.stage, shape.prim)), instead)
        opened, closed = opened[regular].copy(), closed[regular].copy()
        prims = [p for p, good in zip(prims, regular, strict=True) if good]
        opened[:, :3, 3] *= self.meters
        closed[:, :3, 3] *= self.meters
        close = closed if closes else None
        groups = []
        mirrored = determinant[0, regular] < 0
        apart = np.unique([str(p.GetPath()) for p in prims], return_inverse=True)[1] if self.by_path else 0 * mirrored
        for key in np.unique(2 * apart + mirrored):
            mine = np.flatnonzero(2 * apart + mirrored == key)
            if self.share and len(mine) >= SHARED:
                groups.append((mine[0], mine))
            else:
                groups += [(k, np.array([k])) for k in mine]
        groups.sort(key=lambda group: int(group[0]))
        return [_Copies(prims[k], opened[mine], None if close is None else close[mine]) for k, mine in groups]

    # --- meshes ---

    def _meshes(self, shape: _Shape, override: FabricParameters | None, force: bool) -> list[Mesh]:
        copies = self._copies(shape)
        if not copies:
            return []
        local = self._triangles(shape, copies[0], override, force)
        if local is None:
            self.problems.warn(f"{shape.path}: the mesh has no triangles, left out")
            return []
        meshes = []
        for group in copies:
            if len(group.to_world) > 1:
                baked = bake_many(local, group.to_world, group.to_world_close)
            else:
                close = None if group.to_world_close is None else group.to_world_close[0]
                baked = bake(local, group.to_world[0], close)
            if not baked.areas().sum() > 0:
                raise UsdfabError("the mesh has no area", place=site(self.stage, shape.prim))
            assert shape.cage is not None
            slots = shape.bindings.slot[local.face]
            baked = self._turned(shape, baked, slots, override, force)
            materials = self._face_materials(shape, baked, slots, override, force)
            meshes.append(
                Mesh(
                    str(group.prim.GetPath()), baked.points, baked.triangles, baked.normals, baked.uv, materials,
                    shape.cage.double_sided, baked.placements, baked.points_close, baked.placements_close, baked.albedo,
                )
            )  # fmt: skip
        return meshes

    def _triangles(
        self, shape: _Shape, first: _Copies, override: FabricParameters | None, force: bool
    ) -> Triangles | None:
        """The triangles of a shape; if it is cloth without usable texture coordinates, they are made."""
        cage = shape.cage
        assert cage is not None
        level, warning = levels(cage, self.subdivision)
        self.problems.warn(*([warning] if warning else []))
        local = tessellate(cage, level)
        cloth = [force or self._is_cloth(m, override) for m in shape.bindings.materials]
        if local is None or not any(cloth):
            return local
        faces = np.array(cloth)[shape.bindings.slot[local.face]]
        if not faces.any() or (local.uv is not None and _uv_area(local.uv[faces]) > 0):
            return local
        problem = "has no texture coordinates" if local.uv is None else "has texture coordinates that cover no area"
        self.problems.warn(f"{shape.path}: the cloth {problem}; it is unwrapped, yarns change direction at its seams")
        shape.unwrapped = True
        # As large as the first copy, but not turned as it is: the charts of a mesh that moves stay what they are.
        stretch = _stretch(first.to_world[0])
        uv = unwrap_faces(cage.rest @ stretch, cage.topology.counts, cage.topology.indices)
        if cage.left_handed != (np.linalg.det(first.to_world[0, :3, :3]) < 0):
            # The front is where the faces run clockwise: u and v are not to be mirrored as seen from there.
            uv = uv * (-1.0, 1.0)
        # Linear when refined: charts have jagged borders, which splines would fold over.
        return tessellate(replace(cage, uv=Values("unwrapped", uv, "faceVarying"), seams="all"), level)

    def _orientation(self, prim: Usd.Prim) -> Orientation:
        """How the fabric lies on a mesh or a subset; as it is where that cannot be read (a fault)."""
        with self.problems.tolerating(str(prim.GetPath()), "the fabric is not turned or scaled"):
            return read_orientation(prim, self.shutter.frame)
        return Orientation()

    def _turned(
        self, shape: _Shape, baked: Baked, slots: np.ndarray, override: FabricParameters | None, force: bool
    ) -> Baked:
        """The texture coordinates of the faces that are cloth, turned as their prims say."""
        if baked.uv is None:
            return baked
        uv = baked.uv
        for slot, (material, prim) in enumerate(zip(shape.bindings.materials, shape.bindings.prims, strict=True)):
            faces = slots == slot
            if faces.any() and (force or self._is_cloth(material, override)):
                uv = uv.copy()
                uv[faces] = self._orientation(prim).turned(uv[faces])
        return replace(baked, uv=uv)

    def _is_cloth(self, prim: Usd.Prim | None, override: FabricParameters | None) -> bool:
        return prim is not None and is_fabric(prim) and (override is not None or self._fabric(prim) is not None)

    def _override_targets(self, shapes: list[_Shape]) -> set[int]:
        """Numbers of the meshes that get the override although no fabric is bound to them (see ``read_scene``)."""
        if any(is_fabric(m) for shape in shapes for m in shape.bindings.materials if m):
            return set()
        with_uv = [i for i, shape in enumerate(shapes) if shape.cage is not None and shape.cage.uv is not None]
        free = [i for i in with_uv if not any(shapes[i].bindings.materials)]
        if free:
            return set(free)
        if len(with_uv) == 1:
            return set(with_uv)
        if not with_uv and len(shapes) == 1:
            return {0}
        names = ", ".join(shapes[i].path for i in with_uv)
        raise UsdfabError(
            f"which mesh is cloth? All have other materials ({names})" if names else "no mesh has texture coordinates",
            place=stage_name(self.stage),
            remedy="bind the fabric to a mesh with `usdfab bind`" if names else "add a primvar 'st' to the cloth",
        )

    # --- materials and fabrics ---

    def _face_materials(
        self, shape: _Shape, baked: Baked, slots: np.ndarray, override: FabricParameters | None, force: bool
    ) -> np.ndarray:
        """(T,) int32 indices into ``materials``."""
        index = np.zeros(len(shape.bindings.materials), dtype=np.int32)
        for slot, prim in enumerate(shape.bindings.materials):
            faces = slots == slot
            if not faces.any():
                continue
            fabric = override
            if fabric is None and prim is not None and is_fabric(prim):
                fabric = self._fabric(prim)
            if fabric is not None and (force or self._is_cloth(prim, override)):
                orientation = self._orientation(shape.bindings.prims[slot])
                index[slot] = self._add_fabric(shape, baked, faces, prim, fabric, orientation)
            elif prim:
                self._check_coordinates(shape, prim)
                index[slot] = self._shared(prim)
            else:
                index[slot] = self._append(unbound_material(shape.prim, self.shutter.frame, self.problems))
        return index[slots]

    def _append(self, material: Material) -> int:
        self.materials.append(material)
        return len(self.materials) - 1

    def _look(self, prim: Usd.Prim) -> Look:
        path = canonical(prim)
        if path not in self._looks:
            # Whatever is wrong inside is dealt with there; this is for a Material that USD itself stumbles over.
            self._looks[path] = Look(plain_material(str(prim.GetPath()), (0.5, 0.5, 0.5)))
            with self.problems.tolerating(str(prim.GetPath()), "the material is shown grey"):
                self._looks[path] = read_material(prim, self.shutter.frame, self.problems)
        return self._looks[path]

    def _shared(self, prim: Usd.Prim) -> int:
        path = canonical(prim)
        if path not in self._index:
            self._index[path] = self._append(self._look(prim).material)
        return self._index[path]

    def _check_coordinates(self, shape: _Shape, prim: Usd.Prim) -> None:
        """Warn where a material's textures want other coordinates than the mesh has."""
        look, uv = self._look(prim), shape.cage.uv if shape.cage else None
        if uv is None:
            if look.material.textures:
                self.problems.warn(f"{shape.path}: {prim.GetPath()} has textures, the mesh no texture coordinates")
            return
        for name in look.uv_names:
            if name != uv.name:
                self.problems.warn(f"{shape.path}: {prim.GetPath()} reads '{name}', the mesh's '{uv.name}' is used")

    def _fabric(self, prim: Usd.Prim) -> FabricParameters | None:
        """The fabric of a Material, None where it cannot be read (a fault)."""
        path = canonical(prim)
        if path not in self._parameters:
            self._parameters[path] = None
            with self.problems.tolerating(str(prim.GetPath()), "the cloth is shown without fibers"):
                self._parameters[path] = fabric_from_prim(prim)
        return self._parameters[path]

    def _add_fabric(
        self,
        shape: _Shape,
        baked: Baked,
        faces: np.ndarray,
        prim: Usd.Prim | None,
        fabric: FabricParameters,
        orientation: Orientation,
    ) -> int:
        """A FabricSurface and its material for the triangles ``faces`` of one mesh."""
        meters = 0.0
        if prim is not None and is_fabric(prim) and not shape.unwrapped:
            with self.problems.tolerating(str(prim.GetPath()), "metres per uv are measured"):
                meters = meters_per_uv_from_prim(prim)
        path = str(prim.GetPath()) if prim else shape.path
        # A fabric that lies larger has less of its cloth in one unit of uv.
        meters = (meters or self._measured(shape, baked, faces)) / orientation.scale
        texture = orientation.in_place(albedo_map(fabric, path, self.problems))
        surface = FabricSurface(path, fabric, meters, texture)
        self.fabrics.append(surface)
        if prim is not None and UsdShade.Material(prim):
            look = self._look(prim).material
        else:
            look = unbound_material(shape.prim, self.shutter.frame, self.problems)
        number = len(self.fabrics) - 1
        return self._append(
            Material(path, number, look.base_color, look.roughness, look.metallic, look.opacity, ior=look.ior)
        )

    def _measured(self, shape: _Shape, baked: Baked, faces: np.ndarray) -> float:
        """sqrt(area on the surface / area in uv) over the triangles ``faces``, at rest: cloth that stretches while it
        moves keeps its yarns in place."""
        assert baked.uv is not None, "cloth without texture coordinates is unwrapped"
        area, uv_area = float(baked.areas()[faces].sum()), _uv_area(baked.uv[faces])
        if not (area > 0 and uv_area > 0):
            raise UsdfabError("the cloth has no area", place=site(self.stage, shape.prim))
        return float(np.sqrt(area / uv_area))


def _uv_area(uv: Array) -> float:
    edges = uv[:, 1:] - uv[:, :1]
    return 0.5 * float(np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum())


def _stretch(to_world: Array) -> Array:
    """(3, 3) symmetric: how a transform stretches, without its rotation; rounded so that rotations do not show."""
    _, s, vt = np.linalg.svd(to_world[:3, :3])
    stretch = (vt.T * s) @ vt
    return np.round(stretch / s[0], 9) * float(f"{s[0]:.9g}")
