"""How a sample of the data set is looked at: its place and turn below the camera, and the lamps.

Table 4's fabrics are shown as Li et al. 2024 do, by ``usdfab.usd.rig``. Real photos come from microscopes nobody has
described: the cloth lies a few degrees askew, one lamp or a ring of them is near the objective, daylight may join in.
All light is white and gives a white diffuse sample a radiance of 1 in the middle of the picture: exposure, white
balance and all else that acts on finished pixels is for ``augment``. Lengths are metres, angles radians; the cloth is
the plane z = 0 as in ``usdfab.usd.rig``.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fibers.budget import patch_points
from usdfab.usd.rig import PLANE_FACTOR, Rig, swatch_scene
from usdfab.usd.scene import DomeLight, Light, Material, Mesh, PointLight, Scene, SphereLight

MAX_ROTATION = math.radians(6.0)
RING_LAMPS = 8
UNIQUE_POINTS = 500_000
"""A tile is enlarged up to this many points on its fibers so that the picture shows no repetition."""


@dataclass(frozen=True)
class SampleView:
    """Where camera, cloth and light are.

    ``rotation`` turns the cloth counter-clockwise about the picture's middle, ``shift`` moves it along its own axes
    before. ``lamps``: centres of spheres of ``lamp_radius`` (0: points), all equally strong. ``sky``: share of the
    irradiance that comes evenly from above. ``backing``: reflectance of paper ``backing_depth`` below the cloth; 0 is
    a dark room.
    """

    camera_height: float
    lamps: tuple[tuple[float, float, float], ...]
    lamp_radius: float = 0.0
    rotation: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    sky: float = 0.0
    backing: float = 0.0
    backing_depth: float = 0.0

    def as_table(self) -> dict[str, Any]:
        """As plain JSON data."""
        return {k: [list(p) for p in v] if k == "lamps" else v for k, v in asdict(self).items()}


def view_from_table(table: dict[str, Any]) -> SampleView:
    """The inverse of ``SampleView.as_table``; raises ``KeyError`` or ``TypeError`` for another table."""
    values = {f.name: table[f.name] for f in fields(SampleView)}
    values["lamps"] = tuple(tuple(map(float, lamp)) for lamp in values["lamps"])
    values["shift"] = tuple(map(float, values["shift"]))
    return SampleView(**values)


def paper_view(fabric: FabricParameters) -> SampleView:
    """The capture rig of Li et al. 2024, section 5.2."""
    rig = Rig(fabric.size)
    return SampleView(rig.camera_height, (rig.light_position,))


def sample_view(fabric: FabricParameters, rng: np.random.Generator) -> SampleView:
    """A random microscope over ``fabric``."""
    camera = float(np.exp(rng.uniform(np.log(0.03), np.log(0.15))))
    kind = rng.choice(["lamp", "pair", "ring"], p=[0.45, 0.2, 0.35])
    around = rng.uniform(0.0, 2.0 * math.pi)
    distance = float(np.exp(rng.uniform(np.log(0.02), np.log(0.12))))
    if kind == "ring":
        tilt, count = rng.uniform(math.radians(10), math.radians(50)), RING_LAMPS
    else:
        tilt, count = rng.uniform(math.radians(2), math.radians(50)), 1 if kind == "lamp" else 2
    angles = around + 2.0 * math.pi * np.arange(count) / count
    side, height = distance * math.sin(tilt), distance * math.cos(tilt)
    lamps = tuple((float(side * math.cos(a)), float(side * math.sin(a)), float(height)) for a in angles)
    picks, ends = fabric.repeat()
    backing = float(rng.uniform(0.05, 0.85)) if rng.random() < 0.25 else 0.0
    return SampleView(
        camera_height=camera,
        lamps=lamps,
        lamp_radius=min(distance * float(rng.uniform(0.05, 0.25)), _room(fabric, camera, side, height, count)),
        rotation=float(np.clip(rng.normal(0.0, math.radians(2.5)), -MAX_ROTATION, MAX_ROTATION)),
        shift=(float(rng.uniform(0.0, ends * fabric.cell[0])), float(rng.uniform(0.0, picks * fabric.cell[1]))),
        sky=float(rng.uniform(0.1, 0.9)) if rng.random() < 0.4 else 0.0,
        backing=backing,
        backing_depth=float(rng.uniform(1.0, 5.0)) * max(fabric.cell) if backing else 0.0,
    )


def _room(fabric: FabricParameters, camera: float, side: float, height: float, count: int) -> float:
    """Largest radius of lamps that neither stand in the camera's view nor before each other; 0 where there is none."""
    view = math.hypot(*fabric.size) / 2.0 * max(0.0, 1.0 - height / camera)
    # Half of what would touch: lamps must not hide each other or much of the sky.
    beside = 0.5 * side * math.sin(math.pi / count) if count > 1 else math.inf
    # A lamp above the camera hangs lower by its radius; a tenth is left over.
    return 0.9 * max(0.0, min((side - view) / 1.5, beside, height / 2.0))


def view_scene(fabric: FabricParameters, view: SampleView) -> Scene:
    """The scene to render; its only camera shows a square or oblong of ``fabric.size``."""
    scene = swatch_scene(unrepeated(fabric), Rig(fabric.size, view.camera_height))
    cloth = _placed(scene.meshes[0], view)
    meshes: tuple[Mesh, ...] = (cloth,)
    materials = scene.materials
    if view.backing > 0.0:
        below = view.backing_depth + 2.0 * sum(y.radius * max(1.0, y.crimp) for y in (fabric.warp, fabric.weft))
        paper = replace(
            cloth, path="/Rig/Backing", points=scene.meshes[0].points - [0.0, 0.0, below],
            face_material=np.ones(2, dtype=np.int32),
        )  # fmt: skip
        meshes += (paper,)
        materials += (Material("/Rig/Paper", -1, np.full(3, view.backing), 1.0, 0.0, 1.0),)
    return replace(scene, meshes=meshes, materials=materials, lights=_lights(view))


def unrepeated(fabric: FabricParameters) -> FabricParameters:
    """The same cloth with several repeats of the weave written out, so that the tile covers the picture.

    Each repeat has randomness of its own then. As many as fit into ``UNIQUE_POINTS``; at least one.
    """
    picks, ends = fabric.repeat()
    want = [max(1, math.ceil(fabric.warp.count / ends)), max(1, math.ceil(fabric.weft.count / picks))]
    one = patch_points(fabric)
    while one * want[0] * want[1] > UNIQUE_POINTS and max(want) > 1:
        want[want.index(max(want))] -= 1
    weave = fabric.weave.tiled(picks // fabric.weave.picks * want[1], ends // fabric.weave.ends * want[0])
    return replace(fabric, weave=weave)


def _placed(mesh: Mesh, view: SampleView) -> Mesh:
    """The cloth's plane turned about the camera's axis; the cloth slides on it."""
    if view.rotation == 0.0 and view.shift == (0.0, 0.0):
        return mesh
    c, s = math.cos(view.rotation), math.sin(view.rotation)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert mesh.uv is not None
    return replace(mesh, points=mesh.points @ turn.T, uv=mesh.uv - np.asarray(view.shift))


def _lights(view: SampleView) -> tuple[Light, ...]:
    """Lamps and sky that together give the middle of the sample the irradiance pi."""
    places = np.asarray(view.lamps)
    distance = np.linalg.norm(places, axis=1)
    per_intensity = float((places[:, 2] / distance**3).sum())
    intensity = np.full(3, math.pi * (1.0 - view.sky) / per_intensity)
    lights: tuple[Light, ...] = tuple(_lamp(f"/Rig/Lamp{k}", place, view, intensity) for k, place in enumerate(places))
    if view.sky > 0.0:
        # The pole of the dome is up (+z); its lower half is dark, since gaps of the cloth show the table.
        to_world = np.eye(4)
        to_world[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        lights += (DomeLight("/Rig/Sky", to_world, np.full(3, view.sky), _sky()),)
    return lights


def _lamp(path: str, place: NDArray, view: SampleView, intensity: NDArray) -> Light:
    if view.lamp_radius == 0.0:
        return PointLight(path, place, intensity)
    # Seen as a disc pi r^2 of this radiance; the irradiance of a sphere above the horizon is that of a point.
    return SphereLight(path, place, view.lamp_radius, intensity / (math.pi * view.lamp_radius**2))


def _sky() -> NDArray[np.float32]:
    """(4, 4, 3): radiance 1 above the horizon, whose irradiance on the cloth is pi, and 0 below."""
    image = np.zeros((4, 4, 3), dtype=np.float32)
    image[:2] = 1.0
    return image


assert PLANE_FACTOR >= 2.0, "a turned plane must still fill the picture"
