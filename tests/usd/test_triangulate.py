"""Triangles cover exactly the polygon, whatever its shape."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.usd.triangulate import triangulate


def polygon_area(p):
    rel = p - p[0]
    return 0.5 * np.cross(rel, np.roll(rel, -1, axis=0)).sum(axis=0)


def signed_areas(p, corners):
    t = p[corners]
    return 0.5 * np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])


def one(points):
    """Corners of the triangulation of one polygon."""
    points = np.asarray(points, dtype=float)
    corners, faces = triangulate([len(points)], np.arange(len(points)), points)
    assert (faces == 0).all()
    assert len(corners) == len(points) - 2
    return points, corners


L_SHAPE = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]
ARROW = [(0, 0, 0), (2, 1, 0), (0, 2, 0), (0.5, 1, 0)]
COMB = [(0, 0, 0), (7, 0, 0), (7, 3, 0), (6, 3, 0), (6, 1, 0), (5, 1, 0), (5, 3, 0), (4, 3, 0), (4, 1, 0), (0, 1, 0)]
COLLINEAR = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 2, 0), (1, 2, 0), (0, 2, 0), (0, 1, 0)]
# A square ring cut open by a bridge: two corners occur twice.
RING = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0), (0, 0, 0), (1, 1, 0), (1, 3, 0), (3, 3, 0), (3, 1, 0), (1, 1, 0)]


@pytest.mark.parametrize("shift", range(4))
@pytest.mark.parametrize(
    "shape", [L_SHAPE, ARROW, COMB, COLLINEAR, RING], ids=["L", "arrow", "comb", "collinear", "ring"]
)
def test_concave_polygons(shape, shift):
    points, corners = one(shape[shift:] + shape[:shift])
    areas = signed_areas(points, corners)[:, 2]
    assert (areas >= 0).all()
    assert areas.sum() == pytest.approx(polygon_area(points)[2])


@given(
    st.lists(st.floats(0.2, 1.0), min_size=5, max_size=24),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 1)),
    st.booleans(),
)
def test_star_shaped_polygons_in_any_plane(radii, normal, reverse):
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    flat = np.asarray(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    n = np.asarray(normal) / np.linalg.norm(normal)
    u = np.cross(n, [1.0, 0.3, 0.1])
    u /= np.linalg.norm(u)
    points = flat @ np.stack([u, np.cross(n, u)])
    points, corners = one(points[::-1] if reverse else points)
    areas = signed_areas(points, corners) @ (-n if reverse else n)
    assert areas.min() > -1e-12
    assert areas.sum() == pytest.approx(np.linalg.norm(polygon_area(points)))


def test_mixed_faces_keep_their_order():
    points = np.array([*L_SHAPE, (5, 0, 0), (6, 0, 0), (5, 1, 0)], dtype=float)
    counts = [6, 3, 2, 4]
    indices = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 0, 1, 0, 1, 2, 3])
    corners, faces = triangulate(counts, indices, points)
    assert faces.tolist() == [0, 0, 0, 0, 1, 3, 3]
    assert corners[4].tolist() == [6, 7, 8]
    assert set(corners[5:].ravel().tolist()) == {11, 12, 13, 14}


def test_no_faces():
    corners, faces = triangulate([], [], np.zeros((0, 3)))
    assert corners.shape == (0, 3)
    assert faces.shape == (0,)


def test_a_polygon_without_area_still_ends():
    _, corners = one([(0, 0, 0)] * 6)
    assert len(corners) == 4
    one([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (1, 0, 0)])
