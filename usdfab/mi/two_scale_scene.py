"""A backend-neutral scene for the two-scale integrator: the macro scene, the tiles, and what connects them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.mi.camera import Window, sensor
from usdfab.mi.fibers import TextureReader
from usdfab.mi.lights import emitters
from usdfab.mi.space import Space
from usdfab.mi.surfaces import TEXELS, surface_shapes, write_ply
from usdfab.mi.two_scale_cloth import ClothTriangles, cloth_triangles
from usdfab.mi.two_scale_tiles import FiberTiles, build_tiles
from usdfab.usd.scene import Camera, Scene, Texture

MACRO_EXTENT = 100.0
"""Size of the cloth in units of the macro scene."""

_BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}


@dataclass(frozen=True, eq=False)
class TwoScaleScene:
    """A Mitsuba scene and the integrator that knows its cloth. ``points``: control points of all tiles."""

    scene: Any
    integrator: Any
    warnings: tuple[str, ...]
    points: int


def wears_cloth(scene: Scene) -> bool:
    """Whether any face of a scene wears a fabric."""
    worn = np.array([m.fabric >= 0 for m in scene.materials])
    return any(bool(worn[mesh.face_material].any()) and mesh.uv is not None for mesh in scene.meshes)


def load_two_scale(
    mi: Any,
    scene: Scene,
    camera: Camera,
    size: tuple[int, int],
    region: Window,
    folder: Path,
    *,
    max_depth: int = 64,
    pictures: Mapping[str, NDArray] | None = None,
    textures: TextureReader | None = None,
) -> TwoScaleScene:
    """A scene with cloth, ready to be rendered. Parameters and errors as `usdfab.mi.scene.translate`.

    ``mi`` is Mitsuba in a variant of Dr.Jit.
    """
    cloth = cloth_triangles(scene)
    corners = cloth.corners.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    space = Space(MACRO_EXTENT / max(float(np.linalg.norm(high - low)), 1e-12), 0.5 * (low + high))
    view, warnings = sensor(mi, camera, size, region, space)
    meshes, said = surface_shapes(mi, scene, (), textures, space, folder)
    warnings += said
    every = np.concatenate([space.points(corners), *(_placed_points(scene, space))])
    reach = float(np.linalg.norm(np.abs(every).max(axis=0)))
    radius = reach / space.scale + float(np.linalg.norm(camera.to_world[:3, 3] - space.origin))
    lights = emitters(mi, scene.lights, pictures or {}, space, radius)
    if not lights and not any("emitter" in shape for shape in meshes.values()):
        raise UsdfabError("the stage has no light", place=scene.path, remedy="add a UsdLux light, e.g. a DomeLight")
    write_ply(folder / "cloth.ply", space.points(cloth.corners), None, None)
    woven = {"type": "ply", "filename": str(folder / "cloth.ply"), "face_normals": True, "bsdf": _BLACK, "id": "cloth"}
    description = {"type": "scene", "sensor": view, **lights, **meshes, "cloth": woven}
    # Plugins written in Python trace Dr.Jit code when they are made: not in several threads at once.
    loaded = mi.load_dict(description, parallel=False)
    shape = next(shape for shape in loaded.shapes() if shape.id() == "cloth")
    fabrics: list[FabricParameters] = []
    for surface in scene.fabrics:
        if surface.fabric not in fabrics:
            fabrics.append(surface.fabric)
    tiles = _tiles(tuple(fabrics))
    numbers = [fabrics.index(surface.fabric) for surface in scene.fabrics]
    maps, said = _albedo_maps(mi, scene, cloth, textures)
    warnings += said
    masked = any(s["bsdf"]["type"] == "mask" for s in meshes.values())
    macro, optics = _device_scene(mi, scene, cloth, tiles, numbers, maps, shape, space, reach, masked, folder)
    from usdfab.mi.two_scale import integrator_class

    integrator = integrator_class()(macro, optics, max_depth=max_depth, bare=bool(meshes))
    return TwoScaleScene(loaded, integrator, tuple(dict.fromkeys(warnings)), len(tiles.points))


@functools.lru_cache(maxsize=1)
def _tiles(fabrics: tuple[FabricParameters, ...]) -> FiberTiles:
    """The frames of an animation have the same."""
    return build_tiles(fabrics)


def _device_scene(
    mi: Any, scene: Scene, cloth: ClothTriangles, tiles: FiberTiles, numbers: list[int], maps: list, shape: Any,
    space: Space, reach: float, masked: bool, folder: Path,
) -> tuple[Any, Any]:  # fmt: skip
    """(macro tracer, optics of all fibers): arrays on the device."""
    # These modules need a variant that is set.
    from usdfab.mi.two_scale_enter import ClothTables
    from usdfab.mi.two_scale_fiber import FiberOptics
    from usdfab.mi.two_scale_macro import MacroTracer
    from usdfab.mi.two_scale_slab import FiberScene

    own = [tiles.fabrics[k] for k in numbers]
    fibers = FiberScene(tiles, numbers, _curves(mi, tiles, folder))
    tables = ClothTables(cloth, space.scale, own, [s.meters_per_uv for s in scene.fabrics], maps)
    return MacroTracer(fibers, tables, shape, reach=reach, masked=masked), FiberOptics(tiles.materials)


def _curves(mi: Any, tiles: FiberTiles, folder: Path) -> Any:
    """All tiles as one shape. Its arrays are handed over; a file of as many numbers would be slow."""
    seed = folder / "seed.txt"
    seed.write_text("".join(f"{k} 0 0 1\n" for k in range(4)))
    shape = mi.load_dict({"type": "bsplinecurve", "filename": str(seed), "bsdf": _BLACK}, parallel=False)
    arrays = mi.traverse(shape)
    arrays["control_point_count"] = len(tiles.points)
    arrays["control_points"] = mi.Float(tiles.points.ravel())
    arrays["segment_indices"] = mi.UInt32(tiles.segments)
    arrays.update()
    return shape


def _placed_points(scene: Scene, space: Space) -> list[NDArray[np.float64]]:
    """Corners of the boxes around all meshes and copies, macro units."""
    found = []
    for mesh in scene.meshes:
        box = np.stack([mesh.points.min(axis=0), mesh.points.max(axis=0)])
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
        if mesh.placements is None:
            found.append(space.points(corners))
        else:
            found += [space.points(corners @ matrix[:, :3].T + matrix[:, 3]) for matrix in mesh.placements]
    return found


def _albedo_maps(
    mi: Any, scene: Scene, cloth: ClothTriangles, textures: TextureReader | None
) -> tuple[list[Callable[[Any], Any] | None], list[str]]:
    """For each fabric surface its albedo map as a function of texture coordinates, and what was left out."""
    maps: list[Callable[[Any], Any] | None] = []
    warnings = []
    for number, surface in enumerate(scene.fabrics):
        uv = cloth.uv[cloth.fabric == number].reshape(-1, 2)
        if surface.albedo_map is None or not len(uv):
            maps.append(None)
        elif textures is None:
            warnings.append(f"{surface.path}: the albedo map is left out")
            maps.append(None)
        else:
            maps.append(_albedo_map(mi, surface.albedo_map, uv, textures))
    return maps, warnings


def _albedo_map(mi: Any, texture: Texture, uv: NDArray, textures: TextureReader) -> Callable[[Any], Any]:
    """A texture as the tracer sees it, over the box of texture coordinates (N, 2) that the cloth uses."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    size = np.maximum(high - low, 1e-9)
    place = (np.arange(TEXELS) + 0.5) / TEXELS
    u, v = np.meshgrid(low[0] + size[0] * place, low[1] + size[1] * place)
    values = textures(texture, np.stack([u.ravel(), v.ravel()], axis=1)).reshape(TEXELS, TEXELS, 3)
    stored = mi.Texture2f(mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32)))

    corner, extent = mi.Point2f(*low.tolist()), mi.Vector2f(*size.tolist())

    def lookup(at: Any) -> Any:
        return mi.Color3f(stored.eval(mi.Point2f((at - corner) / extent)))

    return lookup
