"""The match stage: its coordinates, its steps, and a small match from the tracer's own pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from small_network import small_net

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fit import features, match_space, match_stage
from usdfab.fit.features import FeatureNet
from usdfab.fit.judge import Judge
from usdfab.fit.match_pictures import MOST_SPP, MatchPictures
from usdfab.fit.match_run import run_match
from usdfab.fit.match_space import BLUR, BLUR_UNIT, CONTRAST, CONTRAST_RANGE, EXPOSURE, MOVES, MatchSpace, Move
from usdfab.fit.match_stage import MatchPoint, MatchResult, MatchSettings, checked_match_quality, match_photo
from usdfab.fit.match_steps import SOFT, best_step, broyden_update, damped_step, normal_equations, soft_l1
from usdfab.fit.raster_stage import StageSettings
from usdfab.fit.texture import Target
from usdfab.imaging import denoise
from usdfab.imaging.lens import PIVOT, through_lens, toned
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.cached_tracer import CachedTracer
from usdfab.usd.rig import rig_for, swatch_scene

YARN = YarnParameters(count=3, radius=3e-4, fiber_count=6, albedo=(0.6, 0.4, 0.3), roughness_azimuthal=0.3)
CLOTH = FabricParameters(weave_from_name("plain"), (2e-3, 2e-3), YARN, replace(YARN, albedo=(0.3, 0.5, 0.7)))
SMALL = MatchSettings(width=32, spp=16, iterations=2, steps=3, levels=(1,), free=("albedo",), prior=1e-4)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> FeatureNet:
    return small_net(tmp_path_factory.mktemp("net"), features.fast_dtype())


@pytest.fixture(scope="module")
def goal() -> np.ndarray:
    # The draws of the stage's own pictures: with others, noise and not the search decides how near albedos come.
    scene = swatch_scene(CLOTH)
    settings = RenderSettings((32, 32), spp=SMALL.spp, seed=SMALL.seed)
    small = replace(settings, resolution=(16, 16), seed=SMALL.seed + 1000)
    render = CachedTracer(Tracer(scene), scene.cameras[0], small).render(scene.cameras[0], settings)
    return 1.2 * denoise(render.pixels, render.albedo, render.normal)


def wrong() -> FabricParameters:
    return replace(CLOTH, warp=replace(CLOTH.warp, albedo=(0.3, 0.4, 0.5)), weft=replace(CLOTH.weft, albedo=(0.5,) * 3))


# --- coordinates ---


@pytest.mark.parametrize("name", MOVES)
@given(part=st.floats(0.02, 0.98), steps=st.floats(-4.0, 4.0))
def test_moves_are_monotone_and_stay_in_range(name: str, part: float, steps: float) -> None:
    move = MOVES[name]
    value = move.low + part * (move.high - move.low)
    assert move.moved(value, 0.0) == value
    there = move.moved(value, steps)
    assert move.low <= there <= move.high
    assert (there - value) * np.sign(steps) >= -1e-12 * move.high
    assert move.moved(value, steps + 0.5) >= there
    inside = move.low < there < move.high
    if inside:
        assert move.moved(there, -steps) == pytest.approx(value, rel=1e-6)


def test_a_value_outside_the_range_stays_until_it_moves_inwards() -> None:
    move = Move("log", 0.1, 1.0, 2.0)
    assert move.moved(3.0, 0.0) == 3.0
    assert move.moved(3.0, 2.0) == 3.0
    assert move.moved(3.0, -1.0) == pytest.approx(3.0 * np.exp(-0.1))


def test_a_point_moves_the_numbers_it_names() -> None:
    cloth = replace(CLOTH, weft=replace(CLOTH.weft, yarn_albedo=((0.1,) * 3, (0.9,) * 3)))
    space = MatchSpace.about(cloth, light=1.5)
    zero = np.zeros(len(space.names))
    assert space.fabric(zero) == cloth
    assert space.exposure(zero) == 1.5
    point = zero.copy()
    point[space.names.index("warp.crimp")] = 1.0
    point[space.names.index("weft.albedo.g")] = -1.0
    point[space.names.index("weft.flyaway_density")] = 2.0
    moved = space.fabric(point)
    assert moved.warp == replace(cloth.warp, crimp=cloth.warp.crimp * np.exp(MOVES["crimp"].step))
    assert moved.weft.flyaway_density == pytest.approx(1600.0)
    for before, after in zip(cloth.weft.colors(), moved.weft.colors(), strict=True):
        assert (after[0], after[2]) == (before[0], before[2])
        # Odds fall by the same factor for each colour of the system.
        odds = [c / (1.0 - c) for c in (before[1], after[1])]
        assert odds[1] / odds[0] == pytest.approx(np.exp(-MOVES["albedo"].step))
    with pytest.raises(UsdfabError, match="moves no 'colour'"):
        MatchSpace.about(cloth, ("colour",))


def test_deviations_are_in_the_parameters_own_units() -> None:
    space = MatchSpace.about(CLOTH, ("crimp", "albedo", EXPOSURE))
    found = space.deviations(np.zeros(len(space.names)), np.full(len(space.names), 0.1))
    assert EXPOSURE not in found
    assert found["warp.crimp"] == pytest.approx(CLOTH.warp.crimp * MOVES["crimp"].step * 0.1, rel=1e-3)
    c = CLOTH.warp.albedo[0]
    assert found["warp.albedo[r]"] == pytest.approx(c * (1 - c) * MOVES["albedo"].step * 0.1, rel=1e-3)


# --- steps ---


@given(seed=st.integers(0, 2**32 - 1))
def test_the_quadratic_touches_the_sum_of_absolute_values_and_lies_above_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    r0 = rng.normal(0, 1, 40).astype(np.float32)
    jacobian = rng.normal(0, 1, (3, 40)).astype(np.float32)
    weights = rng.uniform(0, 1, 40).astype(np.float32)
    matrix, gradient = normal_equations(r0, jacobian, weights)
    for x in (rng.normal(0, 1, 3), rng.normal(0, 1e-3, 3)):
        moved = soft_l1(r0 + x.astype(np.float32) @ jacobian, weights)
        above = soft_l1(r0, weights) + gradient @ x + 0.5 * x @ matrix @ x
        assert moved <= above + 1e-4
    # The tangent: half a central difference.
    h = 1e-2
    for k in range(3):
        up, down = (soft_l1(r0 + s * h * jacobian[k], weights) for s in (1, -1))
        curvature = (jacobian[k].astype(float) ** 2 * weights).sum() / SOFT * h
        assert (up - down) / (2 * h) == pytest.approx(gradient[k], abs=curvature + 1e-3)


def test_a_step_solves_the_least_squares_with_its_prior_and_is_no_longer_than_allowed() -> None:
    matrix, gradient = np.diag([2.0, 4.0]), np.array([-2.0, 8.0])
    free = damped_step(matrix, gradient, np.zeros(2), np.full(2, 1e6), 1.0, 0.0, 10.0)
    assert free == pytest.approx([1.0, -2.0])
    held = damped_step(matrix, gradient, np.array([1.0, 0.0]), np.array([1.0, 1.0]), 2.0, 0.0, 10.0)
    assert held == pytest.approx([0.0, -8.0 / 6.0])
    assert np.abs(damped_step(matrix, gradient, np.zeros(2), np.full(2, 1e6), 1.0, 0.0, 0.5)).max() == 0.5
    assert np.linalg.norm(damped_step(matrix, gradient, np.zeros(2), np.full(2, 1e6), 1.0, 10.0, 9.0)) < 0.5


def test_broyden_learns_what_a_step_showed_and_keeps_the_rest() -> None:
    rng = np.random.default_rng(0)
    jacobian = rng.normal(0, 1, (3, 20)).astype(np.float32)
    before, step = jacobian.copy(), np.array([1.0, 0.0, -2.0])
    change = rng.normal(0, 1, 20).astype(np.float32)
    broyden_update(jacobian, step, change)
    assert step @ jacobian == pytest.approx(change, abs=1e-5)
    across = np.array([2.0, 3.0, 1.0])
    assert across @ jacobian == pytest.approx(across @ before, abs=1e-5)


# --- the stage ---


@pytest.fixture(scope="module")
def matched(net: FeatureNet, goal: np.ndarray) -> MatchResult:
    return match_photo(wrong(), goal, SMALL, net=net, exposure=1.2)


def test_colours_are_found_from_a_picture(matched: MatchResult) -> None:
    assert list(matched.losses) == sorted(matched.losses, reverse=True)
    assert matched.losses[-1] < 0.05 * matched.losses[0]
    assert not matched.interrupted
    for system in ("warp", "weft"):
        truth, start, found = (np.array(f.system(system).albedo) for f in (CLOTH, wrong(), matched.fabric))  # type: ignore[arg-type]
        # The test's network of random filters hardly tells which system has how much of the blue.
        assert np.abs(found - truth)[:2].mean() < 0.4 * np.abs(start - truth)[:2].mean()
    assert set(matched.uncertainty) == {f"{s}.albedo[{c}]" for s in ("warp", "weft") for c in "rgb"}
    assert matched.fabric.warp.radius == CLOTH.warp.radius


def test_a_broken_off_match_goes_on_to_the_same_result(
    matched: MatchResult, net: FeatureNet, goal: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / "state.npz"
    whole = match_stage._Search.round

    def break_off(search: match_stage._Search) -> None:
        if search.state.round == 1:
            raise RuntimeError("killed")
        whole(search)

    monkeypatch.setattr(match_stage._Search, "round", break_off)
    with pytest.raises(RuntimeError):
        match_photo(wrong(), goal, SMALL, net=net, exposure=1.2, checkpoint=state)
    monkeypatch.setattr(match_stage._Search, "round", whole)
    again = match_photo(wrong(), goal, SMALL, net=net, exposure=1.2, checkpoint=state)
    assert again.fabric == matched.fabric
    assert again.losses == matched.losses
    with pytest.raises(UsdfabError, match="another"):
        match_photo(CLOTH, goal, SMALL, net=net, exposure=1.2, checkpoint=state)
    state.write_bytes(b"no state")
    with pytest.raises(UsdfabError, match="damaged"):
        match_photo(wrong(), goal, SMALL, net=net, exposure=1.2, checkpoint=state)


def test_ctrl_c_keeps_the_best_so_far(
    net: FeatureNet, goal: np.ndarray, monkeypatch: pytest.MonkeyPatch, matched: MatchResult
) -> None:
    def stop(done: int, _: int, loss: float) -> None:
        if loss < 0.9 * matched.losses[0]:
            raise KeyboardInterrupt

    result = match_photo(wrong(), goal, SMALL, net=net, exposure=1.2, progress=stop)
    assert result.interrupted


@pytest.mark.parametrize("closer", [True, False])
def test_the_stage_is_used_only_where_it_comes_closer(
    net: FeatureNet, goal: np.ndarray, monkeypatch: pytest.MonkeyPatch, closer: bool
) -> None:
    way = (MatchPoint(replace(CLOTH, name="Matched"), 1.4), MatchPoint(replace(CLOTH, name="Lucky"), 1.5))
    result = MatchResult(way, (1.0, 0.5), {"warp.crimp": 0.1}, False)
    monkeypatch.setattr(features, "load_features", lambda *_, **__: net)
    monkeypatch.setattr(match_stage, "match_photo", lambda *_, **__: result)
    # The last point is the best of the stage's own pictures, but not seen better.
    distances = {"Matched": 0.3 if closer else 0.9, "Lucky": 0.4 if closer else 0.95}
    monkeypatch.setattr(Judge, "picture", lambda _, fabric, *__: fabric.name)
    monkeypatch.setattr(Judge, "distance", lambda _, name, *__: distances[name])
    judge = StageSettings(width=32, supersampling=1, iterations=1, levels=(1,))
    before, outcome = run_match(wrong(), goal, 0.0, SMALL, judge, exposure=1.2, distance=0.5)
    assert before == 0.5
    assert outcome.distance == pytest.approx(0.3 if closer else 0.5)
    assert (outcome.fabric.name, outcome.exposure) == (("Matched", 1.4) if closer else (wrong().name, 1.2))
    assert bool(outcome.uncertainty) == closer
    assert any("did not come closer" in note for note in outcome.notes) != closer


def test_an_unknown_quality_is_refused() -> None:
    with pytest.raises(UsdfabError, match="no quality 'best'"):
        checked_match_quality("best")
    assert checked_match_quality("draft", 7).seed == 7


# --- the camera ---


@given(least=st.integers(-6, 6), start=st.integers(-6, 6))
def test_single_steps_lead_to_the_least(least: int, start: int) -> None:
    seen: list[int] = []

    def look(step: int) -> float:
        seen.append(step)
        return abs(step - least - 0.2)

    assert best_step(look, start, lambda loss: loss) == (0.2, least)
    # Not one is looked at twice, and no further than one beyond.
    assert len(seen) == len(set(seen)) <= abs(start - least) + 3


def test_the_camera_moves_before_the_cloth(net: FeatureNet, goal: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exposure and contrast from one picture of the cloth as it is."""
    settings = replace(SMALL, free=("albedo", CONTRAST, EXPOSURE), iterations=1)
    losses: list[tuple[float, float]] = []
    camera = match_stage._Search._settle_camera

    def watched(search: match_stage._Search) -> None:
        before, rendered = search.loss, search._done
        camera(search)
        losses.append((before, search.loss))
        assert search._done == rendered
        assert search.state.way[-1] is search.state.point
        assert not search.state.point[:-2].any()

    monkeypatch.setattr(match_stage._Search, "_settle_camera", watched)
    result = match_photo(CLOTH, toned(np.maximum(goal, 0.0), 1.3), settings, net=net, exposure=1.0)
    assert len(losses) == 1 and losses[0][1] < 0.25 * losses[0][0]
    assert result.losses[1] == losses[0][1] < result.losses[0]


@pytest.mark.parametrize("pixels", [1.2, 0.7, -0.9])
def test_the_cameras_blur_is_found(
    pixels: float, goal: np.ndarray, net: FeatureNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colours, exposure and sharpness from a photo that is blurred or sharpened, whose scale says how far in metres."""
    monkeypatch.setattr(match_space, "BLUR_UNIT", 1.0 / SMALL.width)
    settings = replace(SMALL, free=("albedo", BLUR, EXPOSURE), iterations=4)
    photo = np.maximum(through_lens(goal, pixels), 0.0)
    result = match_photo(CLOTH, photo, settings, net=net, exposure=1.2)
    assert result.rig is not None
    found = result.rig.blur * settings.width / CLOTH.size[0]
    assert found * abs(found) == pytest.approx(pixels * abs(pixels), abs=0.15)
    assert result.losses[-1] < 0.1 * result.losses[0]


@pytest.mark.parametrize("contrast", [1.4, 0.75])
def test_the_cameras_contrast_is_found(contrast: float, goal: np.ndarray, net: FeatureNet) -> None:
    """Colours, exposure and contrast from a photo that shows a power of the light."""
    settings = replace(SMALL, free=("albedo", CONTRAST, EXPOSURE), iterations=4)
    result = match_photo(CLOTH, toned(np.maximum(goal, 0.0), contrast), settings, net=net, exposure=1.2)
    assert result.rig is not None
    assert result.rig.contrast == pytest.approx(contrast, rel=0.1)
    assert result.losses[-1] < 0.1 * result.losses[0]


def test_contrast_leaves_the_photos_mean_as_bright_as_it_is() -> None:
    space = MatchSpace.about(CLOTH, (CONTRAST, EXPOSURE), 1.4, contrast=1.2, level=0.05)
    point = np.array([2.0, 0.0])
    # What is 0.05 in the photo at the start.
    start = (0.05 / PIVOT) ** (1 / 1.2) * PIVOT / 1.4
    assert toned(np.full(1, 1.4 * start), 1.2) == pytest.approx(0.05)
    assert toned(np.full(1, space.exposure(point) * start), space.contrast_at(point)) == pytest.approx(0.05)


def test_contrast_moves_by_factors_and_stops() -> None:
    space = MatchSpace.about(CLOTH, (CONTRAST,), contrast=1.2)
    found = [space.contrast_at(np.array([x])) for x in (-100.0, 0.0, 1.0, 100.0)]
    assert found == pytest.approx([CONTRAST_RANGE[0], 1.2, 1.2 * np.exp(0.1), CONTRAST_RANGE[1]])


def test_the_camera_of_a_known_rig_stays(goal: np.ndarray, net: FeatureNet) -> None:
    settings = replace(SMALL, free=(BLUR, CONTRAST, EXPOSURE))
    rig = replace(rig_for(CLOTH.size), blur=1.2 * CLOTH.size[0] / settings.width, contrast=1.25)
    photo = toned(through_lens(goal, 1.2), 1.25)
    known, sharp = (
        match_photo(CLOTH, photo, settings, net=net, exposure=1.2, rig=r, rig_known=True)
        for r in (rig, rig_for(CLOTH.size))
    )
    assert known.rig == rig and sharp.rig == rig_for(CLOTH.size)
    assert known.losses[-1] < 0.1 * sharp.losses[-1]


def test_blur_moves_through_sharp_and_stops() -> None:
    space = MatchSpace.about(CLOTH, (BLUR,))
    unit = BLUR_UNIT * CLOTH.size[0]
    found = [space.blur_at(np.array([x])) / unit for x in (-100.0, -4.0, 0.0, 4.0, 100.0)]
    assert found == pytest.approx([-np.sqrt(1.5), -1.0, 0.0, 1.0, 2.0])
    beyond = MatchSpace.about(CLOTH, (BLUR,), blur=3 * unit)
    assert beyond.blur_at(np.zeros(1)) == 3 * unit
    assert beyond.blur_at(np.array([-20.0])) == pytest.approx(2 * unit)


# --- what pictures cost ---


def test_dark_cloth_gets_more_samples_for_the_same_rays(net: FeatureNet, goal: np.ndarray) -> None:
    picture = torch.from_numpy(goal.astype(np.float32)).permute(2, 0, 1)
    pictures = MatchPictures(Target.from_image(picture, net, (1,), "gram"), 32, 2, 0)
    found = []
    for albedo in ((0.95,) * 3, (0.05,) * 3):
        pictures.spp = pictures.cached_spp = pictures.learning = 2
        dyed = replace(CLOTH, warp=replace(YARN, albedo=albedo), weft=replace(YARN, albedo=albedo))
        pictures.spend(120.0, dyed, None)
        found.append((pictures.spp, pictures.cached_spp, pictures.learning))
    for bright, dark in zip(*found, strict=True):
        assert 2 < bright <= dark <= MOST_SPP
    # Paths that end at the cache are as long in both.
    assert found[0][0] < found[1][0] and found[0][2] < found[1][2]
    pictures.spend(1.0, CLOTH, None)
    assert (pictures.spp, pictures.cached_spp, pictures.learning) == found[1]


def test_a_picture_is_nearer_to_the_cloth_than_a_sketch(net: FeatureNet, goal: np.ndarray) -> None:
    """For the same rays. The denoiser makes much of few whole paths, where light scatters often."""
    picture = torch.from_numpy(goal.astype(np.float32)).permute(2, 0, 1)
    pictures = MatchPictures(Target.from_image(picture, net, (1,), "gram"), 48, 2, 0)
    bright = replace(YARN, albedo=(0.97,) * 3, fiber_count=20)
    white = replace(CLOTH, warp=bright, weft=bright)
    pictures.spend(40.0, white, None)
    scene = swatch_scene(white)
    many = Tracer(scene).render(scene.cameras[0], RenderSettings((48, 48), spp=400, seed=5))
    truth = denoise(many.pixels, many.albedo, many.normal)
    far, near = (np.sqrt(np.mean((seen(white, None) - truth) ** 2)) for seen in (pictures.sketch, pictures.picture))
    assert near < 0.7 * far
    # Both are kept: they are made once.
    assert pictures.picture(white, None) is pictures.picture(white, None)
    assert pictures.sketch(white, None) is pictures.sketch(white, None)
