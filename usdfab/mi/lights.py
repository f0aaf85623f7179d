"""Lights as Mitsuba emitters.

What differs from the tracer: a distant light with an angle is a disk so far away that it cannot be told from infinity,
which a camera that looks at it sees; texels of a dome's picture are blended at their edges. A lamp's other side is
black, as there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.mi.space import Space
from usdfab.usd.scene import (
    CylinderLight,
    DiskLight,
    DistantLight,
    DomeLight,
    Light,
    PointLight,
    RectLight,
    SphereLight,
)

INFINITY = 1e4
"""How far away disks stand that stand for distant lights, in radii of the scene."""

ENVIRONMENT_ROWS = 1024
"""Pictures of domes with fewer rows are drawn with each texel repeated."""

_BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
Description = dict[str, Any]


def emitters(
    mi: Any, lights: Sequence[Light], textures: Mapping[str, NDArray], space: Space, radius: float
) -> dict[str, Description]:
    """Mitsuba dictionaries of lights by name.

    Parameters
    ----------
    textures:
        Pictures of dome lights by file name, linear (H, W, 3).
    radius: metres
        Of a sphere about ``space.origin`` that holds the scene.

    Raises
    ------
    UsdfabError
        For two dome lights with different pictures: Mitsuba has one environment.
    """
    domes = [light for light in lights if isinstance(light, DomeLight)]
    found = {}
    for number, light in enumerate(lights):
        if not isinstance(light, DomeLight):
            found[f"light{number}"] = _emitter(mi, light, space, radius)
    if domes:
        found["environment"] = _environment(mi, domes, textures)
    return found


def _emitter(mi: Any, light: Light, space: Space, radius: float) -> Description:
    match light:
        case PointLight():
            return {
                "type": "point",
                "position": space.points(light.position).tolist(),
                "intensity": rgb(space.scale**2 * light.intensity),
            }
        case SphereLight():
            shape = {"center": space.points(light.center).tolist(), "radius": space.scale * light.radius}
            return {"type": "sphere", **shape, **_glow(light.radiance)}
        case RectLight():
            center = light.corner + 0.5 * (light.edge_u + light.edge_v)
            return _flat(mi, "rectangle", center, 0.5 * light.edge_u, 0.5 * light.edge_v, light, space)
        case DiskLight():
            return _flat(mi, "disk", light.center, light.axis_u, light.axis_v, light, space)
        case CylinderLight():
            ends = space.points(light.center - light.half), space.points(light.center + light.half)
            shape = {"p0": ends[0].tolist(), "p1": ends[1].tolist(), "radius": space.scale * light.radius}
            return {"type": "cylinder", **shape, **_glow(light.radiance)}
        case DistantLight():
            return _distant(mi, light, space, radius)
    raise AssertionError(f"a light of an unknown kind: {light}")


def _flat(
    mi: Any, kind: str, center: NDArray, u: NDArray, v: NDArray, light: RectLight | DiskLight, space: Space
) -> Description:
    """A rectangle or disk with half axes ``u`` and ``v`` that shines on the side of the light's normal."""
    if np.dot(np.cross(u, v), light.normal) < 0.0:
        u, v = v, u
    matrix = np.eye(4)
    matrix[:3, :3] = space.scale * np.column_stack([u, v, light.normal * np.sqrt(np.linalg.norm(np.cross(u, v)))])
    matrix[:3, 3] = space.points(center)
    return {"type": kind, "to_world": mi.ScalarTransform4f(matrix), **_glow(light.radiance)}


def _distant(mi: Any, light: DistantLight, space: Space, radius: float) -> Description:
    if light.half_angle <= 0.0:
        return {"type": "directional", "direction": light.direction.tolist(), "irradiance": rgb(light.irradiance)}
    # E = pi L sin^2 of the half angle, for a disk seen face-on from its axis.
    radiance = light.irradiance / (np.pi * np.sin(light.half_angle) ** 2)
    distance = INFINITY * radius
    side = np.cross(light.direction, np.eye(3)[np.argmin(np.abs(light.direction))])
    u = distance * np.tan(min(light.half_angle, 1.5)) * side / np.linalg.norm(side)
    v = np.cross(light.direction, u)
    center = space.origin - distance * light.direction
    disk = DiskLight(light.path, center, u, v, light.direction, radiance)
    return _flat(mi, "disk", center, u, v, disk, space)


def _environment(mi: Any, domes: Sequence[DomeLight], textures: Mapping[str, NDArray]) -> Description:
    """All domes in one: those without a picture add the same everywhere."""
    constant = np.zeros(3)
    pictured: DomeLight | None = None
    image = None
    for dome in domes:
        own = dome.texture if dome.texture is not None else textures.get(dome.texture_path)
        if own is None:
            constant += dome.radiance
        elif pictured is not None:
            raise UsdfabError(
                "Mitsuba has one dome light with a picture", place=dome.path, remedy="use --backend embree"
            )
        else:
            pictured, image = dome, np.asarray(own, dtype=np.float64)[..., :3] * dome.radiance
    if pictured is None or image is None:
        return {"type": "constant", "radiance": rgb(constant)}
    # The tracer's texels have edges; Mitsuba blends their middles, and puts the first and last row on the poles.
    finer = np.ones((max(1, ENVIRONMENT_ROWS // len(image)),) * 2 + (1,))
    bitmap = mi.Bitmap(np.ascontiguousarray(np.kron(image + constant, finer), dtype=np.float32))
    # The dome's own space is Mitsuba's: +y up, the picture's middle in +z.
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(pictured.to_world)}


def _glow(radiance: NDArray) -> Description:
    return {"bsdf": _BLACK, "emitter": {"type": "area", "radiance": rgb(radiance)}}


def rgb(value: NDArray) -> Description:
    """A colour that Mitsuba takes as it is, also above 1."""
    return {"type": "rgb", "value": [float(v) for v in value]}
