"""A measured capture rig from a USD stage: where camera and lights are about the sample."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.read_scene import read_scene
from usdfab.usd.rig import BLUR_ATTRIBUTE, CONTRAST_ATTRIBUTE, Rig
from usdfab.usd.scene import Camera, Light, Scene
from usdfab.usd.stage import open_stage

Floats = NDArray[np.float64]

MOST_TILT = math.radians(2.0)
"""Between the camera's axis and the sample's normal."""

_PLACES = {"position", "center", "corner"}
_VECTORS = {"direction", "edge_u", "edge_v", "normal", "axis_u", "axis_v", "half"}
_STRENGTHS = {"intensity", "radiance", "irradiance"}


def read_rig(path: str | Path) -> Rig:
    """The rig on a stage: its first camera, all its lights, and the surface that the camera looks at.

    The camera's axis meets the sample in its middle, at a right angle; the picture's width and height there are
    ``sample_size``. A camera's exposure goes into the strength of the lights; its ``BLUR_ATTRIBUTE`` and
    ``CONTRAST_ATTRIBUTE``, if it has them, say how its photos show what it sees.

    Raises
    ------
    UsdfabError
        As ``read_scene``; without camera, light or anything in view; for a camera that looks at the sample at a slant
        or through an offset film.
    """
    stage = open_stage(path)
    scene = read_scene(stage)
    for kind, found in (("camera", scene.cameras), ("light", scene.lights)):
        if not found:
            raise UsdfabError(f"the rig has no {kind}", place=str(path), remedy="give it one")
    camera = scene.cameras[0]
    place = f"{path}, {camera.path}"
    if np.any(np.abs(camera.offset) > 1e-3):
        raise UsdfabError("the rig's camera has an offset film", place=place, remedy="crop the photo instead")
    height, normal = _sample_below(scene, camera, place)
    tilt = math.acos(min(1.0, abs(float(normal @ camera.to_world[:3, 2]))))
    if tilt > MOST_TILT:
        raise UsdfabError(
            f"the camera looks at the sample {math.degrees(tilt):.1f} degrees off its normal",
            place=place,
            remedy="turn it to look straight down",
        )
    to_rig = _rig_frame(camera, height)
    gain = 2.0**camera.exposure
    # A camera's numbers are singles: their rounding is no part of the size.
    width, depth = (float(f"{2.0 * height * float(t):.6g}") for t in camera.tan_half)
    return Rig(
        (width, depth), camera_height=height, lights=tuple(_moved(light, to_rig, gain) for light in scene.lights),
        blur=_blur(stage, camera, place), contrast=_contrast(stage, camera, place),
    )  # fmt: skip


def _blur(stage: Usd.Stage, camera: Camera, place: str) -> float:
    prim = stage.GetPrimAtPath(camera.path)
    value = prim.GetAttribute(BLUR_ATTRIBUTE).Get()
    if value is None:
        return 0.0
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise UsdfabError(f"{value!r} is not a length", place=f"{place}.{BLUR_ATTRIBUTE}")
    # In the units of the camera's own frame, which may be scaled into the stage's.
    axis = UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()).GetRow3(0)
    return float(value) * axis.GetLength() * float(UsdGeom.GetStageMetersPerUnit(stage))


def _contrast(stage: Usd.Stage, camera: Camera, place: str) -> float:
    value = stage.GetPrimAtPath(camera.path).GetAttribute(CONTRAST_ATTRIBUTE).Get()
    if value is None:
        return 1.0
    if not isinstance(value, (int, float)) or not (math.isfinite(value) and value > 0):
        raise UsdfabError(f"{value!r} is not a contrast above 0", place=f"{place}.{CONTRAST_ATTRIBUTE}")
    return float(value)


def _sample_below(scene: Scene, camera: Camera, place: str) -> tuple[float, Floats]:
    """Distance to the first surface on the camera's axis, and its unit normal."""
    origin, axis = camera.to_world[:3, 3], -camera.to_world[:3, 2]
    best, normal = math.inf, np.zeros(3)
    for mesh in scene.meshes:
        a, b, c = (np.asarray(mesh.points, dtype=float)[mesh.triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        facing = normals @ axis
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.einsum("ij,ij->i", a - origin, normals) / facing
            hit = origin + distance[:, None] * axis
            inside = (distance > 0.0) & np.isfinite(distance)
            for p, q in ((a, b), (b, c), (c, a)):
                inside &= np.einsum("ij,ij->i", np.cross(q - p, hit - p), normals) >= -1e-9 * (normals**2).sum(1)
        if inside.any():
            k = int(np.argmin(np.where(inside, distance, np.inf)))
            if distance[k] < best:
                best, normal = float(distance[k]), normals[k] / np.linalg.norm(normals[k])
    if not math.isfinite(best):
        raise UsdfabError("nothing lies on the axis of the rig's camera", place=place, remedy="aim it at the sample")
    return best, normal


def _rig_frame(camera: Camera, height: float) -> Floats:
    """(4, 4) from the world to the rig's frame: origin in the sample's middle, x and y the camera's right and up."""
    to_camera: Floats = np.linalg.inv(camera.to_world).astype(np.float64)
    to_camera[2, 3] += height
    return to_camera


def _moved(light: Light, matrix: Floats, gain: float) -> Light:
    changes = {}
    for f in fields(light):
        value = getattr(light, f.name)
        if f.name in _PLACES:
            changes[f.name] = matrix[:3, :3] @ value + matrix[:3, 3]
        elif f.name in _VECTORS:
            changes[f.name] = matrix[:3, :3] @ value
        elif f.name == "to_world":
            turn = np.eye(4)
            turn[:3, :3] = matrix[:3, :3]
            changes[f.name] = turn @ value
        elif f.name in _STRENGTHS:
            changes[f.name] = gain * np.asarray(value)
    return replace(light, **changes)
