"""The wide prior: every draw is cloth that could exist, can be generated, and is what its label says."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import NAMED_WEAVES, PAPER_WEAVES, SYSTEMS, Weave
from usdfab.fabric.plausible import doubts
from usdfab.fabric.sampling_colors import STRIPE_CELLS
from usdfab.fabric.sampling_weaves import CLASSES, LONGEST_FLOAT, OTHER, random_draft, sample_weave, weave_class
from usdfab.fabric.sampling_wide import (
    ACCEPTED,
    COUNT_RANGE,
    COVER_RANGE,
    FLATTENING_RANGE,
    OTHER_SHARE,
    sample_class,
    sample_wide,
)
from usdfab.fibers import generate_patch
from usdfab.fibers.budget import EASY_PATCH_POINTS, patch_points
from usdfab.fibers.tiles import tile_copies

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.sampled_from(CLASSES))
def test_every_draw_could_exist(seed: int, label: str) -> None:
    fabric = sample_wide(label, np.random.default_rng(seed))
    assert {doubt.rule for doubt in doubts(fabric)} <= ACCEPTED
    assert weave_class(fabric.weave) == label
    assert patch_points(fabric, copies=tile_copies(fabric)) <= EASY_PATCH_POINTS
    for system in SYSTEMS:
        yarn = fabric.system(system)
        assert COUNT_RANGE[0] <= yarn.count <= COUNT_RANGE[1]
        # Rounding: the cover is computed back from the radius.
        assert COVER_RANGE[0] - 1e-9 <= fabric.cover(system) <= COVER_RANGE[1] + 1e-9
        assert 1 <= yarn.ply_count <= 4
        assert yarn.flattening >= FLATTENING_RANGE[0]
        assert not yarn.yarn_albedo or np.prod(fabric.repeat()) <= STRIPE_CELLS


@given(SEEDS)
@settings(max_examples=4)
def test_a_patch_can_be_generated(seed: int) -> None:
    rng = np.random.default_rng(seed)
    patch = generate_patch(sample_wide(sample_class(rng), rng), vertices_per_segment=6)
    assert all(np.isfinite(curves.points).all() for curves in patch.curves)


def test_the_same_seed_gives_the_same_fabric_and_another_seed_another() -> None:
    first, same, other = (sample_wide("plain", np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert first == same
    assert first != other


def test_classes_come_as_often_as_said() -> None:
    rng = np.random.default_rng(5)
    draws = 4000
    found = Counter(sample_class(rng) for _ in range(draws))
    # Five standard deviations of a binomial distribution.
    for label in CLASSES:
        share = OTHER_SHARE if label == OTHER else (1 - OTHER_SHARE) / len(PAPER_WEAVES)
        assert abs(found[label] - draws * share) < 5 * np.sqrt(draws * share * (1 - share))


def test_draws_cover_what_photos_show() -> None:
    fabrics = [sample_wide(OTHER, np.random.default_rng(seed)) for seed in range(150)]
    yarns = [fabric.system(system) for fabric in fabrics for system in SYSTEMS]
    assert {yarn.ply_count for yarn in yarns} == {1, 2, 3, 4}
    assert 0.3 < np.mean([yarn.flyaway_density > 0 for yarn in yarns]) < 0.9
    assert any(yarn.yarn_albedo for yarn in yarns)
    assert any(fabric.warp.albedo == fabric.weft.albedo for fabric in fabrics)
    covers = [fabric.cover(system) for fabric in fabrics for system in SYSTEMS]
    assert min(covers) < 0.6 and max(covers) > 1.1
    assert {"twill", "basket", "other"} <= {fabric.weave.classify() for fabric in fabrics}


@pytest.mark.parametrize("name", PAPER_WEAVES)
def test_a_class_is_the_same_wherever_the_repeat_starts_and_mirrored(name: str) -> None:
    matrix = NAMED_WEAVES[name].matrix
    assert weave_class(Weave(np.roll(matrix, (1, 2), (0, 1)))) == name
    assert weave_class(Weave(matrix[:, ::-1])) == name


@pytest.mark.parametrize("name", ["twill_2_2", "basket", "sateen_8", "herringbone", "twill_5x5"])
def test_weaves_beyond_the_paper_are_other(name: str) -> None:
    assert weave_class(NAMED_WEAVES[name]) == OTHER


@given(SEEDS)
def test_drafts_interlace_and_have_short_floats(seed: int) -> None:
    weave = random_draft(np.random.default_rng(seed))
    for matrix in (weave.matrix, weave.matrix.T):
        for row in matrix:
            # A run that goes around the end is found in two repeats side by side.
            runs = "".join(map(str, np.tile(row, 2)))
            assert max(len(run) for run in runs.replace("01", "0 1").replace("10", "1 0").split()) <= LONGEST_FLOAT


def test_an_unknown_class_is_refused() -> None:
    for sampler in (sample_weave, sample_wide):
        with pytest.raises(UsdfabError, match="no class 'velvet'"):
            sampler("velvet", np.random.default_rng(0))
