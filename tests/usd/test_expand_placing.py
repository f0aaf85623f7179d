"""Pieces of tiles on surfaces: each cell of the cloth once, frames that follow, neighbours that meet."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.usd.expand.divide import MAX_PROTOTYPES, divide
from usdfab.usd.expand.frames import Frames, poses
from usdfab.usd.expand.place import place_pieces
from usdfab.usd.expand.seams import measure_seams
from usdfab.usd.expand.surface import ClothSurface
from usdfab.usd.scene import FabricSurface, Mesh

FABRIC = FabricParameters(size=(0.1, 0.1), warp=YarnParameters(count=20), weft=YarnParameters(count=25))
TILING = divide((4, 4), (0.005, 0.004), 4)


def plain_tint(uv, colors):
    return colors


def cloth(points, uv, triangles, normals=None, albedo=None) -> ClothSurface:
    """A surface of which one unit of uv is a metre; uv (V, 2) at the points or (T, 3, 2) at the corners."""
    points, triangles = np.asarray(points, dtype=float), np.asarray(triangles)
    uv = np.asarray(uv, dtype=float)
    uv = uv[triangles] if uv.ndim == 2 else uv
    mesh = Mesh("/M", points, triangles, normals, uv, np.zeros(len(triangles), dtype=np.int32), False, albedo=albedo)
    return ClothSurface(mesh, FabricSurface("/F", FABRIC, 1.0), np.ones(len(triangles), dtype=bool))


def grid(n: int, shape=lambda u, v: np.stack([u, v, 0 * u], axis=-1), turn: float = 0.0):
    """(points, uv, triangles) of a unit square of n x n quads put through ``shape``, its uv turned."""
    v, u = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    triangles = np.concatenate([first + np.array(c) for c in ([0, 1, n + 2], [0, n + 2, n + 1])])
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    return shape(u.ravel(), v.ravel()), np.column_stack([u.ravel(), v.ravel()]) @ rotation.T, triangles


def placed(surface: ClothSurface, tolerance=math.inf, **options):
    return place_pieces(surface, TILING, tolerance, 1e-3, plain_tint, **options)


def cells(pieces) -> np.ndarray:
    """(M, 3) chart, column and row of every cell that a piece covers."""
    found = [
        (c, i, j)
        for c, (i0, j0), (i1, j1) in zip(pieces.chart, pieces.first, pieces.last, strict=True)
        for i in range(i0, i1)
        for j in range(j0, j1)
    ]
    return np.array(found).reshape(-1, 3)


@pytest.mark.parametrize("n", [1, 2, 5, 7, 25])
@pytest.mark.parametrize("tolerance", [math.inf, 1e-9])
def test_every_cell_is_covered_once(n, tolerance):
    # 50 x 62.5 tiles; cells' centres fall on edges, diagonals and corners of triangles.
    found = cells(placed(cloth(*grid(n)), tolerance))
    assert len(np.unique(found, axis=0)) == len(found) == 200 * 250


@given(st.floats(0.0, 6.3), st.integers(1, 5))
@settings(max_examples=5, deadline=None)
def test_every_cell_of_turned_cloth_is_covered_once(turn, n):
    surface = cloth(*grid(n, turn=turn))
    found = cells(placed(surface))
    assert len(np.unique(found, axis=0)) == len(found)
    # Exactly those whose centre lies on the cloth.
    size = np.asarray(TILING.cell)
    i, j = np.meshgrid(np.arange(-400, 400), np.arange(-400, 400))
    centre = (np.column_stack([i.ravel(), j.ravel()]) + 0.5) * size
    back = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    there = centre @ back.T
    margin = np.abs(there - 0.5).max(axis=1) - 0.5
    sure_in, sure_out = (margin < -1e-9).sum(), (margin < 1e-9).sum()
    assert sure_in <= len(found) <= sure_out


def test_borders_seams_and_regions_are_followed_by_single_cells():
    surface = cloth(*grid(4, turn=0.3))
    pieces = placed(surface)
    assert (pieces.level[pieces.level > 0] > 0).any() and (pieces.level == 0).any()
    region = placed(cloth(*grid(3)), region=(0.1025, 0.1, 0.2025, 0.3))
    centres = 0.5 * (region.first + region.last) * TILING.cell
    assert (centres >= (0.1025, 0.1)).all() and (centres < (0.2025, 0.3)).all()
    assert len(cells(region)) == 20 * 50


def test_frames_on_a_cylinder():
    radius = 1.0 / math.pi
    surface = cloth(*grid(200, lambda u, v: np.stack(
        [radius * np.cos(math.pi * u), v, -radius * np.sin(math.pi * u)], axis=-1)))  # fmt: skip
    pieces = placed(surface)
    angle = math.pi * 0.5 * (pieces.first + pieces.last)[:, 0] * TILING.cell[0]
    zero = 0 * angle
    x = np.stack([-np.sin(angle), zero, -np.cos(angle)], axis=1)
    z = np.stack([np.cos(angle), zero, -np.sin(angle)], axis=1)
    y = np.broadcast_to([0.0, 1.0, 0.0], z.shape)
    # u x v looks inward here, and so does the front
    np.testing.assert_allclose(pieces.frames.linear, np.stack([x, y, np.cross(x, y)], axis=2), atol=0.012)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", z, np.cross(x, y))), 1.0)
    posed = poses(pieces.frames, np.ones(len(pieces)))
    np.testing.assert_allclose(posed.linear, pieces.frames.linear, atol=1e-3)


def test_mirrored_and_stretched_uv():
    points, uv, triangles = grid(2)
    mirrored = placed(cloth(points, uv * [-1, 1], triangles))
    np.testing.assert_allclose(mirrored.frames.linear[0], np.diag([-1.0, 1.0, 1.0]), atol=1e-12)
    posed = poses(mirrored.frames, np.ones(len(mirrored)))
    np.testing.assert_allclose(np.linalg.det(posed.rotations), 1.0)
    np.testing.assert_allclose(posed.scales, np.broadcast_to([1, -1, 1], (len(mirrored), 3)), atol=1e-12)
    stretched = placed(cloth(points, uv * [0.5, 2], triangles))
    np.testing.assert_allclose(stretched.frames.linear[5], np.diag([2.0, 0.5, 1.0]), atol=1e-12)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_poses_are_the_frames_up_to_rounded_shear(seed):
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    q = q * np.sign(np.linalg.det(q))
    sx, sy, sz = rng.uniform(0.5, 2.0, 3)
    shear, side = rng.uniform(-0.4, 0.4), rng.choice([-1.0, 1.0])
    linear = q @ np.array([[sx, sx * shear, 0], [0, side * sy, 0], [0, 0, sz]])
    frames = Frames(np.zeros((1, 3)), linear[None])
    np.testing.assert_allclose(poses(frames, np.array([1e-7])).linear[0], linear, atol=1e-6)
    coarse = poses(frames, np.array([0.1]))
    assert abs(np.linalg.det(coarse.rotations[0]) - 1) < 1e-9
    # Less than half a step is lost, half of it in x and half in y.
    lost = np.linalg.norm(coarse.linear[0] - linear, axis=0)
    assert lost.max() < 0.05 * max(sx, sx * sx / sy, sy) * 0.75


def wavy(u, v):
    return np.stack([u, v, 0.03 * np.sin(9 * u + 4 * v) * np.cos(7 * v)], axis=-1)


@pytest.mark.parametrize("n", [12, 90])
def test_neighbours_meet_in_the_middle_of_their_borders(n):
    """Whatever the surface does, also where it is faceted: frames come from corners that neighbours share."""
    surface = cloth(*grid(n, wavy))
    pieces = place_pieces(surface, TILING, math.inf, 1e-3, plain_tint)
    inner = pieces.level == 0
    by_cell = {tuple(c): k for k, c in enumerate(pieces.tile) if inner[k]}
    half = 0.5 * np.asarray(TILING.size)
    gaps = []
    for (i, j), k in by_cell.items():
        other = by_cell.get((i + 1, j))
        if other is not None:
            right = pieces.frames[np.array([k])].at(np.array([[half[0], 0.0, 0.0]]))
            left = pieces.frames[np.array([other])].at(np.array([[-half[0], 0.0, 0.0]]))
            gaps.append(np.linalg.norm(right - left))
    assert len(gaps) > 1000 and max(gaps) < 1e-12


def test_division_closes_seams():
    surface = cloth(*grid(90, wavy))
    sizes = []
    for tolerance in (math.inf, 1e-4, 2.5e-5):
        pieces = placed(surface, tolerance)
        seams = measure_seams(pieces, pieces.frames, TILING, FABRIC)
        assert seams is not None
        sizes.append(seams.p99)
    assert sizes[0] > 1.5 * sizes[1] > 3 * sizes[2]
    assert sizes[1] < 2e-4 and sizes[2] < 5e-5
    # With the poses of instances it is hardly worse than with whole frames: this cloth does not shear much.
    posed = poses(pieces.frames, np.full(len(pieces), 0.02))
    other = measure_seams(pieces, Frames(pieces.frames.centers, posed.linear), TILING, FABRIC)
    assert other is not None and other.p99 < 4 * sizes[2]


def test_seams_of_two_pieces_are_their_distance():
    surface = cloth(*grid(1))
    pieces = placed(surface)
    moved = pieces.frames.centers + np.where((pieces.tile[:, :1] % 2) == 0, 0.0, 1e-4) * [[0.0, 0.0, 1.0]]
    seams = measure_seams(pieces, Frames(moved, pieces.frames.linear), TILING, FABRIC)
    assert seams is not None and seams.largest == pytest.approx(1e-4) and seams.median == pytest.approx(0.0, abs=1e-12)
    assert seams.yarn_width == pytest.approx(2 * FABRIC.warp.radius * FABRIC.warp.flattening)


def test_charts_and_places():
    points, uv, triangles = grid(6, wavy)
    corner_uv = uv[triangles].copy()
    corner_uv[20:50] += 10.0  # an island of its own
    surface = cloth(points, corner_uv, triangles)
    assert len(np.unique(surface.chart)) >= 2
    rng = np.random.default_rng(1)
    owner = rng.integers(0, len(triangles), 500)
    weights = rng.dirichlet([1, 1, 1], 500)
    xy = np.einsum("nc,ncx->nx", weights, corner_uv[owner])
    triangle, found = surface.locate(surface.chart[owner], xy)
    np.testing.assert_array_equal(triangle, owner)
    np.testing.assert_allclose(found, weights, atol=1e-9)
    expected = np.einsum("nc,ncx->nx", weights, points[triangles[owner]])
    np.testing.assert_allclose(surface.at(triangle, found).points, expected, atol=1e-12)
    assert (surface.locate(surface.chart[owner], xy + 40.0)[0] == -1).all()


def test_overlapping_halves_are_told_apart():
    """A cloth folded in uv: both halves lie on the same places of the plane, one of them mirrored."""
    points, uv, triangles = grid(10)
    folded = np.column_stack([0.5 - np.abs(uv[:, 0] - 0.5), uv[:, 1]])
    found = placed(cloth(points, folded, triangles))
    cover = cells(found)
    assert len(np.unique(found.chart)) == 2
    assert len(cover) == len(np.unique(cover, axis=0)) == 2 * 100 * 250


def test_tint_divides_pieces():
    points, uv, triangles = grid(2)
    surface = cloth(points, uv, triangles)

    def tint(uv, colors):
        return colors * np.where(uv[:, :1] < 0.5025, 1.0, 0.2)

    pieces = place_pieces(surface, TILING, 1e-3, 1e-3, tint)
    centre = 0.5 * (pieces.first + pieces.last)[:, 0] * TILING.cell[0]
    np.testing.assert_allclose(pieces.tint[:, 0], np.where(centre < 0.5025, 1.0, 0.2))
    edge = np.abs(centre - 0.5025) < 0.002
    assert (pieces.level[edge] == 2).all() and (pieces.level == 0).mean() > 0.4


def test_divisions_partition_the_tile():
    for size, variants in (((4, 4), 4), ((5, 8), 4), ((1, 7), 1), ((40, 40), 4)):
        tiling = divide(size, (1.0, 1.0), variants)
        assert tiling.levels[0].pieces == 1
        assert sum(variants * level.pieces for level in tiling.levels) <= max(MAX_PROTOTYPES, variants)
        for level, finer in zip(tiling.levels, tiling.levels[1:], strict=False):
            for borders, child, inner in ((level.x, level.child_x, finer.x), (level.y, level.child_y, finer.y)):
                assert np.isin(borders, inner).all() and borders[0] == 0
                for (first, last), low, high in zip(child, borders[:-1], borders[1:], strict=True):
                    assert inner[first] == low and inner[last] == high
