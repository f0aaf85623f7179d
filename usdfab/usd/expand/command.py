"""Cloth as fibers in a USD file, for renderers that know no usdfab.

The new file sublayers the user's stage and never flattens it. Beside each cloth mesh stands ``<Mesh>_fibers``; the mesh
itself is made invisible. Three ways:

- ``instancer``: a PointInstancer over prototypes, each a piece of one of the fabric's tiles in one of its variants.
- ``xform``: an Xform with the whole affine frame for each piece, an instance of a prototype.
- ``baked``: the curves themselves, bent onto the surface, for close-ups of a region.

All choose the same variant for each tile as usdfab's own renderer, so that pictures agree fiber by fiber.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fibers import PATH_TRACING_VERTICES, patch_variants
from usdfab.fibers.tiles import tile_copies
from usdfab.usd.atomic import atomic_path, checked_output
from usdfab.usd.expand.author import author_curves, define_root, fabric_material, fiber_facts
from usdfab.usd.expand.bake import bake_curves
from usdfab.usd.expand.centres import estimate
from usdfab.usd.expand.curves import FiberCurves, tile_curves
from usdfab.usd.expand.divide import divide
from usdfab.usd.expand.frames import MAX_SHEAR, Frames, poses
from usdfab.usd.expand.instances import Cloth, Written, write_instancer, write_xforms
from usdfab.usd.expand.layer import editable, new_layer, replace_mesh
from usdfab.usd.expand.place import Box, Pieces, Tint, place_pieces
from usdfab.usd.expand.seams import Seams, measure_seams
from usdfab.usd.expand.surface import ClothSurface
from usdfab.usd.fabric_io import with_relative_files
from usdfab.usd.read_scene import read_scene, time_code
from usdfab.usd.scene import FabricSurface, Mesh, Scene, Texture
from usdfab.usd.stage import site, stage_name

Mode = Literal["instancer", "xform", "baked"]
Purpose = Literal["default", "render"]
TextureReader = Callable[[Texture, NDArray[np.float64]], NDArray[np.float64]]
"""Colours (N, 3) of a texture at texture coordinates (N, 2)."""

MAX_INSTANCES = 5_000_000
"""More copies than this are refused unless asked for: some 200 MB in the file."""

MAX_XFORMS = 500_000
"""The same for ``xform``: each is a prim of its own."""

MAX_POINTS = 30_000_000
"""The same for the control points of ``baked``: some 400 MB."""

TOLERANCE = 2.0
"""How far pieces may be from the surface, in fiber radii: a twentieth of a typical yarn's width."""

OVERLAP = 3.0
"""By how many fiber radii fibers of pieces go on beyond the piece."""

SHEAR_STEPS = 4.0
"""Steps of the smallest pieces' shear, in tolerances over their height: what rounding it moves the corners by is less
than the tolerance."""

INSTANCED_VERTICES = 24
"""Control points on each run of a yarn in prototypes: within half a fiber radius of many more."""


@dataclass(frozen=True)
class ExpandOptions:
    """How to expand.

    Parameters
    ----------
    mode:
        "instancer", "xform" or "baked".
    region:
        (u0, v0, u1, v1) in the mesh's texture coordinates as the renderer sees them: only what lies there. Baked curves
        are cut at it, pieces belong to it by their centres.
    vertices_per_segment:
        Control points for each run of a yarn on one side; None: ``INSTANCED_VERTICES``, or as many as the renderer has
        where baked.
    tolerance: fiber radii
        How far pieces may be from the surface at their corners before they are divided.
    overlap: fiber radii
        By how much fibers of pieces go on beyond the piece.
    purpose:
        "default": fibers replace the mesh. "render": fibers are for final renders, the mesh is the proxy elsewhere.
    limit:
        Most copies (control points where baked); None: ``MAX_INSTANCES``, ``MAX_XFORMS``, ``MAX_POINTS``.
    """

    mode: Mode = "instancer"
    region: Box | None = None
    vertices_per_segment: int | None = None
    tolerance: float = TOLERANCE
    overlap: float = OVERLAP
    purpose: Purpose = "default"
    limit: int | None = None

    def checked(self) -> ExpandOptions:
        """The options themselves.

        Raises
        ------
        UsdfabError
            If one makes no sense.
        """
        for name, value, known in (("--mode", self.mode, Mode), ("--purpose", self.purpose, Purpose)):
            if value not in get_args(known):
                raise UsdfabError(f"there is no '{value}'", place=name, remedy=f"use {', '.join(get_args(known))}")
        if not self.tolerance > 0.0:
            raise UsdfabError(f"{self.tolerance} is no distance", place="--tolerance", remedy="give fiber radii")
        if not 0.0 <= self.overlap <= 1000.0:
            raise UsdfabError(f"{self.overlap} is no overlap", place="overlap", remedy="give fiber radii, 0 or more")
        if self.region is not None:
            u0, v0, u1, v1 = self.region
            if not (np.isfinite(self.region).all() and u0 < u1 and v0 < v1):
                raise UsdfabError("the region is empty", place="--region", remedy="write u0,v0,u1,v1, lower ends first")
        return self

    @property
    def vertices(self) -> int:
        """Control points on each run of a yarn."""
        default = PATH_TRACING_VERTICES if self.mode == "baked" else INSTANCED_VERTICES
        return default if self.vertices_per_segment is None else self.vertices_per_segment

    @property
    def most(self) -> int:
        """The limit that holds."""
        defaults = {"instancer": MAX_INSTANCES, "xform": MAX_XFORMS, "baked": MAX_POINTS}
        return defaults[self.mode] if self.limit is None else self.limit


@dataclass(frozen=True)
class Expansion:
    """What was written. ``curves`` and ``points`` are those of the prototypes, or all of them where baked.

    ``seams`` tells how well pieces meet on the mesh on which they do worst; None where baked (curves share control
    points there) and where none meet.
    """

    path: Path
    mode: Mode
    meshes: tuple[str, ...]
    instances: int
    prototypes: int
    curves: int
    points: int
    seams: Seams | None
    warnings: tuple[str, ...]


def expand(
    source: str | Path,
    out: str | Path,
    fabric: FabricParameters | None = None,
    options: ExpandOptions | None = None,
    *,
    prim: str | None = None,
    time: float | None = None,
    textures: TextureReader | None = None,
    overwrite: bool = False,
) -> Expansion:
    """Write the cloth of a stage as fibers.

    Parameters
    ----------
    source:
        A USD file with cloth meshes; ``out`` sublayers it by a relative path. Write ``.usdc``: the arrays are large.
    fabric:
        Replaces the fabrics that are bound (``read_scene``'s ``fabric_override``).
    options:
        ``ExpandOptions()`` by default.
    prim:
        Only this cloth mesh.
    time:
        The mesh is read at this time code; the fibers do not move.
    textures:
        Reads albedo maps; without it they are left out, with a warning.

    Raises
    ------
    UsdfabError
        As ``read_scene``; if no cloth mesh is found, more copies are needed than ``options`` allows or none is, or the
        file cannot be written.
    """
    options = (options or ExpandOptions()).checked()
    checked_output(out, overwrite=overwrite)
    source_path, out_path = Path(source).resolve(), Path(out).resolve()
    if source_path == out_path:
        raise UsdfabError("the file to write is the file to read", place=str(out), remedy="choose another name")
    scene = read_scene(source, time=time, fabric_override=fabric, shutter=False, by_path=True)
    surfaces = _surfaces(scene, prim)
    with atomic_path(out, overwrite=overwrite) as temporary:
        stage = new_layer(source_path, temporary)
        writer = _Writer(stage, scene, time, options, textures, out_path.parent, override=fabric is not None)
        for mesh, surface in surfaces:
            writer.add(mesh, surface)
        if writer.total.instances + writer.total.points == 0:
            raise UsdfabError(
                "no patch cell has its centre on the cloth",
                place=stage_name(stage) if prim is None else f"{source}<{prim}>",
                remedy=f"a patch is {writer.patch_size}; is the cloth's scale or the region right?",
            )
        stage.GetRootLayer().Save()
        del stage
    names = tuple(dict.fromkeys(mesh.path for mesh, _ in surfaces))
    total = writer.total
    return Expansion(
        Path(out), options.mode, names, total.instances, total.prototypes, total.curves, total.points, writer.seams,
        tuple(dict.fromkeys(writer.warnings)),
    )  # fmt: skip


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


class _Writer:
    """Adds fibers beside meshes."""

    def __init__(
        self, stage: Usd.Stage, scene: Scene, time: float | None, options: ExpandOptions,
        textures: TextureReader | None, folder: Path, *, override: bool,
    ) -> None:  # fmt: skip
        self.stage, self.scene, self.options, self.override = stage, scene, options, override
        self.textures, self.folder = textures, folder
        self.time = time_code(stage, time)
        self.meters = UsdGeom.GetStageMetersPerUnit(stage)
        self.warnings = list(scene.warnings)
        self.total = Written()
        self.seams: Seams | None = None
        self.patch_size = ""
        self.cloths: dict[FabricParameters, Cloth] = {}

    def add(self, mesh: Mesh, surface: FabricSurface) -> None:
        """Fibers for the faces of ``mesh`` that carry ``surface``."""
        fabric_of_face = np.array([m.fabric for m in self.scene.materials], dtype=int)[mesh.face_material]
        faces = fabric_of_face == next(k for k, s in enumerate(self.scene.fabrics) if s is surface)
        cloth = self._cloth(surface.fabric)
        copies = [None] if mesh.placements is None else list(range(len(mesh.placements)))
        self._check(mesh, surface, cloth, faces, len(copies))
        tint = self._tint(surface)
        region = None
        if self.options.region is not None:
            u0, v0, u1, v1 = (surface.meters_per_uv * c for c in self.options.region)
            region = (u0, v0, u1, v1)
        places = [ClothSurface(mesh, surface, faces, copy) for copy in copies]
        if self.options.mode == "baked":
            self._bake(mesh, surface, cloth, [p for p in places if len(p)], tint, region)
        else:
            self._place(mesh, surface, cloth, [p for p in places if len(p)], tint, region)
        if (fabric_of_face < 0).any():
            self.warnings.append(f"{mesh.path}: only some faces are cloth, the mesh stays visible behind the fibers")

    def _cloth(self, fabric: FabricParameters) -> Cloth:
        """The tile of a fabric, its variants and divisions."""
        if fabric not in self.cloths:
            copies = tile_copies(fabric)
            patches = patch_variants(fabric, self.options.vertices, copies)
            picks, ends = fabric.repeat()
            tiling = divide((ends * copies[0], picks * copies[1]), fabric.cell, len(patches))
            finest = min(y.effective_fiber_radius for y in (fabric.warp, fabric.weft))
            overlap = 0.0 if self.options.mode == "baked" else self.options.overlap * finest
            self.cloths[fabric] = Cloth(fabric, tiling, [list(tile_curves(p, overlap)) for p in patches], overlap)
        size = self.cloths[fabric].tiling.size
        self.patch_size = f"{size[0] * 1e3:.3g} x {size[1] * 1e3:.3g} mm"
        return self.cloths[fabric]

    def _check(self, mesh: Mesh, surface: FabricSurface, cloth: Cloth, faces: np.ndarray, copies: int) -> None:
        """Refuse what would be far too much before anything is made."""
        assert mesh.uv is not None, "a mesh with a fabric has uv"
        size = cloth.tiling.size
        about = estimate(mesh.uv[faces] * surface.meters_per_uv, size)
        if self.options.region is not None:
            u0, v0, u1, v1 = self.options.region
            about = min(about, (u1 - u0) * (v1 - v0) * surface.meters_per_uv**2 / (size[0] * size[1]))
        if self.options.mode == "baked":
            self._limit(mesh, self.total.points, about * copies * sum(len(c.points) for c in cloth.variants[0]))
        else:
            self._limit(mesh, self.total.instances, about * copies)

    def _limit(self, mesh: Mesh, before: int, more: float) -> None:
        # Also for NaN.
        if not before + more <= self.options.most:
            what = "control points" if self.options.mode == "baked" else "copies of the patch"
            raise UsdfabError(
                f"about {before + more:.3g} {what} are needed, above {self.options.most:g}",
                place=f"{self.scene.path}<{mesh.path}>",
                remedy="give a region, or a higher limit; `usdfab render` needs no copies",
            )

    def _tint(self, surface: FabricSurface) -> Tint:
        texture, read = surface.albedo_map, self.textures
        if texture is None:
            return lambda uv, colors: colors
        if read is None:
            self.warnings.append(f"{surface.path}: the albedo map is left out")
            return lambda uv, colors: colors
        return lambda uv, colors: colors * read(texture, uv)

    # --- the three modes ---

    def _place(
        self, mesh: Mesh, surface: FabricSurface, cloth: Cloth, places: list[ClothSurface], tint: Tint,
        region: Box | None,
    ) -> None:  # fmt: skip
        fabric, exact = surface.fabric, self.options.mode == "xform"
        finest = min(y.effective_fiber_radius for y in (fabric.warp, fabric.weft))
        tolerance = self.options.tolerance * finest
        # Sheared pieces are divided; only the smallest come in several shears, so that the file stays small.
        steps = np.full(len(cloth.tiling.levels), 4.0 * MAX_SHEAR)
        height = float(np.diff(cloth.tiling.levels[-1].y).max()) * cloth.tiling.cell[1]
        steps[-1] = min(SHEAR_STEPS * tolerance / height, MAX_SHEAR)
        parts: list[Pieces] = []
        charts = 0
        for place in places:
            limit = partial(self._limit, mesh, self.total.instances + sum(len(p) for p in parts))
            found = place_pieces(
                place, cloth.tiling, tolerance, 2.0 * (fabric.warp.radius + fabric.weft.radius),
                tint, region, shear_steps=None if exact else steps, limit=limit,
            )  # fmt: skip
            parts.append(replace(found, chart=found.chart + charts))
            charts += int(place.chart.max(initial=0)) + 1
        pieces = Pieces.joined(parts) if parts else None
        if pieces is None or len(pieces) == 0:
            return
        posed = poses(pieces.frames, steps[pieces.level])
        frames = pieces.frames if exact else Frames(pieces.frames.centers, posed.linear)
        self._worst(measure_seams(pieces, frames, cloth.tiling, fabric))
        centre = pieces.frames.centers.mean(axis=0)
        root, material = self._root(mesh, surface, centre)
        if exact:
            written = write_xforms(self.stage, root, cloth, pieces, centre, self.meters, material)
        else:
            written = write_instancer(self.stage, root, cloth, pieces, posed, centre, self.meters, material)
        self._count(written)

    def _bake(
        self, mesh: Mesh, surface: FabricSurface, cloth: Cloth, places: list[ClothSurface], tint: Tint,
        region: Box | None,
    ) -> None:  # fmt: skip
        baked: list[list[FiberCurves]] = []
        for place in places:
            before = self.total.points + sum(len(c.points) for curves in baked for c in curves)
            limit = partial(self._limit, mesh, before)
            baked.append(bake_curves(place, cloth.tiling, cloth.variants, tint, region, limit))
        everything = [c.points for curves in baked for c in curves]
        if not everything:
            return
        centre = np.concatenate(everything).mean(axis=0)
        root, material = self._root(mesh, surface, centre)
        written = Written()
        for number, curves in enumerate(baked):
            for kind in curves:
                name = kind.name if len(baked) == 1 else f"{kind.name}_{number}"
                facts = fiber_facts(surface.fabric, kind.system, str(material.GetPath()) if material else "")
                path = root.GetPath().AppendChild(name)
                moved = replace(kind, points=kind.points - centre)
                author_curves(self.stage, path, moved, self.meters, material, facts)
                written.curves += len(kind.counts)
                written.points += len(kind.points)
        self._count(written)

    def _root(self, mesh: Mesh, surface: FabricSurface, centre: np.ndarray) -> tuple[UsdGeom.Xform, UsdShade.Material]:
        """The Xform that holds the fibers of a mesh, which gives way to them, and their material."""
        prim = editable(self.stage, mesh.path)
        purpose = self.options.purpose
        root = define_root(self.stage, prim, centre, self.meters, self.time, purpose)
        fabric = surface.fabric
        if self.override:
            fabric = with_relative_files(fabric, self.folder)
        material = fabric_material(self.stage, root, replace(surface, fabric=fabric), new=self.override)
        if not material:
            self.warnings.append(f"{site(self.stage, Sdf.Path(mesh.path))}: no material is bound to the curves")
        cloth = np.array([m.fabric >= 0 for m in self.scene.materials])[mesh.face_material]
        if cloth.all():
            replace_mesh(prim, purpose)
            if purpose != "default":
                UsdGeom.Imageable(root).SetProxyPrim(prim)
        return root, material

    def _count(self, written: Written) -> None:
        self.total.instances += written.instances
        self.total.prototypes += written.prototypes
        self.total.curves += written.curves
        self.total.points += written.points

    def _worst(self, seams: Seams | None) -> None:
        if seams is not None and (self.seams is None or seams.p99 > self.seams.p99):
            self.seams = seams
