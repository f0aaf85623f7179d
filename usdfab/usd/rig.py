"""The capture rig of Li et al. 2024, section 5.2: a camera above a flat sample and one small lamp beside the camera.

The paper's figure gives 4 cm and 6 cm. Settled: the camera is 6 cm above the sample and looks straight down, the lamp
is 4 cm above and 1 cm to the side (+x). The sample lies in the plane z = 0, centred at the origin, weft along +x, warp
along +y. A rig is a USD stage with a Camera, a SphereLight with ``treatAsPoint`` and a plane, so any microscope can
be described by editing the file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdLux

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.fabric import SIZE_RANGE
from usdfab.usd.atomic import checked_output, export_layer
from usdfab.usd.fabric_io import preview_color, preview_roughness
from usdfab.usd.problems import Problems
from usdfab.usd.read_scene import read_scene
from usdfab.usd.read_textures import albedo_map
from usdfab.usd.scene import Camera, FabricSurface, Light, Material, Mesh, PointLight, Scene
from usdfab.usd.stage import new_stage, open_stage

RIG_PATH = "/Rig"
PLANE_FACTOR = 3.0
"""Side of the plane over the side of the view: light that enters outside the picture and scatters in is right."""
MAX_LAMPS = 64
BLUR_ATTRIBUTE = "usdfab:blur"
"""Of a rig's camera, double, in the units of its own frame: ``Rig.blur``."""
CONTRAST_ATTRIBUTE = "usdfab:contrast"
"""Of a rig's camera, double: ``Rig.contrast``."""
_LAMP_RADIUS = 1e-3
_FOCAL_LENGTH = 50.0


@dataclass(frozen=True)
class Rig:
    """Where camera and lamp are. Metres.

    Parameters
    ----------
    sample_size: (2,)
        The part of the sample that fills the picture.
    camera_height, light_height:
        Above the sample.
    light_side:
        From the camera's axis.
    lamps:
        Equal lamps, evenly on the circle of radius ``light_side`` about the camera's axis: 1 is a lamp to the side,
        many are a ring lamp, as microscopes have it. Together they are as strong as one.
    azimuth:
        Direction from the camera's axis to the first lamp, radians from +x towards +y.
    lights:
        Lights of a measured rig, in its own frame (``read_rig``); they take the place of the lamps.
    blur:
        On the sample: how far the camera blurs (standard deviation) or, with a minus sign, how widely it sharpens, see
        ``imaging.lens``. Pictures that are compared with its photos show it, scenes do not.
    contrast:
        Power of the light that its photos show, see ``imaging.lens.toned``; as ``blur``, of its photos only.
    """

    sample_size: tuple[float, float]
    camera_height: float = 0.06
    light_height: float = 0.04
    light_side: float = 0.01
    lamps: int = 1
    azimuth: float = 0.0
    lights: tuple[Light, ...] | None = None
    blur: float = 0.0
    contrast: float = 1.0

    def __post_init__(self) -> None:
        if len(self.sample_size) != 2:
            raise UsdfabError(f"expected two lengths in metres, got {self.sample_size!r}", place="sample_size")
        low, high = SIZE_RANGE
        for side in self.sample_size:
            if not (math.isfinite(side) and low <= side <= high):
                raise UsdfabError(f"{side} m is not between {low:g} and {high:g} m", place="sample_size")
        for name in ("camera_height", "light_height"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsdfabError(f"{value} is not a height above 0", place=name)
        if not math.isfinite(self.light_side):
            raise UsdfabError(f"{self.light_side} is not a length", place="light_side")
        if not math.isfinite(self.blur):
            raise UsdfabError(f"{self.blur} is not a length", place="blur")
        if not (math.isfinite(self.contrast) and self.contrast > 0):
            raise UsdfabError(f"{self.contrast} is not a contrast above 0", place="contrast")
        if not math.isfinite(self.azimuth):
            raise UsdfabError(f"{self.azimuth} is not an angle", place="azimuth")
        if not 1 <= self.lamps <= MAX_LAMPS:
            raise UsdfabError(f"{self.lamps} lamps are not between 1 and {MAX_LAMPS}", place="lamps")

    @property
    def tan_half(self) -> tuple[float, float]:
        """Tangents of half the fields of view: the picture covers exactly the sample at z = 0."""
        return self.sample_size[0] / 2 / self.camera_height, self.sample_size[1] / 2 / self.camera_height

    @property
    def light_positions(self) -> tuple[tuple[float, float, float], ...]:
        """Positions of the lamps."""
        angles = [self.azimuth + 2.0 * math.pi * k / self.lamps for k in range(self.lamps)]
        return tuple((self.light_side * math.cos(a), self.light_side * math.sin(a), self.light_height) for a in angles)

    @property
    def light_position(self) -> tuple[float, float, float]:
        """Position of the first lamp."""
        return self.light_positions[0]

    @property
    def light_intensity(self) -> float:
        """Intensity in W/sr of all lamps at which a white diffuse sample has radiance 1 in the picture's middle.

        The irradiance there is I cos / d^2 and a white diffuse surface reflects E / pi, so I = pi d^2 / cos =
        pi d^3 / height. Towards the picture's border it falls off by less than 10 % for samples up to 5 mm.
        """
        distance = math.hypot(self.light_side, self.light_height)
        return math.pi * distance**3 / self.light_height

    def with_sample(self, sample_size: tuple[float, float]) -> Rig:
        """The same rig with the field of view of another sample size."""
        return replace(self, sample_size=sample_size)


def rig_for(sample_size: tuple[float, float]) -> Rig:
    """The paper's rig for a sample; above 3 cm all distances grow with the sample so that the view stays narrow."""
    rig = Rig(sample_size)
    factor = max(1.0, max(sample_size) / 0.03)
    return Rig(sample_size, factor * rig.camera_height, factor * rig.light_height, factor * rig.light_side)


def ring_rig(sample_size: tuple[float, float], elevation: float, lamps: int = 8, azimuth: float = 0.0) -> Rig:
    """``rig_for`` with lamps seen from the sample at ``elevation`` radians above it, as far away as its lamp.

    Eight lamps look like a ring; one is a lamp to the side, towards ``azimuth``.
    """
    rig = rig_for(sample_size)
    distance = math.hypot(rig.light_side, rig.light_height)
    return replace(
        rig, light_height=distance * math.sin(elevation), light_side=distance * math.cos(elevation), lamps=lamps,
        azimuth=azimuth,
    )  # fmt: skip


def write_rig(
    path: str | Path, sample_size: tuple[float, float], *, rig: Rig | None = None, overwrite: bool = False
) -> Path:
    """Write the rig for samples of ``sample_size`` (metres) as a USD file and return its path.

    Parameters
    ----------
    rig:
        Other distances than the paper's; its sample size is replaced by ``sample_size``.

    Raises
    ------
    UsdfabError
        For sizes out of range, and when the file exists (unless ``overwrite``) or cannot be written.
    """
    checked_output(path, overwrite=overwrite)
    stage = new_stage()
    prim = define_rig(stage, rig.with_sample(sample_size) if rig else rig_for(sample_size))
    stage.SetDefaultPrim(prim)
    return export_layer(stage.GetRootLayer(), path, overwrite=overwrite)


def define_rig(stage: Usd.Stage, rig: Rig, path: str | Sdf.Path = RIG_PATH) -> Usd.Prim:
    """Define the rig's prims below ``path``: ``Camera``, ``Lamp`` and ``Sample``. Returns the Xform at ``path``.

    Several lamps are ``Lamp1``, ``Lamp2``, ... A rig that was read from a stage is not written again.

    The stage is taken to be in metres and z up. ``Sample`` is a plane ``PLANE_FACTOR`` times the view; its ``st`` is in
    metres, (0, 0) at the lower left corner of the view: one unit of uv is one metre.
    """
    if rig.lights is not None:
        raise UsdfabError("the lights of a rig that was read cannot be written", remedy="copy its file")
    path = Sdf.Path(path)
    root = UsdGeom.Xform.Define(stage, path).GetPrim()
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    _define_camera(stage, path.AppendChild("Camera"), rig)
    for name, position in zip(_lamp_names(rig), rig.light_positions, strict=True):
        lamp = UsdLux.SphereLight.Define(stage, path.AppendChild(name))
        lamp.CreateRadiusAttr(_LAMP_RADIUS)
        lamp.CreateTreatAsPointAttr(True)
        # As a point it has the intensity pi r^2 L (usdfab.usd.read_lights).
        lamp.CreateIntensityAttr(rig.light_intensity / rig.lamps / (math.pi * _LAMP_RADIUS**2))
        lamp.CreateColorAttr(Gf.Vec3f(1.0))
        lamp.CreateNormalizeAttr(False)
        lamp.CreateExtentAttr([(-_LAMP_RADIUS,) * 3, (_LAMP_RADIUS,) * 3])
        UsdGeom.Xformable(lamp).AddTranslateOp().Set(Gf.Vec3d(*position))
    _define_plane(stage, path.AppendChild("Sample"), rig)
    return root


def _lamp_names(rig: Rig) -> list[str]:
    return ["Lamp"] if rig.lamps == 1 else [f"Lamp{k + 1}" for k in range(rig.lamps)]


def _define_camera(stage: Usd.Stage, path: Sdf.Path, rig: Rig) -> None:
    camera = UsdGeom.Camera.Define(stage, path)
    camera.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    camera.CreateFocalLengthAttr(_FOCAL_LENGTH)
    camera.CreateHorizontalApertureAttr(2.0 * _FOCAL_LENGTH * rig.tan_half[0])
    camera.CreateVerticalApertureAttr(2.0 * _FOCAL_LENGTH * rig.tan_half[1])
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01 * rig.camera_height, 100.0 * rig.camera_height))
    camera.CreateFocusDistanceAttr(rig.camera_height)
    if rig.blur:
        camera.GetPrim().CreateAttribute(BLUR_ATTRIBUTE, Sdf.ValueTypeNames.Double).Set(rig.blur)
    if rig.contrast != 1.0:
        camera.GetPrim().CreateAttribute(CONTRAST_ATTRIBUTE, Sdf.ValueTypeNames.Double).Set(rig.contrast)
    UsdGeom.Xformable(camera).AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, rig.camera_height))


def _plane(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """(4, 3) points and (4, 2) uv, both in metres, counter-clockwise from the lower left corner."""
    size = np.asarray(rig.sample_size)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * PLANE_FACTOR * size
    return np.column_stack([corners, np.zeros(4)]), corners + 0.5 * size


def _define_plane(stage: Usd.Stage, path: Sdf.Path, rig: Rig) -> None:
    points, uv = _plane(rig)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 4)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(0.5)])
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )  # fmt: skip
    st.Set([Gf.Vec2f(*map(float, c)) for c in uv])


def blur_in_pixels(rig: Rig | None, pixels_per_meter: float) -> float:
    """``Rig.blur`` at a picture's scale; the paper's rig, None, is sharp."""
    return 0.0 if rig is None else rig.blur * pixels_per_meter


def contrast_of(rig: Rig | None) -> float:
    """``Rig.contrast``; the paper's rig, None, is linear."""
    return 1.0 if rig is None else rig.contrast


def swatch_scene(
    fabric: FabricParameters, rig: str | Path | Usd.Stage | Rig | None = None, *, strict: bool = False
) -> Scene:
    """A flat sample of ``fabric`` under the capture rig, as ``usdfab render fabric.usda`` and the fit show it.

    The picture shows the rectangle (0, 0) to ``fabric.size`` of the cloth, exactly at z = 0, on a plane
    ``PLANE_FACTOR`` times as large. A white diffuse sample has pixel value 1 in the middle
    (``Rig.light_intensity``). An albedo map covers the fabric's size once and repeats.

    Parameters
    ----------
    rig:
        None: the paper's rig for the fabric's size. A ``Rig``: its distances and its sample size. A file or stage:
        its cameras, lights and plane as they are; the cloth goes on the plane by ``read_scene``'s rule.
    strict:
        As ``read_scene``; a missing albedo map is an error then.

    Raises
    ------
    UsdfabError
        As ``read_scene`` for a rig file; also if it holds no camera or no light.
    """
    if rig is None:
        return _swatch(fabric, rig_for(fabric.size), strict)
    if isinstance(rig, Rig):
        return _swatch(fabric, rig, strict)
    stage = open_stage(rig)
    scene = read_scene(stage, fabric_override=fabric, strict=strict)
    for kind, found in (("camera", scene.cameras), ("light", scene.lights)):
        if not found:
            raise UsdfabError(f"the rig has no {kind}", place=scene.path, remedy="write one with `write_rig` and edit")
    return replace(scene, fabrics=tuple(_map_over_sample(surface) for surface in scene.fabrics))


def sample_scene(fabric: FabricParameters, rig: Rig | None = None, *, strict: bool = False) -> Scene:
    """``swatch_scene`` under ``rig``, or the paper's, with the fabric's size in view, whatever the rig's own is."""
    return swatch_scene(fabric, rig.with_sample(fabric.size) if rig is not None else None, strict=strict)


def _swatch(fabric: FabricParameters, rig: Rig, strict: bool) -> Scene:
    problems = Problems(strict=strict)
    points, uv = _plane(rig)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    normals = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (2, 3, 3))
    mesh = Mesh(f"{RIG_PATH}/Sample", points, triangles, normals, uv[triangles], np.zeros(2, dtype=np.int32), True)
    to_world = np.eye(4)
    to_world[2, 3] = rig.camera_height
    camera = Camera(f"{RIG_PATH}/Camera", to_world, np.asarray(rig.tan_half), np.zeros(2), 0.0)
    lights: tuple[Light, ...] = rig.lights or tuple(
        PointLight(f"{RIG_PATH}/{name}", np.asarray(position), np.full(3, rig.light_intensity / rig.lamps))
        for name, position in zip(_lamp_names(rig), rig.light_positions, strict=True)
    )
    look = Material(f"{RIG_PATH}/Fabric", 0, np.asarray(preview_color(fabric)), preview_roughness(fabric), 0.0, 1.0)
    surface = _map_over_sample(FabricSurface(look.path, fabric, 1.0, albedo_map(fabric, look.path, problems)))
    return Scene("swatch", (mesh,), (look,), (surface,), (camera,), lights, tuple(problems.warnings), "Z")


def _map_over_sample(surface: FabricSurface) -> FabricSurface:
    """The surface with its albedo map, if any, over ``fabric.size`` of cloth instead of over one unit of uv."""
    if surface.albedo_map is None:
        return surface
    transform = surface.albedo_map.uv_transform.copy()
    transform[:, :2] *= surface.meters_per_uv / np.asarray(surface.fabric.size)
    return replace(surface, albedo_map=replace(surface.albedo_map, uv_transform=transform))
