"""UsdLux semantics against values worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux

from usdfab.errors import UsdfabError
from usdfab.usd.read_lights import matrix, read_light
from usdfab.usd.read_scene import read_scene
from usdfab.usd.scene import (
    CylinderLight,
    DiskLight,
    DistantLight,
    DomeLight,
    PointLight,
    RectLight,
    SphereLight,
)


def stage_with(kind: str, up: str = "Z", **inputs):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    light = getattr(UsdLux, kind).Define(stage, "/L")
    for name, value in inputs.items():
        attribute = light.GetPrim().GetAttribute(f"inputs:{name}") or light.GetPrim().GetAttribute(name)
        assert attribute, name
        attribute.Set(value)
    return stage, light


def read(stage: Usd.Stage, meters_per_unit: float = 1.0):
    prim = stage.GetPrimAtPath("/L")
    to_world = matrix(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
    return read_light(prim, to_world, meters_per_unit, Usd.TimeCode.Default())


def light_of(kind: str, **inputs):
    stage, _ = stage_with(kind, **inputs)
    light, warnings = read(stage)
    assert warnings == []
    return light


def test_intensity_exposure_color():
    light = light_of("SphereLight", intensity=3.0, exposure=2.0, color=Gf.Vec3f(1, 0.5, 0.25), radius=0.1)
    assert isinstance(light, SphereLight)
    np.testing.assert_allclose(light.radiance, [12, 6, 3])
    assert light.radius == pytest.approx(0.1)


def test_color_temperature():
    warm = light_of("SphereLight", enableColorTemperature=True, colorTemperature=3000.0)
    np.testing.assert_allclose(warm.radiance, UsdLux.BlackbodyTemperatureAsRgb(3000), rtol=1e-6)
    assert warm.radiance[0] > 2 * warm.radiance[2]
    np.testing.assert_allclose(light_of("SphereLight", colorTemperature=3000.0).radiance, 1)


def test_sphere_normalize():
    # L = X / (4 pi r^2): 4 pi 0.25 = pi
    light = light_of("SphereLight", intensity=math.pi, radius=0.5, normalize=True)
    np.testing.assert_allclose(light.radiance, 1, rtol=1e-6)


@pytest.mark.parametrize("radius", [0.5, 1e-3])
def test_point_is_a_far_sphere(radius):
    # I = pi r^2 L; with normalize X / 4 for any radius
    light = light_of("SphereLight", intensity=2.0, radius=radius, treatAsPoint=True)
    assert isinstance(light, PointLight)
    np.testing.assert_allclose(light.intensity, 2 * math.pi * radius**2, rtol=1e-6)
    normalized = light_of("SphereLight", intensity=2.0, radius=radius, treatAsPoint=True, normalize=True)
    np.testing.assert_allclose(normalized.intensity, 0.5, rtol=1e-6)


def test_normalized_point_of_radius_zero():
    light = light_of("SphereLight", intensity=8.0, radius=0.0, treatAsPoint=True, normalize=True)
    np.testing.assert_allclose(light.intensity, 2)


def test_point_and_sphere_light_a_far_surface_alike():
    sphere = light_of("SphereLight", intensity=5.0, radius=0.2)
    point = light_of("SphereLight", intensity=5.0, radius=0.2, treatAsPoint=True)
    # Irradiance of a sphere at distance d on a surface facing it: pi L (r/d)^2, exactly.
    np.testing.assert_allclose(math.pi * sphere.radiance * (0.2 / 7) ** 2, point.intensity / 7**2, rtol=1e-6)


def test_scale_enlarges_lights():
    stage, light = stage_with("SphereLight", radius=0.5, intensity=4 * math.pi, normalize=True)
    light.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    light.AddScaleOp().Set(Gf.Vec3f(2))
    sphere, _ = read(stage)
    np.testing.assert_allclose(sphere.center, [1, 2, 3])
    assert sphere.radius == pytest.approx(1.0)
    np.testing.assert_allclose(sphere.radiance, 1, rtol=1e-6)


def test_an_ellipsoid_is_reported():
    stage, light = stage_with("SphereLight", radius=0.5)
    light.AddScaleOp().Set(Gf.Vec3f(1, 1, 8))
    sphere, warnings = read(stage)
    assert sphere.radius == pytest.approx(1.0)
    assert "ellipsoid" in warnings[0]


def test_rect():
    stage, light = stage_with("RectLight", width=4.0, height=2.0, intensity=16.0, normalize=True)
    light.AddTranslateOp().Set(Gf.Vec3d(0, 0, 10))
    rect, warnings = read(stage, 0.01)
    assert isinstance(rect, RectLight) and warnings == []
    np.testing.assert_allclose(rect.corner, [-0.02, -0.01, 0.1])
    np.testing.assert_allclose(rect.edge_u, [0.04, 0, 0])
    np.testing.assert_allclose(rect.edge_v, [0, 0.02, 0])
    np.testing.assert_allclose(rect.normal, [0, 0, -1])
    # normalize divides by the area in stage units
    np.testing.assert_allclose(rect.radiance, 2)


def test_rect_emits_along_minus_z_also_when_turned_or_mirrored():
    stage, light = stage_with("RectLight")
    light.AddRotateXOp().Set(90.0)
    np.testing.assert_allclose(read(stage)[0].normal, [0, 1, 0], atol=1e-7)
    light.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    np.testing.assert_allclose(read(stage)[0].normal, [0, 1, 0], atol=1e-7)


def test_distant():
    half = math.radians(10)
    plain = light_of("DistantLight", intensity=2.0, angle=20.0)
    assert isinstance(plain, DistantLight)
    assert plain.half_angle == pytest.approx(half)
    np.testing.assert_allclose(plain.direction, [0, 0, -1])
    np.testing.assert_allclose(plain.irradiance, 2 * math.pi * math.sin(half) ** 2, rtol=1e-6)
    np.testing.assert_allclose(light_of("DistantLight", intensity=2.0, angle=20.0, normalize=True).irradiance, 2)
    for normalize in (False, True):
        parallel = light_of("DistantLight", intensity=2.0, angle=0.0, normalize=normalize)
        np.testing.assert_allclose(parallel.irradiance, 2)
        assert parallel.half_angle == 0.0


def test_distant_wider_than_a_hemisphere():
    wide = light_of("DistantLight", intensity=1.0, angle=240.0)
    np.testing.assert_allclose(wide.irradiance, math.pi)
    normalized = light_of("DistantLight", intensity=1.0, angle=240.0, normalize=True)
    np.testing.assert_allclose(normalized.irradiance, 1 / (2 - math.sin(math.radians(120)) ** 2), rtol=1e-6)


def test_distant_radiance_in_the_cone_gives_the_irradiance():
    light = light_of("DistantLight", intensity=1.0, angle=60.0)
    theta = np.linspace(0, light.half_angle, 20001)
    integral = np.trapezoid(2 * math.pi * np.sin(theta) * np.cos(theta), theta)
    np.testing.assert_allclose(light.irradiance, integral, rtol=1e-6)


def test_dome_orientation():
    dome = light_of("DomeLight", intensity=2.0)
    assert isinstance(dome, DomeLight) and dome.texture_path == "" and dome.texture is None
    np.testing.assert_allclose(dome.to_world, np.eye(4))
    np.testing.assert_allclose(dome.radiance, 2)
    y_up, _ = read(stage_with("DomeLight_1", up="Y")[0])
    np.testing.assert_allclose(y_up.to_world, np.eye(4))
    z_up, _ = read(stage_with("DomeLight_1", up="Z")[0])
    # the documentation of DomeLight_1: the pole goes to +z, the middle of the image to -y
    np.testing.assert_allclose(z_up.to_world @ [0, 1, 0, 0], [0, 0, 1, 0])
    np.testing.assert_allclose(z_up.to_world @ [0, 0, 1, 0], [0, -1, 0, 0])
    fixed, _ = read(stage_with("DomeLight_1", up="Z", poleAxis="Y")[0])
    np.testing.assert_allclose(fixed.to_world, np.eye(4))


def test_dome_ignores_normalize_and_scale():
    stage, light = stage_with("DomeLight", intensity=2.0, normalize=True)
    light.AddRotateZOp().Set(90.0)
    light.AddScaleOp().Set(Gf.Vec3f(5))
    dome, _ = read(stage)
    np.testing.assert_allclose(dome.radiance, 2)
    np.testing.assert_allclose(dome.to_world @ [1, 0, 0, 0], [0, 1, 0, 0], atol=1e-7)


def test_dome_texture_path_is_resolved(tmp_path):
    (tmp_path / "sky.exr").write_bytes(b"")
    stage = Usd.Stage.CreateNew(str(tmp_path / "s.usda"))
    UsdLux.DomeLight.Define(stage, "/L").CreateTextureFileAttr("./sky.exr")
    assert read(stage)[0].texture_path == str(tmp_path / "sky.exr")


@pytest.mark.parametrize("kind", ["PortalLight", "GeometryLight"])
def test_unsupported_lights_are_named(kind):
    light, warnings = read(stage_with(kind)[0])
    assert light is None
    assert f"/L: lights of type {kind}" in warnings[0]


def test_ignored_controls_are_named():
    stage, light = stage_with("SphereLight", diffuse=0.5)
    prim = light.GetPrim()
    UsdLux.ShapingAPI.Apply(prim).CreateShapingConeAngleAttr(30.0)
    UsdLux.LightAPI(prim).GetLightLinkCollectionAPI().CreateExcludesRel().AddTarget("/World")
    text = " ".join(read(stage)[1])
    assert "multipliers" in text and "cones" in text and "linking" in text


@pytest.mark.parametrize(
    ("kind", "inputs", "problem"),
    [
        ("SphereLight", {"radius": -1.0}, "inputs:radius>: -1.0 is not a size"),
        ("SphereLight", {"radius": math.nan}, "inputs:radius>: nan"),
        ("RectLight", {"width": 0.0}, "inputs:width>: 0.0"),
        ("SphereLight", {"intensity": math.inf}, "not finite"),
    ],
)
def test_bad_values(kind, inputs, problem):
    stage, _ = stage_with(kind, **inputs)
    with pytest.raises(UsdfabError, match=problem):
        read(stage)


def test_disk():
    disk = light_of("DiskLight", radius=2.0, intensity=8 * math.pi, normalize=True)
    assert isinstance(disk, DiskLight)
    np.testing.assert_allclose([disk.center, disk.axis_u, disk.axis_v], [[0, 0, 0], [2, 0, 0], [0, 2, 0]])
    np.testing.assert_allclose(disk.normal, [0, 0, -1])
    # L = X / (pi r^2)
    np.testing.assert_allclose(disk.radiance, 2, rtol=1e-6)
    np.testing.assert_allclose(light_of("DiskLight", radius=2.0, intensity=3.0).radiance, 3)


def test_disks_become_ellipses_and_stay_the_right_way_round():
    stage, light = stage_with("DiskLight", radius=1.0, intensity=6 * math.pi, normalize=True)
    light.AddTranslateOp().Set(Gf.Vec3d(0, 0, 10))
    light.AddScaleOp().Set(Gf.Vec3f(-2, 3, 1))
    disk, warnings = read(stage, 0.01)
    assert warnings == []
    np.testing.assert_allclose([disk.center, disk.axis_u, disk.axis_v], [[0, 0, 0.1], [-0.02, 0, 0], [0, 0.03, 0]])
    np.testing.assert_allclose(disk.normal, [0, 0, -1])
    # the area in stage units is 6 pi
    np.testing.assert_allclose(disk.radiance, 1, rtol=1e-6)


def test_cylinder():
    stage, light = stage_with("CylinderLight", radius=0.5, length=4.0, intensity=12 * math.pi, normalize=True)
    light.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    light.AddScaleOp().Set(Gf.Vec3f(0.5, 3, 3))
    cylinder, warnings = read(stage, 0.1)
    assert isinstance(cylinder, CylinderLight) and warnings == []
    np.testing.assert_allclose(cylinder.center, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(cylinder.half, [0.1, 0, 0])
    assert cylinder.radius == pytest.approx(0.15)
    # 2 pi r l = 2 pi 1.5 2 in stage units
    np.testing.assert_allclose(cylinder.radiance, 2, rtol=1e-6)
    np.testing.assert_allclose(light_of("CylinderLight", intensity=5.0).radiance, 5)


def test_flattened_cylinders_are_reported():
    stage, light = stage_with("CylinderLight", radius=1.0)
    light.AddScaleOp().Set(Gf.Vec3f(1, 4, 1))
    cylinder, warnings = read(stage)
    assert cylinder.radius == pytest.approx(2.0) and "elliptic" in warnings[0]


def test_lines():
    # a line's intensity per length is that of any thin cylinder of the same power
    line = light_of("CylinderLight", radius=0.0, length=2.0, intensity=3.0, normalize=True, treatAsLine=True)
    thin = light_of("CylinderLight", radius=1e-3, length=2.0, intensity=3.0, normalize=True)
    np.testing.assert_allclose(line.radiance * line.radius, thin.radiance * thin.radius, rtol=1e-6)
    assert 0 < line.radius < 0.01


NO_AREA = {
    "DiskLight": {"radius": 0.0},
    "CylinderLight": {"length": 0.0},
    "SphereLight": {"radius": 0.0},
    "RectLight": {"height": 0.0},
}


@pytest.mark.parametrize("kind", NO_AREA)
@pytest.mark.parametrize("how", ["size", "scale"])
def test_lights_without_area_are_left_out(kind, how, new_mesh):
    stage, light = stage_with(kind, **(NO_AREA[kind] if how == "size" else {}))
    if how == "scale":
        light.AddScaleOp().Set(Gf.Vec3f(1, 0, 0))
    new_mesh(stage, "/M", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 2]])
    scene = read_scene(stage)
    assert scene.lights == ()
    assert "</L" in scene.warnings[0] and scene.warnings[0].endswith("; the light is left out")
    with pytest.raises(UsdfabError, match="</L"):
        read_scene(stage, strict=True)


@pytest.mark.parametrize("kind", [*NO_AREA, "DistantLight", "DomeLight"])
def test_lights_at_no_place(kind, new_mesh):
    stage, light = stage_with(kind)
    light.AddTranslateOp().Set(Gf.Vec3d(math.nan, 0, 0))
    new_mesh(stage, "/M", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 2]])
    scene = read_scene(stage)
    assert scene.lights == () and "</L>: the transform is not finite; the light is left out" in scene.warnings[0]


def test_domes_whose_image_is_missing(new_mesh):
    stage, _ = stage_with("DomeLight", **{"texture:file": "/nowhere/sky.exr"})
    new_mesh(stage, "/M", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 2]])
    scene = read_scene(stage)
    assert scene.lights == ()
    problem = "the image /nowhere/sky.exr does not exist"
    assert scene.warnings == (f"/L.inputs:texture:file: {problem}; the light is left out",)
