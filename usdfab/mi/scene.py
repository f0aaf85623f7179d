"""A backend-neutral scene as a Mitsuba scene dictionary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.mi.camera import Window, sensor
from usdfab.mi.fibers import MAX_POINTS, FiberBsdf, TextureReader, curve_shapes, hair_bsdf, hair_warnings, make_cloth
from usdfab.mi.lights import emitters
from usdfab.mi.space import RAY_OFFSET, Space
from usdfab.mi.surfaces import surface_shapes
from usdfab.usd.scene import Camera, Scene

FIBER_UNITS = 1.0
"""Radius of the thinnest fiber in Mitsuba's units."""


@dataclass(frozen=True, eq=False)
class Translation:
    """A scene for ``mitsuba.load_dict``, what was left out or approximated, and control points of all fibers."""

    description: dict[str, Any]
    warnings: tuple[str, ...]
    points: int
    space: Space


def translate(
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
    fiber_bsdf: FiberBsdf | None = None,
    budget: int = MAX_POINTS,
) -> Translation:
    """A scene in Mitsuba's terms.

    Parameters
    ----------
    mi:
        ``mitsuba`` with its variant set.
    size, region:
        Of the whole picture (width, height), and the part (x0, y0, x1, y1) of it to render, in pixels.
    folder:
        Where meshes and curves are written; needed until the scene is loaded.
    max_depth:
        Longest path in vertices.
    pictures:
        Of dome lights, by file name.
    textures:
        Looks up textures of materials and albedo maps; without it they are left out, with a warning.
    fiber_bsdf:
        How fibers scatter; None: Mitsuba's own hair.
    budget:
        Most control points of fibers.

    Raises
    ------
    UsdfabError
        For what Mitsuba or this backend cannot show at all.
    """
    if not scene.meshes:
        raise UsdfabError("the stage has no visible mesh", place=scene.path, remedy="add a Mesh or check visibility")
    left, right = (2.0 * region[k] / size[0] - 1.0 for k in (0, 2))
    bottom, top = (1.0 - 2.0 * region[k] / size[1] for k in (3, 1))
    cloth = make_cloth(scene, camera, textures, budget, (left, bottom, right, top))
    warnings = list(cloth.warnings)
    if fiber_bsdf is None:
        warnings += hair_warnings([f.fabric for f in scene.fabrics])
    low, high = cloth.bounds or _bounds(scene)
    thinnest = min((f.curves.radius for f in cloth.fibers), default=0.0)
    extent = float(np.linalg.norm(high - low))
    space = Space(FIBER_UNITS / thinnest if thinnest else 100.0 / max(extent, 1e-12), 0.5 * (low + high))
    offset = RAY_OFFSET * (1.0 + 0.5 * space.scale * extent) / FIBER_UNITS
    if thinnest and offset > 0.2:
        warnings.append(
            f"Mitsuba's rays start up to {offset:.1f} fiber radii off the fibers: look at less cloth at once"
        )
    view, said = sensor(mi, camera, size, region, space)
    warnings += said
    curves, said = curve_shapes(cloth, space, fiber_bsdf or hair_bsdf, folder)
    warnings += said
    meshes, said = surface_shapes(mi, scene, cloth.rest, textures, space, folder)
    warnings += said
    far = np.abs(np.stack(_bounds(scene)) - space.origin).max(axis=0)
    radius = float(np.linalg.norm(far)) + float(np.linalg.norm(camera.to_world[:3, 3] - space.origin))
    lights = emitters(mi, scene.lights, pictures or {}, space, radius)
    if not lights and not any("emitter" in shape for shape in meshes.values()):
        raise UsdfabError("the stage has no light", place=scene.path, remedy="add a UsdLux light, e.g. a DomeLight")
    integrator = {"type": "path", "max_depth": max_depth, "rr_depth": 5}
    description = {"type": "scene", "integrator": integrator, "sensor": view, **lights, **curves, **meshes}
    return Translation(description, tuple(dict.fromkeys(warnings)), cloth.points, space)


def _bounds(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner of all meshes and copies, metres."""
    parts = []
    for mesh in scene.meshes:
        box = np.stack([mesh.points.min(axis=0), mesh.points.max(axis=0)])
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
        if mesh.placements is None:
            parts.append(corners)
        else:
            parts += [corners @ matrix[:, :3].T + matrix[:, 3] for matrix in mesh.placements]
    points = np.concatenate(parts)
    return points.min(axis=0), points.max(axis=0)
