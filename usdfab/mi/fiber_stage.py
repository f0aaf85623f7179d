"""A swatch under its rig as a stage for paths through fibers: one shape of all curves, colours are rows of `Optics`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.optics import Optics, optics_of
from usdfab.mi.camera import sensor
from usdfab.mi.curve_color import curve_of_segment
from usdfab.mi.fiber_paths import Stage
from usdfab.mi.fibers import Cloth, Fibers, make_cloth, write_curves
from usdfab.mi.lights import emitters
from usdfab.mi.scene import FIBER_UNITS
from usdfab.mi.space import Space
from usdfab.usd.scene import Camera, DistantLight, FabricSurface, PointLight, Scene

Floats = NDArray[np.float64]


def fabric_surface(scene: Scene) -> FabricSurface:
    """The one fabric of a scene of nothing else.

    Raises
    ------
    UsdfabError
        For other scenes, and for what paths through fibers alone cannot show or have no parameters for.
    """
    if len(scene.fabrics) != 1:
        raise UsdfabError(f"expected a scene of one fabric, got {len(scene.fabrics)}", place=scene.path)
    surface = scene.fabrics[0]
    for mesh in scene.meshes:
        if any(scene.materials[m].fabric < 0 for m in np.unique(mesh.face_material)):
            raise UsdfabError(
                "only fibers and lights can be differentiated", place=mesh.path, remedy="leave this mesh out of the rig"
            )
    if surface.albedo_map is not None:
        raise UsdfabError(
            "a fabric with an albedo map has no few colours to differentiate", place=surface.path, remedy="remove it"
        )
    yarns = surface.fabric.warp, surface.fabric.weft
    if any(yarn.fiber_count < 1 for yarn in yarns):
        raise UsdfabError("there are no fibers to differentiate", place=surface.path)
    if yarns[0].cuticle_tilt != yarns[1].cuticle_tilt:
        raise UsdfabError("warp and weft need the same cuticle tilt to be differentiated", place=surface.path)
    return surface


def seen_fibers(scene: Scene, camera: Camera, margin: float | None, budget: int) -> Cloth:
    """The curves that a camera sees; ``margin`` and ``budget`` as in ``make_cloth``. Errors as there, and for none."""
    cloth = make_cloth(scene, camera, None, budget, margin=margin)
    if not sum(len(f.curves.counts) for f in cloth.fibers):
        raise UsdfabError(
            "the camera sees no fibers", place=camera.path, remedy="point it at the cloth or take a larger margin"
        )
    return cloth


def color_rows(fibers: Fibers, optics: Optics) -> NDArray[np.int64]:
    """(curves,) the row in ``optics.albedo`` of each curve."""
    rows = np.flatnonzero(optics.system == ("warp", "weft").index(fibers.curves.system))
    different, which = np.unique(fibers.curves.color, axis=0, return_inverse=True)
    distance = np.abs(different[:, None] - optics.albedo[None, rows]).max(axis=-1)
    nearest = distance.argmin(axis=1)
    assert np.all(distance[np.arange(len(different)), nearest] < 1e-6), "fibers have their yarns' colours"
    return rows[nearest][which.ravel()]


def write_all(path: Path, fibers: Sequence[Fibers], space: Space) -> None:
    """A Mitsuba curve file of all curves of all systems, in order."""
    parts = []
    for number, own in enumerate(fibers):
        part = path.with_suffix(f".{number}")
        write_curves(part, own.curves, np.ones(len(own.curves.counts), dtype=bool), space)
        parts.append(part)
    with path.open("wb") as file:
        for part in parts:
            file.write(part.read_bytes())
            part.unlink()


def build_stage(
    scene: Scene, camera: Camera, size: tuple[int, int], cloth: Cloth, vertices: int
) -> tuple[Stage, list[str]]:
    """Load the scene into Mitsuba, whose variant is set, and what was approximated.

    Parameters
    ----------
    size:
        (width, height) in pixels.
    vertices:
        Most hits of a path.

    Raises
    ------
    UsdfabError
        For pixels that are not square, a scene without light, and domes with two pictures.
    """
    optics = optics_of(fabric_surface(scene).fabric)
    assert cloth.bounds is not None, "seen_fibers has looked"
    low, high = cloth.bounds
    space = Space(FIBER_UNITS / min(f.curves.radius for f in cloth.fibers), 0.5 * (low + high))
    view, warnings = sensor(mi, camera, size, (0, 0, *size), space)
    corners = np.concatenate([mesh.points for mesh in scene.meshes])
    far = np.abs(corners - space.origin).max(axis=0)
    radius = float(np.linalg.norm(far)) + float(np.linalg.norm(camera.to_world[:3, 3] - space.origin))
    lights = emitters(mi, scene.lights, {}, space, radius)
    if not lights:
        raise UsdfabError("the stage has no light", place=scene.path, remedy="add a UsdLux light, e.g. a DomeLight")
    alone = all(
        isinstance(light, PointLight) or (isinstance(light, DistantLight) and light.half_angle <= 0.0)
        for light in scene.lights
    )
    with tempfile.TemporaryDirectory(prefix="usdfab-") as folder:
        path = Path(folder) / "fibers.txt"
        write_all(path, cloth.fibers, space)
        description: dict[str, Any] = {
            "type": "scene", "sensor": view, **lights,
            "fibers": {"type": "bsplinecurve", "filename": str(path), "bsdf": {"type": "diffuse"}},
        }  # fmt: skip
        loaded = mi.load_dict(description, parallel=False)
    rows = np.concatenate([color_rows(f, optics) for f in cloth.fibers])
    segments = curve_of_segment(np.concatenate([f.curves.counts for f in cloth.fibers]))
    fibers = next(shape for shape in loaded.shapes() if shape.id() == "fibers")
    stage = Stage(
        loaded, fibers, mi.UInt32(rows[segments].astype(np.uint32)), len(optics.albedo),
        int(np.sum(optics.system == 0)), alone, vertices,
    )  # fmt: skip
    return stage, warnings
