"""A small stage of everything that production stages hold, seen from straight above, in any unit and up axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.imaging import write_image
from usdfab.usd.fabric_io import define_fabric_material

CELL = 0.02
"""Side in metres of the squares of cloth; the picture shows 3 x 2 of them."""
RED, BLUE = (0.8, 0.03, 0.03), (0.03, 0.05, 0.8)
HEIGHT = 0.3
LIGHTS = ("DistantLight", "SphereLight", "point", "DiskLight", "RectLight", "CylinderLight", "DomeLight")


def fabric(color: Sequence[float], **changes) -> FabricParameters:
    """5 mm of plain weave with thick, rough fibers: little noise, quick to build."""
    values = {
        "count": 10,
        "radius": 2.3e-4,
        "fiber_count": 10,
        "roughness_longitudinal": 0.6,
        "roughness_azimuthal": 0.5,
    }
    values |= {"roughness_primary": 0.6, "albedo": tuple(color)}
    yarn = YarnParameters(**(values | changes))
    return FabricParameters(weave_from_name("plain"), (5e-3, 5e-3), yarn, yarn)


@dataclass
class Builder:
    """Writes physical things, in metres with z up, into a stage of another unit or up axis."""

    meters: float = 1.0
    up: str = "Z"
    left_handed: bool = False
    stage: Usd.Stage = field(init=False)

    def __post_init__(self) -> None:
        self.stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageMetersPerUnit(self.stage, self.meters)
        UsdGeom.SetStageUpAxis(self.stage, self.up)
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/World").GetPrim())

    def vector(self, p: Sequence[float]) -> tuple[float, float, float]:
        x, y, z = p
        return (x, y, z) if self.up == "Z" else (x, z, -y)

    def point(self, p: Sequence[float]) -> Gf.Vec3d:
        return Gf.Vec3d(*(float(c) / self.meters for c in self.vector(p)))

    def mesh(
        self, path: str, points: Sequence[Sequence[float]], faces: list[list[int]], uv=None, scheme: str = "none"
    ) -> UsdGeom.Mesh:
        mesh = UsdGeom.Mesh.Define(self.stage, path)
        mesh.CreatePointsAttr([Gf.Vec3f(self.point(p)) for p in points])
        order = -1 if self.left_handed else 1
        mesh.CreateOrientationAttr("leftHanded" if self.left_handed else "rightHanded")
        mesh.CreateFaceVertexCountsAttr([len(f) for f in faces])
        mesh.CreateFaceVertexIndicesAttr([i for f in faces for i in f[::order]])
        mesh.CreateSubdivisionSchemeAttr(scheme)
        if uv is not None:
            st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
            st.Set([Gf.Vec2f(*map(float, c)) for c in uv])
        return mesh

    def sheet(self, path: str, center: Sequence[float], side: float = 0.9 * CELL, parts: int = 2, **options):
        """A level square of ``parts`` x ``parts`` quads with uv from 0 to 1."""
        a = np.linspace(0.0, 1.0, parts + 1)
        uv = [(u, v) for v in a for u in a]
        points = [(center[0] + side * (u - 0.5), center[1] + side * (v - 0.5), center[2]) for u, v in uv]
        n = parts + 1
        faces = [
            [j * n + i, j * n + i + 1, (j + 1) * n + i + 1, (j + 1) * n + i] for j in range(parts) for i in range(parts)
        ]
        return self.mesh(path, points, faces, options.pop("uv", uv), **options)

    def camera(self, path: str = "/World/Camera", center: Sequence[float] = (0, 0)) -> UsdGeom.Camera:
        """Looks down from ``HEIGHT`` on 3 x 2 cells."""
        camera = UsdGeom.Camera.Define(self.stage, path)
        camera.CreateFocalLengthAttr(50.0 / 1000 * 10 / self.meters)
        for attribute, cells in ((camera.CreateHorizontalApertureAttr(), 3), (camera.CreateVerticalApertureAttr(), 2)):
            attribute.Set(cells * CELL / HEIGHT * camera.GetFocalLengthAttr().Get())
        xform = UsdGeom.Xformable(camera)
        xform.AddTranslateOp().Set(self.point((*center, HEIGHT)))
        if self.up == "Y":
            xform.AddRotateXOp().Set(-90.0)
        return camera

    def light(self, kind: str, path: str | None = None):
        """One light of a kind, beside the picture and shining down, of about the same brightness as the others."""
        path = path or f"/World/Light_{kind}"
        light = getattr(UsdLux, "SphereLight" if kind == "point" else kind).Define(self.stage, path)
        turn = UsdGeom.Xformable(light)
        if kind not in ("DomeLight", "DistantLight"):
            angle = 0.4 * np.pi * LIGHTS.index(kind)  # lights hide one another: each has a place of its own
            turn.AddTranslateOp().Set(self.point((0.09 * np.cos(angle), 0.09 * np.sin(angle), 0.15)))
        if self.up == "Y":
            turn.AddRotateXOp().Set(-90.0)  # UsdLux shines along -z, which is then down
        size = 0.04 / self.meters
        for name in ("radius", "length", "width", "height"):
            attribute = light.GetPrim().GetAttribute(f"inputs:{name}")
            if attribute:
                attribute.Set(0.25 * size if kind in ("CylinderLight", "point") and name == "radius" else size)
        if kind == "point":
            light.CreateTreatAsPointAttr(True)
        intensity = {"DomeLight": 0.5, "DistantLight": 5.0, "point": 400.0, "DiskLight": 40.0}.get(kind, 100.0)
        light.CreateIntensityAttr(intensity)
        if kind == "DistantLight":
            light.CreateAngleAttr(3.0)
            light.CreateNormalizeAttr(False)
            light.CreateExposureAttr(9.0)  # of a small cone
        return light

    def bind(self, prim, material: UsdShade.Material) -> None:
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)

    def surface(self, path: str, texture: Path | None = None, **inputs) -> UsdShade.Material:
        """A UsdPreviewSurface, its diffuseColor from an image where one is given."""
        material = UsdShade.Material.Define(self.stage, path)
        shader = UsdShade.Shader.Define(self.stage, f"{path}/Surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        kinds = {"diffuseColor": Sdf.ValueTypeNames.Color3f, "emissiveColor": Sdf.ValueTypeNames.Color3f}
        for name, value in inputs.items():
            shader.CreateInput(name, kinds.get(name, Sdf.ValueTypeNames.Float)).Set(value)
        if texture is not None:
            reader = UsdShade.Shader.Define(self.stage, f"{path}/Reader")
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
            image = UsdShade.Shader.Define(self.stage, f"{path}/Image")
            image.CreateIdAttr("UsdUVTexture")
            image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(str(texture))
            image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
            image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
            target = shader.CreateInput("diffuseColor", kinds["diffuseColor"])
            target.ConnectToSource(image.ConnectableAPI(), "rgb")
        shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        return material

    def save(self, path: Path) -> Path:
        self.stage.GetRootLayer().Export(str(path))
        return path


def halves(path: Path, left: Sequence[float], right: Sequence[float]) -> Path:
    """A PNG of two linear colours."""
    pixels = np.zeros((8, 16, 3), dtype=np.float32)
    pixels[:, :8], pixels[:, 8:] = left, right
    write_image(path, pixels)
    return path


def cell(column: int, row: int) -> tuple[float, float]:
    """Centre of a cell of the picture, column 0 at the left, row 0 at the bottom."""
    return (column - 1) * CELL, (row - 0.5) * CELL


def showroom(
    texture: Path, lights: Sequence[str] = ("DomeLight",), change: Callable[[Builder], None] | None = None, **options
) -> Builder:
    """Six cells: bottom, a red fabric; red and blue on GeomSubsets; a textured surface. Top: displayColor; four copies
    of a red cloth by a point instancer; a blue fabric on a cube refined to a ball, without texture coordinates.

    Sheets that are not to be seen hang above it all.
    """
    b = Builder(**options)
    UsdGeom.Scope.Define(b.stage, "/World/Looks")
    red = define_fabric_material(b.stage, "/World/Looks/Red", fabric(RED))
    loose = fabric(BLUE, ply_count=2, twist=0.25, ply_twist=-0.2, flyaway_density=500.0, flyaway_length=5e-4)
    blue = define_fabric_material(b.stage, "/World/Looks/Blue", loose)

    b.bind(b.sheet("/World/Red", (*cell(0, 0), 0)), red)

    both = b.sheet("/World/Both", (*cell(1, 0), 0))
    for name, faces, material in (("left", [0, 2], red), ("right", [1, 3], blue)):
        b.bind(UsdShade.MaterialBindingAPI(both).CreateMaterialBindSubset(name, faces), material)

    b.bind(b.sheet("/World/Textured", (*cell(2, 0), 0)), b.surface("/World/Looks/Paint", texture, roughness=1.0))

    shown = b.sheet("/World/Shown", (*cell(0, 1), 0))
    shown.CreateDisplayColorAttr([Gf.Vec3f(0.1, 0.7, 0.1)])

    instancer = UsdGeom.PointInstancer.Define(b.stage, "/World/Copies")
    b.bind(b.sheet("/World/Copies/Prototypes/Patch", (0, 0, 0), 0.4 * CELL), red)
    instancer.CreatePrototypesRel().AddTarget("/World/Copies/Prototypes/Patch")
    x, y = cell(1, 1)
    places = [(x + i * 0.23 * CELL, y + j * 0.23 * CELL, 0) for i in (-1, 1) for j in (-1, 1)]
    instancer.CreatePositionsAttr([Gf.Vec3f(b.point(p)) for p in places])
    instancer.CreateProtoIndicesAttr([0, 0, 0, 0])

    x, y = cell(2, 1)
    half = 0.4 * CELL
    cube = [
        (x + half * (2 * i - 1), y + half * (2 * j - 1), half * (2 * k - 1))
        for k in (0, 1)
        for j in (0, 1)
        for i in (0, 1)
    ]
    faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    cage = b.mesh("/World/Cage", cube, faces, scheme="catmullClark")
    b.bind(cage, blue)

    for name in ("Invisible", "Proxy", "Guide"):
        hidden = b.sheet(f"/World/{name}", (0, 0, 0.1), 0.5)
        if name == "Invisible":
            hidden.MakeInvisible()
        else:
            hidden.CreatePurposeAttr(name.lower())
    b.camera()
    for kind in lights:
        b.light(kind)
    if change:
        change(b)
    return b
