"""Stages of the fit joined: which there are, what the report shows, and how recovery is judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_network import small_net

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fabric.sampling import sample_fabric
from usdfab.fit import features, raster_evaluation, raster_stage, stages as fit_stages, weights_file
from usdfab.fit.later_stages import LaterStages
from usdfab.fit.pipeline import fit_photo
from usdfab.fit.raster.unconstrained import parameters_of
from usdfab.fit.raster_evaluation import (
    JUDGED,
    PERTURBATION,
    WEAVES,
    Recovery,
    errors,
    evaluate_raster,
    format_recoveries,
    perturbed,
)
from usdfab.fit.raster_stage import StageSettings
from usdfab.fit.report import loss_curve
from usdfab.fit.stages import checked_stages, run_raster
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import sample_scene

QUICK = StageSettings(width=40, supersampling=1, iterations=2, rate=0.05, levels=(1, 2))
YARN = YarnParameters(count=4, radius=2.4e-4, fiber_count=6, albedo=(0.5, 0.5, 0.5), roughness_azimuthal=0.2)
CLOTH = FabricParameters(weave_from_name("plain"), (2e-3, 2e-3), YARN, YARN)


@pytest.fixture
def quick_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    net = small_net(tmp_path, features.fast_dtype())
    monkeypatch.setattr(features, "load_features", lambda *_, **__: net)
    for module in (raster_stage, raster_evaluation):
        monkeypatch.setattr(module, "load_features", lambda *_, **__: net)


@pytest.mark.parametrize(
    ("stages", "line"),
    [
        (("path",), "start from the analysis"),
        (("analysis", "magic"), "no stage 'magic'"),
        (("raster",), "start from the analysis"),
        (("analysis", "analysis"), "named twice"),
    ],
)
def test_stages_that_cannot_run_are_one_line(stages: tuple[str, ...], line: str) -> None:
    with pytest.raises(UsdfabError, match=line):
        checked_stages(stages)
    assert checked_stages(("path", "raster", "analysis")) == ("analysis", "raster", "path")


def test_a_photo_with_too_few_rows_is_refused_before_any_work() -> None:
    later = LaterStages.of(("analysis", "raster"), "draft", 0, 100, None)
    later.require_room(np.zeros((100, 400, 3)), "strip.png")
    with pytest.raises(UsdfabError, match=r"strip\.png.*405 x 100 pixels, too wide.*at most 4 times"):
        later.require_room(np.zeros((100, 405, 3)), "strip.png")
    LaterStages.of(("analysis",), "draft", 0, 100, None).require_room(np.zeros((100, 9000, 3)), "strip.png")


def test_missing_weights_are_said_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights_file, "SHIPPED", tmp_path / "gone.safetensors")
    with pytest.raises(UsdfabError, match=r"gone\.safetensors.*missing"):
        fit_photo(tmp_path / "no_photo.png", stages=("analysis", "raster"))
    with pytest.raises(UsdfabError, match="missing"):
        evaluate_raster(progress=lambda *_: pytest.fail("work has begun"))


@pytest.mark.parametrize("closer", [True, False])
def test_the_raster_stage_is_used_only_where_it_comes_closer(
    quick_features: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, closer: bool
) -> None:
    wild = replace(CLOTH, weft=replace(YARN, twist=0.5))
    photo = np.full((50, 50, 3), 0.4, dtype=np.float32)
    distances = iter((1.0, 0.5) if closer else (0.5, 1.0))
    monkeypatch.setattr(fit_stages, "traced_distance", lambda *_: next(distances))
    state = tmp_path / "state.safetensors"
    before, after = run_raster(wild, wild, photo, 0.0, QUICK, albedo_paths=500, checkpoint=state)
    assert before.fabric is wild
    assert state.exists()
    assert len(after.losses) == QUICK.iterations
    assert any("weft.twist was outside" in note for note in after.notes)
    assert any("not used" in note for note in after.notes) != closer
    assert (after.fabric is wild) != closer
    assert after.distance == 0.5
    if closer:
        assert after.fabric.weft.twist != wild.weft.twist
        assert after.fabric.warp.albedo != CLOTH.warp.albedo


def test_the_traced_distance_is_small_to_itself_and_not_to_another(quick_features: None) -> None:
    net = features.load_features()
    own = sample_scene(CLOTH)
    picture = Tracer(own).render(own.cameras[0], RenderSettings((40, 40), spp=32, seed=5)).pixels
    other = replace(CLOTH, warp=replace(YARN, albedo=(0.9, 0.2, 0.1)), weft=replace(YARN, radius=1e-4))
    near, far = (fit_stages.traced_distance(f, picture, QUICK, net) for f in (CLOTH, other))
    assert near < 0.3 * far


def test_the_loss_curve_falls_and_has_gaps() -> None:
    picture = loss_curve([2.0, 1.0, float("nan"), 0.5, 0.4], (100, 50))
    assert picture.shape == (50, 100, 3)
    blue = picture[..., 2] > picture[..., 0] + 0.1
    assert not blue[:, 50].any()
    height = [np.flatnonzero(blue[:, k]).mean() for k in (0, 20, 80, 99)]
    assert height == sorted(height)


@pytest.mark.parametrize("weave", WEAVES)
def test_perturbed_fabrics_are_a_fifth_of_the_range_off(weave: str) -> None:
    rng = np.random.default_rng(3)
    truth = sample_fabric(weave, rng)
    start = perturbed(truth, weave, rng)
    parameters_of(start, free=(*JUDGED, "diffuse"))
    assert start.seed != truth.seed
    found = errors(start, truth, weave)
    assert all(0.0 < e <= PERTURBATION * 1.0001 for e in found.values())
    assert np.mean(list(found.values())) > 0.9 * PERTURBATION
    assert set(errors(truth, truth, weave).values()) == {0.0}


def test_tables_show_before_and_after_beside_the_paper() -> None:
    same = dict.fromkeys(JUDGED, 0.2)
    result = Recovery("plain", 0, "full", same, same | {"crimp": 0.05}, 1.0, 0.5, 20, 3.0)
    table = format_recoveries([result, replace(result, ablation="single")])
    (row,) = [line for line in table.split("\n\n")[0].splitlines() if line.startswith("beta")]
    assert row.split() == ["beta", "20.0", ">", "5.0", "20.0", ">", "5.0", "2.29"]
    assert "single:" in table
    with pytest.raises(UsdfabError, match="nothing to fit"):
        evaluate_raster(0)


@pytest.mark.slow
def test_recovery_runs_end_to_end(quick_features: None) -> None:
    (result,) = evaluate_raster(1, 0, QUICK, weaves=("plain",), fibers=6)
    assert result.iterations == QUICK.iterations
    assert result.best_loss <= result.first_loss
    assert set(result.after) == set(JUDGED)
