"""Fabrics as Mitsuba curves: the same fibers as the tracer's, tile by tile, bent onto the mesh.

Every control point of every tile is made, so this is for close-ups and small cloth, up to a budget. Where the whole
cloth is too much, only what the camera sees is made, with a margin around it; the rest of the mesh is a surface.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fibers import patch_variants
from usdfab.fibers.tiles import tile_copies
from usdfab.mi.space import Space
from usdfab.mi.visible import MARGIN_CELLS, Window, visible_boxes
from usdfab.scattering.roughness import absorption_from_albedo
from usdfab.usd.expand.bake import bake_curves
from usdfab.usd.expand.centres import estimate
from usdfab.usd.expand.curves import FiberCurves, tile_curves
from usdfab.usd.expand.divide import Tiling, divide
from usdfab.usd.expand.place import Box, Tint
from usdfab.usd.expand.surface import ClothSurface
from usdfab.usd.scene import Camera, FabricSurface, Mesh, Scene, Texture

Floats = NDArray[np.float64]
FiberBsdf = Callable[[YarnParameters, Floats], dict[str, Any]]
"""A Mitsuba BSDF dictionary for fibers of a yarn system with albedo coefficient (3,)."""
TextureReader = Callable[[Texture, Floats], Floats]
"""Colours (N, 3) of a texture at texture coordinates."""

MAX_POINTS = 8_000_000
"""Most control points: 1 GB with Mitsuba's acceleration structure."""

MAX_COLORS = 128
"""Most different colours of fibers, each of which is a BSDF of its own; beyond that they are rounded."""


def plugin_bsdf(yarn: YarnParameters, albedo: Floats) -> dict[str, Any]:
    """Our own fiber BSDF (``usdfab.mi.fiber_bsdf``, to be registered before), the same as the tracer's."""
    return {
        "type": "usdfab_fiber",
        "albedo": {"type": "rgb", "value": np.maximum(albedo, 1e-4).tolist()},
        "gamma_m": yarn.roughness_longitudinal,
        "gamma_n": yarn.roughness_azimuthal,
        "gamma_m0": yarn.roughness_primary,
        "eta": yarn.ior,
        "tilt": yarn.cuticle_tilt,
    }


def hair_bsdf(yarn: YarnParameters, albedo: Floats) -> dict[str, Any]:
    """Mitsuba's own hair BSDF. It has one longitudinal roughness and no cuticle: see ``hair_warnings``."""
    return {
        "type": "hair",
        "longitudinal_roughness": yarn.roughness_longitudinal,
        "azimuthal_roughness": yarn.roughness_azimuthal,
        "scale_tilt": 0.0,
        "int_ior": yarn.ior,
        "ext_ior": 1.0,
        "sigma_a": {
            "type": "rgb",
            "value": absorption_from_albedo(np.maximum(albedo, 1e-4), yarn.roughness_azimuthal).tolist(),
        },
    }


def hair_warnings(fabrics: Sequence[FabricParameters]) -> list[str]:
    """What Mitsuba's own hair BSDF cannot show of these fabrics."""
    yarns = [yarn for f in fabrics for yarn in (f.warp, f.weft)]
    warnings = []
    if any(y.roughness_primary != y.roughness_longitudinal for y in yarns):
        warnings.append("Mitsuba's hair has one longitudinal roughness: roughness_primary is left out")
    if any(y.cuticle_tilt != 0.0 for y in yarns):
        warnings.append("Mitsuba's hair tilts its cuticle by another rule: cuticle_tilt is left out")
    return warnings


@dataclass(frozen=True, eq=False)
class Fibers:
    """Curves of one yarn system of one fabric on one mesh, in world space."""

    yarn: YarnParameters
    curves: FiberCurves


@dataclass(frozen=True, eq=False)
class Rest:
    """The triangles (T,) of a mesh, or of one of its copies, that wear a fabric but are not made of fibers."""

    mesh: Mesh
    faces: NDArray[np.bool_]
    copy: int | None


@dataclass(frozen=True, eq=False)
class Cloth:
    """All fibers of a scene, cloth without fibers, and what is to be told."""

    fibers: tuple[Fibers, ...]
    rest: tuple[Rest, ...]
    warnings: tuple[str, ...]

    @property
    def points(self) -> int:
        """Control points of all curves."""
        return sum(len(f.curves.points) for f in self.fibers)

    @property
    def bounds(self) -> tuple[Floats, Floats] | None:
        """Lowest and highest control point, metres."""
        parts = [f.curves.points for f in self.fibers if len(f.curves.points)]
        if not parts:
            return None
        return np.min([p.min(axis=0) for p in parts], axis=0), np.max([p.max(axis=0) for p in parts], axis=0)


def make_cloth(
    scene: Scene,
    camera: Camera,
    textures: TextureReader | None,
    budget: int = MAX_POINTS,
    window: Window = (-1.0, -1.0, 1.0, 1.0),
    margin: float | None = None,
) -> Cloth:
    """The fibers of all fabrics of a scene.

    Parameters
    ----------
    window:
        (left, bottom, right, top) of the part of the film that is rendered, from -1 to 1.
    textures:
        Reads albedo maps; without it they are left out, with a warning.
    budget:
        Most control points.
    margin:
        Cells of the weave to make around what the camera sees, and no more. None: all cloth where it fits the budget,
        else ``MARGIN_CELLS``.

    Raises
    ------
    UsdfabError
        If the cloth that the camera sees takes more; nothing large has been made then.
    """
    pieces = [
        (Rest(mesh, faces, copy), surface, ClothSurface(mesh, surface, faces, copy))
        for mesh in scene.meshes
        for surface, faces in _worn(scene, mesh)
        for copy in ([None] if mesh.placements is None else range(len(mesh.placements)))
    ]
    tiles = {surface.fabric: _tile(surface.fabric) for _, surface, _ in pieces}
    regions: list[list[Box] | None] = [None] * len(pieces)
    warnings: list[str] = []
    if margin is not None or _needed(pieces, tiles, regions) > budget:
        cells = MARGIN_CELLS if margin is None else margin
        regions = [visible_boxes(place, camera, surface.fabric, window, cells) for _, surface, place in pieces]
        needed = _needed(pieces, tiles, regions)
        if needed > budget:
            raise UsdfabError(
                f"the cloth in view needs about {needed:.2g} control points, above {budget:.2g}",
                place="--backend mitsuba",
                remedy="use --backend embree, which needs no copies, or show less with --region or a closer camera",
            )
        warnings.append(
            f"only the cloth in view and {cells:g} yarns around it are fibers; the rest is an opaque surface, "
            "so that light from there and through it is only about right"
        )
    found: list[Fibers] = []
    rest: list[Rest] = []
    for (whole, surface, place), boxes in zip(pieces, regions, strict=True):
        if boxes is not None:
            rest.append(replace(whole, faces=_outside(whole, surface, boxes)))
        tiling, variants = tiles[surface.fabric]
        tint = _tint(surface, textures, warnings)
        for box in [None] if boxes is None else boxes:
            baked = bake_curves(place, tiling, variants, tint, box) if len(place) else []
            found += [Fibers(surface.fabric.system(c.system), c) for c in baked]  # type: ignore[arg-type]
    return Cloth(tuple(found), tuple(rest), tuple(dict.fromkeys(warnings)))


def _worn(scene: Scene, mesh: Mesh) -> list[tuple[FabricSurface, NDArray[np.bool_]]]:
    """The fabrics of a mesh, each with the faces (T,) that wear it."""
    fabric = np.array([m.fabric for m in scene.materials], dtype=int)[mesh.face_material]
    return [(scene.fabrics[f], fabric == f) for f in np.unique(fabric) if f >= 0]


@functools.lru_cache(maxsize=4)
def _tile(fabric: FabricParameters) -> tuple[Tiling, list[list[FiberCurves]]]:
    copies = tile_copies(fabric)
    patches = patch_variants(fabric, copies=copies)
    picks, ends = fabric.repeat()
    tiling = divide((ends * copies[0], picks * copies[1]), fabric.cell, len(patches), levels=1)
    return tiling, [list(tile_curves(patch)) for patch in patches]


def _needed(pieces: Sequence[tuple[Rest, FabricSurface, ClothSurface]], tiles: dict, regions: Sequence) -> float:
    """About how many control points the pieces take."""
    total = 0.0
    for (_, surface, place), boxes in zip(pieces, regions, strict=True):
        tiling, variants = tiles[surface.fabric]
        number = estimate(place.xy, tiling.size)
        if boxes is not None:
            area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in boxes)
            number = min(number, area / (tiling.size[0] * tiling.size[1]))
        total += number * sum(len(c.points) for c in variants[0])
    return total


def _outside(whole: Rest, surface: FabricSurface, boxes: Sequence[Box]) -> NDArray[np.bool_]:
    """(T,) which of the faces have no part in any box: a gap is better than fibers in a surface."""
    assert whole.mesh.uv is not None, "a mesh with a fabric has uv"
    xy = whole.mesh.uv * surface.meters_per_uv
    low, high = xy.min(axis=1), xy.max(axis=1)
    outside = whole.faces.copy()
    for x0, y0, x1, y1 in boxes:
        outside &= ((high <= (x0, y0)) | (low >= (x1, y1))).any(axis=1)
    return outside


def _tint(surface: FabricSurface, textures: TextureReader | None, warnings: list[str]) -> Tint:
    texture = surface.albedo_map
    if texture is None:
        return lambda uv, colors: colors
    if textures is None:
        warnings.append(f"{surface.path}: the albedo map is left out")
        return lambda uv, colors: colors
    return lambda uv, colors: colors * textures(texture, uv)


def curve_shapes(
    cloth: Cloth, space: Space, bsdf: FiberBsdf, folder: Path
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Mitsuba dictionaries of all curves, one for each colour of a yarn system; their files are put into ``folder``."""
    shapes: dict[str, dict[str, Any]] = {}
    warnings: list[str] = []
    for fibers in cloth.fibers:
        curves = fibers.curves
        colors = curves.color
        if len(colors) == len(curves.points) != len(curves.counts):
            colors = np.add.reduceat(colors, curves.offsets[:-1], axis=0) / curves.counts[:, None]
            warnings.append("Mitsuba's curves have one colour each: colours that vary along fibers are averaged")
        found, which = np.unique(colors, axis=0, return_inverse=True)
        if len(found) > MAX_COLORS:
            steps = 4.0
            found, which = np.unique(np.round(colors * steps**2) / steps**2, axis=0, return_inverse=True)
            warnings.append(f"fibers have more than {MAX_COLORS} colours, which are rounded")
        for number, color in enumerate(found):
            name = f"fibers{len(shapes)}"
            write_curves(folder / f"{name}.txt", curves, which.ravel() == number, space)
            shapes[name] = {
                "type": "bsplinecurve",
                "filename": str(folder / f"{name}.txt"),
                "bsdf": bsdf(fibers.yarn, color),
            }
    return shapes, list(dict.fromkeys(warnings))


def write_curves(path: Path, curves: FiberCurves, chosen: NDArray[np.bool_], space: Space) -> None:
    """A Mitsuba curve file of the chosen curves: x y z radius on a line, an empty line between curves."""
    points = space.points(curves.points)
    radius = space.scale * curves.radius
    row = f"%.8g %.8g %.8g {radius:.8g}\n"
    with path.open("w") as file:
        for curve in np.flatnonzero(chosen):
            own = points[curves.offsets[curve] : curves.offsets[curve + 1]]
            file.write(row * len(own) % tuple(own.ravel().tolist()) + "\n")
