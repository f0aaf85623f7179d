"""The capture rig as the rasterizer sees it: rays and lamps in the frame of the patch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.usd.scene import Camera, PointLight, Scene

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera and lamps above flat cloth. Patch frame: x along the weft, z the cloth's normal; metres.

    Parameters
    ----------
    eye: (3,)
    directions: (H, W, 3)
        Unit vectors through the middles of the pixels, rows from the top.
    lamps: (K, 3), intensity: (K, 3)
        Point lights; W/sr, linear Rec. 709.
    gain:
        Pixel value for radiance 1: the camera's exposure.
    """

    eye: Floats
    directions: Floats
    lamps: Floats
    intensity: Floats
    gain: float


def view_of(scene: Scene, camera: Camera, size: tuple[int, int]) -> View:
    """What ``camera`` sees of the flat cloth of a rig, at ``size`` (width, height) pixels.

    Raises
    ------
    UsdfabError
        Where the rig is not what this stage of the fit is made for: point lights above one flat cloth in true size.
    """
    to_patch, origin = cloth_frame(scene)
    rotation, eye = to_patch @ camera.to_world[:3, :3], to_patch @ (camera.to_world[:3, 3] - origin[0]) + origin[1]
    width, height = size
    s = 2.0 * (np.arange(width) + 0.5) / width - 1.0 + camera.offset[0]
    t = 1.0 - 2.0 * (np.arange(height) + 0.5) / height + camera.offset[1]
    x, y = np.broadcast_arrays(camera.tan_half[0] * s[None, :], camera.tan_half[1] * t[:, None])
    local = np.stack([x, y, -np.ones_like(x)], axis=-1)
    directions = local @ rotation.T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    if eye[2] <= 0.0 or (directions[..., 2] >= -0.05).any():
        raise UsdfabError(
            "the camera does not look down on the face of the cloth", place=camera.path,
            remedy="put it above the sample, looking at it",
        )  # fmt: skip
    points, intensity = [], []
    for light in scene.lights:
        if not isinstance(light, PointLight):
            raise UsdfabError(
                f"the rasterization stage knows point lights, not {type(light).__name__}", place=light.path,
                remedy="use a SphereLight with treatAsPoint",
            )  # fmt: skip
        points.append(to_patch @ (light.position - origin[0]) + origin[1])
        intensity.append(np.asarray(light.intensity, dtype=float))
        if points[-1][2] <= 0.0:
            raise UsdfabError("the lamp is not above the face of the cloth", place=light.path)
    if not points:
        raise UsdfabError("the rig has no lamp", place=scene.path, remedy="add a SphereLight with treatAsPoint")
    return View(eye, directions, np.array(points), np.array(intensity), 2.0**camera.exposure)


def cloth_frame(scene: Scene) -> tuple[Floats, tuple[Floats, Floats]]:
    """The rotation from world to patch, and one point in (world, patch).

    Raises
    ------
    UsdfabError
        If there is no cloth, if it is not flat, or if its texture coordinates do not show it in true size.
    """
    for mesh in scene.meshes:
        worn = np.array([scene.materials[m].fabric for m in mesh.face_material])
        if (worn < 0).all() or mesh.uv is None:
            continue
        face = int(np.flatnonzero(worn >= 0)[0])
        surface = scene.fabrics[int(worn[face])]
        corners = mesh.points[mesh.triangles[face]]
        cloth = mesh.uv[face] * surface.meters_per_uv
        edges, steps = corners[1:] - corners[0], cloth[1:] - cloth[0]
        normal = np.cross(edges[0], edges[1])
        normal /= np.linalg.norm(normal)
        if abs((mesh.points - corners[0]) @ normal).max() > 1e-6 * np.ptp(mesh.points, axis=0).max():
            raise UsdfabError("the sample is not flat", place=mesh.path, remedy="use a plane, as `usdfab` writes it")
        # Rows: gradients of the cloth's x and y over the plane.
        gradients = np.linalg.solve(np.vstack([edges, normal]), np.vstack([steps, np.zeros(2)])).T
        # Mirrored texture coordinates make this a reflection: the cloth is then seen mirrored, as the tracer shows it.
        matrix = np.vstack([gradients, normal])
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
            raise UsdfabError(
                "the texture coordinates of the sample do not show the cloth in true size", place=mesh.path,
                remedy="make one unit of st one metre, or bind with the right scale",
            )  # fmt: skip
        return matrix, (corners[0], np.r_[cloth[0], 0.0])
    raise UsdfabError("the rig has no cloth", place=scene.path)
