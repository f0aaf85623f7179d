"""Tiles, passes, stopping, unfinished renders: the same picture however it is made, and honest errors."""

from __future__ import annotations

import errno
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
import scenes
from hypothesis import given, settings as hypothesis_settings, strategies as st
from scenes import cloth_material, dome, fabric, lambert, plane, swatch

from usdfab.errors import UsdfabError
from usdfab.memory import available_memory
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.accumulate import ThreadRunner, accumulate
from usdfab.tracer.checkpoint import Autosave, Identity, fingerprint, load_work, merge_work, resume_work, save_work
from usdfab.tracer.film import ALPHA, CHANNELS, DEPTH, DIRECT, FIBER_ID, NORMAL, RGB, SAMPLES, UV, YARN_ID
from usdfab.tracer.memory import check_memory
from usdfab.tracer.render import Render, develop, resolve_region, start
from usdfab.tracer.schedule import (
    BLOCK,
    FIRST_DECISION,
    LAYERS,
    Work,
    bounds,
    next_count,
    plan_tiles,
    relative_error,
    tile_side,
)
from usdfab.usd.scene import DistantLight

SIDE = 104
"""Not a multiple of the tiles' 16."""
NOISE = 0.05
"""Reached by different tiles of the sample at 16, 32 and more samples."""


@pytest.fixture(scope="module")
def sample():
    """A small square of cloth near the corner of a diffuse floor in the sun: noise in one place only."""
    meshes = [plane(0.2, 1, z=-0.01), plane(0.016, 0, center=(-0.02, 0.02))]
    sun = DistantLight("/Sun", np.array([0.0, 0.0, -1.0]), np.full(3, 3.0), 0.0)
    scene = scenes.scene(meshes, [cloth_material(), lambert()], [sun], [fabric(fibers=3)])
    return Tracer(scene), replace(scenes.look((0, 0, 0.3), (0, 0, 0)), exposure=0.25)


def assert_same(a: Render, b: Render, but: tuple[str, ...] = ()) -> None:
    for name in vars(a):
        if name not in ("seconds", *but):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def crop(render: Render, x0: int, y0: int, x1: int, y1: int) -> dict[str, np.ndarray]:
    return {k: v[y0:y1, x0:x1] for k, v in vars(render).items() if isinstance(v, np.ndarray)}


# --- tiles and passes ------------------------------------------------------------------------------------------------


@given(
    st.integers(1, 130),
    st.integers(1, 130),
    st.tuples(*4 * [st.floats(0, 1)]),
    st.integers(1, 5),
    st.booleans(),
)
def test_parts_cover_a_region_once(width, height, corners, parts, adaptive):
    a, b, c, d = corners
    x0, y0 = int(min(a, c) * (width - 1)), int(min(b, d) * (height - 1))
    x1, y1 = max(x0 + 1, int(max(a, c) * width)), max(y0 + 1, int(max(b, d) * height))
    region, seen = (x0, y0, x1, y1), np.zeros((height, width), dtype=int)
    for i in range(1, parts + 1):
        tiles = plan_tiles(width, height, region, (i, parts), adaptive)
        work = Work(tiles)
        for tile in tiles:
            u0, v0, u1, v1 = tile.window
            assert 0 <= u0 < u1 <= width and 0 <= v0 < v1 <= height
            assert work.part(tile.window).shape == (v1 - v0, u1 - u0, LAYERS)
            if tile.wanted:
                seen[v0:v1, u0:u1] += 1
    inside = np.zeros_like(seen)
    inside[y0:y1, x0:x1] = 1
    assert np.array_equal(seen[y0:y1, x0:x1], inside[y0:y1, x0:x1])
    if not adaptive:
        assert np.array_equal(seen, inside)


def test_wanted_tiles_have_all_their_neighbours():
    tiles = plan_tiles(160, 160, (70, 70, 90, 90), adaptive=True)
    wanted = {(t.row, t.column) for t in tiles if t.wanted}
    assert wanted == {(r, c) for r in (4, 5) for c in (4, 5)}
    assert {(t.row, t.column) for t in tiles} == {(r, c) for r in range(3, 7) for c in range(3, 7)}
    assert tile_side(1280, 720) == 32


def test_a_small_region_has_tiles_for_many_threads_and_noise_does_not_see_them():
    assert len(plan_tiles(400, 400, (180, 180, 220, 220))) >= 25
    assert plan_tiles(400, 400, (180, 180, 220, 220), adaptive=True)[0].window == (160, 160, 176, 176)


@given(st.integers(1, 5000), st.integers(1, 5000))
def test_passes_end_and_meet_every_power_of_two(spp, begin):
    count, seen = min(begin, spp), set()
    while count < spp:
        after = next_count(count, spp)
        assert count < after <= count + max(16, count)
        assert after == spp or after & (after - 1) == 0 or after % 16 == 0
        seen.add(count := after)
    assert {2**k for k in range(13) if begin < 2**k <= spp} <= seen


# --- the same picture ------------------------------------------------------------------------------------------------


class Shuffled:
    """A runner that does tiles one at a time, in an order of its own."""

    def __init__(self, sample: Callable, seed: int) -> None:
        self.slots, self._sample, self._rng = 7, sample, np.random.default_rng(seed)
        self._waiting: list = []

    def submit(self, *job) -> Future:
        future: Future = Future()
        self._waiting.append((future, job))
        if len(self._waiting) == self.slots or self._rng.random() < 0.5:
            self._work()
        return future

    def _work(self) -> None:
        self._rng.shuffle(self._waiting)
        for future, job in self._waiting:
            future.set_result(self._sample(*job))
        self._waiting.clear()

    def result(self, future: Future):
        return future.result()

    def stop(self) -> None:
        self._waiting.clear()


class Patient(Shuffled):
    """Works only when a whole batch is there."""

    def submit(self, *job) -> Future:
        future = super().submit(*job)
        self._work()
        return future


@pytest.mark.parametrize("noise", [None, NOISE])
def test_neither_threads_nor_order_nor_passes_show(sample, noise):
    tracer, camera = sample
    settings = RenderSettings((SIDE, SIDE), spp=36, threads=1, noise=noise, max_depth=4)
    one = tracer.render(camera, settings)
    assert_same(one, tracer.render(camera, replace(settings, threads=2)))
    shot, work = start(camera, settings)
    runner = Patient(partial(tracer.sample, shot), 5)
    accumulate(work, runner, 36, noise=noise, gain=2.0**camera.exposure)
    assert_same(one, develop(work, one.region, one.size, camera.exposure, 0.0, tracer.segments))
    if noise:
        assert one.samples.min() < one.samples.max(), "the test needs tiles that stop at different counts"
    else:
        sums = np.zeros((SIDE, SIDE, LAYERS))
        for first, count in ((0, 7), (7, 29)):
            sums = tracer.sample(shot, (0, 0, SIDE, SIDE), first, count, sums)
        np.testing.assert_array_equal(sums, work.sums)


@pytest.mark.parametrize("noise", [None, NOISE])
@pytest.mark.parametrize("region", [(5, 9, 40, 33), (90, 30, 104, 104), (33, 17, 34, 18)])
def test_a_region_is_a_crop_of_the_whole(sample, noise, region):
    tracer, camera = sample
    settings = RenderSettings((SIDE, SIDE), spp=33, noise=noise, max_depth=3)
    whole = tracer.render(camera, settings)
    part = tracer.render(camera, replace(settings, region=region))
    for name, values in crop(whole, *region).items():
        np.testing.assert_array_equal(getattr(part, name), values, err_msg=name)
    assert part.region == region and part.size == (SIDE, SIDE)


@pytest.mark.parametrize("noise", [None, NOISE])
@pytest.mark.parametrize("count", [1, 3, 60])
def test_parts_merge_into_the_whole(sample, noise, count, tmp_path):
    tracer, camera = sample
    settings = RenderSettings((SIDE, SIDE), spp=18, noise=noise, max_depth=3, region=(3, 0, 104, 50))
    whole = tracer.render(camera, settings)
    paths = []
    for i in range(1, count + 1):
        mine = replace(settings, part=(i, count))
        shot, work = start(camera, mine)
        with ThreadRunner(partial(tracer.sample, shot), 2) as runner:
            accumulate(work, runner, 18, noise=noise, gain=2.0**camera.exposure)
        work.keep_wanted()
        paths.append(tmp_path / f"{i}.part")
        save_work(paths[-1], Identity.of("scene", shot, mine, tracer.segments), work, 18, 1.5)
    parts = [load_work(path) for path in reversed(paths)]
    merged = merge_work(parts, [str(p) for p in reversed(paths)])
    about = merged.identity
    render = develop(merged.work, about.region, (SIDE, SIDE), about.exposure, merged.seconds, about.segments)
    assert_same(whole, render)
    assert merged.seconds == 1.5 * count
    if count == 3:
        with pytest.raises(UsdfabError, match=r"tiles 2/3 of the picture are missing"):
            merge_work([parts[0], parts[2]], ["a", "b"])
        with pytest.raises(UsdfabError, match=r"b: holds tile 3/3, and so does a"):
            merge_work([parts[0], parts[0]], ["a", "b"])
        other = replace(parts[1], identity=replace(parts[1].identity, seed=1))
        with pytest.raises(UsdfabError, match=r"b: belongs to another render than a \(seed\)"):
            merge_work([parts[0], other], ["a", "b"])
        empty = replace(parts[1], work=Work(parts[1].work.tiles))
        with pytest.raises(UsdfabError, match="b: is not finished"):
            merge_work([parts[0], empty], ["a", "b"])


@pytest.mark.parametrize("noise", [None, NOISE])
@pytest.mark.parametrize("after", [1, 60, 250])
def test_resumed_is_undisturbed(sample, noise, after, tmp_path):
    tracer, camera = sample
    settings = RenderSettings((SIDE, SIDE), spp=40, noise=noise, max_depth=3)
    shot, work = start(camera, settings)
    identity = Identity.of("scene", shot, settings, tracer.segments)
    path, said = tmp_path / "x.exr.partial", []
    left = [after]

    def interrupt(done: int, total: int) -> None:
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    options = {"noise": noise, "gain": 2.0**camera.exposure}
    with ThreadRunner(partial(tracer.sample, shot), 2) as runner, pytest.raises(KeyboardInterrupt):
        autosave = Autosave(path, identity, 40, said.append, every=0.0)
        accumulate(work, runner, 40, progress=interrupt, save=autosave, **options)
    assert autosave.saved and not said
    resumed = resume_work(path, identity).work
    counts = resumed.counts()
    assert 0 < counts.sum() < 49 * 40
    with ThreadRunner(partial(tracer.sample, shot), 2) as runner:
        accumulate(resumed, runner, 40, **options)
    whole = tracer.render(camera, settings)
    assert_same(whole, develop(resumed, whole.region, whole.size, camera.exposure, 0.0, tracer.segments))
    with pytest.raises(UsdfabError, match=r"another one \(it differs in: scene, seed\)"):
        resume_work(path, replace(identity, scene="other", seed=1))
    autosave.remove()
    assert not list(tmp_path.iterdir())


def test_an_error_in_a_worker_is_passed_on_and_what_is_done_is_kept(sample):
    tracer, camera = sample
    shot, work = start(camera, RenderSettings((SIDE, SIDE), spp=2, max_depth=2))
    calls = []

    def broken(*job):
        calls.append(job)
        if len(calls) == 6:
            raise UsdfabError("no more")
        return tracer.sample(shot, *job)

    saved = []
    with ThreadRunner(broken, 1) as runner, pytest.raises(UsdfabError, match="no more"):
        accumulate(work, runner, 2, save=lambda work, must: saved.append(must))
    assert saved[-1] is True and work.counts().sum() >= 5


# --- stopping --------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def exponential_draws(seed: int, rare: bool) -> np.ndarray:
    """(512, 64, 64) samples of mean 1, or that are 40 in one of 1000."""
    rng = np.random.default_rng([seed, rare])
    draws = rng.exponential(0.5 if rare else 1.0, (512, 64, 64)).astype(np.float32)
    return (
        np.where(rng.random(draws.shape, dtype=np.float32) < 1e-3, draws + np.float32(40.0), draws) if rare else draws
    )


def noisy(seed: int, bright: Callable = lambda x, y: 1.0, rare: bool = False) -> Callable:
    """A stand-in for the tracer: gray samples from an exponential law of mean ``bright(x, y)``."""

    def sample(window, first, samples, sums):
        x0, y0, x1, y1 = window
        y, x = np.mgrid[y0:y1, x0:x1]
        values = exponential_draws(seed, rare)[first : first + samples, y0:y1, x0:x1] * bright(x, y)
        out = sums.copy()
        out[..., RGB : RGB + 3] += values.sum(axis=0, dtype=float)[..., None]
        out[..., CHANNELS:] += (values.astype(float) ** 2).sum(axis=0)[..., None]
        out[..., SAMPLES] += samples
        return out

    return sample


def test_the_error_is_that_of_the_picture():
    """Known law: variance of a mean of n exponentials is mean^2 / n."""
    sums = noisy(3, lambda x, y: np.where(x < 32, 0.5, 2.0))((0, 0, 64, 64), 0, 64, np.zeros((64, 64, LAYERS)))
    for gain in (1.0, 2.0):
        expected = np.sqrt(np.mean([m**2 / 64 / (m**2 + 0.01) for m in (0.5 * gain, 2.0 * gain)]))
        assert relative_error(sums, gain) == pytest.approx(expected, rel=0.02)
    truth = np.where(np.arange(64) < 32, 0.5, 2.0)[None, :, None]
    actual = np.mean((sums[..., :3] / 64 - truth) ** 2 / (truth**2 + 0.01))
    assert relative_error(sums) == pytest.approx(np.sqrt(actual), rel=0.05)
    assert relative_error(sums[:1, :1]) == pytest.approx(1 / 8, rel=1.0)
    assert relative_error(np.zeros((9, 5, LAYERS))) == np.inf
    black = np.zeros((BLOCK, BLOCK, LAYERS))
    black[..., SAMPLES] = 2
    assert relative_error(black) == 0.0


def test_adaptive_sampling_reaches_its_noise_without_bias():
    """Means of pictures against the known truth, over many seeds; a rare bright event tempts tiles to stop early."""
    wanted, side, seeds = 0.35, 64, 60
    means, spp, reached = [], [], []
    for seed in range(seeds):
        work = Work(plan_tiles(side, side, (0, 0, side, side), adaptive=True))
        with ThreadRunner(noisy(seed, rare=True), 1) as runner:
            accumulate(work, runner, 512, noise=wanted)
        n = work.sums[..., SAMPLES]
        means.append((work.sums[..., 0] / n).mean())
        spp.append(n.mean())
        stopped = n < 512
        reached.append(relative_error(work.sums) <= wanted or not stopped.all())
    error = np.std(means, ddof=1) / np.sqrt(seeds)
    assert abs(np.mean(means) - 0.54) < 3 * error, f"{np.mean(means)} +- {error}"
    assert error < 0.004, "the test could not see a bias of 2 %"
    assert min(spp) >= FIRST_DECISION and max(spp) < 512
    assert np.mean(reached) > 0.9


def test_adaptive_sampling_of_a_scene(sample):
    tracer, camera = sample
    settings = RenderSettings((SIDE, SIDE), spp=128, noise=NOISE, max_depth=3)
    adaptive = tracer.render(camera, settings)
    assert adaptive.samples.min() == FIRST_DECISION and adaptive.samples.max() > 2 * FIRST_DECISION
    assert adaptive.samples.mean() < 64
    shot, _ = start(camera, settings)
    gain, good = 2.0**camera.exposure, []
    for tile in plan_tiles(SIDE, SIDE, (0, 0, SIDE, SIDE)):
        x0, y0, x1, y1 = tile.window
        count = int(adaptive.samples[y0, x0])
        sums = tracer.sample(shot, tile.window, 0, count, np.zeros((y1 - y0, x1 - x0, LAYERS)))
        good.append(count == 128 or relative_error(sums, gain) <= NOISE)
    assert np.mean(good) > 0.9
    # Another seed, so that the two pictures are independent; the cloth, where the noise is.
    uniform = tracer.render(camera, replace(settings, noise=None, spp=32, seed=9))
    a, b = (render.pixels[:32, :32].mean() for render in (adaptive, uniform))
    error = np.sqrt(sum(render.variance[:32, :32].mean(axis=-1).sum() for render in (adaptive, uniform))) / 32**2
    assert abs(a - b) < 4 * error, f"{a} {b} +- {error}"
    assert error < 0.03 * b


def test_a_clean_scene_stops_at_the_first_decision():
    tracer = Tracer(scenes.scene([plane(1.0)], [lambert((0.5, 0.5, 0.5))], [dome()]))
    camera = scenes.look((0, 0, 1), (0, 0, 0))
    render = tracer.render(camera, RenderSettings((40, 24), spp=1000, max_depth=2, noise=0.5))
    assert set(np.unique(render.samples)) == {FIRST_DECISION} and render.noise <= 0.5


def test_time_ends_a_render_between_passes(sample):
    tracer, camera = sample
    render = tracer.render(camera, RenderSettings((32, 32), spp=10**6, time_limit=0.3, max_depth=2))
    assert render.spp == render.samples.min() == render.samples.max() > 1
    same = tracer.render(camera, RenderSettings((32, 32), spp=render.spp, max_depth=2))
    np.testing.assert_array_equal(render.pixels, same.pixels)


# --- files -----------------------------------------------------------------------------------------------------------


def small_work() -> tuple[Identity, Work]:
    identity = Identity("s", 20, 10, (0, 0, 20, 10), (1, 1), 0, 4, None, 0.0, 7)
    work = Work(plan_tiles(20, 10, identity.region))
    work.sums[...] = np.random.default_rng(0).random(work.sums.shape)
    return identity, work


def test_what_is_saved_is_loaded(tmp_path):
    identity, work = small_work()
    save_work(tmp_path / "a.partial", identity, work, 12, 3.5)
    saved = load_work(tmp_path / "a.partial")
    assert (saved.identity, saved.spp, saved.seconds) == (identity, 12, 3.5)
    np.testing.assert_array_equal(saved.work.sums, work.sums)
    np.testing.assert_array_equal(saved.work.stops, work.stops)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.partial"]


@pytest.mark.parametrize("kind", ["cut", "empty", "text", "pickle", "other", "shape", "missing", "folder"])
def test_files_that_are_no_unfinished_renders(kind, tmp_path):
    identity, work = small_work()
    path = tmp_path / "a.partial"
    save_work(path, identity, work, 12)
    if kind == "cut":
        path.write_bytes(path.read_bytes()[:-3000])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("hello")
    elif kind == "pickle":
        with path.open("wb") as file:
            np.savez(file, sums=np.array([object()]), stops=work.stops, about=np.array("{}"))
    elif kind == "other":
        with path.open("wb") as file:
            np.savez(file, sums=work.sums, stops=work.stops, about=np.array('{"format": "x"}'))
    elif kind == "shape":
        save_work(path, replace(identity, region=(0, 0, 10, 10)), work, 12)
    else:
        path.unlink()
        if kind == "folder":
            path.mkdir()
    with pytest.raises(UsdfabError) as caught:
        load_work(path)
    assert caught.value.place == str(path) and "\n" not in str(caught.value)


def test_a_full_disk_leaves_the_old_file_and_the_render_goes_on(sample, tmp_path, monkeypatch):
    identity, work = small_work()
    path = tmp_path / "a.partial"
    save_work(path, identity, work, 12)
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("usdfab.tracer.checkpoint.np.savez", full)
    with pytest.raises(UsdfabError, match=r"a\.partial: cannot be written \(No space left on device\)"):
        save_work(path, identity, work, 12)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    tracer, camera = sample
    said: list[str] = []
    shot, work = start(camera, RenderSettings((SIDE, SIDE), spp=2, max_depth=2))
    with ThreadRunner(partial(tracer.sample, shot), 2) as runner:
        accumulate(work, runner, 2, save=Autosave(path, identity, 2, said.append, every=0.0))
    assert len(said) == 1 and "No space left" in said[0]
    assert work.counts().min() == 2


def test_saving_takes_a_small_part_of_the_time(tmp_path, monkeypatch):
    identity, work = small_work()
    work.sums[..., SAMPLES] = 1
    now, saved = [0.0], []
    monkeypatch.setattr("usdfab.tracer.checkpoint.time.perf_counter", lambda: now[0])

    def slow(*_: object) -> None:
        saved.append(now[0])
        now[0] += 10.0

    monkeypatch.setattr("usdfab.tracer.checkpoint.save_work", slow)
    autosave = Autosave(tmp_path / "a", identity, 1, lambda text: None)
    while now[0] < 1000.0:
        now[0] += 1.0
        autosave(work, False)
    assert saved[0] == 30.0
    assert 10.0 * len(saved) <= 0.06 * now[0]
    count = len(saved)
    autosave(work, True)
    assert len(saved) == count + 1


# --- fingerprints ----------------------------------------------------------------------------------------------------


def test_a_fingerprint_sees_what_pixels_see():
    scene, camera = swatch(fabric(fibers=3))
    again, _ = swatch(fabric(fibers=3))
    assert fingerprint(scene) == fingerprint(again)
    assert fingerprint(scene) == fingerprint(replace(scene, path="/elsewhere.usda", warnings=("hm",)))
    mesh, material = scene.meshes[0], scene.materials[0]
    moved = mesh.points.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 1)
    others = [
        replace(scene, meshes=(replace(mesh, points=moved), *scene.meshes[1:])),
        replace(scene, meshes=(replace(mesh, double_sided=not mesh.double_sided), *scene.meshes[1:])),
        replace(scene, materials=(replace(material, roughness=0.123), *scene.materials[1:])),
        replace(scene, cameras=(replace(camera, exposure=0.5),)),
        replace(scene, lights=()),
        replace(scene, fabrics=tuple(replace(f, fabric=fabric(fibers=4)) for f in scene.fabrics)),
    ]
    prints = [fingerprint(s) for s in (scene, *others)]
    assert len(set(prints)) == len(prints)
    assert fingerprint(scene, {}) != fingerprint(scene, {"sky": np.ones((2, 4, 3))})


LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
TREES = st.recursive(
    LEAVES, lambda t: st.lists(t, max_size=3) | st.dictionaries(st.text(), t, max_size=3), max_leaves=6
)


@hypothesis_settings(max_examples=200)
@given(TREES, TREES)
def test_different_values_have_different_fingerprints(a, b):
    assert (fingerprint(a) == fingerprint(b)) == (repr(sorted_keys(a)) == repr(sorted_keys(b)))


def sorted_keys(tree):
    if isinstance(tree, dict):
        return {k: sorted_keys(tree[k]) for k in sorted(tree)}
    return [sorted_keys(t) for t in tree] if isinstance(tree, list) else tree


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"region": (0, 0, 33, 32)}, "--region"),
        ({"region": (5, 5, 5, 9)}, "--region"),
        ({"region": (-1, 0, 5, 9)}, "--region"),
        ({"part": (3, 2)}, "--tile"),
        ({"noise": 0.0}, "--noise"),
        ({"noise": float("nan")}, "--noise"),
        ({"time_limit": -1.0}, "--time"),
        ({"time_limit": float("nan")}, "--time"),
        ({"threads": 0}, "--threads"),
        ({"resolution": (20_000, 20_000)}, "too many"),
        ({"resolution": (2_000_000, 1)}, "too many"),
    ],
)
def test_settings_that_make_no_sense(sample, changes, words):
    tracer, camera = sample
    with pytest.raises(UsdfabError, match=words):
        tracer.render(camera, replace(RenderSettings((32, 32), spp=1), **changes))


def test_a_small_region_of_a_huge_picture_can_be_rendered(sample):
    tracer, camera = sample
    render = tracer.render(
        camera, RenderSettings((200_000, 200_000), spp=1, region=(99_990, 100_000, 100_000, 100_003), max_depth=2)
    )
    assert render.pixels.shape == (3, 10, 3)
    assert resolve_region(None, 7, 5) == (0, 0, 7, 5) and bounds([]) == (0, 0, 0, 0)


def test_memory_is_asked_for_beforehand(tmp_path, monkeypatch):
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    2048 kB\n")
    assert available_memory(tmp_path) == 2048 * 1024
    (tmp_path / "sys/fs/cgroup").mkdir(parents=True)
    (tmp_path / "sys/fs/cgroup/memory.max").write_text("max")
    (tmp_path / "sys/fs/cgroup/memory.current").write_text("5")
    assert available_memory(tmp_path) == 2048 * 1024
    (tmp_path / "sys/fs/cgroup/memory.max").write_text("1005")
    assert available_memory(tmp_path) == 1000
    monkeypatch.setattr("usdfab.tracer.memory.available_memory", lambda: 2**20)
    check_memory(40, 40)
    with pytest.raises(UsdfabError, match=r"4000 x 3000 pixels need about 4\.5 GiB"):
        check_memory(4000, 3000)
    monkeypatch.setattr("usdfab.tracer.memory.available_memory", lambda: None)
    check_memory(4000, 3000)


# --- developing ------------------------------------------------------------------------------------------------------


def test_sums_become_a_picture():
    """Two samples in one pixel, none in the other, every channel by hand."""
    work = Work(plan_tiles(2, 1, (0, 0, 2, 1)))
    sums = work.sums[0, 0]
    sums[RGB : RGB + 3], sums[CHANNELS:] = (1.0, 2.0, 3.0), (1.0, 2.5, 5.0)
    sums[DIRECT : DIRECT + 3] = (0.5, 1.0, 1.5)
    sums[NORMAL : NORMAL + 3] = (0.0, 0.0, 1.5)
    sums[DEPTH], sums[ALPHA], sums[SAMPLES] = 4.0, 1.0, 2.0
    sums[UV : UV + 2] = (0.25, 0.75)
    sums[FIBER_ID], sums[YARN_ID] = 2.0**24, 12.0
    render = develop(work, (0, 0, 2, 1), (2, 1), 1.0, 0.0, 5)
    np.testing.assert_array_equal(render.pixels[0, 0], [1.0, 2.0, 3.0])  # means doubled by the exposure
    np.testing.assert_array_equal(render.variance[0, 0], [4 * 0.25, 4 * 0.25, 4 * 0.25])
    np.testing.assert_array_equal(render.direct[0, 0], [0.5, 1.0, 1.5])
    np.testing.assert_array_equal(render.normal[0, 0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(render.uv[0, 0], [0.25, 0.75])
    assert render.depth[0, 0] == 4.0 and render.alpha[0, 0] == 0.5 and render.samples.tolist() == [[2, 0]]
    assert render.fiber_id[0, 0] == 2**24 and render.yarn_id[0, 0] == 12
    assert not render.pixels[0, 1].any() and np.isfinite(render.pixels).all() and render.spp == 1
