"""The capture rig: as a file, as a scene, and the two alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.check import check
from usdfab.usd.read_scene import read_scene
from usdfab.usd.rig import PLANE_FACTOR, Rig, swatch_scene, write_rig

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
