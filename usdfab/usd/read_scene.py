"""A USD stage at one time as a :class:`~usdfab.usd.scene.Scene`: metres, world space, triangles, no ``pxr``."""

from __future__ import annotations

import math
from pathlib import Path

from pxr import Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.usd.collect import PURPOSES, Collector, Placed, drawn_prims
from usdfab.usd.frames import Shutter, shutter as shutter_at, time_code as time_code
from usdfab.usd.problems import Problems
from usdfab.usd.read_camera import is_perspective, read_camera, shutter_of
from usdfab.usd.read_lights import read_light
from usdfab.usd.resolve import Resolver
from usdfab.usd.scene import Array, Camera, Light, Scene
from usdfab.usd.stage import open_stage, stage_name


def read_scene(
    source: str | Path | Usd.Stage,
    time: float | None = None,
    camera: str | None = None,
    fabric_override: FabricParameters | None = None,
    *,
    shutter: bool = True,
    subdivision: int | None = None,
    strict: bool = False,
    placements: bool = True,
    purposes: tuple[str, ...] = PURPOSES,
    by_path: bool = False,
) -> Scene:
    """What a renderer needs of a stage.

    Visible prims of the wanted purposes are read, native instances and point instancers included. Lights, cameras and
    shapes that usdfab does not support are named in ``Scene.warnings``, as is everything that is approximated.

    Cloth without usable texture coordinates is unwrapped in metres. Variants are as the stage selects them.

    Parameters
    ----------
    time:
        Time code; None is the stage's start, where it has one, else the earliest sample.
    camera:
        Path of a camera, which then comes first in ``Scene.cameras``.
    fabric_override:
        Replaces every bound fabric. If no mesh has one, it goes on the meshes that have texture coordinates and no
        material at all; if there is none of these either, on the only mesh with texture coordinates, or the only mesh.
    shutter:
        Read the ends of motion while the shutter of the chosen (or first) camera is open.
    subdivision:
        Steps of refinement of subdivision surfaces; None: by their size (``usdfab.usd.tessellate``).
    strict:
        Raise at the first thing that is wrong; else the prim is left out, or falls back, with a warning.
    placements:
        Whether copies may be ``Mesh.placements``. If not, native instances are meshes of their own, and point
        instancers are left out with a warning.
    by_path:
        Native instances are meshes of their own also where ``placements`` allows to share them: each has its path.
    purposes:
        ``default``, ``render``, ``proxy``, ``guide``.

    Raises
    ------
    UsdfabError
        If the stage cannot be opened, is empty or has no mesh that can be drawn; for a missing camera; and when there
        is no mesh, or no single one, for ``fabric_override``. With ``strict`` also for prims that are wrong: values
        that are not finite, singular transforms, indices out of range, primvars of the wrong length, lights and meshes
        without area, missing images, fabrics with values out of range.
    """
    stage = open_stage(source)
    frame = time_code(stage, time)
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    if not (math.isfinite(meters) and meters > 0):
        raise UsdfabError(f"metersPerUnit is {meters}", place=stage_name(stage), remedy="author it")
    problems = Problems(strict=strict)
    problems.warn(*(f"composition: {' '.join(str(error).split())}" for error in stage.GetCompositionErrors()))
    span = _shutter(stage, frame, camera, purposes, problems) if shutter else Shutter.still(frame)
    collector = Collector(stage, span, problems, purposes, instancers=placements)
    collector.collect()
    cameras = _chosen_first(stage, collector.cameras, camera, meters, frame, problems)
    lights = _lights(collector.lights, meters, frame, problems)
    resolver = Resolver(stage, span, problems, share=placements, by_path=by_path, subdivision=subdivision)
    meshes = resolver.resolve(collector.meshes, fabric_override)
    if not meshes:
        raise _nothing(stage, problems)
    return Scene(
        stage_name(stage),
        meshes,
        tuple(resolver.materials),
        tuple(resolver.fabrics),
        cameras,
        lights,
        (*problems.warnings, *collector.left_out()),
        str(UsdGeom.GetStageUpAxis(stage)),
    )


def _nothing(stage: Usd.Stage, problems: Problems) -> UsdfabError:
    """The error for a stage of which no mesh is left."""
    if not any(True for _ in stage.TraverseAll()):
        return UsdfabError("the stage is empty", place=stage_name(stage), remedy="usdfab renders polygon meshes")
    if problems.first is not None:
        found = problems.first
        problem = f"no mesh can be drawn: {found.problem}"
        return UsdfabError(problem, place=found.place or stage_name(stage), remedy=found.remedy)
    problem = "there is no visible mesh in this stage"
    return UsdfabError(problem, place=stage_name(stage), remedy="usdfab renders polygon meshes")


# --- cameras and lights ----------------------------------------------------------------------------------------------


def _shutter(
    stage: Usd.Stage, frame: Usd.TimeCode, camera: str | None, purposes: tuple[str, ...], problems: Problems
) -> Shutter:
    """The shutter of the chosen camera, or of the first that usdfab can render through."""
    for prim in drawn_prims(stage, frame, purposes):
        if not prim.IsA(UsdGeom.Camera) or camera not in (None, str(prim.GetPath())):
            continue
        if is_perspective(prim, frame):
            opening, closing = 0.0, 0.0
            with problems.tolerating(str(prim.GetPath()), "nothing is blurred"):
                opening, closing = shutter_of(prim, frame)
            if closing < opening:
                problems.warn(f"{prim.GetPath()}: the shutter closes before it opens, nothing is blurred")
            return shutter_at(frame, opening, closing)
    return Shutter.still(frame)


def _single(places: Array | None) -> Array | None:
    return None if places is None else places[0]


def _chosen_first(
    stage: Usd.Stage, placed: list[Placed], wanted: str | None, meters: float, frame: Usd.TimeCode, problems: Problems
) -> tuple[Camera, ...]:
    """The stage's perspective cameras, ``wanted`` first."""
    cameras: list[Camera] = []
    for place in placed:
        path = str(place.prim.GetPath())
        if not is_perspective(place.prim, frame):
            problems.warn(f"{path}: only perspective cameras are supported, left out")
            continue
        if path == wanted:
            # Nothing can stand in for the camera that was asked for.
            found, warnings = read_camera(
                place.prim, place.to_world[0], _single(place.to_world_close), meters, frame
            )  # fmt: skip
            problems.warn(*warnings)
            cameras.insert(0, found)
            continue
        with problems.tolerating(path, "the camera is left out"):
            found, warnings = read_camera(
                place.prim, place.to_world[0], _single(place.to_world_close), meters, frame
            )  # fmt: skip
            problems.warn(*warnings)
            cameras.append(found)
    if wanted is not None and not any(c.path == wanted for c in cameras):
        names = ", ".join(c.path for c in cameras)
        remedy = f"choose one of {names}" if names else "the stage has no perspective camera"
        raise UsdfabError("there is no such camera", place=f"{stage_name(stage)}<{wanted}>", remedy=remedy)
    return tuple(cameras)


def _lights(placed: list[Placed], meters: float, frame: Usd.TimeCode, problems: Problems) -> tuple[Light, ...]:
    lights: list[Light] = []
    for place in placed:
        with problems.tolerating(str(place.prim.GetPath()), "the light is left out"):
            light, warnings = read_light(place.prim, place.to_world[0], meters, frame)
            problems.warn(*warnings)
            lights += [light] if light else []
    return tuple(lights)
