"""Stretch of texture coordinates against maps whose singular values are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.usd.read_scene import read_scene
from usdfab.usd.stretch import measure, spread, surfaces, warnings

UV = np.array([[(0.0, 0.0), (1.0, 0.0), (0.2, 0.9)], [(1.0, 1.0), (0.1, 1.2), (0.4, 0.1)]])
finite = st.floats(-3, 3)


def mapped(jacobian, meters=1.0):
    """Corners whose surface is ``jacobian`` (3, 2) times the cloth."""
    return (UV * meters) @ np.asarray(jacobian, dtype=float).T


@given(st.lists(finite, min_size=6, max_size=6), st.floats(0.01, 10))
def test_singular_values_densities_and_shear_of_any_linear_map(numbers, meters):
    jacobian = np.array(numbers).reshape(3, 2)
    s = np.linalg.svd(jacobian, compute_uv=False)
    if s[1] < 1e-3:
        return
    found = measure(mapped(jacobian, meters), UV, meters)
    np.testing.assert_allclose(found.s1, s[0], rtol=1e-7)
    np.testing.assert_allclose(found.s2, s[1], rtol=1e-6)
    np.testing.assert_allclose(found.stretch, max(s[0], 1 / s[1]), rtol=1e-6)
    # The cloth's x and y as functions on the surface: their gradients are the rows of the pseudoinverse.
    gradients = np.linalg.norm(np.linalg.pinv(jacobian), axis=1)
    np.testing.assert_allclose(found.ends, gradients[0], rtol=1e-6)
    np.testing.assert_allclose(found.picks, gradients[1], rtol=1e-6)
    weft, warp = jacobian.T
    angle = np.degrees(np.arccos(np.clip(weft @ warp / np.linalg.norm(weft) / np.linalg.norm(warp), -1, 1)))
    np.testing.assert_allclose(found.shear, abs(90 - angle), atol=1e-5)


def test_a_simple_shear_leaves_the_area_and_counts_yarns_across_them():
    # x' = x + y: the warp leans by 45 degrees, so ends lie closer by cos 45; picks stay where they are.
    found = measure(mapped([[1, 1], [0, 1], [0, 0]]), UV, 1.0)
    np.testing.assert_allclose(found.ends, np.sqrt(2))
    np.testing.assert_allclose(found.picks, 1.0)
    np.testing.assert_allclose(found.shear, 45.0)
    np.testing.assert_allclose(found.s1 * found.s2, 1.0)


def test_mirrored_and_degenerate_coordinates():
    # Both triangles of UV run counter-clockwise.
    assert not measure(mapped(np.eye(3)[:, :2]), UV, 1.0).mirrored.any()
    assert measure(mapped(np.eye(3)[:, :2]), UV * (-1, 1), 1.0).mirrored.all()
    flat = measure(mapped(np.eye(3)[:, :2]), UV * (1, 0), 1.0)
    assert np.isinf(flat.s1).all() and (flat.s2 == 0).all() and np.isinf(flat.stretch).all()


def test_percentiles_are_weighted_by_area():
    area = np.array([1.0, 98.0, 1.0])
    found = spread(np.array([3.0, 1.0, 2.0]), area)
    assert (found.min, found.max) == (1.0, 3.0)
    assert found.mean == pytest.approx((3 + 98 + 2) / 100)
    assert found.median < 1.05 and found.p5 == 1.0
    many = np.random.default_rng(1).random(20000)
    even = spread(many, np.ones(20000))
    assert (even.p5, even.median, even.p95) == pytest.approx(tuple(np.quantile(many, (0.05, 0.5, 0.95))), abs=1e-4)
    assert spread(np.array([np.nan]), np.ones(1)) is None


def test_the_report_of_a_stage(cloth_stage):
    # A square of one metre with uv to 0.5; a quarter of it is drawn out along u by hand.
    scene = read_scene(cloth_stage)
    (surface,) = surfaces(scene, 1.25)
    report = surface.report
    fabric = scene.fabrics[0].fabric
    assert report.area == pytest.approx(1.0) and report.triangles == 2
    assert report.nominal_ends_per_cm == pytest.approx(fabric.warp.count / fabric.size[0] / 100)
    assert report.ends_per_cm.mean == pytest.approx(report.nominal_ends_per_cm, rel=1e-6)
    assert report.picks_per_cm.max == pytest.approx(report.nominal_picks_per_cm, rel=1e-6)
    assert report.above == report.mirrored == report.degenerate == 0
    assert warnings(report) == []
    uv = scene.meshes[0].uv.copy()
    uv[0, :, 0] *= 0.5
    stretched = replace(scene, meshes=(replace(scene.meshes[0], uv=uv),))
    (surface,) = surfaces(stretched, 1.25)
    assert surface.report.above == pytest.approx(0.5)
    assert surface.report.stretch_max.max == pytest.approx(2.0)
    assert surface.report.ends_per_cm.min == pytest.approx(report.nominal_ends_per_cm / 2, rel=1e-6)
    assert "50 % of the area (5e+03 cm^2)" in warnings(surface.report)[0]
    assert surfaces(scene, 1.25, ("/Other",)) == []


def test_yarns_that_are_meant_to_be_larger_are_not_stretched(cloth_stage):
    """Half the metres per uv is what --scale 2 makes of a fabric."""
    scene = read_scene(cloth_stage)
    (usual,) = surfaces(scene, 1.25)
    twice = replace(scene, fabrics=(replace(scene.fabrics[0], meters_per_uv=scene.fabrics[0].meters_per_uv / 2),))
    (unmeant,), (meant,) = surfaces(twice, 1.25), surfaces(twice, 1.25, scale=2.0)
    assert unmeant.report.above == pytest.approx(1.0) and meant.report.above == 0
    assert unmeant.report.ends_per_cm.mean == pytest.approx(usual.report.ends_per_cm.mean / 2)
    assert meant.report.ends_per_cm.mean == pytest.approx(usual.report.ends_per_cm.mean / 2)
    assert meant.report.nominal_ends_per_cm == pytest.approx(usual.report.nominal_ends_per_cm / 2)


def test_a_mirrored_side_is_named(cloth_stage):
    scene = read_scene(cloth_stage)
    mirrored = replace(scene, meshes=(replace(scene.meshes[0], uv=scene.meshes[0].uv * (-1, 1)),))
    (surface,) = surfaces(mirrored, 1.25)
    assert surface.report.mirrored == 1.0
    assert "100 % of the area has mirrored" in warnings(surface.report)[0]


def test_placements_count_as_often_as_they_are_placed(cloth_stage):
    scene = read_scene(cloth_stage)
    places = np.stack([np.eye(4)[:3], np.diag([2.0, 2.0, 2.0, 1.0])[:3]])
    placed = replace(scene, meshes=(replace(scene.meshes[0], placements=places),))
    (surface,) = surfaces(placed, 1.25)
    assert surface.report.area == pytest.approx(5.0)
    assert surface.report.above == pytest.approx(0.8)
