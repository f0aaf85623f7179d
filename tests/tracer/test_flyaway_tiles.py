"""Flyaways in the tracer's tile: every piece that overlaps it, ends that are ends, light that is not lost."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import dome, fabric, swatch

from usdfab.fibers import OpenCurves, generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.embree import NEIGHBOR_LEFT, NEIGHBOR_RIGHT
from usdfab.tracer.patch_scene import _tile_segments, build_patch_scene

FLY = {"flyaway_density": 4e3, "flyaway_length": 2.5e-3, "flyaway_spread": 0.3}


@pytest.fixture(scope="module")
def patch():
    """A patch of two by two cells, 1 mm wide, with flyaways longer than that."""
    return generate_patch(fabric(**FLY), 20)


def _spline(curves: OpenCurves, k: int, t: float) -> np.ndarray:
    """A place on curve ``k``'s clamped cubic B-spline, by scipy: an implementation of its own."""
    from scipy.interpolate import BSpline

    points, offsets = curves.pinned()
    own = points[offsets[k] : offsets[k + 1]]
    knots = np.arange(-3, len(own) + 1.0)
    return BSpline(knots, own, 3)(t)


def test_all_pieces_that_overlap_the_tile_are_there(patch):
    size = np.asarray(patch.size)
    for curves in patch.flyaways:
        vertices, tangents, first, _, _ = _tile_segments(curves, patch.size)
        tile = np.sort(vertices[first].round(12), axis=0)
        expected, spread = [], 0
        for k in range(curves.curves):
            count = curves.offsets[k + 1] - curves.offsets[k]
            places = np.array([_spline(curves, k, t) for t in np.arange(count)])
            low = np.minimum(places[:-1], places[1:])[:, :2] - curves.radius
            high = np.maximum(places[:-1], places[1:])[:, :2] + curves.radius
            for i in range(-6, 7):
                for j in range(-6, 7):
                    shift = np.array([i, j]) * size
                    overlap = np.all((high + shift > 0) & (low + shift < size), axis=1)
                    expected.append(places[:-1][overlap] + np.r_[shift, 0.0])
                    spread = max(spread, max(abs(i), abs(j)) * bool(overlap.any()))
        assert spread >= 2, "the flyaways are too short for this test"
        np.testing.assert_allclose(tile, np.sort(np.concatenate(expected).round(12), axis=0), atol=1e-11)
        np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1)


def _same_place(a: np.ndarray, b: np.ndarray, size: tuple[float, float]) -> np.ndarray:
    """Whether points (N, 3) agree up to the copy of the patch."""
    offset = (a - b) / np.r_[size, 1.0]
    offset[:, :2] -= np.round(offset[:, :2])
    return np.abs(offset).max(axis=1) < 1e-9


def test_only_free_ends_and_joints_outside_the_tile_have_no_neighbour(patch):
    for curves in patch.flyaways:
        vertices, _, first, flags, curve = _tile_segments(curves, patch.size)
        starts = _same_place(vertices[first], curves.points[curves.offsets[:-1]][curve], patch.size)
        ends = _same_place(vertices[first + 1], curves.points[curves.offsets[1:] - 1][curve], patch.size)
        assert starts.any() and ends.any()
        for alone, free, vertex in (
            ((flags & NEIGHBOR_LEFT) == 0, starts, vertices[first]),
            ((flags & NEIGHBOR_RIGHT) == 0, ends, vertices[first + 1]),
        ):
            assert alone[free].all()
            # A joint is a sphere about the vertex.
            place = vertex[alone & ~free][:, :2]
            outside = (place <= -curves.radius) | (place >= np.asarray(patch.size) + curves.radius)
            assert len(place) and outside.any(axis=1).all()
        # Neighbours stand beside each other in the buffer.
        steps = np.linalg.norm(vertices[first + 1] - vertices[first], axis=1)
        joined = first[(flags & NEIGHBOR_LEFT) != 0]
        before = np.linalg.norm(vertices[joined] - vertices[joined - 1], axis=1)
        assert before.max() < 1.5 * steps.max()


def test_the_tile_has_their_height_and_material(patch):
    cloth = fabric(**FLY)
    tile, bare = build_patch_scene(cloth, patch), build_patch_scene(fabric(), generate_patch(fabric(), 20))
    assert len(tile.segments) > len(bare.segments)
    assert tile.z_range[1] == pytest.approx(tile.units_per_meter * patch.z_range[1], rel=1e-3)
    assert tile.z_range[1] > 1.5 * bare.z_range[1]
    np.testing.assert_allclose(tile.albedo[:, :3], np.tile(cloth.warp.albedo, (4, 1)))


def test_flyaways_lose_no_light():
    # A white cloth under a white sky is invisible, hairs and their ends included.
    scene, camera = swatch(fabric(albedo=(1, 1, 1), **(FLY | {"flyaway_density": 1e4, "flyaway_length": 5e-4})), dome())
    render = Tracer(scene).render(camera, RenderSettings((24, 24), spp=200, max_depth=2000))
    pixels = render.pixels[render.alpha > 0.5].astype(float)
    assert len(pixels) > 200
    error = pixels.std(axis=0) / np.sqrt(len(pixels))
    assert error.max() < 4e-3
    assert np.all(np.abs(pixels.mean(axis=0) - 1.0) < 3.5 * error), pixels.mean(axis=0)
