"""Drafts, colours and mixtures on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from usdfab.fabric import hex_color, preset, read_wif
from usdfab.fabric.draft_picture import draft_picture
from usdfab.imaging import read_image
from usdfab.usd.fabric_io import read_fabric

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "shepherd-check.wif"
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def denim(tmp_path: Path, run: Run) -> Path:
    assert run("new", "denim", "-o", tmp_path / "denim.usda")[0] == 0
    return tmp_path / "denim.usda"


def refused(done: tuple[int, str, str], *words: str) -> None:
    code, out, error = done
    assert code == 2 and out == "" and len(error.strip().splitlines()) == 1, done
    for word in words:
        assert word in error, error


# --- drafts ----------------------------------------------------------------------------------------------------------


def test_a_fabric_from_a_draft_and_back(run: Run, tmp_path: Path) -> None:
    made = tmp_path / "check.usda"
    code, out, _ = run("new", "wool-twill", "--wif", SAMPLE, "-o", made, "--json")
    assert code == 0
    table = json.loads(out)
    assert table["warnings"] == [] and table["fabric"]["name"] == "Shepherd's check"
    assert table["fabric"]["provenance"]["source"] == SAMPLE.name
    fabric, wool = read_fabric(made), preset("wool-twill")
    assert fabric.repeat() == (8, 8) and len(fabric.warp.yarn_albedo) == 8
    assert fabric.warp.cuticle_tilt == wool.warp.cuticle_tilt and fabric.warp.fiber_count == wool.warp.fiber_count
    assert fabric.cell == pytest.approx((0.05 * 0.0254,) * 2)
    code, out, _ = run("draft", made, "-o", tmp_path / "back.wif", "--screenshot", tmp_path / "d.png")
    assert code == 0 and "8 picks x 8 ends, 4 shafts, 4 treadles, 2 + 2 colours" in out
    back, sample = read_wif(tmp_path / "back.wif"), read_wif(SAMPLE)
    assert np.array_equal(back.weave.matrix, sample.weave.matrix)
    assert [hex_color(c) for c in back.warp.colors] == [hex_color(c) for c in sample.warp.colors]
    picture = read_image(tmp_path / "d.png").pixels
    np.testing.assert_allclose(picture, draft_picture(fabric), atol=0.01)
    assert run("check", made, "--strict")[0] == 0


def test_a_draft_alone_and_its_facts(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("draft", SAMPLE, "--json")
    facts = json.loads(out)
    assert code == 0 and (facts["shafts"], facts["treadles"], facts["ends"], facts["colors"]["warp"]) == (4, 4, 8, 2)
    assert facts["ends_per_cm"] == pytest.approx(20 / 2.54)
    refused(run("new", "--wif", tmp_path / "none.wif", "-o", tmp_path / "a.usda"), "none.wif", "does not exist")
    refused(run("new", "-o", tmp_path / "a.usda"), "a preset, a weave or --wif")
    refused(run("draft", SAMPLE, "-o", tmp_path / "a.txt"), "use .wif")
    assert list(tmp_path.iterdir()) == []


def test_warnings_of_a_draft_are_told_and_kept(run: Run, tmp_path: Path) -> None:
    odd = tmp_path / "odd.wif"
    odd.write_text(SAMPLE.read_text().replace("Rising Shed=true", "") + "[PRIVATE MINE]\na=b\n")
    code, _, error = run("new", "--wif", odd, "-o", tmp_path / "a.usda")
    assert code == 0
    for words in ("warning: the draft does not say whether its shed rises", "warning: private sections"):
        assert words in error
    assert len(read_fabric(tmp_path / "a.usda").provenance.notes) == 2
    assert "rising shed is assumed" in run("info", tmp_path / "a.usda")[1]


def test_large_drafts_are_thinned_and_say_so(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    lifts = (np.flatnonzero(rng.integers(0, 2, 300)) + 1 for _ in range(300))
    lift = "\n".join(f"{k}={','.join(map(str, shafts))}" for k, shafts in enumerate(lifts, start=1))
    text = "[WEAVING]\nRising Shed=1\n[THREADING]\n" + "\n".join(f"{k}={k}" for k in range(1, 301))
    (tmp_path / "large.wif").write_text(f"{text}\n[LIFTPLAN]\n{lift}\n")
    code, _, error = run("new", "--wif", tmp_path / "large.wif", "-o", tmp_path / "a.usda")
    assert code == 0 and "the repeat of 300 picks and 300 ends is large: variants are set to 1" in error
    assert read_fabric(tmp_path / "a.usda").warp.fiber_count < 20


# --- editing ---------------------------------------------------------------------------------------------------------


def test_edit_changes_in_a_fixed_order(run: Run, denim: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    arguments = ("--set", "warp.twist=.2", "--recolor", "#3a2c26->#ff0000", "--weave", "plain", "--wif", SAMPLE)
    assert run("edit", denim, "-o", out, *arguments)[0] == 0
    fabric = read_fabric(out)
    assert fabric.weave.name == "plain" and fabric.warp.twist == 0.2
    assert [hex_color(c) for c in fabric.warp.yarn_albedo] == ["#e2d6be"] * 4 + ["#ff0000"] * 4


def test_colourways_from_making_to_listing(run: Run, denim: Path, tmp_path: Path) -> None:
    navy, red = tmp_path / "navy.usda", tmp_path / "red.usda"
    assert run("edit", denim, "--colorway", "navy", "--recolor", "warp=#102040", "-o", navy)[0] == 0
    assert run("edit", navy, "--colorway", "red", "--recolor", "warp=#aa2222", "-o", red)[0] == 0
    assert "colourways   original, navy, red (selected)" in run("info", red)[1]
    table = json.loads(run("info", red, "--json")[1])
    assert (table["colorways"], table["colorway"]) == (["original", "navy", "red"], "red")
    assert hex_color(table["warp"]["albedo"]) == "#aa2222"
    assert run("edit", red, "--colorway", "original", "-o", tmp_path / "o.usda")[0] == 0
    assert read_fabric(tmp_path / "o.usda") == preset("denim")
    assert json.loads(run("info", denim, "--json")[1])["colorways"] == []


def test_mixing(run: Run, denim: Path, tmp_path: Path) -> None:
    assert run("new", "linen", "-o", tmp_path / "linen.usda")[0] == 0
    out = tmp_path / "mixed.usda"
    assert run("edit", "--mix", tmp_path / "linen.usda", denim, "0.3", "--set", "seed=9", "-o", out)[0] == 0
    fabric = read_fabric(out)
    radii = [f.warp.radius for f in (preset("linen"), preset("denim"))]
    assert fabric.warp.radius == pytest.approx(radii[0] ** 0.7 * radii[1] ** 0.3)
    assert fabric.seed == 9 and fabric.weave.name == "plain"


def test_edits_that_are_refused(run: Run, denim: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    refused(run("edit", denim, "-o", out), "nothing to change")
    refused(run("edit", "--set", "seed=1", "-o", out), "one fabric or --mix")
    refused(run("edit", denim, "--mix", denim, denim, "0.5", "-o", out), "--mix")
    refused(run("edit", "--mix", denim, denim, "1.5", "-o", out), "--mix", "1.5 is not between")
    refused(run("edit", "--mix", denim, denim, ".5", "--colorway", "a", "-o", out), "--colorway")
    refused(run("edit", denim, "--recolor", "warp=blue", "-o", out), "--recolor", "'blue' is no colour")
    refused(run("edit", denim, "--weave", "tweed", "-o", out), "tweed")
    refused(run("edit", denim, "--colorway", "navy", "-o", out), "no colourway 'navy'")
    refused(run("edit", denim, "--wif", denim, "-o", out), "denim.usda")
    assert not out.exists()
