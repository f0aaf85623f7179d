"""Fibers bent onto surfaces: exactly there, cut exactly where the cloth or the region ends."""

from __future__ import annotations

import numpy as np
import pytest

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fibers import patch_variants
from usdfab.fibers.tiles import tile_copies, tile_variants
from usdfab.usd.expand.bake import bake_curves
from usdfab.usd.expand.curves import tile_curves
from usdfab.usd.expand.divide import divide
from usdfab.usd.expand.surface import ClothSurface
from usdfab.usd.scene import FabricSurface, Mesh

YARN = YarnParameters(count=10, radius=2e-4, fiber_count=5, flyaway_density=300.0, flyaway_length=5e-4)
FABRIC = FabricParameters(size=(5e-3, 5e-3), warp=YARN, weft=YARN)
COPIES = tile_copies(FABRIC)
VARIANTS = [list(tile_curves(p)) for p in patch_variants(FABRIC, 10, COPIES)]
TILING = divide((2 * COPIES[0], 2 * COPIES[1]), FABRIC.cell, len(VARIANTS))
SIDE = 5e-3


def surface(n: int, shape) -> ClothSurface:
    """A square of SIDE metres of cloth in n x n quads, put through ``shape`` of the cloth's (x, y)."""
    y, x = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(0, SIDE, n + 1)], indexing="ij"))
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    triangles = np.concatenate([first + np.array(c) for c in ([0, 1, n + 2], [0, n + 2, n + 1])])
    points, normals = shape(x, y)
    mesh = Mesh("/M", points, triangles, normals[triangles], np.column_stack([x, y])[triangles],
                np.zeros(len(triangles), dtype=np.int32), False)  # fmt: skip
    return ClothSurface(mesh, FabricSurface("/F", FABRIC, 1.0), np.ones(len(triangles), dtype=bool))


def flat(x, y):
    return np.stack([x, y, 0 * x], axis=-1), np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))


def plain(uv, colors):
    return colors


def ends(curves):
    """First and last place of each spline."""
    weights = np.array([1, 4, 1]) / 6
    o = curves.offsets
    first = np.stack([weights @ curves.points[s : s + 3] for s in o[:-1]])
    return first, np.stack([weights @ curves.points[e - 3 : e] for e in o[1:]])


def test_on_a_plane_fibers_are_those_of_the_tiles():
    baked = {c.name: c for c in bake_curves(surface(3, flat), TILING, VARIANTS, plain)}
    assert set(baked) == {"Warp", "Weft", "WarpFlyaways", "WeftFlyaways"}
    variant = int(tile_variants(1, 1, len(VARIANTS)))  # a tile that lies wholly inside
    for kind in VARIANTS[variant]:
        expected = kind.points + np.array([*TILING.size, 0.0])
        distance = np.linalg.norm(baked[kind.name].points[:, None] - expected[None, ::7], axis=2).min(axis=0)
        assert distance.max() < 1e-12
        assert baked[kind.name].radius == kind.radius


def test_curves_end_at_the_border():
    baked = bake_curves(surface(3, flat), TILING, VARIANTS, plain)
    for curves in baked:
        for place in ends(curves):
            assert (place[:, :2] > -1e-8).all() and (place[:, :2] < SIDE + 1e-8).all()
        assert (curves.counts >= 4).all() and curves.counts.sum() == len(curves.points)
    warp = baked[0]
    first, last = ends(warp)
    # Every fiber of the warp reaches both borders of the cloth, and goes on in between.
    length = (last - first)[:, 1].sum()
    fibers = 10 * len(np.unique(warp.fiber))
    assert length == pytest.approx(fibers * SIDE, rel=0.01)


def test_a_region_is_cut_out():
    region = (1.1e-3, 0.9e-3, 2.3e-3, 2.05e-3)
    for curves in bake_curves(surface(3, flat), TILING, VARIANTS, plain, region):
        for place in ends(curves):
            assert (place[:, :2] > np.array(region[:2]) - 1e-8).all()
            assert (place[:, :2] < np.array(region[2:]) + 1e-8).all()


def test_height_stands_on_the_surface():
    """On a cylinder of radius R a fiber at height z is R + z from the axis; yarns keep their arc length."""
    radius = 3e-3

    def cylinder(x, y):
        a = x / radius
        normal = np.stack([np.sin(a), 0 * a, np.cos(a)], axis=-1)
        return np.stack([radius * np.sin(a), y, radius * np.cos(a)], axis=-1), normal

    bent = bake_curves(surface(200, cylinder), TILING, VARIANTS, plain)
    straight = bake_curves(surface(200, flat), TILING, VARIANTS, plain)
    for one, other in zip(bent, straight, strict=True):
        np.testing.assert_array_equal(one.counts, other.counts)
        angle = np.arctan2(one.points[:, 0], one.points[:, 2])
        inside = ((other.points[:, :2] > 0) & (other.points[:, :2] < SIDE)).all(axis=1)
        height = np.hypot(one.points[:, 0], one.points[:, 2]) - radius
        np.testing.assert_allclose(height[inside], other.points[inside, 2], atol=5e-7)
        np.testing.assert_allclose((radius * angle)[inside], other.points[inside, 0], atol=5e-7)
        np.testing.assert_allclose(one.points[inside, 1], other.points[inside, 1], atol=5e-7)


def test_height_scales_with_the_cloth():
    def stretched(x, y):
        return np.stack([2 * x, 0.5 * y, 0 * x], axis=-1) * 3, np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))

    bent = bake_curves(surface(3, stretched), TILING, VARIANTS, plain)
    straight = bake_curves(surface(3, flat), TILING, VARIANTS, plain)
    for one, other in zip(bent, straight, strict=True):
        np.testing.assert_allclose(one.points, other.points * [6, 1.5, 3], atol=1e-9)


def test_neighbouring_tiles_meet_exactly():
    def dented(x, y):
        k = 900.0
        z = 4e-4 * np.sin(k * x) * np.cos(k * y)
        dx, dy = 4e-4 * k * np.cos(k * x) * np.cos(k * y), -4e-4 * k * np.sin(k * x) * np.sin(k * y)
        normal = np.stack([-dx, -dy, 1 + 0 * x], axis=-1)
        return np.stack([x, y, z], axis=-1), normal / np.linalg.norm(normal, axis=1, keepdims=True)

    warp = bake_curves(surface(40, dented), TILING, VARIANTS, plain)[0]
    first, last = ends(warp)
    inner = last[(last[:, 1] < 0.9 * SIDE)]
    nearest = np.linalg.norm(inner[:, None] - first[None], axis=2).min(axis=1)
    assert nearest.max() < 1e-12


def test_colours_follow_the_surface():
    def tint(uv, colors):
        return colors * np.where(uv[:, :1] < 0.5 * SIDE, 1.0, 0.5)

    for curves in bake_curves(surface(3, flat), TILING, VARIANTS, tint):
        assert len(curves.color) == len(curves.points)
        left = curves.points[:, 0] < 0.5 * SIDE
        albedo = np.array(YARN.albedo)
        np.testing.assert_allclose(curves.color, np.where(left[:, None], albedo, 0.5 * albedo))


def test_too_many_points_are_refused_beforehand():
    def limit(count):
        raise UsdfabError(f"{count:g} points")

    with pytest.raises(UsdfabError, match="points"):
        bake_curves(surface(1, flat), TILING, VARIANTS, plain, limit=limit)
