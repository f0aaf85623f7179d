"""Fibers, hits, edges and views of the rasterizer, each against something known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from raster_reference import Segments
from raster_rows import crossing, meet, pass_by
from raster_scenes import coarse_fabric

from usdfab.errors import UsdfabError
from usdfab.fibers import generate_patch
from usdfab.fit.raster.curves import CurveModel
from usdfab.fit.raster.edges import Jumps, blended, inside, outside, pixel_pairs
from usdfab.fit.raster.view import view_of
from usdfab.fit.raster.visibility import NOTHING, index_patch, look
from usdfab.usd.rig import Rig, swatch_scene
from usdfab.usd.scene import DomeLight

DOWN = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)


def segment(start, end, radius=1.0) -> Segments:
    start, end = (torch.tensor([p], dtype=torch.float64) for p in (start, end))
    tangent = (end - start) / torch.linalg.norm(end - start)
    return Segments(start, end, tangent, tangent, torch.tensor([radius], dtype=torch.float64))


@pytest.mark.parametrize("plies", [1, 2])
def test_fibers_are_those_of_the_patch(plies):
    fabric = coarse_fabric(fiber_count=6, ply_count=plies, ply_twist=0.3 if plies > 1 else 0.0)
    model = CurveModel(fabric, (2, 1), 12)
    lines = model(model.shapes())
    patch = generate_patch(fabric, 12, (2, 1))
    np.testing.assert_allclose(
        lines.points.numpy(), np.concatenate([patch.warp.points, patch.weft.points]), rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(lines.radius.numpy(), [patch.warp.radius, patch.weft.radius], rtol=1e-12)
    # Following a fiber's vertices goes along its yarn, by less than a cell, also over the patch's border.
    ends = lines.points.numpy()[model.following] + np.c_[model.following_shift * model.size, np.zeros(model.vertices)]
    assert np.linalg.norm(ends - lines.points.numpy(), axis=1).max() < max(fabric.cell)
    assert (model.following[model.preceding] == np.arange(model.vertices)).all()


def test_a_ray_beside_a_cylinder():
    # Axis along x at height 0: a ray straight down at y = 0.6 radii meets it at height 0.8.
    s = segment((-1.0, 0.6 - 3.0, -5.0), (1.0, 0.6 - 3.0, -5.0))
    moved = s._replace(start=s.start + torch.tensor([[0.0, 3.0, 0.0]]), end=s.end + torch.tensor([[0.0, 3.0, 0.0]]))
    h, middle, half = pass_by(moved, DOWN)
    assert abs(float(h)) == pytest.approx(0.6)
    assert (float(middle), float(half)) == pytest.approx((5.0, 1.0))
    met = meet(moved, DOWN)
    assert float(met.distance) == pytest.approx(5.0 - 0.8)
    assert abs(float(met.h)) == pytest.approx(0.6, abs=1e-9)


def test_past_its_end_a_segment_is_a_sphere():
    s = segment((-3.0, 0.0, -5.0), (-0.5, 0.0, -5.0))
    h, middle, half = pass_by(s, DOWN)
    assert abs(float(h)) == pytest.approx(0.5)
    assert float(middle - half * torch.sqrt(1.0 - h * h)) == pytest.approx(5.0 - math.sqrt(0.75))


@settings(max_examples=100, deadline=None)
@given(st.floats(-1.2, 1.2), st.floats(-0.9, 0.9), st.floats(-1.0, 1.0), st.floats(0.2, 2.0))
def test_two_segments_agree_at_their_joint(turn, aside, along, length):
    # The same joint as the end of one segment and the start of the next, seen where both are past it.
    joint = (along, aside, -6.0)
    before = segment((along - length, aside, -6.0 - 0.3 * length), joint)
    after = segment(joint, (along + length * math.cos(turn), aside, -6.0 + length * math.sin(turn)))
    values = [meet(s, DOWN) for s in (before, after)]
    places = [v.distance for v in values]
    entries = [pass_by(s, DOWN)[2] for s in (before, after)]
    if all(float(e) == 1.0 for e in entries) and math.hypot(along, aside) < 0.99:
        ends = [float(torch.linalg.norm(p * DOWN - torch.tensor([joint]))) for p in places]
        if all(e == pytest.approx(1.0, abs=1e-6) for e in ends):
            assert float(places[0]) == pytest.approx(float(places[1]))


def row_with_a_jump(place, left, right):
    """Two functions that meet at ``place``, seen by eight pixels: their blended values."""
    x = np.arange(8) + 0.5
    row = torch.from_numpy(np.tile(np.where(x < place, left(x), right(x)), 2)[:, None])
    pairs = pixel_pairs(2, 8)[0]
    chosen = pairs[(x[pairs.p % 8] < place) & (x[pairs.q % 8] >= place)]
    t = torch.from_numpy(place - x[chosen.p % 8])
    here = x[inside(chosen, t) % 8]
    step = np.where(outside(chosen, t) == chosen.p, 1.0, -1.0) * (left(here) - right(here))
    return blended(row, [Jumps(chosen, t, torch.from_numpy(step)[:, None])]).numpy().reshape(2, 8)[0]


@settings(max_examples=100, deadline=None)
@given(st.floats(0.6, 7.4), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_row_with_one_jump_has_the_right_area(place, left, right):
    # Each pixel becomes its mean over its width, so sums are integrals.
    result = row_with_a_jump(place, lambda x: left + 0.0 * x, lambda x: right + 0.0 * x)
    assert result.sum() == pytest.approx(left * place + right * (8 - place), rel=1e-9)


@settings(max_examples=100, deadline=None)
@given(st.floats(0.6, 6.4), *[st.floats(-0.05, 0.05)] * 2, st.floats(0.5, 1.0), st.floats(0.5, 1.0))
def test_straight_functions_miss_only_their_bend_in_the_strip(place, slope_left, slope_right, left, right):
    # The strip from the jump to the pixel's border has the values of the pixel's middle: what the functions change from
    # there to the strip is left out, and nothing else.
    result = row_with_a_jump(place, lambda x: left + slope_left * x, lambda x: right + slope_right * x)
    integral = left * place + slope_left * place**2 / 2 + right * (8 - place) + slope_right * (64 - place**2) / 2
    away = abs(place - (math.floor(place) + 0.5))
    missing = 0.5 * (slope_right - slope_left) * (0.25 - away**2)
    # Which function fills the strip, and on which side of the middle it lies, change sign together.
    assert result.sum() + missing == pytest.approx(integral, rel=1e-9)


@pytest.mark.parametrize("place", [3.0, 3.5])
def test_a_jump_that_passes_a_border_or_a_middle_changes_nothing_suddenly(place):
    # However steep the functions are.
    values = [row_with_a_jump(place + side * 1e-9, np.exp, lambda x: 40.0 - x**2) for side in (-1.0, 1.0)]
    np.testing.assert_allclose(*values, rtol=1e-7)


def test_a_jump_lies_where_its_function_is_zero():
    t = crossing(torch.tensor([-1.0, 1.0, -3.0]), torch.tensor([1.0, -3.0, -1.0]))
    np.testing.assert_allclose(t.numpy(), [0.5, 0.25, 1.0])


def test_what_is_seen_is_what_is_nearest():
    fabric = coarse_fabric()
    model = CurveModel(fabric, (1, 1), 8)
    lines = model(model.shapes())
    points, radius = lines.points.detach().numpy(), lines.radius.detach().numpy()
    index = index_patch(model, points, radius)
    rng = np.random.default_rng(2)
    aims = np.c_[rng.uniform(-1, 2, (300, 2)) * model.size, np.zeros(300)]
    eye = np.array([0.3e-3, 0.2e-3, 0.06])
    rays = (aims - eye) / np.linalg.norm(aims - eye, axis=1, keepdims=True)
    seen, _ = look(index, eye, rays, np.zeros((0, 3)))
    # By hand: all segments in all near copies, one ray after the other.
    ends = points[model.following] + np.c_[model.following_shift * model.size, np.zeros(len(points))]
    for k, ray in enumerate(rays):
        best = (math.inf, NOTHING)
        for i in range(-2, 4):
            for j in range(-2, 4):
                shift = np.array([i * model.size[0], j * model.size[1], 0.0]) - eye
                s = Segments(
                    *(torch.from_numpy((p + shift) / radius[0]) for p in (points, ends)),
                    torch.zeros(0), torch.zeros(0), torch.from_numpy(radius[model.system] / radius[0]),
                )  # fmt: skip
                h, middle, half = pass_by(s, torch.from_numpy(ray).expand(len(points), 3))
                depth = torch.where(h.abs() < 1.0, middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0)), math.inf)
                nearest = int(depth.argmin())
                best = min(best, (float(depth[nearest]), nearest))
        if best[1] == NOTHING:
            assert seen.segment[k] == NOTHING
        else:
            assert model.curve[seen.segment[k]] == model.curve[best[1]]


def test_rigs_that_do_not_fit():
    scene = swatch_scene(coarse_fabric(), Rig((2e-3, 2e-3)))
    view = view_of(scene, scene.cameras[0], (4, 4))
    np.testing.assert_allclose(view.eye, [1e-3, 1e-3, 0.06], atol=1e-12)
    camera = scene.cameras[0]
    sideways = replace(camera, to_world=camera.to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    with pytest.raises(UsdfabError, match="look down"):
        view_of(scene, sideways, (4, 4))
    dome = DomeLight("/Dome", np.ones(3), "", np.eye(3))
    with pytest.raises(UsdfabError, match="point lights"):
        view_of(replace(scene, lights=(dome,)), camera, (4, 4))
    with pytest.raises(UsdfabError, match="no lamp"):
        view_of(replace(scene, lights=()), camera, (4, 4))
    with pytest.raises(UsdfabError, match="no cloth"):
        view_of(replace(scene, meshes=()), camera, (4, 4))
    small = replace(scene.fabrics[0], meters_per_uv=0.5)
    with pytest.raises(UsdfabError, match="true size"):
        view_of(replace(scene, fabrics=(small,)), camera, (4, 4))
    mesh = scene.meshes[0]
    bent = replace(mesh, points=mesh.points + np.array([[0, 0, 1e-3], [0, 0, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(UsdfabError, match="not flat"):
        view_of(replace(scene, meshes=(bent,)), camera, (4, 4))
