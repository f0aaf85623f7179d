"""The analysis against drawn cloth, where the truth is exact."""

from __future__ import annotations

import numpy as np
import pytest
from cloth_drawing import Cloth, draw

from usdfab.fabric.weave import Weave, basket, plain, satin, twill
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo

HERRINGBONE = Weave(
    np.array([[1, 1, 0, 0, 1, 0, 0, 1], [0, 1, 1, 0, 1, 1, 0, 0], [0, 0, 1, 1, 0, 1, 1, 0], [1, 0, 0, 1, 0, 0, 1, 1]])
)

CASES = {
    "plain": (Cloth(plain().matrix, 12, 10, size=256, seed=1), "plain"),
    "twill 2/2": (Cloth(twill(2, 2).matrix, 13, 11.5, size=256, seed=2, rotation=0.06), "twill"),
    "twill 3/1 s": (Cloth(twill(3, 1, "s").matrix, 12, 12, size=256, seed=3, twist=(-0.3, 0.4)), "twill"),
    "twill 1/2": (Cloth(twill(1, 2).matrix, 10.5, 12.5, size=256, seed=4, rotation=-0.1), "twill"),
    "satin 5": (Cloth(satin(5, 2).matrix, 15, 12, size=288, seed=5, twist=(0.3, -0.3)), "satin"),
    "sateen 5": (Cloth(satin(5, 3).rotated().matrix, 11, 15, size=288, seed=6), "satin"),
    "basket": (Cloth(basket(2, 2).matrix, 14, 13, size=288, seed=7), "basket"),
    "herringbone": (Cloth(HERRINGBONE.matrix, 16, 15, size=320, seed=8), "other"),
}


def expected_counts(cloth: Cloth) -> tuple[float, float]:
    """Yarns met on a horizontal and on a vertical line over the photo."""
    c = np.cos(cloth.rotation)
    return cloth.warp_count * c, cloth.weft_count * c


@pytest.fixture(scope="module")
def analyses() -> dict[str, PhotoAnalysis]:
    return {name: analyze_photo(draw(cloth)) for name, (cloth, _) in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_counts_weave_rotation(name: str, analyses: dict[str, PhotoAnalysis]) -> None:
    cloth, family = CASES[name]
    a = analyses[name]
    warp, weft = expected_counts(cloth)
    assert a.warp_count == pytest.approx(warp, rel=0.03)
    assert a.weft_count == pytest.approx(weft, rel=0.03)
    assert a.weave.equivalent(Weave(cloth.matrix)), a.weave.rows()
    assert a.weave_class == family
    assert a.rotation == pytest.approx(cloth.rotation, abs=0.02)
    assert abs(a.skew) < 0.03
    assert a.lattice_confidence > 0.8 and a.weave_confidence > 0.5


@pytest.mark.parametrize("name", CASES)
def test_twist(name: str, analyses: dict[str, PhotoAnalysis]) -> None:
    cloth, _ = CASES[name]
    for system, angle in ((analyses[name].warp, cloth.twist[0]), (analyses[name].weft, cloth.twist[1])):
        if system.twist_confidence < 0.2:  # a system that hardly shows may say so
            continue
        assert system.twist == ("Z" if angle > 0 else "S")
        assert system.fiber_angle == pytest.approx(angle, abs=0.15)


def test_spacing_is_in_pixels_of_the_photo_as_given(analyses: dict[str, PhotoAnalysis]) -> None:
    cloth, _ = CASES["plain"]
    small = analyses["plain"]
    large = analyze_photo(np.repeat(np.repeat(draw(cloth), 2, 0), 2, 1))
    assert large.shape == (512, 512)
    assert large.warp.spacing == pytest.approx(2 * small.warp.spacing, rel=0.02)
    assert large.warp_count == pytest.approx(small.warp_count, rel=0.02)


def test_origin_of_the_matrix_is_the_lowest_left_crossing() -> None:
    # Half a cell in from the corner lies the centre of crossing (0, 0) of the drawing.
    cloth = Cloth(twill(3, 1).matrix, 12, 12, size=256, phase=(2.0, 2.0), wobble=0.0)
    a = analyze_photo(draw(cloth))
    start = 50 + 2 - 6
    expected = np.roll(cloth.matrix, (-(start % 4), -(start % 4)), (0, 1))
    assert np.array_equal(a.matrix, expected)


def test_colours_of_two_systems() -> None:
    a = analyze_photo(
        draw(Cloth(twill(2, 2).matrix, 12, 12, ((0.7, 0.1, 0.1),), ((0.1, 0.1, 0.6),), size=256, twist=(0.3, 0.3)))
    )
    for system, truth in ((a.warp, (0.7, 0.1, 0.1)), (a.weft, (0.1, 0.1, 0.6))):
        hue = system.colour / system.colour.max()
        assert np.allclose(hue, np.array(truth) / max(truth), atol=0.06)
        assert system.colour_sequence.shape == (1, 3)
        assert system.colour_confidence > 0.4


def test_yarn_dyed_sequence() -> None:
    warp = ((0.7, 0.65, 0.55), (0.7, 0.65, 0.55), (0.1, 0.15, 0.55))
    weft = ((0.7, 0.65, 0.55), (0.6, 0.1, 0.1))
    a = analyze_photo(draw(Cloth(plain().matrix, 14, 12, warp, weft, size=288)))
    assert a.weave_class == "plain"
    assert a.warp_count == pytest.approx(14, rel=0.03) and a.weft_count == pytest.approx(12, rel=0.03)
    assert a.warp.colour_sequence.shape == (3, 3)
    assert a.weft.colour_sequence.shape == (2, 3)
    blue = a.warp.yarn_colours[:, 2] > a.warp.yarn_colours[:, 0]
    assert np.array_equal(np.diff(np.flatnonzero(blue)), np.full(blue.sum() - 1, 3))


def test_gaps_and_widths() -> None:
    tight = analyze_photo(draw(Cloth(plain().matrix, 12, 12, size=256, width=0.95)))
    loose = analyze_photo(draw(Cloth(plain().matrix, 12, 12, size=256, width=0.65)))
    assert tight.gap_cover < 0.03
    assert loose.gap_cover == pytest.approx(0.35**2, abs=0.05)
    assert loose.warp.width == pytest.approx(0.65, abs=0.12)
    assert loose.weft.width == pytest.approx(0.65, abs=0.12)
    assert tight.warp.width > loose.warp.width


def test_same_photo_same_answer(analyses: dict[str, PhotoAnalysis]) -> None:
    first, second = analyses["twill 1/2"], analyze_photo(draw(CASES["twill 1/2"][0]))
    assert first.warp_count == second.warp_count
    assert np.array_equal(first.matrix, second.matrix)
    assert np.array_equal(first.warp.yarn_colours, second.warp.yarn_colours)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_random_cloth(seed: int) -> None:
    """Random counts, weaves, colours, noise, rotation: counts within 3 % and the matrix exact."""
    rng = np.random.default_rng(seed)
    weaves = [plain(), twill(2, 1), twill(2, 2), twill(1, 3, "s"), satin(5, 2), satin(8, 3), basket(2, 2), HERRINGBONE]
    weave = weaves[seed % len(weaves)]
    cloth = Cloth(
        weave.matrix,
        float(rng.uniform(9, 20)),
        float(rng.uniform(9, 20)),
        (tuple(rng.uniform(0.1, 0.8, 3)),),
        (tuple(rng.uniform(0.1, 0.8, 3)),),
        width=float(rng.uniform(0.75, 1.0)),
        rotation=float(rng.uniform(-0.15, 0.15)),
        twist=tuple(rng.choice([-1, 1], 2) * rng.uniform(0.15, 0.5, 2)),
        phase=tuple(rng.random(2)),
        noise=float(rng.uniform(0.0, 0.05)),
        wobble=float(rng.uniform(0.0, 0.1)),
        seed=seed,
    )
    a = analyze_photo(draw(cloth))
    warp, weft = expected_counts(cloth)
    assert a.warp_count == pytest.approx(warp, rel=0.03)
    assert a.weft_count == pytest.approx(weft, rel=0.03)
    assert a.weave.equivalent(weave), a.weave.rows()
