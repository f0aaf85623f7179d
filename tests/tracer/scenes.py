"""Small scenes for the tests of the tracer. World in metres, z up."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.usd.rig import swatch_scene
from usdfab.usd.scene import Camera, DomeLight, FabricSurface, Light, Material, Mesh, Scene

GRAY = (0.5, 0.5, 0.5)


def fabric(weave: str = "plain", fibers: int = 12, variants: int = 1, **changes) -> FabricParameters:
    """5 mm of cloth with ten yarns each way, rough fibers (little noise), Mitsuba's three roughnesses in two."""
    values = {
        "count": 10,
        "radius": 2.2e-4,
        "fiber_count": fibers,
        "roughness_longitudinal": 0.6,
        "roughness_primary": 0.6,
        "roughness_azimuthal": 0.5,
        "albedo": (0.7, 0.4, 0.2),
        "twist": 0.1,
        "irregularity": 0.2,
    }
    yarn = YarnParameters(**(values | changes))
    return FabricParameters(weave_from_name(weave), (5e-3, 5e-3), yarn, yarn, variants=variants)


def swatch(cloth: FabricParameters, *lights: Light, zoom: float = 0.4) -> tuple[Scene, Camera]:
    """The capture rig's scene, its lamp replaced where lights are given, and its camera, zoomed in."""
    scene = swatch_scene(cloth)
    if lights:
        scene = replace(scene, lights=lights)
    camera = scene.cameras[0]
    return scene, replace(camera, tan_half=zoom * camera.tan_half)


def look(eye, target, tan_half=(0.1, 0.1), up=(0.0, 1.0, 0.0)) -> Camera:
    """A camera at ``eye`` that looks at ``target``."""
    eye, target, up = (np.asarray(v, dtype=float) for v in (eye, target, up))
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    to_world = np.eye(4)
    to_world[:3, :4] = np.column_stack([right, np.cross(backward, right), backward, eye])
    return Camera("/Camera", to_world, np.asarray(tan_half, dtype=float), np.zeros(2), 0.0)


def dome(radiance: float = 1.0, texture=None, to_world=None) -> DomeLight:
    """A dome light."""
    to_world = np.eye(4) if to_world is None else to_world
    return DomeLight("/Dome", to_world, np.full(3, radiance), texture=texture)


def plane(side: float, material: int = 0, z: float = 0.0, center=(0.0, 0.0)) -> Mesh:
    """A square that faces +z, its uv in metres."""
    corners = side * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) + np.asarray(center)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    points = np.column_stack([corners, np.full(4, z)])
    return Mesh("/Plane", points, triangles, None, corners[triangles], np.full(2, material, dtype=np.int32), True)


def sheet(point, uv, columns: int, rows: int) -> Mesh:
    """A smooth mesh: ``point(a, b)`` (..., 3) and ``uv(a, b)`` (..., 2) for a, b in [0, 1], normals by differences."""
    a, b = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1), indexing="ij")
    points = point(a, b).reshape(-1, 3)
    step = 1e-4
    da, db = point(a + step, b) - point(a - step, b), point(a, b + step) - point(a, b - step)
    normals = np.cross(da, db).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    index = np.arange(len(points)).reshape(columns + 1, rows + 1)
    p, q, r, s = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    triangles = np.concatenate([np.c_[p, q, r], np.c_[p, r, s]]).astype(np.int32)
    coordinates = uv(a, b).reshape(-1, 2)
    faces = np.zeros(len(triangles), dtype=np.int32)
    return Mesh("/Sheet", points, triangles, normals[triangles], coordinates[triangles], faces, True)


def strip(radius: float = 0.02) -> Mesh:
    """Most of a half cylinder about the x axis, 4 cm long, with the cloth unrolled on it."""

    def point(a, b):
        angle = math.pi * (0.9 * b - 0.45)
        return np.stack([0.04 * (a - 0.5), radius * np.sin(angle), radius * np.cos(angle)], axis=-1)

    return sheet(point, lambda a, b: np.stack([0.04 * a, 0.9 * math.pi * radius * b], axis=-1), 8, 24)


def lambert(color=GRAY) -> Material:
    """A diffuse material."""
    return Material("/Lambert", -1, np.asarray(color, dtype=float), 1.0, 0.0, 1.0, ior=1.0)


def cloth_material(index: int = 0) -> Material:
    """The material of fabric ``index`` of the scene."""
    return Material(f"/Cloth{index}", index, np.asarray(GRAY), 1.0, 0.0, 1.0)


def scene(meshes, materials, lights, fabrics=()) -> Scene:
    """A scene of these things, uv in metres."""
    surfaces = tuple(FabricSurface(f"/Cloth{k}", f, 1.0) for k, f in enumerate(fabrics))
    return Scene("memory", tuple(meshes), tuple(materials), surfaces, (), tuple(lights), (), "Z")
