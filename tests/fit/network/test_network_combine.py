"""The combination of network and analysis: who is right when both are sure, when one is, when neither is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.weave import NAMED_WEAVES, twill
from usdfab.fit.network.combine import (
    BETTER_THAN_ASSUMED,
    Combined,
    average,
    combine,
    combined_count,
    combined_weave,
    fabric_of,
    speaks,
)
from usdfab.fit.network.labels import LABELS
from usdfab.fit.network.predict import LOOKS, Guess, estimates, turned_back, values_back
from usdfab.fit.network.spectra import BINS, FREQUENCIES
from usdfab.fit.network.targets import INDEX, NAMES, TARGETS, decode, encode
from usdfab.fit.network.turns import Turn

ALL = dict.fromkeys(NAMES, 0.1)
"""A network that is good at everything."""


def odds(*peaks: tuple[float, float]) -> np.ndarray:
    """(BINS,) with the share of the second number near the count of the first."""
    found = sum(share * np.exp(-0.5 * ((np.log(FREQUENCIES) - np.log(at)) / 0.03) ** 2) for at, share in peaks)
    return np.asarray(found / np.sum(found))


def guess(label: str = "plain", sure: float = 0.9, warp: float = 10.0, weft: float = 20.0, **values: float) -> Guess:
    weave = np.full(len(LABELS), (1.0 - sure) / (len(LABELS) - 1))
    weave[LABELS.index(label)] = sure
    targets = encode(
        FabricParameters(size=(1.0, 1.0), warp=YarnParameters(count=warp), weft=YarnParameters(count=weft))
    )
    found = targets[0].copy()
    for name, value in values.items():
        found[:, INDEX[name]] = value
    return Guess(
        weave, np.array([warp, weft]), np.full(2, 0.01), np.stack([odds((warp, 1.0)), odds((weft, 1.0))]), found,
        np.full((2, len(TARGETS)), 0.1), np.ones(2),
    )  # fmt: skip


def analysis(
    weave: str = "plain", sure: float = 0.9, warp: float = 10.1, weft: float = 19.8, count_sure: float = 0.9
) -> SimpleNamespace:
    """What ``combine`` reads of an analysis."""

    def system(count: float) -> SimpleNamespace:
        return SimpleNamespace(
            count=count, count_confidence=count_sure, width=0.8, width_confidence=0.5, twist_confidence=0.0
        )

    return SimpleNamespace(
        warp=system(warp), weft=system(weft), weave=NAMED_WEAVES[weave], weave_confidence=sure, rotation=0.0,
        weave_known=False, counts_known=False,
    )  # fmt: skip


def shown(weave: str = "plain", warp: float = 10.1, weft: float = 19.8) -> FabricParameters:
    yarn = YarnParameters(count=warp, radius=1.5e-4, yarn_albedo=((0.1, 0.2, 0.3), (0.4, 0.5, 0.6)), crimp=0.8)
    return FabricParameters(NAMED_WEAVES[weave], (5e-3, 5e-3), yarn, replace(yarn, count=weft, radius=1e-4))


def both(a: Guess, b: SimpleNamespace, fabric: FabricParameters | None = None, skill: dict | None = None) -> Combined:
    return combine(a, b, fabric or shown(), ALL if skill is None else skill)  # type: ignore[arg-type]


def test_where_they_agree_the_analysis_is_more_exact() -> None:
    found = both(guess(), analysis())
    assert found.label == "plain" and found.weave is NAMED_WEAVES["plain"] and found.weave_confidence > 0.95
    assert found.counts.tolist() == [10.1, 19.8] and found.notes == ()
    assert (found.count_confidence > 0.95).all()


def test_the_surer_one_decides_a_count() -> None:
    doubled = guess(warp=20.2)
    kept = combined_count(doubled, 0, 10.1, 1.0)
    moved = combined_count(doubled, 0, 10.1, 0.05)
    assert kept[0] == 10.1 and moved[0] == 20.2
    torn = replace(doubled, count_odds=np.stack([odds((10.1, 0.45), (20.2, 0.55))] * 2))
    assert combined_count(torn, 0, 10.1, 0.5)[0] == 10.1
    assert combined_count(torn, 0, 10.1, 0.5)[1] > kept[1]


def test_a_count_of_the_network_throws_the_weave_of_the_wrong_lattice_out() -> None:
    found = both(guess("twill0", 0.6, warp=20.2), analysis("satin", 1.0, count_sure=0.02))
    assert found.counts[0] == 20.2 and found.label == "twill0" and found.weave is NAMED_WEAVES["twill0"]
    assert any("20.2 yarns of the warp" in note for note in found.notes)
    fabric = fabric_of(shown(), found, speaks(dict.fromkeys(NAMES, 1.0)))
    assert fabric.warp.count == 20.2 and fabric.warp.yarn_albedo == () and fabric.weft.yarn_albedo != ()
    # The cover stays as the photo shows it.
    assert fabric.cover("warp") == pytest.approx(shown().cover("warp"))


def test_what_was_given_is_not_overruled() -> None:
    sees_other = guess("twill0", 0.99, warp=20.2)
    seen = analysis("satin", 0.1, count_sure=0.02)
    seen.weave_known = seen.counts_known = True
    found = both(sees_other, seen, shown("satin"))
    assert found.label == "satin" and found.weave is NAMED_WEAVES["satin"] and found.weave_confidence == 1.0
    assert found.counts.tolist() == [10.1, 19.8] and found.notes == ()
    seen.counts_known = False
    assert both(sees_other, seen, shown("satin")).counts[0] == 20.2


def test_the_weave_of_the_networks_own_lattice_is_no_evidence_for_another() -> None:
    """Satins look plain to who takes two picks for one."""
    halved = guess("plain", 0.99, weft=9.9)
    found = both(halved, analysis("satin", 0.2, count_sure=1.0), shown("satin"))
    assert found.counts[1] == 19.8 and found.label == "satin" and found.weave is NAMED_WEAVES["satin"]
    assert both(guess("plain", 0.99), analysis("satin", 0.2, count_sure=1.0), shown("satin")).label == "plain"


def test_the_surer_one_decides_the_weave() -> None:
    sure, unsure = analysis("twill_2_2", 0.95), analysis("twill_2_2", 0.0)
    fabric = shown("twill_2_2")
    assert both(guess("satin", 0.5), sure, fabric).label == "other_twill"
    found = both(guess("satin", 0.97), unsure, fabric)
    assert found.label == "satin" and found.weave is NAMED_WEAVES["satin"]
    assert "satin" in found.notes[0] and "other_twill" in found.notes[0]
    # The analysis knows the whole matrix: the direction of a twill is kept.
    mirrored = analysis()
    mirrored.weave = twill(2, 1, "s")
    assert both(guess("twill0"), mirrored, shown("twill0")).weave is mirrored.weave


def test_probabilities_of_the_weave_by_hand() -> None:
    mine = np.zeros(len(LABELS))
    mine[0] = 1.0
    found = combined_weave(mine, LABELS[1], 1.0)
    assert found.sum() == pytest.approx(1.0)
    # WEAVE_DOUBT 0.15, and the analysis right with 0.85: the rest is shared by the ten other labels.
    assert found[0] / found[1] == pytest.approx((0.85 + 0.15 / 11) * 0.015 / (0.15 / 11 * 0.85))
    alone = combined_weave(mine, LABELS[1], 1.0, trusted=False)
    np.testing.assert_allclose(alone, 0.85 * mine + 0.15 / 11)


def test_averages_weigh_by_inverse_variance() -> None:
    mean, sigma = average(np.array([1.0, 1.0, 1.0]), np.array([1.0, np.inf, np.inf]),
                          np.array([4.0, 4.0, 4.0]), np.array([0.5, 0.5, np.inf]))  # fmt: skip
    np.testing.assert_allclose(mean, [(1.0 + 4.0 * 4.0) / 5.0, 4.0, 1.0])
    np.testing.assert_allclose(sigma, [1.0 / np.sqrt(5.0), 0.5, np.inf])


def test_a_network_without_skill_changes_nothing() -> None:
    fabric = shown()
    skill = dict.fromkeys(NAMES, 1.0)
    found = both(guess(crimp=0.0, irregularity=0.9), analysis(), fabric, skill)
    # Size over spacing of the analysis is the fabric's count here.
    assert fabric_of(fabric, found, speaks(skill)) == fabric
    assert not speaks(skill).any() and not speaks({}).any()
    little = speaks(dict.fromkeys(NAMES, 0.95))
    assert {name for name, heard in zip(NAMES, little, strict=True) if heard} == set(BETTER_THAN_ASSUMED)


def test_what_the_network_knows_goes_into_the_fabric() -> None:
    values = {
        "crimp": np.log(0.4), "irregularity": np.sqrt(0.3), "height": np.log(0.5), "cover": np.log(0.9), "plied": 0.9,
        "twist": np.arcsinh(0.2 / 0.05), "fiber_count": np.log(90.0), "flyaways": np.log(0.1 + 2.0),
        "roughness_primary": np.log(0.2),
    }  # fmt: skip
    found = both(guess(**values), analysis())
    fabric = fabric_of(shown(), found, speaks(ALL))
    for yarn, system in ((fabric.warp, "warp"), (fabric.weft, "weft")):
        assert yarn.crimp == pytest.approx(0.4) and yarn.irregularity == pytest.approx(0.3)
        assert yarn.twist == pytest.approx(0.2) and yarn.fiber_count == 90 and yarn.ply_count == 2
        assert yarn.roughness_primary == pytest.approx(0.2)
        assert yarn.flyaway_density * 5e-3 / yarn.count == pytest.approx(2.0)
        # Cover: the network's and the analysis' estimate, by their variances.
        cover = float(decode(found.values)["cover"][0 if system == "warp" else 1])
        old = shown().cover(system)  # type: ignore[arg-type]
        assert min(0.9, old) < cover < max(0.9, old)
        assert fabric.cover(system) == pytest.approx(cover)  # type: ignore[arg-type]
        assert yarn.albedo == shown().warp.albedo
    assert fabric.weave is NAMED_WEAVES["plain"]


def test_answers_of_turned_pictures_are_brought_back() -> None:
    fabric = replace(shown("twill0"), warp=replace(shown().warp, twist=0.2))
    values, _ = encode(fabric)
    label = LABELS.index("twill0")
    for turn in LOOKS:
        turned = turn.fabric(fabric)
        np.testing.assert_allclose(values_back(encode(turned)[0], turn), values, atol=1e-12)
        probabilities = np.zeros(len(LABELS))
        probabilities[LABELS.index("twill0_rot90" if turn.quarters % 2 else "twill0")] = 1.0
        assert int(turned_back(probabilities, turn).argmax()) == label
    sigma = np.arange(2.0 * len(TARGETS)).reshape(2, -1)
    np.testing.assert_array_equal(values_back(sigma, Turn(1, True), signed=False), sigma[::-1])


def test_estimates_in_units() -> None:
    one = replace(guess(), stretch=np.array([1.5, 1.0]), counts=np.array([15.0, 20.0]))
    found = estimates(one, 6e-3)
    assert found["count"][0].tolist() == [15.0, 20.0]
    height = decode(one.values)["height"]
    # The middle square is 4 mm wide.
    np.testing.assert_allclose(found["radius"][0], height * 4e-3 / 2.0 / np.array([10.0, 20.0]))
    mean, sigma = found["crimp"]
    np.testing.assert_allclose(sigma / mean, 0.1, rtol=0.01)
    # Height and count both move the radius.
    np.testing.assert_allclose(found["radius"][1] / found["radius"][0], np.hypot(0.1, 0.1), rtol=0.02)
    assert one.count_axis.shape == (2, BINS)
    assert one.count_axis[0, 0] == pytest.approx(1.5 * FREQUENCIES[0])
