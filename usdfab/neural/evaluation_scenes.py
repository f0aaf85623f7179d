"""Small scenes that judge the neural material, after figures 1, 4, 5 and 6 of Chen et al. 2024, made in memory.

Cloths are surface materials themselves, not fabrics: the surface model is the truth here. Metres, y up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters, Weave, YarnParameters, weave_from_name
from usdfab.neural.dataset_draws import PAPER_WEAVES, DatasetSettings, draw_material
from usdfab.neural.surface_material import SurfaceMaterial, weave_of
from usdfab.usd.scene import Camera, DistantLight, FabricSurface, Light, Material, Mesh, PointLight, Scene

Floats = NDArray[np.float64]
Color = tuple[float, float, float]

CELL = 4e-4
"""Distance between yarns."""


@dataclass(frozen=True, eq=False)
class Cloth:
    """A material with its diffuse colours of warp and weft; specular albedo 0.3 of the front, half of all behind."""

    material: SurfaceMaterial
    warp: Color
    weft: Color

    @property
    def albedo(self) -> Floats:
        """(2, 4, 3) as ``NeuralScene.albedo``."""
        front = np.array([self.warp, self.weft, (0.3,) * 3, (0.3,) * 3])
        return np.stack([front, 0.5 * front])

    @property
    def fabric(self) -> FabricParameters:
        """What says how large a tile is; none of its fibers is looked at."""
        rows, columns = self.material.weave.shape
        weave = Weave(1 - self.material.weave.astype(np.uint8))
        return FabricParameters(weave, (CELL * columns, CELL * rows), _yarns(columns), _yarns(rows))


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene with the cloths of its fabrics, in their order."""

    name: str
    seen: bool
    scene: Scene
    cloths: tuple[Cloth, ...]

    @property
    def camera(self) -> Camera:
        """The only one."""
        return self.scene.cameras[0]


def _yarns(count: int) -> YarnParameters:
    return YarnParameters(count=count, radius=0.4 * CELL, fiber_count=4)


def seen_material(index: int) -> SurfaceMaterial:
    """A material that the shipped networks learned from, or that judged: number ``index`` of the data set of seed 0."""
    return draw_material(DatasetSettings(), index)


def unseen_twill() -> SurfaceMaterial:
    """Of a weave that no data set has: the twill 4x4 of the paper's figure 5."""
    return SurfaceMaterial(
        weave_of(weave_from_name("twill 1/3")), (math.radians(-30), math.radians(-30)),
        (math.radians(28), math.radians(35)), 0.35, 1.0, name="twill_4x4",
    )  # fmt: skip


def unseen_plain() -> SurfaceMaterial:
    """A plain weave with numbers of its own, through which light shines (the paper's figure 6)."""
    return SurfaceMaterial(
        weave_of(weave_from_name("plain")), (math.radians(15), math.radians(-15)),
        (math.radians(25), math.radians(25)), 0.55, 0.8, name="plain",
    )  # fmt: skip


Surface = Callable[[Floats, Floats], Floats]


def patch(surface: Surface, lengths: tuple[float, float], steps: tuple[int, int], fabric: int = 0) -> Mesh:
    """A smooth mesh: ``surface(a, b)`` (..., 3) for a, b in [0, 1], ``lengths`` of cloth in metres along both."""
    a, b = np.meshgrid(np.linspace(0, 1, steps[0] + 1), np.linspace(0, 1, steps[1] + 1), indexing="ij")
    points = surface(a, b).reshape(-1, 3)
    e = 1e-4
    across = np.cross(surface(a + e, b) - surface(a - e, b), surface(a, b + e) - surface(a, b - e)).reshape(-1, 3)
    normals = across / np.linalg.norm(across, axis=1, keepdims=True)
    index = np.arange(len(points)).reshape(steps[0] + 1, steps[1] + 1)
    p, q, r, s = (k.ravel() for k in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    triangles = np.concatenate([np.c_[p, q, r], np.c_[p, r, s]]).astype(np.int32)
    uv = np.stack([lengths[0] * a, lengths[1] * b], axis=-1).reshape(-1, 2)
    faces = np.full(len(triangles), fabric, dtype=np.int32)
    return Mesh(f"/Patch{fabric}", points, triangles, normals[triangles], uv[triangles], faces, True)


def camera_at(eye: Sequence[float] | Floats, target: Sequence[float], half: float) -> Camera:
    """A camera at ``eye`` that looks at ``target``; ``half`` is the tangent of half its field of view."""
    place, aim = np.asarray(eye, dtype=float), np.asarray(target, dtype=float)
    back = (place - aim) / np.linalg.norm(place - aim)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([right, np.cross(back, right), back, place])
    return Camera("/Camera", to_world, np.full(2, half), np.zeros(2), 0.0)


def stage_of(
    name: str, seen: bool, meshes: Sequence[Mesh], lights: Sequence[Light], camera: Camera, cloths: Sequence[Cloth]
) -> Stage:
    """Cloths on meshes whose faces' material is the cloth's number."""
    looks = tuple(Material(f"/Cloth{k}", k, np.full(3, 0.5), 1.0, 0.0, 1.0) for k in range(len(cloths)))
    surfaces = tuple(FabricSurface(look.path, cloth.fabric, 1.0) for look, cloth in zip(looks, cloths, strict=True))
    scene = Scene(name, tuple(meshes), looks, surfaces, (camera,), tuple(lights), (), "Y")
    return Stage(name, seen, scene, tuple(cloths))


SUN = DistantLight("/Sun", np.array([-0.45, -0.65, -0.6]) / np.linalg.norm([0.45, 0.65, 0.6]), np.full(3, 3.0), 0.0)
FILL = DistantLight("/Fill", np.array([0.6, -0.3, -0.75]) / np.linalg.norm([0.6, 0.3, 0.75]), np.full(3, 0.6), 0.0)


def single_cloth(cloth: Cloth, seen: bool, distance: float = 0.09, name: str = "single cloth") -> Stage:
    """Waves of a cloth 60 mm wide that goes away from the camera."""

    def waves(a: Floats, b: Floats) -> Floats:
        height = 3e-3 * np.sin(7.0 * a + 2.0 * b)
        return np.stack([0.06 * (a - 0.5), height - 0.01, 0.06 * (0.5 - b)], axis=-1)

    mesh = patch(waves, (0.06, 0.06), (48, 32))
    eye = distance * np.array([0.0, 0.6, 0.8])
    return stage_of(name, seen, [mesh], [SUN, FILL], camera_at(eye, (0, -0.01, 0), 0.30), [cloth])


def bowl(cloth: Cloth, seen: bool) -> Stage:
    """The inside of a bowl of cloth, 6 cm wide."""

    def half_sphere(a: Floats, b: Floats) -> Floats:
        turn, down = 2.0 * math.pi * a, 0.15 + 1.2 * b
        return 0.03 * np.stack([np.sin(down) * np.cos(turn), -np.cos(down), np.sin(down) * np.sin(turn)], axis=-1)

    mesh = patch(half_sphere, (2 * math.pi * 0.025, 0.036), (64, 24))
    return stage_of("bowl", seen, [mesh], [SUN, FILL], camera_at((0.0, 0.08, 0.06), (0, -0.012, 0), 0.32), [cloth])


def lamp(cloth: Cloth, seen: bool) -> Stage:
    """A lampshade lit from within: what is seen of it is light that went through."""

    def shade(a: Floats, b: Floats) -> Floats:
        turn, radius = 2.0 * math.pi * a, 0.02 + 0.006 * (1.0 - b)
        return np.stack([radius * np.cos(turn), 0.05 * (b - 0.5), -radius * np.sin(turn)], axis=-1)

    mesh = patch(shade, (2 * math.pi * 0.023, 0.05), (64, 8))
    bulb = PointLight("/Bulb", np.zeros(3), np.full(3, 4e-3))
    far = replace(FILL, irradiance=np.full(3, 0.3))
    return stage_of("lamp", seen, [mesh], [bulb, far], camera_at((0.0, 0.03, 0.12), (0, 0, 0), 0.26), [cloth])


def sofa(cloths: Sequence[Cloth]) -> Stage:
    """Cushions in two rows, each of another cloth."""
    meshes = []
    for k in range(len(cloths)):
        column, row = k % 4, k // 4
        middle = np.array([0.026 * (column - 1.5), 0.026 * (0.5 - row), -0.008 * (1 - row)])

        def cushion(a: Floats, b: Floats, middle: Floats = middle) -> Floats:
            x, y = 2.0 * a - 1.0, 2.0 * b - 1.0
            high = 0.006 * np.sqrt(np.maximum((1.0 - x**4) * (1.0 - y**4), 0.0) + 0.02)
            return middle + np.stack([0.0125 * x, 0.0125 * y, high], axis=-1)

        meshes.append(patch(cushion, (0.025, 0.025), (20, 20), k))
    return stage_of("sofa", True, meshes, [SUN, FILL], camera_at((0.0, 0.03, 0.16), (0, 0, 0), 0.36), cloths)


COLORS: tuple[Color, ...] = (
    (0.6, 0.2, 0.15), (0.15, 0.3, 0.55), (0.55, 0.5, 0.35), (0.2, 0.45, 0.25),
    (0.6, 0.45, 0.1), (0.4, 0.2, 0.45), (0.7, 0.68, 0.62), (0.12, 0.14, 0.2),
)  # fmt: skip


def stages() -> list[Stage]:
    """All that ``usdfab evaluate neural`` renders."""
    seen = [Cloth(seen_material(k), COLORS[k], COLORS[(k + 3) % 8]) for k in range(len(PAPER_WEAVES) + 1)]
    twill = Cloth(unseen_twill(), (0.5, 0.12, 0.1), (0.6, 0.55, 0.4))
    plain = Cloth(unseen_plain(), (0.75, 0.68, 0.5), (0.75, 0.68, 0.5))
    return [
        single_cloth(seen[5], True), single_cloth(twill, False, name="single cloth, twill 4x4"), bowl(twill, False),
        lamp(plain, False), sofa(seen),
    ]  # fmt: skip


def zoom_stages(steps: int) -> list[Stage]:
    """A flat sheet of the unseen twill that fills the picture, from ever farther away, up to 64 times."""
    twill = Cloth(unseen_twill(), (0.5, 0.12, 0.1), (0.6, 0.55, 0.4))
    found = []
    for k in range(steps):
        distance = 0.02 * 64.0 ** (k / max(steps - 1, 1))
        side = 4.0 * distance

        def sheet(a: Floats, b: Floats, side: float = side) -> Floats:
            return np.stack([side * (a - 0.5), np.zeros_like(a), side * (0.5 - b)], axis=-1)

        camera = camera_at(distance * np.array([0.0, 0.8, 0.6]), (0, 0, 0), 0.3)
        mesh = patch(sheet, (side, side), (2, 2))
        found.append(stage_of(f"zoom {k}", False, [mesh], [SUN, FILL], camera, [twill]))
    return found
