"""The capture rig: as a file, as a scene, and the two alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pxr import Sdf, Usd, UsdGeom, UsdLux

from usdfab.errors import UsdfabError
from usdfab.usd.check import check
from usdfab.usd.read_rig import read_rig
from usdfab.usd.read_scene import read_scene
from usdfab.usd.rig import PLANE_FACTOR, Rig, ring_rig, sample_scene, swatch_scene, write_rig

SIZE = (5e-3, 3e-3)


def corners_in_view(scene):
    """Where the four corners of the picture meet z = 0, as (4, 2) x and y."""
    camera = scene.cameras[0]
    film = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) + camera.offset
    rays = np.column_stack([film * camera.tan_half, -np.ones(4)]) @ camera.to_world[:3, :3].T
    origin = camera.to_world[:3, 3]
    return (origin - rays * (origin[2] / rays[:, 2:]))[:, :2]


def uv_at(mesh, xy):
    """uv of a flat mesh at points in the plane, from its first triangle (affine)."""
    p, uv = mesh.points[mesh.triangles[0]][:, :2], mesh.uv[0]
    basis = np.linalg.inv(np.column_stack([p[1] - p[0], p[2] - p[0]]))
    return uv[0] + (xy - p[0]) @ basis.T @ np.stack([uv[1] - uv[0], uv[2] - uv[0]])


@pytest.mark.parametrize("as_file", [False, True])
def test_the_picture_is_exactly_the_sample(as_file, fabric, tmp_path):
    fabric = replace(fabric, size=SIZE)
    rig = write_rig(tmp_path / "rig.usda", SIZE) if as_file else None
    scene = swatch_scene(fabric, rig)
    cloth = uv_at(scene.meshes[0], corners_in_view(scene)) * scene.fabrics[0].meters_per_uv
    np.testing.assert_allclose(cloth, [(0, 0), (SIZE[0], 0), SIZE, (0, SIZE[1])], atol=1e-9)
    np.testing.assert_allclose(np.ptp(scene.meshes[0].points, axis=0)[:2], PLANE_FACTOR * np.array(SIZE), rtol=1e-6)
    assert scene.fabrics[0].fabric == fabric
    assert scene.materials[scene.meshes[0].face_material[0]].fabric == 0
    assert scene.warnings == () and scene.up_axis == "Z"


def test_file_and_memory_agree(fabric, tmp_path):
    fabric = replace(fabric, size=SIZE)
    memory, file = swatch_scene(fabric), swatch_scene(fabric, write_rig(tmp_path / "r.usda", SIZE))
    np.testing.assert_allclose(memory.lights[0].position, file.lights[0].position)
    np.testing.assert_allclose(memory.lights[0].intensity, file.lights[0].intensity, rtol=1e-6)
    np.testing.assert_allclose(memory.cameras[0].to_world, file.cameras[0].to_world)
    np.testing.assert_allclose(memory.cameras[0].tan_half, file.cameras[0].tan_half, rtol=1e-6)
    np.testing.assert_allclose(memory.meshes[0].points, file.meshes[0].points, atol=1e-9)
    np.testing.assert_allclose(memory.meshes[0].uv, file.meshes[0].uv, atol=1e-9)


def test_geometry_of_the_paper(fabric):
    scene = swatch_scene(fabric)
    np.testing.assert_allclose(scene.cameras[0].to_world[:3, 3], [0, 0, 0.06])
    np.testing.assert_allclose(scene.lights[0].position, [0.01, 0, 0.04])


def test_a_white_diffuse_sample_has_radiance_one(fabric):
    light = swatch_scene(fabric).lights[0]
    x, y = np.meshgrid(np.linspace(-2.5e-3, 2.5e-3, 11), np.linspace(-2.5e-3, 2.5e-3, 11))
    to_light = light.position - np.stack([x, y, 0 * x], axis=-1)
    distance = np.linalg.norm(to_light, axis=-1)
    radiance = light.intensity[0] * to_light[..., 2] / distance**3 / math.pi
    assert radiance[5, 5] == pytest.approx(1.0)
    assert abs(radiance - 1).max() < 0.1


def test_own_distances(fabric, tmp_path):
    rig = Rig((1e-3, 1e-3), camera_height=0.1, light_height=0.02, light_side=0.0)
    scene = read_scene(write_rig(tmp_path / "r.usdc", (2e-3, 2e-3), rig=rig))
    assert scene.cameras[0].to_world[2, 3] == pytest.approx(0.1)
    np.testing.assert_allclose(scene.cameras[0].tan_half, 0.01, rtol=1e-6)
    np.testing.assert_allclose(scene.lights[0].position, [0, 0, 0.02], rtol=1e-6)
    assert swatch_scene(fabric, rig).cameras[0].to_world[2, 3] == 0.1


def test_large_samples_are_seen_from_farther_away(fabric):
    scene = swatch_scene(replace(fabric, size=(0.3, 0.3)))
    np.testing.assert_allclose(scene.cameras[0].tan_half, 0.25)
    np.testing.assert_allclose(corners_in_view(scene)[2], [0.15, 0.15])


def test_the_file_is_clean(tmp_path):
    assert check(write_rig(tmp_path / "r.usda", SIZE)) == []


def test_a_rig_in_other_units_and_axes(fabric, tmp_path):
    path = write_rig(tmp_path / "r.usda", SIZE)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    root = UsdGeom.Xform.Define(stage, "/R")
    root.GetPrim().GetReferences().AddReference(str(path))
    root.AddScaleOp().Set((1000, 1000, 1000))
    scene = swatch_scene(replace(fabric, size=SIZE), stage)
    cloth = uv_at(scene.meshes[0], corners_in_view(scene)) * scene.fabrics[0].meters_per_uv
    np.testing.assert_allclose(cloth[2], SIZE, rtol=1e-5)
    np.testing.assert_allclose(scene.lights[0].intensity, swatch_scene(fabric).lights[0].intensity, rtol=1e-5)


@given(elevation=st.floats(0.2, 1.5), lamps=st.integers(1, 12), azimuth=st.floats(-7, 7))
def test_ring_lamps_together_are_as_bright_as_one(elevation, lamps, azimuth):
    rig = ring_rig(SIZE, elevation, lamps, azimuth)
    radiance = 0.0
    for x, y, z in rig.light_positions:
        distance = math.hypot(x, y, z)
        assert math.asin(z / distance) == pytest.approx(elevation)
        radiance += rig.light_intensity / lamps * z / distance**3 / math.pi
    assert radiance == pytest.approx(1.0)
    if lamps > 1:
        np.testing.assert_allclose(np.sum(rig.light_positions, axis=0)[:2], 0, atol=1e-12)


def test_a_ring_in_a_file_and_in_memory_agree(fabric, tmp_path):
    rig = ring_rig(SIZE, 0.8, 5, 0.3)
    fabric = replace(fabric, size=SIZE)
    path = write_rig(tmp_path / "r.usda", SIZE, rig=rig)
    assert check(path) == []
    file, memory = swatch_scene(fabric, path), sample_scene(fabric, rig.with_sample((1e-3, 1e-3)))
    assert len(file.lights) == len(memory.lights) == 5
    for one, other in zip(file.lights, memory.lights, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-9)
        np.testing.assert_allclose(one.intensity, other.intensity, rtol=1e-6)


def test_a_rig_is_read_from_wherever_it_stands(fabric, tmp_path):
    """Turned, moved, in millimetres and y up: the same rig in its own frame."""
    own = replace(ring_rig(SIZE, 0.8, 2, 0.3), blur=-2e-5, contrast=1.3)
    path = write_rig(tmp_path / "r.usda", SIZE, rig=own)
    stage = Usd.Stage.CreateNew(str(tmp_path / "moved.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    root = UsdGeom.Xform.Define(stage, "/R")
    root.GetPrim().GetReferences().AddReference(str(path))
    root.AddTranslateOp().Set((30, -20, 70))
    root.AddRotateXYZOp().Set((-90, 35, 20))
    root.AddScaleOp().Set((1000, 1000, 1000))
    stage.Save()
    rig = read_rig(tmp_path / "moved.usda")
    np.testing.assert_allclose(rig.sample_size, SIZE, rtol=1e-5)
    assert rig.camera_height == pytest.approx(own.camera_height, rel=1e-5)
    assert rig.blur == pytest.approx(own.blur, rel=1e-6)
    assert rig.contrast == own.contrast
    for light, position in zip(rig.lights, own.light_positions, strict=True):
        np.testing.assert_allclose(light.position, position, atol=1e-8)
    fabric = replace(fabric, size=SIZE)
    seen, known = sample_scene(fabric, rig), sample_scene(fabric, own)
    np.testing.assert_allclose(seen.cameras[0].tan_half, known.cameras[0].tan_half, rtol=1e-5)
    np.testing.assert_allclose(seen.lights[1].intensity, known.lights[1].intensity, rtol=1e-5)
    with pytest.raises(UsdfabError, match="cannot be written"):
        write_rig(tmp_path / "again.usda", SIZE, rig=rig)


def test_all_kinds_of_light_move_with_the_rig(tmp_path):
    path = write_rig(tmp_path / "r.usda", SIZE)
    stage = Usd.Stage.Open(str(path))
    area = UsdLux.RectLight.Define(stage, "/Rig/Panel")
    area.AddTranslateOp().Set((0.02, 0, 0.03))
    UsdLux.DistantLight.Define(stage, "/Rig/Sun")
    UsdLux.DomeLight.Define(stage, "/Rig/Sky")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/Rig/Camera"))
    camera.CreateExposureAttr(1.0)
    stage.Save()
    lights = {light.path: light for light in read_rig(path).lights}
    plain = {light.path: light for light in read_scene(path).lights}
    np.testing.assert_allclose(lights["/Rig/Panel"].corner, plain["/Rig/Panel"].corner, atol=1e-9)
    np.testing.assert_allclose(lights["/Rig/Sun"].direction, (0, 0, -1), atol=1e-9)
    for name, field in (("Panel", "radiance"), ("Sun", "irradiance"), ("Sky", "radiance"), ("Lamp", "intensity")):
        doubled, one = (getattr(found[f"/Rig/{name}"], field) for found in (lights, plain))
        np.testing.assert_allclose(doubled, 2.0 * np.asarray(one))


def test_rigs_that_a_photo_cannot_have(tmp_path):
    def changed(name, change):
        path = write_rig(tmp_path / name, SIZE)
        stage = Usd.Stage.Open(str(path))
        change(stage)
        stage.Save()
        return path

    def tilt(stage):
        UsdGeom.Xformable(stage.GetPrimAtPath("/Rig/Camera")).AddRotateXOp().Set(3.0)

    def away(stage):
        UsdGeom.Xformable(stage.GetPrimAtPath("/Rig/Camera")).AddRotateXOp().Set(90.0)

    def aside(stage):
        UsdGeom.Camera(stage.GetPrimAtPath("/Rig/Camera")).CreateHorizontalApertureOffsetAttr(3.0)

    def endless(stage):
        stage.GetPrimAtPath("/Rig/Camera").CreateAttribute("usdfab:blur", Sdf.ValueTypeNames.Double).Set(float("nan"))

    def named(stage):
        stage.GetPrimAtPath("/Rig/Camera").CreateAttribute("usdfab:blur", Sdf.ValueTypeNames.String).Set("soft")

    def inverted(stage):
        stage.GetPrimAtPath("/Rig/Camera").CreateAttribute("usdfab:contrast", Sdf.ValueTypeNames.Double).Set(-1.0)

    for name, change, words in (
        ("i.usda", inverted, "-1.0 is not a contrast above 0"),
        ("g.usda", endless, "nan is not a length"),
        ("h.usda", named, "'soft' is not a length"),
        ("a.usda", tilt, "3.0 degrees off its normal"),
        ("b.usda", aside, "offset film"),
        ("c.usda", lambda stage: stage.RemovePrim("/Rig/Lamp"), "no light"),
        ("d.usda", lambda stage: stage.RemovePrim("/Rig/Camera"), "no camera"),
        ("e.usda", away, "nothing lies on the axis"),
        ("f.usda", lambda stage: stage.RemovePrim("/Rig/Sample"), "no visible mesh"),
    ):
        with pytest.raises(UsdfabError, match=words):
            read_rig(changed(name, change))


def test_bad_rigs(fabric, tmp_path):
    for bad in ((0.0, 1e-3), (1e-3, math.nan), (1e-3, 50.0)):
        with pytest.raises(UsdfabError, match="sample_size"):
            write_rig(tmp_path / "r.usda", bad)
    with pytest.raises(UsdfabError, match="camera_height"):
        Rig((1e-3, 1e-3), camera_height=0)
    path = write_rig(tmp_path / "r.usda", SIZE)
    with pytest.raises(UsdfabError, match="exists"):
        write_rig(path, SIZE)
    for name, kind in (("Camera", "camera"), ("Lamp", "light"), ("Sample", "mesh")):
        stage = Usd.Stage.Open(str(path))
        stage.GetPrimAtPath(f"/Rig/{name}").SetActive(False)
        with pytest.raises(UsdfabError, match=f"no .*{kind}"):
            swatch_scene(fabric, stage)
        stage.Reload()
