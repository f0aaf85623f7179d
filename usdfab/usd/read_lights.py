"""UsdLux lights as plain data, in metres, by the formulas in UsdLux's own documentation.

Notation: X = intensity * 2^exposure * color * temperature colour (3,), the emission before normalisation;
A = area of the light in world space *in the stage's units* (that is what UsdLux divides by, so a stage in centimetres
and its copy in metres differ when ``normalize`` is on, as in every other renderer); L = emitted radiance.

- Without ``normalize`` L = X, with it L = X / A. Radiance does not change with the unit of length.
- Sphere, A = 4 pi r^2. Seen from far away it has the projected area pi r^2, so a sphere that is treated as a point has
  the intensity I = pi r^2 L with r in metres. With ``normalize`` that is X / 4 times (metres per unit)^2, whatever r.
- Rectangle, A = |edge_u x edge_v|. Disk, scaled to an ellipse with half axes u and v, A = pi |u x v|.
- Cylinder without caps, A = 2 pi r l.
- Distant light of half angle t: with ``normalize`` L = X / (pi sin^2 t) for t up to pi/2, (2 - sin^2 t) pi beyond, 1
  for t = 0. A surface that faces the light receives E = L * integral of cos over the cone in front of it = L pi sin^2 t
  (t up to pi/2; L pi beyond). Parallel light (t = 0) has no radiance: E = X, with ``normalize`` and without.
- Dome: ``normalize`` is ignored, L = X times the texture.
"""

from __future__ import annotations

import math

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdLux

from usdfab.errors import UsdfabError
from usdfab.usd.assets import image_file
from usdfab.usd.scene import (
    Array,
    CylinderLight,
    DiskLight,
    DistantLight,
    DomeLight,
    Light,
    PointLight,
    RectLight,
    SphereLight,
)
from usdfab.usd.stage import site

_SCALE_TOLERANCE = 1e-4
_LINE_RADIUS = 1e-3
"""Radius over length of a cylinder without radius that is to be treated as a line."""


def is_light(prim: Usd.Prim) -> bool:
    """Whether ``prim`` emits light: a UsdLux light of any kind, or geometry with a light API applied."""
    return prim.HasAPI(UsdLux.LightAPI) or prim.IsA(UsdLux.LightFilter)


def read_light(
    prim: Usd.Prim, to_world: Array, meters_per_unit: float, time: Usd.TimeCode
) -> tuple[Light | None, list[str]]:
    """The light of ``prim`` and what could not be honoured.

    Parameters
    ----------
    to_world: (4, 4)
        Local to world in the *stage's* units, column vectors.

    Returns
    -------
    light:
        None for a kind that usdfab does not know; a warning then says so.
    warnings:
        One sentence each.

    Raises
    ------
    UsdfabError
        For values that are not finite, or a size that is not above 0.
    """
    place, kind = str(prim.GetPath()), prim.GetTypeName()
    if kind not in _READERS:
        return None, [f"{place}: lights of type {kind or 'LightAPI on geometry'} are not supported, left out"]
    if not np.isfinite(to_world).all():
        raise UsdfabError("the transform is not finite", place=site(prim.GetStage(), prim))
    warnings = _ignored(prim, time)
    emission = _emission(UsdLux.LightAPI(prim), time)
    return _READERS[kind](prim, to_world, meters_per_unit, time, emission, warnings), warnings


def _emission(light: UsdLux.LightAPI, time: Usd.TimeCode) -> Array:
    """X (3,): intensity, exposure, colour and temperature multiplied."""
    scalar = light.GetIntensityAttr().Get(time) * 2.0 ** light.GetExposureAttr().Get(time)
    color = np.asarray(light.GetColorAttr().Get(time), dtype=float)
    if light.GetEnableColorTemperatureAttr().Get(time):
        # The function that UsdLux's documentation names; at 6500 K it is near to white, not exactly white.
        color = color * np.asarray(UsdLux.BlackbodyTemperatureAsRgb(light.GetColorTemperatureAttr().Get(time)))
    emission = scalar * color
    if not np.isfinite(emission).all():
        raise UsdfabError(f"the emission {emission} is not finite", place=site(light.GetPrim().GetStage(), light))
    return emission


def _ignored(prim: Usd.Prim, time: Usd.TimeCode) -> list[str]:
    """What the light asks for and no usdfab renderer does."""
    place = str(prim.GetPath())
    light, shaping = UsdLux.LightAPI(prim), UsdLux.ShapingAPI(prim)
    warnings = []
    if light.GetDiffuseAttr().Get(time) != 1.0 or light.GetSpecularAttr().Get(time) != 1.0:
        warnings.append(f"{place}: the diffuse and specular multipliers are not supported, taken as 1")
    if light.GetFiltersRel().GetTargets():
        warnings.append(f"{place}: light filters are not supported, left out")
    for collection in (light.GetLightLinkCollectionAPI(), light.GetShadowLinkCollectionAPI()):
        rules = collection.ComputeMembershipQuery().GetAsPathExpansionRuleMap()
        if [str(path) for path in rules] != ["/"]:
            warnings.append(f"{place}: light linking is not supported, the light reaches everything")
            break
    if prim.HasAPI(UsdLux.ShapingAPI):
        if shaping.GetShapingConeAngleAttr().Get(time) < 90.0 or shaping.GetShapingFocusAttr().Get(time) > 0.0:
            warnings.append(f"{place}: cones and focus are not supported, the light is unshaped")
        if shaping.GetShapingIesFileAttr().Get(time):
            warnings.append(f"{place}: IES profiles are not supported, the light is unshaped")
    return warnings


def _positive(prim: Usd.Prim, attribute: Usd.Attribute, time: Usd.TimeCode, zero: bool = False) -> float:
    value = float(attribute.Get(time))
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise UsdfabError(f"{value} is not a size above 0", place=site(prim.GetStage(), attribute))
    return value


def _sphere(
    prim: Usd.Prim, to_world: Array, mpu: float, time: Usd.TimeCode, emission: Array, warnings: list[str]
) -> Light:
    light = UsdLux.SphereLight(prim)
    point = bool(light.GetTreatAsPointAttr().Get(time))
    radius = _positive(prim, light.GetRadiusAttr(), time, zero=point) * _uniform_scale(prim, to_world, warnings)
    center = to_world[:3, 3] * mpu
    normalize = bool(light.GetNormalizeAttr().Get(time))
    if point:
        # I = pi r^2 L, L = X or X / (4 pi r^2).
        intensity = emission * (mpu**2 / 4.0 if normalize else math.pi * (radius * mpu) ** 2)
        if radius == 0 and not normalize:
            raise UsdfabError("a sphere of radius 0 without normalize emits nothing", place=site(prim.GetStage(), prim))
        return PointLight(str(prim.GetPath()), center, intensity)
    if not radius > 0:
        raise UsdfabError("the sphere has no area", place=site(prim.GetStage(), prim))
    radiance = emission / (4.0 * math.pi * radius**2) if normalize else emission
    return SphereLight(str(prim.GetPath()), center, radius * mpu, radiance)


def _uniform_scale(prim: Usd.Prim, to_world: Array, warnings: list[str]) -> float:
    scales = np.linalg.svd(to_world[:3, :3], compute_uv=False)
    mean = float(np.cbrt(np.prod(scales)))
    if mean > 0 and scales[0] / scales[-1] - 1.0 > _SCALE_TOLERANCE:
        warnings.append(f"{prim.GetPath()}: the sphere is scaled to an ellipsoid, a sphere of equal volume is used")
    return mean


def _rect(
    prim: Usd.Prim, to_world: Array, mpu: float, time: Usd.TimeCode, emission: Array, warnings: list[str]
) -> Light:
    light = UsdLux.RectLight(prim)
    width = _positive(prim, light.GetWidthAttr(), time)
    height = _positive(prim, light.GetHeightAttr(), time)
    texture = light.GetTextureFileAttr().Get(time)
    if texture and texture.path:
        warnings.append(f"{prim.GetPath()}: textures on rectangle lights are not supported, the light is uniform")
    linear = to_world[:3, :3]
    edge_u, edge_v = linear @ [width, 0.0, 0.0], linear @ [0.0, height, 0.0]
    corner = to_world[:3, 3] - 0.5 * (edge_u + edge_v)
    cross = np.cross(edge_u, edge_v)
    area = float(np.linalg.norm(cross))
    if not area > 0:
        raise UsdfabError("the rectangle has no area", place=site(prim.GetStage(), prim))
    # It emits along its local -z; edge_u x edge_v points to local +z, or against it under a mirroring transform.
    normal = -cross / area * np.sign(np.linalg.det(linear) or 1.0)
    radiance = emission / area if light.GetNormalizeAttr().Get(time) else emission
    return RectLight(str(prim.GetPath()), corner * mpu, edge_u * mpu, edge_v * mpu, normal, radiance)


def _disk(
    prim: Usd.Prim, to_world: Array, mpu: float, time: Usd.TimeCode, emission: Array, warnings: list[str]
) -> Light:
    light = UsdLux.DiskLight(prim)
    radius = _positive(prim, light.GetRadiusAttr(), time)
    linear = to_world[:3, :3]
    axis_u, axis_v = radius * linear[:, 0], radius * linear[:, 1]
    cross = np.cross(axis_u, axis_v)
    size = float(np.linalg.norm(cross))
    if not size > 0:
        raise UsdfabError("the disk has no area", place=site(prim.GetStage(), prim))
    # As for rectangles: the disk emits along its local -z.
    normal = -cross / size * np.sign(np.linalg.det(linear) or 1.0)
    radiance = emission / (math.pi * size) if light.GetNormalizeAttr().Get(time) else emission
    return DiskLight(str(prim.GetPath()), to_world[:3, 3] * mpu, axis_u * mpu, axis_v * mpu, normal, radiance)


def _cylinder(
    prim: Usd.Prim, to_world: Array, mpu: float, time: Usd.TimeCode, emission: Array, warnings: list[str]
) -> Light:
    light = UsdLux.CylinderLight(prim)
    line, normalize = bool(light.GetTreatAsLineAttr().Get(time)), bool(light.GetNormalizeAttr().Get(time))
    length = _positive(prim, light.GetLengthAttr(), time)
    radius = _positive(prim, light.GetRadiusAttr(), time, zero=line and normalize)
    linear = to_world[:3, :3]
    half = 0.5 * length * linear[:, 0]
    axis = _unit(prim, half)
    across = linear[:, 1:] - np.outer(axis, axis @ linear[:, 1:])
    scales = np.linalg.svd(across, compute_uv=False)
    if scales[0] > (1.0 + _SCALE_TOLERANCE) * scales[1]:
        warnings.append(
            f"{prim.GetPath()}: the cylinder is scaled to an elliptic one, a round one of its section is used"
        )
    length = 2.0 * float(np.linalg.norm(half))
    # What a line emits per length does not depend on its radius once it is normalised; a thin cylinder stands for it.
    radius = radius * math.sqrt(scales[0] * scales[1]) or _LINE_RADIUS * length
    if scales[1] == 0:
        raise UsdfabError("the transform is singular", place=site(prim.GetStage(), prim))
    radiance = emission / (2.0 * math.pi * radius * length) if normalize else emission
    return CylinderLight(str(prim.GetPath()), to_world[:3, 3] * mpu, half * mpu, radius * mpu, radiance)


def _distant(
    prim: Usd.Prim, to_world: Array, mpu: float, time: Usd.TimeCode, emission: Array, warnings: list[str]
) -> Light:
    light = UsdLux.DistantLight(prim)
    half = math.radians(min(max(float(light.GetAngleAttr().Get(time)), 0.0), 360.0)) / 2.0
    sine2 = math.sin(half) ** 2
    if half == 0.0:
        irradiance = emission
    else:
        # E = L pi sin^2 t in front of the surface, all of the hemisphere once t passes pi/2.
        projected = math.pi * (sine2 if half <= math.pi / 2 else 1.0)
        size = math.pi * (sine2 if half <= math.pi / 2 else 2.0 - sine2)
        irradiance = emission * projected / (size if light.GetNormalizeAttr().Get(time) else 1.0)
    direction = to_world[:3, :3] @ [0.0, 0.0, -1.0]
    return DistantLight(str(prim.GetPath()), _unit(prim, direction), irradiance, half)


def _dome(
    prim: Usd.Prim, to_world: Array, mpu: float, time: Usd.TimeCode, emission: Array, warnings: list[str]
) -> Light:
    light = UsdLux.DomeLight_1(prim) if prim.IsA(UsdLux.DomeLight_1) else UsdLux.DomeLight(prim)
    if light.GetPortalsRel().GetTargets():
        warnings.append(f"{prim.GetPath()}: portals are not supported, left out (they only guide sampling)")
    texture = image_file(light.GetTextureFileAttr(), time)
    layout = light.GetTextureFormatAttr().Get(time)
    if texture and layout not in ("automatic", "latlong"):
        warnings.append(f"{prim.GetPath()}: textures of format {layout} are not supported, read as latlong")
    rotation = np.eye(4)
    rotation[:3, :3] = _rotation(prim, to_world)
    if isinstance(light, UsdLux.DomeLight_1):
        pole = light.GetPoleAxisAttr().Get(time)
        up = UsdGeom.GetStageUpAxis(prim.GetStage())
        if pole == "Z" or (pole == "scene" and up == UsdGeom.Tokens.z):
            # +y -> +z and +z -> -y: the pole goes up, the image's middle to -y.
            rotation = rotation @ [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    return DomeLight(str(prim.GetPath()), rotation, emission, None, texture)


def _unit(prim: Usd.Prim, vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    if not (length > 0 and math.isfinite(length)):
        raise UsdfabError("the transform is singular", place=site(prim.GetStage(), prim))
    return vector / length


def _rotation(prim: Usd.Prim, to_world: Array) -> Array:
    """The rotation (or mirrored rotation) nearest to the transform's linear part."""
    u, s, vt = np.linalg.svd(to_world[:3, :3])
    if not (np.isfinite(s).all() and s[-1] > 0):
        raise UsdfabError("the transform is singular", place=site(prim.GetStage(), prim))
    return u @ vt


def matrix(value: Gf.Matrix4d) -> Array:
    """(4, 4) for column vectors from USD's matrix for row vectors."""
    return np.array(value, dtype=np.float64).T


_READERS = {
    "SphereLight": _sphere,
    "RectLight": _rect,
    "DiskLight": _disk,
    "CylinderLight": _cylinder,
    "DistantLight": _distant,
    "DomeLight": _dome,
    "DomeLight_1": _dome,
}
