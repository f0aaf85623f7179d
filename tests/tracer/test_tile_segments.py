"""Segments of a tile: what a hit finds about them, and how they hang together."""

import math

import numpy as np
import pytest
from numba import njit
from scenes import fabric

from usdfab.fibers import generate_patch
from usdfab.tracer.embree import NEIGHBOR_LEFT, NEIGHBOR_RIGHT
from usdfab.tracer.knots import polylines
from usdfab.tracer.patch_scene import _tile_segments, build_patch_scene
from usdfab.tracer.tangents import pack_tangents, tangent_at, unpack_tangents


def directions() -> np.ndarray:
    """Unit vectors: any, the axes, and such with components of 0."""
    some = np.random.default_rng(0).normal(size=(2000, 3))
    flat = some[:50] * [1.0, 1.0, 0.0]
    axes = np.r_[np.eye(3), -np.eye(3)]
    every = np.concatenate([some, flat, axes, some[:50] * [0.0, 1.0, 1.0], some[:50] * [1.0, 0.0, 1.0]])
    return every / np.linalg.norm(every, axis=1, keepdims=True)


@njit
def _read(records, prims, places, out):
    for k in range(len(prims)):
        curve, out[k, 1], out[k, 2], out[k, 3] = tangent_at(records, 0, prims[k], places[k])
        out[k, 0] = curve


def test_tangents_in_four_bytes():
    true = directions()
    packed = pack_tangents(true)
    assert packed.nbytes == 4 * len(true)
    kept = unpack_tangents(packed)
    assert np.linalg.norm(kept - true, axis=1).max() < 7e-5
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 1.0, rtol=1e-12)


def test_kernels_find_curve_and_tangent_of_a_hit():
    true = directions()
    tangents = pack_tangents(true)
    segments = np.array([[0, 7], [5, 2**31 - 1], [len(true) - 2, 2**16]], dtype=np.uint32)
    records = np.array([[tangents.ctypes.data, segments.ctypes.data]], dtype=np.uint64)
    prims, places = np.repeat(np.arange(3), 3), np.tile([0.0, 0.25, 1.0], 3)
    out = np.zeros((9, 4))
    _read(records, prims, places, out)
    first = segments[prims, 0].astype(int)
    expected = (1.0 - places)[:, None] * true[first] + places[:, None] * true[first + 1]
    np.testing.assert_allclose(out[:, 1:], expected, atol=7e-5)
    assert np.array_equal(out[:, 0], segments[prims, 1])


CASES = [("plain", {}), ("satin", {"twist": 0.3}), ("twill_1_3", {"ply_count": 3})]


@pytest.mark.parametrize(("weave", "changes"), CASES)
def test_segments_that_follow_one_another_share_a_vertex(weave, changes):
    patch = generate_patch(fabric(weave, fibers=8, **changes))
    for system in patch.systems:
        vertices, tangents, first, flags, curve = _tile_segments(system, patch.size)
        left, right = (flags & NEIGHBOR_LEFT) != 0, (flags & NEIGHBOR_RIGHT) != 0
        # Flags come in pairs, and the other one stands just before or after.
        assert np.array_equal(left[1:], right[:-1]) and not left[0] and not right[-1]
        assert np.array_equal(first[1:][left[1:]], first[:-1][left[1:]] + 1)
        assert len(vertices) == len(first) + np.count_nonzero(~right)
        # Where nothing follows, the joint is outside of the tile: a fiber goes on for ever.
        for vertex in (vertices[first][~left], vertices[first + 1][~right]):
            place = vertex[:, :2]
            outside = (place <= -system.radius) | (place >= np.asarray(patch.size) + system.radius)
            assert len(place) and outside.any(axis=1).all()
        # Curves go on in their successors, in one line.
        onward = left[1:] & (curve[1:] != curve[:-1])
        assert onward.any()
        assert np.array_equal(curve[1:][onward], system.successor[curve[:-1][onward]])
        step = vertices[first + 1] - vertices[first]
        step /= np.linalg.norm(step, axis=1, keepdims=True)
        bend = np.einsum("kx,kx->k", step[:-1], step[1:])
        assert bend[left[1:]].min() > 0.0
        assert np.einsum("kx,kx->k", step, tangents[first]).min() > 0.5


@pytest.mark.parametrize(("weave", "changes"), CASES)
def test_all_pieces_that_overlap_the_tile_are_there(weave, changes):
    patch = generate_patch(fabric(weave, fibers=8, **changes))
    size = np.asarray(patch.size)
    for system in patch.systems:
        vertices, _, first, _, curve = _tile_segments(system, patch.size)
        points, _, offsets = polylines(system)
        expected = []
        for k in range(system.curves):
            own = points[offsets[k] + 1 : offsets[k + 1] - 2]
            low = np.minimum(own[:-1], own[1:])[:, :2] - system.radius
            high = np.maximum(own[:-1], own[1:])[:, :2] + system.radius
            for i in range(-3, 4):
                for j in range(-3, 4):
                    shift = np.array([i, j]) * size
                    overlap = np.all((high + shift > 0) & (low + shift < size), axis=1)
                    ends = np.c_[own[:-1], own[1:]][overlap] + np.tile(np.r_[shift, 0.0], 2)
                    expected.append(np.c_[np.full(len(ends), k), ends])
        expected = np.concatenate(expected)
        found = np.c_[curve, vertices[first], vertices[first + 1]]
        assert len(found) == len(expected)

        def in_order(rows: np.ndarray) -> np.ndarray:
            keys = np.rint(rows[:, :4] / [1.0, *(3 * [1e-3 * system.radius])])  # noqa: B023
            return rows[np.lexsort(keys.T[::-1])]

        np.testing.assert_allclose(in_order(found), in_order(expected), atol=1e-8 * system.radius)


def test_bytes_of_a_tile():
    """33 bytes a segment at most: one vertex with its tangent, a segment, a flag, and what the ends of fibers take."""
    tile = build_patch_scene(fabric("twill_1_3", fibers=30))
    assert tile.nbytes < 33 * len(tile.segments) + 10_000
    assert math.isclose(tile.scene.nbytes, tile.vertices.nbytes + tile.segments.nbytes + len(tile.segments))
