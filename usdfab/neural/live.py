"""A scene that is looked at and changed: camera, one light, and the fabrics, each change in milliseconds.

What pixels see is kept as long as only light and materials change (``render.Buffer``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, edited
from usdfab.neural.material_file import Weights
from usdfab.neural.render import Buffer, NeuralRender, places_of, render
from usdfab.neural.stage_scene import NeuralScene, build, dressed, relit
from usdfab.neural.surface_from_fabric import surface_from_fabric
from usdfab.tracer.lights import pack_lights, sample_light
from usdfab.usd.scene import Camera, DistantLight, DomeLight, Light, Scene

Floats = NDArray[np.float64]

ROUGHNESS, FLATTENING = "both.roughness_primary", "both.flattening"
"""Settings of ``usdfab edit`` by which the surface's roughness and height scale are changed."""


class LiveScene:
    """A scene in front of a camera.

    Parameters
    ----------
    scene:
        With fabrics, lights and meshes.
    networks:
        For ``reflection`` and ``transmission``.
    pictures:
        Of dome lights, by path.
    """

    def __init__(
        self, scene: Scene, networks: Mapping[str, Weights], pictures: Mapping[str, NDArray], strict: bool = False
    ) -> None:
        self.networks, self.pictures = networks, pictures
        self.scene, self.first = scene, scene
        self.ready: NeuralScene = build(scene, networks, pictures, strict)
        self.warnings = self.ready.warnings
        self.settings: dict[str, str] = {}
        self._seen: tuple[tuple, Buffer] = ((), Buffer())

    def picture(self, camera: Camera, size: tuple[int, int], spp: int = 1, threads: int = 1) -> NeuralRender:
        """What a camera sees now."""
        key = (camera.to_world.tobytes(), np.asarray(camera.tan_half).tobytes(), camera.offset.tobytes(), size)
        if self._seen[0] != key:
            self._seen = (key, Buffer())
        return render(self.ready, camera, size, (0, 0, *size), spp, threads, buffer=self._seen[1])

    def set(self, settings: Mapping[str, str]) -> None:
        """Change all fabrics by settings of ``usdfab edit`` (``weave``, ``warp.albedo``, ...), on top of earlier ones.

        Raises
        ------
        UsdfabError
            As ``fabric.edited``; for a weave that is larger than the encoder takes. Nothing is changed then.
        """
        together = {**self.settings, **settings}
        fabrics = tuple(replace(surface, fabric=edited(surface.fabric, together)) for surface in self.first.fabrics)
        scene = replace(self.scene, fabrics=fabrics)
        before, self.ready = self.ready, dressed(self.ready, scene, self.networks)
        if not np.array_equal(before.cloth.repeats, self.ready.cloth.repeats):
            self._seen = ((), Buffer())  # footprints and places count in repeats
        self.scene, self.settings = scene, together

    def edit_arguments(self) -> list[str]:
        """What has been set, as arguments of ``usdfab edit``."""
        arguments = []
        for name, value in self.settings.items():
            arguments += ["--weave", value] if name == "weave" else ["--set", f"{name}={value}"]
        return arguments

    def fabric(self) -> FabricParameters:
        """The first fabric as it is now.

        Raises
        ------
        UsdfabError
            If the scene has none.
        """
        if not self.scene.fabrics:
            raise UsdfabError(
                "nothing in the stage wears a fabric", place=self.scene.path, remedy="bind one with: usdfab bind"
            )
        return self.scene.fabrics[0].fabric

    def shine_and_relief(self) -> tuple[float, float]:
        """Roughness and height scale of the first fabric's surface."""
        material, _ = surface_from_fabric(self.fabric())
        return material.roughness, material.height_scale

    def light(self, azimuth: float, elevation: float) -> None:
        """Take a sun for the strongest light that is no dome, as bright as that is in the middle of the scene.

        Parameters
        ----------
        azimuth, elevation: degrees
            Where it stands: about the stage's up axis from x on, counter-clockwise seen from above, and above the
            horizon.
        """
        middle = self.middle()
        own = [k for k, light in enumerate(self.first.lights) if not isinstance(light, DomeLight)]
        arriving = [self._irradiance(light, middle) for light in self.first.lights]
        lights: list[Light] = list(self.first.lights)
        if own:
            number = max(own, key=lambda k: float(arriving[k].sum()))
            lights[number] = _sun(azimuth, elevation, self.first.up_axis, arriving[number])
        else:  # domes alone: as much again
            lights.append(_sun(azimuth, elevation, self.first.up_axis, np.sum(arriving, axis=0)))
        bodies = self.ready.cloth.bodies
        self.scene = replace(self.scene, lights=tuple(lights))
        self.ready = relit(self.ready, self.scene, self.pictures)
        if bodies:
            self._seen = ((), Buffer())  # pixels may show the light itself

    def middle(self) -> Floats:
        """The middle (3,) of all cloth, or of everything if there is none."""
        low, high = self.bounds()
        return 0.5 * (low + high)

    def bounds(self) -> tuple[Floats, Floats]:
        """The lowest and the highest corner of the cloth's box, or of everything's if there is none."""
        woven = {k for k, material in enumerate(self.scene.materials) if material.fabric >= 0}
        worn = [m for m in self.scene.meshes if m.placements is None and woven & set(m.face_material.tolist())]
        if not worn:
            box = self.ready.world.macro.bounds
            return box[0].astype(float), box[1].astype(float)
        points = np.concatenate([mesh.points for mesh in worn])
        return points.min(axis=0).astype(float), points.max(axis=0).astype(float)

    def _irradiance(self, light: Light, point: Floats) -> Floats:
        """What a surface at a point receives that faces a light, (3,), taking all of it as coming from one side."""
        packed = pack_lights(replace(self.first, lights=(light,)), dict(self.pictures))
        total = np.zeros(3)
        places = places_of(0, 16)
        for u1, u2 in places:
            total += sample_light(packed, *point, 0.5, u1, u2)[4:7]
        return total / len(places)


def _sun(azimuth: float, elevation: float, up_axis: str, irradiance: Floats) -> DistantLight:
    a, e = math.radians(azimuth), math.radians(elevation)
    x, y, z = math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)
    towards = np.array([x, y, z] if up_axis == "Z" else [x, z, -y])
    return DistantLight("/usdfab_view_light", -towards, np.asarray(irradiance, dtype=float), 0.0)
