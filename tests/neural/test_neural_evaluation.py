"""``usdfab evaluate neural``: what its numbers mean, at the size of a stamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from usdfab.neural.evaluation import Scale, TimedPlan, compare, prepared, shown, with_surface, zoom_rows
from usdfab.neural.evaluation_ablation import (
    VARIANTS,
    AblatedNetwork,
    AblationScale,
    ablations,
    format_ablations,
    interpolations,
)
from usdfab.neural.evaluation_scenes import stages, unseen_twill, zoom_stages
from usdfab.neural.material_file import load_material_network
from usdfab.neural.network import KINDS
from usdfab.neural.paper_network import PaperNetwork

NETWORKS = {kind: load_material_network(None, kind) for kind in KINDS}
SCALE = Scale(pixels=16, zoom=2, zoom_pixels=12)


def test_scenes_are_those_that_are_asked_for() -> None:
    made = stages()
    assert [stage.name for stage in made] == ["single cloth", "single cloth, twill 4x4", "bowl", "lamp", "sofa"]
    assert len(made[-1].cloths) == 8 and [stage.seen for stage in made] == [True, False, False, False, True]
    assert unseen_twill().weave.shape == (4, 4) and unseen_twill().weave.sum() == 4
    for stage in made[2:4]:
        picture, seconds = shown(prepared(stage, NETWORKS), stage, 24)
        assert (picture.max(axis=-1) > 0).mean() > 0.25 and np.isfinite(picture).all() and seconds > 0
    # Of the lamp, light from within is the most.
    lamp = made[3]
    dark = replace(lamp, scene=replace(lamp.scene, lights=lamp.scene.lights[1:]))
    assert (
        shown(prepared(dark, NETWORKS), dark, 24)[0].mean() < 0.3 * shown(prepared(lamp, NETWORKS), lamp, 24)[0].mean()
    )


def test_more_samples_are_nearer_to_the_truth() -> None:
    rows, pictures = compare(stages()[1], NETWORKS, SCALE)
    by = {row.method: row for row in rows}
    assert list(by) == ["neural", "surface 1", "surface 3", "equal time"] and len(pictures) == 5
    assert by["surface 3"].mse < by["surface 1"].mse and by["neural"].mse < by["surface 1"].mse
    for row, picture in zip(rows, pictures, strict=False):
        assert row.mse == pytest.approx(np.mean((picture - pictures[-1]) ** 2), rel=1e-3)


def test_the_surface_model_has_the_places_of_the_network() -> None:
    """The same scene but for the plans: with one query of the truth in the network's place, pixels agree."""
    stage = stages()[0]
    made = prepared(stage, NETWORKS)
    assert all(isinstance(plan, TimedPlan) for plan in made.plans) and len(made.plans) == 4
    one, _ = shown(with_surface(made, stage, 256, 0), stage, 12)
    other, _ = shown(with_surface(made, stage, 256, 5), stage, 12)
    assert np.abs(one - other).mean() < 0.1 * one.mean()
    network, _ = shown(made, stage, 12)
    assert network.mean() == pytest.approx(one.mean(), rel=0.2)


def test_the_network_does_not_alias() -> None:
    rows, pictures = zoom_rows(NETWORKS, SCALE, lambda: None)
    assert len(rows) == 2 and len(pictures[0]) == 3
    assert rows[0]["tiles"] < 1 < rows[1]["tiles"] == pytest.approx(64 * rows[0]["tiles"])
    far = rows[-1]
    # From afar a pixel sees many tiles: what is left of one sample is noise, of the network nothing.
    assert far["neural"] < 0.05 and far["surface_1"] > 10 * far["neural"] and far["truth"] < 0.1
    assert [stage.seen for stage in zoom_stages(2)] == [False, False]


def test_the_full_network_is_the_papers() -> None:
    torch.manual_seed(1)
    full = AblatedNetwork("reflection", *VARIANTS["full"])
    paper = PaperNetwork("reflection")
    paper.load_state_dict(full.state_dict())
    codes, queries = torch.randn(2, 64), torch.rand(2, 7, 8) * 0.5
    assert torch.equal(full.decode(codes, queries), paper.decode(codes, queries))
    for one_blob, fusion in VARIANTS.values():
        assert AblatedNetwork("reflection", one_blob, fusion).decode(codes, queries).shape == (2, 7, 4)


@pytest.mark.slow
def test_ablations_train_each_variant() -> None:
    rows = ablations(AblationScale(2, 8, 1))
    assert [row["network"] for row in rows] == list(VARIANTS)
    assert all(np.isfinite(row["others_value"]) and row["learned_loss"] > 0 for row in rows)
    assert "without one-blob" in format_ablations(rows, [])


def test_mixed_codes_answer_as_those_of_the_encoder() -> None:
    mixed = interpolations(NETWORKS, 100)
    assert [row["beyond"] for row in mixed] == 2 * [False, False, False, True]
    assert all(row["difference"] < 0.1 for row in mixed)
    assert "height_scale" in format_ablations([], mixed)
