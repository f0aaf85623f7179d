"""Lenses and shutters."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, UsdGeom, Vt

from usdfab.usd.read_scene import read_scene


@pytest.fixture
def camera(cloth_stage):
    """The cloth stage's camera, its shutter open from -0.25 to 0.25 frames."""
    cloth_stage.SetStartTimeCode(1)
    cloth_stage.SetEndTimeCode(9)
    camera = UsdGeom.Camera(cloth_stage.GetPrimAtPath("/World/Camera"))
    camera.CreateShutterOpenAttr(-0.25)
    camera.CreateShutterCloseAttr(0.25)
    return camera


@pytest.mark.parametrize("meters", [1.0, 0.01])
def test_lens(cloth_stage, meters):
    UsdGeom.SetStageMetersPerUnit(cloth_stage, meters)
    camera = UsdGeom.Camera(cloth_stage.GetPrimAtPath("/World/Camera"))
    read = read_scene(cloth_stage).cameras[0]
    assert (read.lens_radius, read.focus_distance) == (0.0, 0.0)
    camera.CreateFocalLengthAttr(50.0)
    camera.CreateFStopAttr(2.0)
    camera.CreateFocusDistanceAttr(3.0)
    read = read_scene(cloth_stage).cameras[0]
    # 50 tenths of a unit through f/2: an opening of 2.5 units
    assert read.lens_radius == pytest.approx(1.25 * meters)
    assert read.focus_distance == pytest.approx(3.0 * meters)
    camera.CreateFocusDistanceAttr(0.0)
    scene = read_scene(cloth_stage)
    assert scene.cameras[0].lens_radius == 0.0 and "everything is in focus" in scene.warnings[0]


def test_nothing_moves_nothing_is_doubled(cloth_stage, camera):
    scene = read_scene(cloth_stage)
    assert scene.cameras[0].to_world_close is None
    assert scene.meshes[0].points_close is None and scene.meshes[0].placements_close is None


def test_moving_camera_and_mesh(cloth_stage, camera):
    move = UsdGeom.Xformable(camera.GetPrim()).GetOrderedXformOps()[0]
    for time in (0.0, 10.0):
        move.Set(Gf.Vec3d(0, 0, 2 + time), time)
    lift = UsdGeom.Xformable(cloth_stage.GetPrimAtPath("/World/Cloth")).AddTranslateOp()
    for time in (0.0, 10.0):
        lift.Set(Gf.Vec3d(time, 0, 0), time)
    scene = read_scene(cloth_stage, time=4.0)
    camera_read, mesh = scene.cameras[0], scene.meshes[0]
    assert (camera_read.to_world[2, 3], camera_read.to_world_close[2, 3]) == pytest.approx((5.75, 6.25))
    assert (mesh.points[0, 0], mesh.points_close[0, 0]) == pytest.approx((3.75, 4.25))
    still = read_scene(cloth_stage, time=4.0, shutter=False)
    assert still.cameras[0].to_world[2, 3] == pytest.approx(6.0) and still.cameras[0].to_world_close is None
    assert still.meshes[0].points[0, 0] == pytest.approx(4.0) and still.meshes[0].points_close is None
    # the chosen camera's shutter counts
    UsdGeom.Camera.Define(cloth_stage, "/World/Fast")
    assert read_scene(cloth_stage, time=4.0, camera="/World/Fast").meshes[0].points_close is None
    camera.GetShutterCloseAttr().Set(-1.0)
    scene = read_scene(cloth_stage, time=4.0)
    assert scene.meshes[0].points_close is None and "closes before it opens" in scene.warnings[0]


def raised(points, height):
    return [Gf.Vec3f(p[0], p[1], height) for p in points]


def test_points_that_move(cloth_stage, camera):
    mesh = UsdGeom.Mesh(cloth_stage.GetPrimAtPath("/World/Cloth"))
    points = mesh.GetPointsAttr().Get()
    for time in (0.0, 10.0):
        mesh.GetPointsAttr().Set(raised(points, time), time)
    read = read_scene(cloth_stage, time=4.0).meshes[0]
    np.testing.assert_allclose(read.points[:, 2], 3.75)
    np.testing.assert_allclose(read.points_close[:, 2], 4.25)
    # also through refinement
    mesh.GetSubdivisionSchemeAttr().Set("catmullClark")
    read = read_scene(cloth_stage, time=4.0).meshes[0]
    np.testing.assert_allclose(read.points_close - read.points, np.tile([0, 0, 0.5], (len(read.points), 1)), atol=1e-6)


def test_velocities(cloth_stage, camera):
    cloth_stage.SetTimeCodesPerSecond(24)
    mesh = UsdGeom.Mesh(cloth_stage.GetPrimAtPath("/World/Cloth"))
    points = mesh.GetPointsAttr().Get()
    mesh.GetPointsAttr().Set(points, 4.0)
    mesh.CreateVelocitiesAttr().Set(Vt.Vec3fArray([Gf.Vec3f(0, 0, 48)] * 4), 4.0)
    read = read_scene(cloth_stage, time=4.0).meshes[0]
    # 48 units a second are 2 a frame
    np.testing.assert_allclose(read.points[:, 2], -0.5)
    np.testing.assert_allclose(read.points_close[:, 2], 0.5)


def test_changing_faces_are_not_blurred(cloth_stage, camera):
    mesh = UsdGeom.Mesh(cloth_stage.GetPrimAtPath("/World/Cloth"))
    points = list(mesh.GetPointsAttr().Get())
    mesh.GetPointsAttr().Set(points, 4.0)
    mesh.GetPointsAttr().Set([*points, Gf.Vec3f(2, 2, 0)], 4.1)
    mesh.GetFaceVertexCountsAttr().Set([4], 4.0)
    mesh.GetFaceVertexCountsAttr().Set([4, 3], 4.1)
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3], 4.0)
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3, 1, 4, 2], 4.1)
    scene = read_scene(cloth_stage, time=4.0)
    assert scene.meshes[0].points_close is None
    assert "/World/Cloth: points or faces change while the shutter is open" in scene.warnings[0]


def test_yarns_stay_in_place_on_cloth_that_stretches(cloth_stage, camera):
    mesh = UsdGeom.Mesh(cloth_stage.GetPrimAtPath("/World/Cloth"))
    points = mesh.GetPointsAttr().Get()
    for time, factor in ((0.0, 1.0), (10.0, 2.0)):
        mesh.GetPointsAttr().Set([factor * p for p in points], time)
    scales = [read_scene(cloth_stage, time=t).fabrics[0].meters_per_uv for t in (0.0, 5.0, 9.0)]
    assert scales == pytest.approx([2.0, 2.0, 2.0])
