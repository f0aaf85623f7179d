"""Subdivision against known limits, invariances, and flat cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from usdfab.usd.read_scene import read_scene
from usdfab.usd.subdivide import face_varying, normal_groups, parent_faces, refined, topology

CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
OCTAHEDRON = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=float)
OCTAHEDRON_FACES = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]


def mesh_of(faces, points, **more):
    return topology(np.array([len(f) for f in faces]), np.concatenate(faces), points, **more)


def grid(n):
    """(n + 1)^2 points of the unit square, its quads."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), quads


def test_one_step_of_a_cube():
    # by hand: face points (1, 0, 0), edge points (3/4, 3/4, 0), corners 5/9
    fine, matrix = refined(mesh_of(CUBE_FACES, 8), 1, "catmullClark", limit=False)
    points = np.sort(np.abs(matrix @ CUBE), axis=1)
    np.testing.assert_allclose(points[:8], 5 / 9)
    np.testing.assert_allclose(points[8:20], np.tile([0, 0.75, 0.75], (12, 1)), atol=1e-15)
    np.testing.assert_allclose(points[20:], np.tile([0, 0, 1.0], (6, 1)), atol=1e-15)
    assert fine.counts.tolist() == [4] * 24


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_limit_points_do_not_depend_on_the_number_of_steps(levels):
    # a corner of valence 3: (9 P + 4 edges + opposite corners) / 24 = 1/2
    _, matrix = refined(mesh_of(CUBE_FACES, 8), levels, "catmullClark")
    np.testing.assert_allclose(matrix @ CUBE[:, 0], (matrix @ CUBE)[:, 0])
    np.testing.assert_allclose((matrix @ CUBE)[:8], 0.5 * CUBE, atol=1e-14)
    # Loop, valence 4: beta = (5/8 - 9/64) / 4, weight 1 / (4 + 3 / (8 beta)) of each neighbour, which cancel
    beta = (5 / 8 - 9 / 64) / 4
    own = 1 - 4 / (4 + 3 / (8 * beta))
    _, matrix = refined(mesh_of(OCTAHEDRON_FACES, 6), levels, "loop")
    np.testing.assert_allclose((matrix @ OCTAHEDRON)[:6], own * OCTAHEDRON, atol=1e-14)


def test_steps_converge_to_the_limit():
    cube = mesh_of(CUBE_FACES, 8)
    _, limit = refined(cube, 2, "catmullClark")
    for levels, tolerance in ((2, 0.05), (4, 0.004)):
        _, plain = refined(cube, levels, "catmullClark", limit=False)
        difference = np.abs((plain @ CUBE)[: limit.shape[0]] - limit @ CUBE).max()
        assert 0 < difference < tolerance


@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
@pytest.mark.parametrize("limit", [False, True])
def test_flat_regular_grids_stay_regular(scheme, limit):
    points, quads = grid(4)
    faces = quads if scheme == "catmullClark" else np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    fine, matrix = refined(mesh_of(faces, len(points)), 2, scheme, limit=limit)
    found = matrix @ points
    assert len(found) == 17**2
    if scheme == "loop":
        # two of the square's corners have two triangles: they are no corners to the scheme, and are rounded off
        x, y = found[:, 0], found[:, 1]
        found = found[(np.hypot(x, y) > 0.4) & (np.hypot(1 - x, 1 - y) > 0.4)]
    # all points lie on the finer grid of 1/16, each once
    assert len(np.unique(np.round(found, 9), axis=0)) == len(found) > 200
    np.testing.assert_allclose(found * 16, np.round(found * 16), atol=1e-9)
    assert found.min() == 0 and found.max() == 1
    assert len(fine.counts) == len(parent_faces(np.full(len(faces), len(faces[0])), 2, scheme)) == 16 * len(faces)


def test_boundaries_are_splines_that_know_nothing_of_the_inside():
    points, quads = grid(3)
    raised = points + [0, 0, 1] * ((points[:, :1] % 1 > 0) & (points[:, 1:2] % 1 > 0))
    fine, matrix = refined(mesh_of(quads, len(points)), 2, "catmullClark")
    edge = np.unique(fine.edges[~fine.regular])
    np.testing.assert_array_equal((matrix @ raised)[edge], (matrix @ points)[edge])
    assert (matrix @ raised)[:, 2].max() > 0.5


def test_corners_of_boundaries_round_off_when_asked():
    points, quads = grid(1)
    for sharp, expected in ((True, 0.0), (False, 1 / 6)):
        mesh = mesh_of(quads, 4, sharp_boundary_corners=sharp)
        _, matrix = refined(mesh, 3, "catmullClark")
        np.testing.assert_allclose((matrix @ points)[0, :2], expected, atol=1e-14)


def test_creases():
    # a cube whose bottom and top rims are infinitely sharp: rims are the splines of their squares, in their planes
    rims = [(0, 4), (4, 6), (6, 2), (2, 0), (1, 5), (5, 7), (7, 3), (3, 1)]
    creases = {"creases": np.array(rims), "crease_sharpness": np.full(8, 10.0)}
    fine, matrix = refined(mesh_of(CUBE_FACES, 8, **creases), 3, "catmullClark")
    found = matrix @ CUBE
    np.testing.assert_allclose(found[:8], CUBE * [2 / 3, 2 / 3, 1], atol=1e-14)
    assert found[:, 2].max() == pytest.approx(1) and (np.abs(found[:, 2]) > 1 - 1e-12).sum() > 32
    groups = normal_groups(fine)
    counts = [len(np.unique(groups[fine.indices == k])) for k in (0, 7)]
    assert counts == [2, 2]
    # semi-sharp: between smooth and sharp, monotonic
    heights = []
    for sharpness in (0.0, 0.5, 1.0, 2.0, 10.0):
        creases["crease_sharpness"] = np.full(8, sharpness)
        _, matrix = refined(mesh_of(CUBE_FACES, 8, **creases), 3, "catmullClark")
        heights.append((matrix @ CUBE)[7, 2])
    assert (np.diff(heights) > 0).all() and heights[0] == pytest.approx(0.5) and heights[-1] == pytest.approx(1.0)


def test_sharp_corners_stay():
    mesh = mesh_of(CUBE_FACES, 8, corners=np.array([7]), corner_sharpness=np.array([10.0]))
    _, matrix = refined(mesh, 3, "catmullClark")
    np.testing.assert_allclose((matrix @ CUBE)[[0, 7]], [[-0.5] * 3, [1.0] * 3], atol=1e-14)


def test_seams_of_uv_are_boundaries():
    # two charts over a 2 x 1 grid, the second moved away: each is the affine image of its half
    points, quads = grid(2)
    uv = points[quads.ravel(), :2].copy()
    right = points[quads, 0].mean(axis=1) > 0.5
    uv[np.repeat(right, 4)] += [5, 0]
    own, values = face_varying(mesh_of(quads, 9), uv)
    fine, matrix = refined(own, 2, "catmullClark")
    found = (matrix @ values)[fine.indices]
    moved = np.repeat(np.repeat(right, 16), 4)
    # boundary-linear: 0.5 is met from both sides and the charts' corners stay
    assert found[~moved, 0].max() == pytest.approx(0.5) and found[moved, 0].min() == pytest.approx(5.5)
    position = (refined(mesh_of(quads, 9), 2, "catmullClark")[1] @ points)[
        refined(mesh_of(quads, 9), 2, "catmullClark")[0].indices
    ]
    np.testing.assert_allclose(found[:, 1], position[:, 1], atol=1e-12)


@st.composite
def polygon_soups(draw):
    number = draw(st.integers(3, 9))
    faces = draw(
        st.lists(st.lists(st.integers(0, number - 1), min_size=3, max_size=5, unique=True), min_size=1, max_size=8)
    )
    creases = draw(st.lists(st.tuples(st.integers(0, number - 1), st.integers(0, number - 1)), max_size=4))
    sharp = draw(st.lists(st.floats(0, 12), min_size=len(creases), max_size=len(creases)))
    return number, faces, np.array(creases, dtype=np.int64).reshape(-1, 2), np.array(sharp)


@settings(max_examples=60, deadline=None)
@given(polygon_soups(), st.booleans())
def test_any_polygons_at_all(soup, triangles):
    number, faces, creases, sharp = soup
    if triangles:
        faces = [f[:3] for f in faces]
    mesh = mesh_of(faces, number, creases=creases, crease_sharpness=sharp)
    fine, matrix = refined(mesh, 2, "loop" if triangles else "catmullClark")
    # affine invariance: rows sum to 1, so that a translation of the cage is one of the surface
    np.testing.assert_allclose(np.asarray(matrix.sum(axis=1)).ravel(), 1.0, atol=1e-12)
    assert fine.indices.max() < fine.points == matrix.shape[0]
    assert len(normal_groups(fine)) == len(fine.indices)


# --- in stages -------------------------------------------------------------------------------------------------------


def subdivision_stage(faces, points, scheme=None):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/M")
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    mesh.CreateFaceVertexCountsAttr([len(f) for f in faces])
    mesh.CreateFaceVertexIndicesAttr([int(i) for f in faces for i in f])
    if scheme:
        mesh.CreateSubdivisionSchemeAttr(scheme)
    return stage, mesh


def test_stages_are_refined_by_default():
    stage, mesh = subdivision_stage(CUBE_FACES, CUBE)
    read = read_scene(stage).meshes[0]
    assert len(read.triangles) == 6 * 16 * 2
    # nearly a sphere: normals point along positions
    directions = read.points[read.triangles]
    directions = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    assert (directions * read.normals).sum(axis=2).min() > 0.98
    assert len(read_scene(stage, subdivision=1).meshes[0].triangles) == 48
    assert len(read_scene(stage, subdivision=0).meshes[0].triangles) == 12
    mesh.CreateSubdivisionSchemeAttr("bilinear")
    bilinear = read_scene(stage).meshes[0]
    assert len(bilinear.triangles) == 12 and bilinear.normals is None


def test_loop_in_a_stage():
    stage, _ = subdivision_stage(OCTAHEDRON_FACES, OCTAHEDRON, "loop")
    assert len(read_scene(stage).meshes[0].triangles) == 8 * 16
    stage, _ = subdivision_stage(CUBE_FACES, CUBE, "loop")
    scene = read_scene(stage)
    assert len(scene.meshes[0].triangles) == 12
    assert "Loop subdivision of faces that are no triangles" in scene.warnings[0]


def test_dense_meshes_are_not_refined():
    points, quads = grid(142)
    stage, _ = subdivision_stage(quads, points)
    assert len(quads) > 20_000
    assert len(read_scene(stage).meshes[0].triangles) == 2 * len(quads)
    points, quads = grid(130)
    stage, _ = subdivision_stage(quads, points)
    # two steps would make 540,800 triangles
    assert len(read_scene(stage).meshes[0].triangles) == 8 * len(quads)


@pytest.mark.parametrize("interpolation", ["vertex", "varying", "faceVarying"])
def test_primvars_holes_and_subsets_come_along(interpolation):
    points, quads = grid(2)
    stage, mesh = subdivision_stage(quads, points)
    corners = quads.ravel() if interpolation == "faceVarying" else np.arange(9)
    st_ = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
    st_.Set([Gf.Vec2f(*map(float, points[c, :2])) for c in corners])
    albedo = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("usdfab:albedo", Sdf.ValueTypeNames.Color3fArray, "uniform")
    albedo.Set([Gf.Vec3f(0.1 * k, 0.5, 1.0) for k in range(4)])
    mesh.CreateHoleIndicesAttr(Vt.IntArray([3]))
    read = read_scene(stage).meshes[0]
    assert len(read.triangles) == 3 * 16 * 2
    np.testing.assert_allclose(read.uv, read.points[read.triangles][..., :2], atol=1e-7)
    centre = read.points[read.triangles].mean(axis=1)
    quarter = (centre[:, 0] > 0.5) + 2 * (centre[:, 1] > 0.5)
    np.testing.assert_allclose(read.albedo[:, 0, 0], 0.1 * quarter, atol=1e-7)
    assert quarter.max() == 2


def test_bad_creases_are_left_out():
    stage, mesh = subdivision_stage(CUBE_FACES, CUBE)
    mesh.CreateCreaseIndicesAttr([0, 99])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([5.0])
    scene = read_scene(stage)
    assert len(scene.meshes) == 1 and "creases and corners are left out" in scene.warnings[0]
    mesh.GetCreaseIndicesAttr().Set([0, 1])
    assert read_scene(stage).warnings == ()
