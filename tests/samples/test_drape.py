"""The draped cloth: metric, clear of what it lies on, valid USD, and made by its script."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdLux, UsdValidation

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.fixture(scope="module")
def make_drape():
    sys.path.insert(0, str(SAMPLES))
    try:
        spec = importlib.util.spec_from_file_location("make_drape", SAMPLES / "make_drape.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SAMPLES))
    return module


@pytest.fixture(scope="module")
def stage():
    return Usd.Stage.Open(str(SAMPLES / "drape.usda"))


@pytest.fixture(scope="module")
def cloth(stage):
    return UsdGeom.Mesh(stage.GetPrimAtPath("/World/Cloth"))


@pytest.fixture(scope="module")
def points(cloth, make_drape):
    n = make_drape.QUADS + 1
    return np.array(cloth.GetPointsAttr().Get(), dtype=np.float64).reshape(n, n, 3)


def test_texture_coordinates_are_metric(cloth, points, make_drape):
    """An edge is as long as its share of the cloth, within a few percent."""
    assert np.isfinite(points).all()
    for axis in (0, 1):
        stretch = np.linalg.norm(np.diff(points, axis=axis), axis=-1) / make_drape.SPACING
        assert stretch.min() > 0.94 and stretch.max() < 1.06
        assert abs(stretch.mean() - 1) < 0.005 and np.percentile(abs(stretch - 1), 99) < 0.025
    st = np.array(UsdGeom.PrimvarsAPI(cloth).GetPrimvar("st").Get()).reshape(*points.shape[:2], 2)
    along = np.linspace(0, 1, len(points))
    np.testing.assert_allclose(st[..., 0], np.broadcast_to(along, st.shape[:2]), atol=1e-5)
    np.testing.assert_allclose(st[..., 1], np.broadcast_to(along[:, None], st.shape[:2]), atol=1e-5)


def test_cloth_is_clear_of_the_rest(points, make_drape):
    p = points.reshape(-1, 3)
    assert p[:, 2].min() > 0.5 * make_drape.GAP
    middles = 0.25 * (points[:-1, :-1] + points[1:, :-1] + points[:-1, 1:] + points[1:, 1:]).reshape(-1, 3)
    for q in (p, middles):
        assert np.linalg.norm(q - make_drape.BALL_CENTER, axis=1).min() > make_drape.BALL_RADIUS + 0.0005
    stand, _ = make_drape.stand_mesh()
    foot, pole = stand[stand[:, 2] < 0.008], stand[stand[:, 2] > 0.009]
    away = np.hypot(p[:, 0], p[:, 1])
    assert away[p[:, 2] < 0.008].min(initial=1.0) > np.hypot(foot[:, 0], foot[:, 1]).max()
    assert away[p[:, 2] < pole[:, 2].max() - 0.02].min() > np.hypot(pole[:, 0], pole[:, 1]).max()


def test_cloth_does_not_pass_through_itself(points, make_drape):
    """Vertices that are no neighbours keep apart."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(points.reshape(-1, 3)).query_pairs(0.5 * make_drape.THICKNESS, output_type="ndarray")
    assert len(pairs) == 0


def test_it_has_folds(points):
    """The hem rises and falls, and swings to and fro: seen from above it turns by more than half a circle a side."""
    for hem in (points[0], points[-1], points[:, 0], points[:, -1]):
        assert np.ptp(hem[:, 2]) > 0.04
        heading = np.unwrap(np.arctan2(*np.diff(hem[:, :2], axis=0).T))
        assert abs(np.diff(heading)).sum() > np.pi


@pytest.mark.parametrize("name", ["Cloth", "Ball", "Stand", "Backdrop"])
def test_meshes(stage, name):
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}"))
    p, normals = np.array(mesh.GetPointsAttr().Get()), np.array(mesh.GetNormalsAttr().Get())
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none" and mesh.GetDoubleSidedAttr().Get()
    assert mesh.GetNormalsInterpolation() == "vertex" and len(normals) == len(p)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=2e-4)
    np.testing.assert_allclose(np.array(mesh.GetExtentAttr().Get()), [p.min(axis=0), p.max(axis=0)], atol=1e-6)
    counts, corners = np.array(mesh.GetFaceVertexCountsAttr().Get()), np.array(mesh.GetFaceVertexIndicesAttr().Get())
    assert counts.sum() == len(corners) and set(np.unique(corners)) == set(range(len(p)))
    first = corners[np.r_[0, np.cumsum(counts)[:-1]][:, None] + [0, 1, 2]]
    face = np.cross(p[first[:, 1]] - p[first[:, 0]], p[first[:, 2]] - p[first[:, 0]])
    assert (np.linalg.norm(face, axis=1) > 0).all(), "a face without area"
    facing = np.einsum("ij,ij->i", face, normals[first[:, 0]]) / np.linalg.norm(face, axis=1)
    assert facing.min() > -0.2 and np.median(facing) > 0.9


def test_stage(stage):
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Z"
    cloth = stage.GetPrimAtPath("/World/Cloth")
    assert not cloth.GetRelationship("material:binding") and Usd.ModelAPI(cloth).GetKind() == "component"
    lights = [prim for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert {prim.GetTypeName() for prim in lights} == {"DomeLight", "RectLight"}
    assert (SAMPLES / "drape.usda").stat().st_size < 2e6


def test_camera_sees_the_whole_cloth(stage, points):
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera()
    frustum = camera.frustum
    to_picture = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    clip = np.c_[points.reshape(-1, 3), np.ones(points.size // 3)] @ to_picture
    x, y = (clip[:, :2] / clip[:, 3:]).T
    assert max(abs(x).max(), abs(y).max()) < 0.97
    assert np.ptp(y) > 1.2, "the cloth is small in the picture"


def test_validators_find_nothing(stage):
    registry = UsdValidation.ValidationRegistry()
    errors = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(stage)
    assert [(e.GetName(), e.GetMessage()) for e in errors] == []


def test_the_file_is_what_the_script_writes(make_drape, points, stage):
    """All but the simulation: the committed cloth put through the script's writer gives its own numbers back."""
    text = make_drape.drape_text(points).splitlines()
    assert text[0] == "#usda 1.0"
    committed = (SAMPLES / "drape.usda").read_text(encoding="utf-8").splitlines()
    same = [a == b for a, b in zip(text, committed, strict=True)]
    # Only the cloth's normals may differ, since the file's points are rounded.
    assert same.count(False) <= 1


def test_simulation_is_deterministic_and_falls(make_drape):
    once, again = make_drape.draped_cloth(0.02), make_drape.draped_cloth(0.02)
    np.testing.assert_array_equal(once, again)
    assert once[..., 2].mean() < make_drape.initial_cloth()[..., 2].mean()


@pytest.mark.slow
def test_script_regenerates_the_file_bit_for_bit(tmp_path):
    script, made = SAMPLES / "make_drape.py", tmp_path / "drape.usda"
    subprocess.run([sys.executable, str(script), "-o", str(made)], check=True, timeout=600)
    assert made.read_bytes() == (SAMPLES / "drape.usda").read_bytes()
