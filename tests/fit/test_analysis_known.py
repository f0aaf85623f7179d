"""What people know of the cloth: given weaves and counts, against drawn cloth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw

from usdfab.errors import NoFabricError, UsdfabError
from usdfab.fabric.weave import NAMED_WEAVES, Weave, basket, herringbone, plain, satin, twill
from usdfab.fit.analysis import analyze_photo
from usdfab.fit.analysis.known import COUNT_SLACK, Known, known_counts, known_weaves, phases

SATIN = Cloth(satin(5, 2).matrix, 12, 11, size=256, seed=5)


@pytest.mark.parametrize("name", NAMED_WEAVES)
def test_phases_are_all_beginnings_of_the_weave(name: str) -> None:
    weave = NAMED_WEAVES[name].reduced()
    lattice, tables = phases(weave)
    picks, ends = weave.matrix.shape
    rows = lattice.shape[0]
    found = {lattice.matrix(table).tobytes() for table in tables}
    rolled = {
        np.resize(np.roll(weave.matrix, (a, b), (0, 1)), (rows, ends)).tobytes()
        for a in range(picks)
        for b in range(ends)
    }
    assert found == rolled and len(found) == len(tables) == len(rolled)


def test_a_twill_and_a_satin_are_one_pick_that_shifts() -> None:
    assert phases(twill(2, 2))[0].bits == 4
    assert phases(satin(8, 3))[0].bits == 8
    assert phases(plain())[0].bits == 2


def test_a_weave_that_does_not_repeat_on_the_photo() -> None:
    weave = herringbone()
    photo = draw(Cloth(weave.matrix, 14, 13, size=288, seed=7, noise=0.05))
    # 16 ends to a repeat, 14 on the photo: no repeat can be found there.
    assert not analyze_photo(photo).weave.equivalent(weave)
    found = analyze_photo(photo, known=Known((weave,)))
    assert found.weave.equivalent(weave) and found.weave_known and not found.counts_known
    assert found.weave_confidence == 1.0 and found.lattice_confidence > 0.5
    assert (found.warp_count, found.weft_count) == pytest.approx((14, 13), rel=0.03)


def test_the_direction_is_found_where_it_is_not_said() -> None:
    for direction in ("s", "z"):
        cloth = Cloth(twill(3, 1, direction).matrix, 12, 12, size=256, seed=3)
        found = analyze_photo(draw(cloth), known=Known(known_weaves("twill 3/1")))
        assert found.weave.equivalent(twill(3, 1, direction))


def test_a_weave_that_is_not_there_is_taken_with_a_warning() -> None:
    found = analyze_photo(draw(SATIN), known=Known((basket(2, 2),)))
    assert found.weave.equivalent(basket(2, 2))
    assert found.warnings[0].startswith("The photo looks more like another weave than the one that was given: satin")
    right = analyze_photo(draw(SATIN), known=Known((satin(5, 2),)))
    assert not any("another weave" in warning for warning in right.warnings)


def test_counts_choose_among_the_spacings() -> None:
    # Pairs of like picks pass for one pick of double width; who counts either gets it.
    cloth = Cloth(np.repeat(plain().matrix, 2, 0), 10, 18, size=288, seed=2, wobble=0.02)
    by_count = {n: analyze_photo(draw(cloth), known=Known(counts=(10.0, n))) for n in (9.0, 18.0)}
    for n, found in by_count.items():
        assert found.weft_count == pytest.approx(n, rel=0.04) and found.counts_known
        assert found.warp.count_confidence == found.weft.count_confidence == 1.0
    assert by_count[18.0].weave.equivalent(Weave(cloth.matrix))


def test_a_count_that_is_no_peak_is_taken_as_it_is() -> None:
    given = (25.0, 29.0)
    found = analyze_photo(draw(SATIN), force=True, known=Known(counts=given))
    counts = np.array([found.warp_count, found.weft_count])
    assert (np.abs(np.log(counts / given)) <= COUNT_SLACK + 0.02).all()


def test_counts_alone_make_no_cloth() -> None:
    noise = np.random.default_rng(0).random((200, 200, 3))
    with pytest.raises(NoFabricError):
        analyze_photo(noise, known=Known(counts=(10.0, 10.0)))


def test_nothing_known_changes_nothing() -> None:
    one, other = analyze_photo(draw(SATIN)), analyze_photo(draw(SATIN), known=Known())
    assert one.weave == other.weave and one.warp_count == other.warp_count and one.warnings == other.warnings


def test_names_and_their_mirror_images() -> None:
    assert known_weaves("plain") == (plain(),)
    assert len(known_weaves("satin")) == 2 and len(known_weaves("twill 2/1")) == 2
    for exact in ("twill 2/1 s", "twill 2/1 z", "110/011/101"):
        assert len(known_weaves(exact)) == 1
    assert known_counts(" 12 x 9.5") == (12.0, 9.5)
    said = Known(known_weaves("plain"), (12.0, 9.5)).sentences()
    assert said == ["the weave was given", "the counts were given, about 12 ends and 9.5 picks"]


@pytest.mark.parametrize("text", ["12", "x9", "12x", "1x9", "9x1000", "a x b", "12,9", "-3x9", "nanx3"])
def test_counts_that_are_none(text: str) -> None:
    with pytest.raises(UsdfabError, match=r"--yarns: .* are no counts of yarns; give ends across and picks down"):
        known_counts(text)


def test_an_unknown_weave_names_the_option() -> None:
    with pytest.raises(UsdfabError, match="--weave: unknown weave 'moire'"):
        known_weaves("moire")


def test_the_sample_photo() -> None:
    from usdfab.fit.photo_input import load_photo

    sample = Path(__file__).parents[2] / "samples" / "microscope.png"
    photo = load_photo(sample, 4e-3).pixels.astype(np.float64)
    free = analyze_photo(photo)
    given = analyze_photo(photo, known=Known((free.weave,), (round(free.warp_count), round(free.weft_count))))
    assert given.weave.equivalent(free.weave)
    assert (given.warp_count, given.weft_count) == pytest.approx((free.warp_count, free.weft_count), rel=0.03)
