"""The binding: what Embree says about curves and triangles, against school geometry."""

from __future__ import annotations

import gc
import math
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from scenes import fabric

from usdfab.tracer import embree, patch_scene
from usdfab.tracer.embree import NEIGHBOR_LEFT, NEIGHBOR_RIGHT, EmbreeScene, add_triangles, curve_scene
from usdfab.tracer.intrinsics import (
    ARGS_FILTER,
    ARGS_PLAIN,
    NG,
    PRIM,
    TFAR,
    U,
    V,
    filter_address,
    intersect,
    new_ray_buffer,
    occluded,
)


def test_threads_that_come_first_share_one_device():
    program = """
import sys, threading
from concurrent.futures import ThreadPoolExecutor
from usdfab.tracer import embree
sys.setswitchinterval(1e-6)
together = threading.Barrier(8)
def first(_):
    together.wait()
    return embree.device()
with ThreadPoolExecutor(8) as pool:
    print(len(set(pool.map(first, range(8)))))
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert run.stdout.strip() == "1"


class Hit(NamedTuple):
    hit: np.ndarray
    t: np.ndarray
    normal: np.ndarray
    u: np.ndarray
    v: np.ndarray
    prim: np.ndarray
    blocked: np.ndarray


@njit
def _shoot(functions, filter_function, scene, origins, directions, near, far, arguments, out):
    buffer = new_ray_buffer(filter_function)
    floats, words, _ = buffer
    for k in range(len(origins)):
        o, d = origins[k], directions[k]
        out[k, 0] = intersect(functions[0], scene, buffer, o[0], o[1], o[2], d[0], d[1], d[2], near, far, arguments)
        out[k, 1:7] = floats[TFAR], floats[NG], floats[NG + 1], floats[NG + 2], floats[U], floats[V]
        out[k, 7] = words[PRIM]
        out[k, 8] = occluded(functions[1], scene, buffer, o[0], o[1], o[2], d[0], d[1], d[2], near, far, arguments)


def shoot(scene, origins, directions, near=0.0, far=1e30, arguments=ARGS_FILTER) -> Hit:
    origins, directions = np.atleast_2d(origins).astype(float), np.atleast_2d(directions).astype(float)
    out = np.zeros((len(origins), 9))
    functions = tuple(np.uint64(a) for a in embree.function_addresses())
    _shoot(
        functions, np.uint64(filter_address()), np.uint64(scene.handle), origins, directions, near, far, arguments, out
    )
    return Hit(out[:, 0] > 0, out[:, 1], out[:, 2:5], out[:, 5], out[:, 6], out[:, 7].astype(int), out[:, 8] > 0)


@pytest.fixture(scope="module")
def rod():
    """Three segments of a straight rod of radius 0.1 along x, from 0 to 3."""
    vertices = np.c_[np.arange(4.0), np.zeros((4, 2)), np.full(4, 0.1)]
    flags = np.array([NEIGHBOR_RIGHT, NEIGHBOR_LEFT | NEIGHBOR_RIGHT, NEIGHBOR_LEFT])
    return curve_scene(vertices, np.arange(3), flags)


def triangle_scene(points, triangles):
    """A committed scene of triangles."""
    scene = EmbreeScene()
    add_triangles(scene, np.asarray(points, dtype=float), triangles)
    return scene.commit()


def test_version():
    assert embree.version().startswith("4.")


def test_curve_is_hit_where_geometry_says(rod):
    y = np.linspace(-0.09, 0.09, 7)
    x = np.linspace(0.2, 2.8, 7)
    hit = shoot(rod, np.c_[x, y, np.full(7, 1.0)], np.tile([0.0, 0.0, -1.0], (7, 1)))
    height = np.sqrt(0.01 - y**2)
    assert hit.hit.all() and hit.blocked.all()
    np.testing.assert_allclose(hit.t, 1.0 - height, rtol=1e-5)
    normal = hit.normal / np.linalg.norm(hit.normal, axis=1, keepdims=True)
    np.testing.assert_allclose(normal, np.c_[np.zeros(7), y, height] / 0.1, atol=1e-4)
    np.testing.assert_array_equal(hit.prim, np.floor(x))
    np.testing.assert_allclose(hit.u, x - np.floor(x), atol=1e-4)


def test_curve_is_missed_beside_and_beyond_the_ray(rod):
    assert not shoot(rod, [1.5, 0.101, 1.0], [0, 0, -1]).hit[0]
    assert not shoot(rod, [1.5, 0.0, 1.0], [0, 0, -1], far=0.89).hit[0]
    assert not shoot(rod, [1.5, 0.0, 1.0], [0, 0, -1], far=0.89).blocked[0]
    assert shoot(rod, [1.5, 0.0, 1.0], [0, 0, -1], near=0.89, far=0.91).hit[0]


def test_filter_lets_a_ray_leave_the_fiber_it_is_in(rod):
    inside = [1.5, 0.0, 0.05]
    assert shoot(rod, inside, [0, 0, -1], arguments=ARGS_PLAIN).hit[0]  # this Embree does not cull
    assert not shoot(rod, inside, [0, 0, -1]).hit[0]
    assert not shoot(rod, inside, [0, 0, -1]).blocked[0]
    # Along the fiber too: joints of segments are no surface.
    assert not shoot(rod, [0.5, 0.0, 0.0], [1, 0.01, 0.02]).hit[0]


def test_filter_goes_on_to_the_next_fiber():
    vertices = np.array([[0, 0, 0, 0.1], [1, 0, 0, 0.1], [0, 0, -1, 0.1], [1, 0, -1, 0.1]])
    pair = curve_scene(vertices, np.array([0, 2]), np.zeros(2))
    hit = shoot(pair, [0.5, 0, 0], [0, 0, -1])
    assert hit.hit[0] and hit.blocked[0] and hit.prim[0] == 1
    np.testing.assert_allclose(hit.t, 0.9, rtol=1e-5)


def test_triangles():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    scene = triangle_scene(points, np.array([[0, 1, 2], [1, 3, 2]]))
    hit = shoot(
        scene, [[0.2, 0.3, 2], [0.9, 0.8, -3], [1.2, 0.5, 1]], [[0, 0, -1], [0, 0, 1], [0, 0, -1]], arguments=ARGS_PLAIN
    )
    np.testing.assert_array_equal(hit.hit, [True, True, False])
    np.testing.assert_array_equal(hit.prim[:2], [0, 1])
    np.testing.assert_allclose(hit.t[:2], [2, 3], rtol=1e-6)
    np.testing.assert_allclose([hit.u[0], hit.v[0]], [0.2, 0.3], atol=1e-6)
    assert hit.normal[0, 2] > 0 and hit.normal[0, 0] == hit.normal[0, 1] == 0


def test_scenes_keep_their_buffers():
    """Embree shares the arrays: the scene must own them, or this reads freed memory."""
    scene = triangle_scene(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    gc.collect()
    filler = [np.full(64, np.nan) for _ in range(1000)]
    assert shoot(scene, [0.2, 0.2, 1], [0, 0, -1], arguments=ARGS_PLAIN).hit[0]
    assert scene.nbytes > 0 and len(filler) == 1000


@pytest.mark.parametrize("fibers", [12, 200])
def test_hits_on_a_patch_lie_on_their_fiber(fibers):
    """Embree's curve intersector has absolute thresholds: in metres it returns u = 0 for fibers of 1e-5."""
    tile = patch_scene.build_patch_scene(fabric(fibers=fibers))
    rng = np.random.default_rng(0)
    count = 4000
    origins = np.c_[rng.uniform(0, tile.size[0], count), rng.uniform(0, tile.size[1], count), np.zeros(count)]
    angle, up = rng.uniform(0, 2 * math.pi, count), rng.uniform(-1, 1, count)
    flat = np.sqrt(1 - up**2)
    directions = np.c_[flat * np.cos(angle), flat * np.sin(angle), up]
    hit = shoot(tile.scene, origins, directions)
    vertices = tile.vertices.astype(float)
    some = hit.hit
    assert some.mean() > 0.5
    first = tile.segments[hit.prim[some], 0].astype(np.int64)
    a, b, radius = vertices[first, :3], vertices[first + 1, :3], vertices[first, 3]
    place = origins[some] + hit.t[some, None] * directions[some]
    along = np.einsum("kx,kx->k", place - a, b - a) / np.einsum("kx,kx->k", b - a, b - a)
    u = np.clip(along, 0, 1)
    off = np.linalg.norm(place - (a + u[:, None] * (b - a)), axis=1)
    np.testing.assert_allclose(off, radius, rtol=2e-3)
    np.testing.assert_allclose(hit.u[some], u, atol=2e-2)
    assert hit.u[some].std() > 0.2  # not the same place always
    outward = place - (a + u[:, None] * (b - a))
    cosine = np.einsum("kx,kx->k", outward, hit.normal[some])
    cosine /= np.linalg.norm(outward, axis=1) * np.linalg.norm(hit.normal[some], axis=1)
    assert cosine.min() > 0.99
    assert np.all(np.einsum("kx,kx->k", directions[some], hit.normal[some]) <= 0)


def test_threads_that_start_together_share_one_device():
    """Two devices would leave scenes silently empty: geometry of one does not show in a scene of the other."""
    made = []

    def slow() -> object:
        time.sleep(0.02)
        made.append(object())
        return made[-1]

    shared, barrier = embree._once(slow), threading.Barrier(4)

    def ask(_: int) -> object:
        barrier.wait()
        return shared()

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(ask, range(4)))
    assert len(made) == 1 and all(f is made[0] for f in found)
    assert all(hasattr(f, "__wrapped__") for f in (embree.library, embree.device, embree.function_addresses))
