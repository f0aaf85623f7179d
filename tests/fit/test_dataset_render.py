"""Samples of data sets: drawn and rendered the same everywhere, lit as said, recorded completely."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import PAPER_WEAVES, SYSTEMS
from usdfab.fibers import generate_patch
from usdfab.fibers.fibers import closed_twist
from usdfab.fibers.tiles import tile_copies
from usdfab.fit.dataset.reader import decode_image
from usdfab.fit.dataset.records import sample_of, sample_record
from usdfab.fit.dataset.render import encode_image, render_sample, with_mean
from usdfab.fit.dataset.samples import CHOICES, draw_sample
from usdfab.fit.dataset.settings import Settings
from usdfab.fit.dataset.views import MAX_ROTATION, sample_view, unrepeated, view_scene
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import Material

TINY = Settings(prior="both", size=16, spp=1, denoised=False)


@given(st.sampled_from(CHOICES), st.integers(0, 2**31 - 1), st.integers(0, 10**6 - 1))
@settings(max_examples=20)
def test_a_record_says_everything(choice: str, seed: int, index: int) -> None:
    sample = draw_sample(choice, seed, index)
    record = json.loads(json.dumps(sample_record(sample, TINY.rendering(), b"")))
    assert sample_of(record) == sample == draw_sample(choice, seed, index)


def test_both_priors_take_turns_and_are_the_same_alone() -> None:
    both = [draw_sample("both", 5, i) for i in range(28)]
    assert [s.prior for s in both] == ["paper", "wide"] * 14
    assert [s.label for s in both[::2]] == list(PAPER_WEAVES) * 2
    for alone, together in (("paper", both[0::2]), ("wide", both[1::2])):
        for k, sample in enumerate(together):
            assert replace(sample, index=k) == draw_sample(alone, 5, k)


@pytest.mark.parametrize("choice,seed,index", [("narrow", 0, 0), ("paper", -1, 0), ("paper", 0, 10**6)])
def test_samples_that_do_not_exist(choice: str, seed: int, index: int) -> None:
    with pytest.raises(UsdfabError):
        draw_sample(choice, seed, index)


def test_records_of_something_else_are_refused() -> None:
    record = sample_record(draw_sample("paper", 0, 0), {}, b"")
    for broken in ({}, record | {"schema": "x/1"}, {k: v for k, v in record.items() if k != "view"}):
        with pytest.raises(UsdfabError, match="place"):
            sample_of(broken, "place")
    record["fabric"]["warp"]["crimp"] = 99.0
    with pytest.raises(UsdfabError, match="99 is not between"):
        sample_of(record)


@pytest.mark.parametrize("index", [0, 1])
def test_a_sample_is_the_same_picture_each_time_and_another_seed_another(index: int) -> None:
    first, again = (render_sample(TINY, index) for _ in range(2))
    assert first.image == again.image and first.record == again.record
    pixels = decode_image(first.image)
    assert pixels.shape == (16, 16, 3) and np.isfinite(pixels).all() and pixels.mean() > 1e-4
    assert render_sample(replace(TINY, seed=1), index).image != first.image


def test_denoising_keeps_the_mean() -> None:
    noisy = render_sample(TINY, 4)
    clean = render_sample(replace(TINY, denoised=True), 4)
    a, b = (decode_image(r.image) for r in (noisy, clean))
    np.testing.assert_allclose(a.mean(axis=(0, 1)), b.mean(axis=(0, 1)), rtol=2e-3)
    assert b.std() < a.std()


def test_restoring_the_mean_of_a_black_channel() -> None:
    pixels = np.zeros((4, 4, 3), dtype=np.float32)
    assert np.array_equal(with_mean(pixels, pixels + 1), pixels)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_images_are_stored_to_a_quarter_percent(seed: int) -> None:
    pixels = np.exp(np.random.default_rng(seed).normal(-1.0, 2.0, (8, 8, 3))).astype(np.float32)
    pixels[0, 0] = 0.0
    # Half a step of 2^-8, and half floats' own rounding.
    np.testing.assert_allclose(decode_image(encode_image(pixels)), pixels, rtol=2.0**-9 + 2.0**-11, atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_a_white_diffuse_sample_has_radiance_one_in_the_middle(seed: int) -> None:
    """The light of any view, checked by a surface whose radiance is known: E / pi."""
    sample = draw_sample("wide", 3, seed)
    # Lamps hide some of the sky and of its light; each is looked at without the other, then both roughly.
    lamps = replace(sample.view, sky=0.0, backing=0.0)
    mixed = replace(lamps, sky=0.5)
    for view, bound in ((lamps, 0.01), (replace(mixed, lamp_radius=0.0), 0.01), (mixed, 0.05)):
        scene = view_scene(sample.fabric, view)
        paper = Material("/Paper", -1, np.ones(3), 1.0, 0.0, 1.0, specular_color=np.zeros(3), ior=1.0)
        scene = replace(scene, materials=(paper,), fabrics=())
        how = RenderSettings((9, 9), 4000, max_depth=2, region=(4, 4, 5, 5), threads=1)
        found = Tracer(scene).render(scene.cameras[0], how)
        assert found.pixels.mean() == pytest.approx(1.0, abs=bound + 5 * float(np.sqrt(found.variance.max())))


def test_no_lamp_stands_in_the_camera_s_view() -> None:
    for index in range(200):
        sample = draw_sample("wide", 4, index)
        view, half = sample.view, np.hypot(*sample.fabric.size) / 2
        for x, y, z in view.lamps:
            # The view's cone at the height of the sphere's lowest point, where it is widest.
            low = max(0.0, z - view.lamp_radius)
            cone = half * max(0.0, 1.0 - low / view.camera_height)
            assert view.lamp_radius == 0.0 or np.hypot(x, y) - view.lamp_radius > cone


def test_the_cloth_is_turned_and_slides() -> None:
    fabric = draw_sample("wide", 0, 0).fabric
    view = sample_view(fabric, np.random.default_rng(1))
    mesh = view_scene(fabric, view).meshes[0]
    straight = view_scene(fabric, replace(view, rotation=0.0, shift=(0.0, 0.0))).meshes[0]
    assert abs(view.rotation) <= MAX_ROTATION
    edge = mesh.points[1] - mesh.points[0]
    assert np.arctan2(edge[1], edge[0]) == pytest.approx(view.rotation)
    np.testing.assert_allclose(straight.uv - mesh.uv, np.broadcast_to(view.shift, (2, 3, 2)))
    # A turned plane still fills the picture: its sides are farther away than the picture's corners.
    corners = mesh.points[:, :2]
    sides = np.roll(corners, -1, axis=0) - corners
    away = np.abs(sides[:, 0] * corners[:, 1] - sides[:, 1] * corners[:, 0]) / np.linalg.norm(sides, axis=1)
    assert away.min() > np.hypot(*fabric.size) / 2


@given(st.integers(0, 200))
@settings(max_examples=5)
def test_labels_of_plied_yarns_are_the_twist_that_is_woven(index: int) -> None:
    sample = draw_sample("wide", 9, index)
    tile = unrepeated(sample.fabric)
    copies = tile_copies(tile)
    picks, ends = tile.repeat()
    for system, length in zip(SYSTEMS, (picks * copies[1], ends * copies[0]), strict=True):
        yarn = tile.system(system)
        if yarn.ply_count > 1:
            assert closed_twist(yarn.twist, length, yarn.ply_count) == pytest.approx(yarn.twist, abs=1e-12)
    size = generate_patch(replace(tile, warp=replace(tile.warp, fiber_count=4), weft=replace(tile.weft, fiber_count=4)),
                          vertices_per_segment=4).size  # fmt: skip
    assert size == pytest.approx((ends * tile.cell[0], picks * tile.cell[1]))
    # The same cloth: cells are as large, and the weave is the same.
    assert tile.cell == sample.fabric.cell
    assert tile.weave.equivalent(sample.fabric.weave)
