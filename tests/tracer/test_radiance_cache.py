"""The radiance cache: which boxes there are, what they hold, and that pictures stay nearly right with less noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scenes import cloth_material, dome, fabric, plane, scene, swatch

from usdfab.errors import UsdfabError
from usdfab.fabric import weave_from_name
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.cached_tracer import CachedTracer
from usdfab.tracer.patch_scene import build_tiles
from usdfab.tracer.radiance_cache import LIGHT, THROUGHPUT, box_at, crossings_that_differ, empty_cache, learned

# --- boxes ---


@pytest.mark.parametrize(
    ("name", "count"), [("plain", 2), ("twill 2/2", 4), ("satin 5/2", 5), ("basket 2/2", 8), ("110/001/010", 9)]
)
def test_crossings_that_look_the_same_are_one(name: str, count: int) -> None:
    weave = weave_from_name(name)
    numbers = crossings_that_differ(weave)
    assert numbers.shape == weave.matrix.shape
    assert sorted(set(numbers.ravel().tolist())) == list(range(count))
    # A number says which yarn is on top, and the same of every other crossing from there.
    matrix = weave.matrix
    for number in range(count):
        seen = {np.roll(matrix, (-j, -i), axis=(0, 1)).tobytes() for j, i in np.argwhere(numbers == number)}
        assert len(seen) == 1


@given(
    x=st.floats(0.0, 3.999), y=st.floats(0.0, 3.999), z=st.floats(-2.0, 2.0), row=st.integers(0, 7), up=st.booleans()
)
def test_a_place_one_repeat_on_is_in_the_same_box(x: float, y: float, z: float, row: int, up: bool) -> None:
    cloth = fabric("twill 2/2")
    cache = empty_cache(cloth, _TILE, 3)
    width, height = cache.cell
    box = box_at(cache, row, up, x * width, y * height, z * cache.high)
    assert 0 <= box < len(cache.radiance)
    # Twill: one pick on and one end on is the same crossing.
    diagonal = 1 if cache.crossings[1, 1] == cache.crossings[0, 0] else -1
    for a, b in ((4, 0), (0, 4), (diagonal, 1)):
        if 1e-6 < x % 0.25 < 0.25 - 1e-6 and 1e-6 < y % 0.25 < 0.25 - 1e-6:
            assert box_at(cache, row, up, (x + a) * width, (y + b) * height, z * cache.high) == box
    assert box_at(cache, row, not up, x * width, y * height, z * cache.high) != box


_TILE = build_tiles(fabric("twill 2/2"))[0]


def test_boxes_hold_light_over_throughput_and_lean_where_they_saw_little() -> None:
    cache = empty_cache(fabric(albedo_variation=0.5), build_tiles(fabric(albedo_variation=0.5))[0], 3)
    kinds = cache.shape[0]
    systems = np.arange(kinds, dtype=np.int32) % 2
    rng = np.random.default_rng(0)
    sums = np.zeros((len(cache.radiance), 6))
    sums[:, THROUGHPUT] = rng.uniform(0.0, 2.0, (len(sums), 1))
    # One radiance in all boxes: whatever leans on whatever, that is what comes out.
    sums[:, LIGHT] = sums[:, THROUGHPUT] * [0.2, 0.5, 3.0]
    np.testing.assert_allclose(
        learned(cache, sums, systems).radiance, np.tile([0.2, 0.5, 3.0], (len(sums), 1)), rtol=0.02
    )
    # Much is known of each box of one system, nothing of the other.
    boxes = sums.reshape(*cache.shape, 6)
    own = rng.uniform(0.5, 2.0, cache.shape[1:])
    boxes[..., THROUGHPUT], boxes[..., LIGHT] = 1e5, 0.0
    boxes[systems == 0, ..., LIGHT] = 1e5 * own[..., None]
    boxes[systems == 1] = 0.0
    found = learned(cache, sums, systems).radiance.reshape(*cache.shape, 3)
    np.testing.assert_allclose(found[0, ..., 1], own, rtol=1e-3)
    assert not found[systems == 1].any()


def test_the_mean_of_what_was_learned_from_is_kept() -> None:
    """Looked up where it was learned, the cache gives all light that was found: for each kind and direction."""
    cloth, rng = fabric(albedo_variation=0.5), np.random.default_rng(1)
    tile = build_tiles(cloth)[0]
    cache = empty_cache(cloth, tile, 3)
    sums = np.zeros((len(cache.radiance), 6))
    sums[:, THROUGHPUT] = rng.poisson(3.0, (len(sums), 1))
    sums[:, LIGHT] = sums[:, THROUGHPUT] * rng.gamma(0.3, 1.0, (len(sums), 3))
    radiance = learned(cache, sums, tile.systems).radiance
    shape = (*cache.shape[:2], -1, 3)
    given_back = (sums[:, THROUGHPUT] * radiance).reshape(shape).sum(axis=2)
    np.testing.assert_allclose(given_back, sums[:, LIGHT].reshape(shape).sum(axis=2), rtol=0.02)


# --- pictures ---


@pytest.fixture(scope="module")
def bright() -> Tracer:
    return Tracer(swatch(BRIGHT)[0], later_scale=0.15)


BRIGHT = fabric("twill 2/2", fibers=30, variants=2, albedo=(0.9, 0.8, 0.6), roughness_azimuthal=0.2)
CAMERA = swatch(BRIGHT)[1]
SMALL = RenderSettings((24, 24), spp=64, seed=1)


@pytest.fixture(scope="module")
def pair(bright: Tracer):
    settings = RenderSettings((32, 32), spp=128)
    return bright.render(CAMERA, settings), CachedTracer(bright, CAMERA, SMALL).render(CAMERA, settings)


def test_less_noise_for_fewer_rays(pair) -> None:
    whole, ended = pair
    assert ended.variance.mean() < 0.4 * whole.variance.mean()
    assert ended.rays < 0.6 * whole.rays


def test_the_first_bounce_and_all_that_is_seen_first_stay(pair) -> None:
    whole, ended = pair
    for name in ("direct", "albedo", "normal", "depth", "fiber_id"):
        np.testing.assert_array_equal(getattr(ended, name), getattr(whole, name))


def test_brightness_stays(bright: Tracer, pair) -> None:
    """Of the whole picture, over what several draws to learn from make of it, and of blocks of it."""
    whole, _ = pair
    settings = RenderSettings((32, 32), spp=32)
    found = np.array([
        CachedTracer(bright, CAMERA, replace(SMALL, seed=seed)).render(CAMERA, settings).pixels for seed in range(1, 7)
    ])  # fmt: skip
    error = whole.variance.mean(axis=(0, 1)) ** 0.5 / 32
    means = found.mean(axis=(1, 2))
    spread = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    expected = whole.pixels.mean(axis=(0, 1))
    assert (np.hypot(error, spread) < 0.02 * expected).all(), "too noisy to tell"
    assert (np.abs(means.mean(axis=0) / expected - 1.0) < 0.02 + 2.0 * np.hypot(error, spread) / expected).all()
    blocks = [p.reshape(4, 8, 4, 8, 3).mean(axis=(1, 3)) for p in (whole.pixels, found.mean(axis=0))]
    assert np.abs(blocks[1] / blocks[0] - 1.0).mean() < 0.05


def test_white_cloth_in_white_surroundings_stays_white() -> None:
    cloth = fabric(fibers=8, albedo=(1.0, 1.0, 1.0))
    # The swatch's plane is the only thing there is.
    there, camera = swatch(cloth, dome())
    tracer = Tracer(there)
    settings = RenderSettings((16, 16), spp=64, max_depth=2000)
    render = CachedTracer(tracer, camera, replace(settings, seed=1)).render(camera, settings)
    assert render.pixels.mean() == pytest.approx(1.0, abs=0.01)


def test_paths_that_never_get_as_deep_are_the_tracers_own(bright: Tracer) -> None:
    settings = RenderSettings((16, 16), spp=4, max_depth=6)
    whole = bright.render(CAMERA, settings)
    ended = CachedTracer(bright, CAMERA, replace(settings, seed=1), depth=7).render(CAMERA, settings)
    np.testing.assert_array_equal(ended.pixels, whole.pixels)
    assert ended.rays == whole.rays


def test_the_same_on_any_number_of_threads(bright: Tracer) -> None:
    found = []
    for threads in (1, 3):
        settings = RenderSettings((16, 16), spp=4, threads=threads)
        found.append(CachedTracer(bright, CAMERA, replace(settings, seed=1)).render(CAMERA, settings).pixels)
    np.testing.assert_array_equal(*found)


def test_it_is_of_one_fabric() -> None:
    first, second = fabric(), fabric("twill 2/2")
    meshes = (plane(5e-3), plane(5e-3, material=1, z=-1e-2))
    two = scene(meshes, (cloth_material(0), cloth_material(1)), [dome()], (first, second))
    with pytest.raises(UsdfabError, match="of one fabric, the scene has 2"):
        CachedTracer(Tracer(two), CAMERA, SMALL)
