"""Table 2: errors by hand, the paper's numbers, and the blind fits with everything slow replaced."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from usdfab.cli.evaluate import run as evaluate
from usdfab.cli.main import _run
from usdfab.errors import NoFabricError, UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fabric.sampling import COVER_RANGE
from usdfab.fabric.weave import NAMED_WEAVES
from usdfab.fit import table2_evaluation
from usdfab.fit.fit_checkpoint import CheckpointFiles
from usdfab.fit.pipeline import Fit
from usdfab.fit.stages import StageOutcome
from usdfab.fit.table2 import PAPER_ERRORS, PAPER_MEANS, SYMBOLS, never_estimated, range_errors, range_width
from usdfab.fit.table2_evaluation import (
    FAMILIES,
    PhotoQuality,
    Table2Row,
    drawn_fabric,
    evaluate_table2,
    judged,
    take_photo,
)
from usdfab.fit.table2_format import format_table2, mean_errors, summary
from usdfab.imaging import read_image, write_image
from usdfab.usd.fabric_io import read_fabric

SIDE = 5e-3
YARN = YarnParameters(
    count=8, radius=0.07 * SIDE, fiber_count=200, inclination=0.5, crimp=1.0, twist=0.0, irregularity=0.2,
    migration=0.75, albedo=(0.5, 0.5, 0.5), roughness_longitudinal=0.5, roughness_azimuthal=0.05,
    roughness_primary=0.12,
)  # fmt: skip
TRUTH = FabricParameters(weave_from_name("plain"), (SIDE, SIDE), YARN, YARN)


def test_the_papers_means_are_those_it_prints() -> None:
    # The last column of MODEL.md, section 12, in its order.
    printed = (5.43, 6.01, 9.64, 12.88, 7.94, 2.29, 11.49, 1.69, 2.42, 1.88, 3.14, 0.19)
    assert list(PAPER_ERRORS) == list(SYMBOLS) == list(PAPER_MEANS)
    np.testing.assert_allclose(list(PAPER_MEANS.values()), printed, atol=0.0051)
    assert all(len(values) == 9 for values in PAPER_ERRORS.values())


def test_errors_by_hand() -> None:
    warp = replace(
        YARN, count=9, radius=0.08 * SIDE, fiber_count=206, inclination=0.64, crimp=1.3, twist=0.09, irregularity=0.5,
        migration=0.66, albedo=(0.6, 0.5, 0.2), roughness_longitudinal=0.8, roughness_azimuthal=0.08,
        roughness_primary=0.17,
    )  # fmt: skip
    errors = range_errors(replace(TRUTH, warp=warp), TRUTH, "plain")
    # The weft is right, so each is half of the warp's. Table 4, plain: 6 sigma, or the ends of U.
    expected = {
        "albedo": (0.1 + 0.0 + 0.3) / 3,
        "roughness_longitudinal": 0.3 / 0.6,
        "roughness_primary": 0.05 / 0.05,
        "roughness_azimuthal": 0.03 / 0.06,
        "twist": 0.09 / 0.18,
        "crimp": 0.3 / 1.2,
        "inclination": 0.14 / 1.4,
        "radius": 0.01 / 0.04375,
        "count": 1 / 2,
        "fiber_count": 6 / 30,
        "migration": 0.09 / 0.18,
        "irregularity": 0.3 / 0.6,
    }
    assert errors == pytest.approx({name: 0.5 * value for name, value in expected.items()})
    weft = range_errors(replace(TRUTH, weft=warp), TRUTH, "plain", ("count", "crimp"))
    # Picks are drawn from U(6, 10), ends from U(5, 7).
    assert weft == pytest.approx({"count": 0.5 * 1 / 4, "crimp": errors["crimp"]})
    assert set(range_errors(TRUTH, TRUTH, "plain").values()) == {0.0}


def test_yarns_are_counted_over_the_same_cloth_and_dyed_yarns_are_judged_each() -> None:
    cropped = replace(TRUTH, size=(0.5 * SIDE, SIDE), warp=replace(YARN, count=4))
    assert range_errors(cropped, TRUTH, "plain")["count"] == pytest.approx(0.0)
    colors = ((0.5, 0.5, 0.5), (0.8, 0.5, 0.5))
    dyed = replace(TRUTH, warp=replace(YARN, yarn_albedo=colors))
    assert range_errors(dyed, TRUTH, "plain")["albedo"] == pytest.approx(0.5 * (0.3 / 6))


def test_turned_weaves_have_the_ranges_they_are_drawn_from() -> None:
    assert range_width("crimp", "satin_rot90", "warp") == pytest.approx(0.4)
    assert range_width("crimp", "satin", "weft") == pytest.approx(1.0)
    assert range_width("twist", "satin", "weft") == pytest.approx(0.06)


def test_what_no_stage_estimates_is_the_priors() -> None:
    after = set(never_estimated(["analysis"]))
    assert not after & {"albedo", "count", "radius", "twist"}
    assert {"crimp", "fiber_count", "migration", "irregularity", "roughness_primary"} <= after
    assert "twist" in never_estimated(["analysis"], twist_seen=False)
    assert never_estimated(["analysis", "match"], twist_seen=False) == ("migration",)
    assert "crimp" in never_estimated(["analysis", "path"]) and "crimp" not in never_estimated(["analysis", "raster"])


def test_fabrics_are_fixed_by_their_seed_and_closed() -> None:
    drawn = [drawn_fabric(family, number, 4) for family in FAMILIES for number in range(3)]
    assert [fabric.weave.classify() for _, fabric in drawn] == ["plain"] * 3 + ["twill"] * 3 + ["satin"] * 3
    for weave, fabric in drawn:
        assert fabric.weave.equivalent(NAMED_WEAVES[weave])
        assert all(COVER_RANGE[0] <= fabric.cover(s) <= COVER_RANGE[1] for s in ("warp", "weft"))
    assert drawn[4] == drawn_fabric("twill", 1, 4)
    assert len({fabric.seed for _, fabric in drawn}) == 9
    assert drawn[4] != drawn_fabric("twill", 1, 5)


def test_a_photo_is_the_picture_of_the_rig_at_the_physical_scale(tmp_path: Path) -> None:
    path = tmp_path / "photo.exr"
    thin = replace(YARN, count=3, radius=3e-4, fiber_count=6)
    told: list[tuple[int, int]] = []
    cloth = FabricParameters(TRUTH.weave, (2e-3, 1e-3), thin, thin, variants=1)
    take_photo(cloth, path, PhotoQuality(24, 4, False), 0, lambda done, total: told.append((done, total)))
    pixels = read_image(path).pixels
    assert pixels.shape == (12, 24, 3)
    assert 0.02 < pixels.mean() < 1.0
    assert told[-1][0] == told[-1][1]


def outcome(name: str, fabric: FabricParameters, **more: object) -> StageOutcome:
    return StageOutcome(name, fabric, 2.0, distance=0.25, exposure=1.1, **more)  # type: ignore[arg-type]


def fitted(truth: FabricParameters, stages: tuple[str, ...], photo: np.ndarray, twist: float = 0.9, **more) -> Fit:
    """A fit whose first stage has 1 yarn too many each way, and the next the truth with another weave's start."""
    off = replace(truth, warp=replace(truth.warp, count=truth.warp.count + 1))
    rolled = replace(truth, weave=type(truth.weave)(np.roll(truth.weave.matrix, 1, axis=0)))
    outcomes = tuple(outcome(name, (off, rolled)[k], **more) for k, name in enumerate(stages))
    system = SimpleNamespace(twist_confidence=twist)
    analysis = SimpleNamespace(warp=system, weft=system)
    return Fit(outcomes[-1].fabric, analysis, photo, "--size", (), outcomes, exposure=1.1)  # type: ignore[arg-type]


def test_a_row_holds_errors_marks_and_the_weave_after_each_stage() -> None:
    row = judged("plain1", "plain", TRUTH, fitted(TRUTH, ("analysis", "match"), np.zeros((4, 4, 3)), twist=0.0))
    assert row.errors["analysis"]["count"] == pytest.approx(0.5 * 1 / 2)
    assert set(row.errors["match"].values()) == {0.0}
    assert "twist" in row.priors["analysis"] and row.priors["match"] == ["migration"]
    # Where the repeat begins makes no other cloth; another weave does.
    assert row.right == {"analysis": True, "match": True} and row.found["match"] == "01/10"
    twill = replace(TRUTH, weave=weave_from_name("twill0"))
    assert judged("t", "twill0", twill, fitted(TRUTH, ("analysis",), np.zeros((4, 4, 3)))).right == {"analysis": False}


class Fits:
    """Stands for ``fit_photo``: it refuses the photos named, or is broken off at them."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.calls: list[tuple] = []
        self.refuse: set[str] = set()
        self.interrupt: set[str] = set()

    def __call__(self, path: Path, width: float, *rest: object, **options: object) -> Fit:
        name = path.stem.removesuffix("_photo")
        self.done.append(name)
        self.calls.append((path.name, width, *rest))
        files = options["checkpoint"]
        assert isinstance(files, CheckpointFiles) and options["resume"] is True
        files.fit.write_text("unfinished")
        if name in self.refuse:
            raise NoFabricError("no lattice found", place=str(path))
        truth = read_fabric(path.with_name(f"{name}_truth.usda"))
        return fitted(truth, options["stages"], read_image(path).pixels, interrupted=name in self.interrupt)  # type: ignore[arg-type]


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> Fits:
    result = Fits()
    monkeypatch.setattr(table2_evaluation, "fit_photo", result)
    monkeypatch.setattr(table2_evaluation, "swatch", lambda *_: np.full((24, 24, 3), 0.3))
    monkeypatch.setattr(
        table2_evaluation, "take_photo", lambda _, path, *__: write_image(path, np.full((24, 24, 3), 0.5))
    )
    return result


NAMES = ["plain1", "twill1", "satin1"]


def test_each_fabric_is_fitted_once_and_blind_and_a_broken_run_goes_on(fits: Fits, tmp_path: Path) -> None:
    folder = tmp_path / "table2"
    told: list[tuple[int, int]] = []
    fits.interrupt, fits.refuse = {"twill1"}, {"satin1"}
    with pytest.raises(KeyboardInterrupt):
        evaluate_table2(folder, count=1)
    assert fits.done == NAMES[:2]
    assert (folder / "plain1.json").exists() and not (folder / "twill1.json").exists()
    # The unfinished fit's checkpoint stays, the finished one's is gone.
    assert not CheckpointFiles(folder / "plain1.usda").existing() and CheckpointFiles(folder / "twill1.usda").existing()
    fits.interrupt = set()
    rows = evaluate_table2(folder, count=1, progress=lambda _, done, total: told.append((done, total)))
    assert fits.done == [*NAMES[:2], *NAMES[1:]]
    assert [row.name for row in rows] == NAMES
    assert all(call[1:4] == (5e-3, None, 0) for call in fits.calls)
    assert rows[2].problem == "no lattice found" and not rows[2].errors
    assert not CheckpointFiles(folder / "satin1.usda").existing()
    assert [done for done, _ in told] == sorted(done for done, _ in told) and told[-1][1] == 3000
    for name in NAMES[:2]:
        truth = read_fabric(folder / f"{name}_truth.usda")
        assert truth.warp.count == pytest.approx(drawn_fabric(name[:-1], 0)[1].warp.count)
        assert read_fabric(folder / f"{name}.usda").weave.equivalent(truth.weave)
        assert read_image(folder / f"{name}.png").pixels.shape[1] > 3 * 24
    assert evaluate_table2(folder, count=1) == rows
    # More fabrics go into the same folder.
    assert evaluate_table2(folder, count=2)[0] == rows[0]
    assert fits.done[4:] == ["plain2", "twill2", "satin2"]


def made_up() -> list[Table2Row]:
    def row(name: str, c: float) -> Table2Row:
        errors = dict.fromkeys(SYMBOLS, 0.5) | {"albedo": c}
        return Table2Row(
            name, "plain", {"analysis": errors}, {"analysis": ["crimp"]}, {"analysis": "10/01"},
            {"analysis": name == "plain1"}, {"analysis": None}, {"analysis": 12.0},
        )  # fmt: skip

    return [row("plain1", 0.02), row("plain2", 0.04), Table2Row("plain3", "plain", problem="nothing seen")]


def test_the_table_shows_means_marks_and_the_papers_columns() -> None:
    rows = made_up()
    assert mean_errors(rows, "analysis")["albedo"] == pytest.approx(3.0)
    lines = format_table2(rows).splitlines()
    table = {line.split()[0]: line.split()[1:] for line in lines[2:15] if line}
    assert table["weave"] == ["right", "wrong", "-"]
    assert table["C"] == ["2.00", "4.00", "-", "3.00", "5.43"]
    assert table["beta"] == ["50.00~", "50.00~", "-", "50.00~", "2.29"]
    assert "weaves right: 1 of 3; mean error at or under the paper's: 1 of 12 rows" in lines
    assert "plain3 was refused: nothing seen" in lines
    assert lines[-12].split() == ["C", *(f"{v:.2f}" for v in PAPER_ERRORS["albedo"]), "5.43"]
    assert max(map(len, lines)) <= 120
    told = json.loads(json.dumps(summary(rows)))
    assert told["fabrics"][0]["errors"]["analysis"]["albedo"] == pytest.approx(2.0)
    assert told["means"]["analysis"]["albedo"] == pytest.approx(3.0) and told["weaves_right"] == {"analysis": 1}
    assert told["paper"]["albedo"]["fabrics"]["satin2"] == 11.24


def test_a_table_without_any_fit_says_why() -> None:
    text = format_table2([Table2Row("plain1", "plain", problem="nothing seen")])
    assert text.startswith("plain1 was refused: nothing seen") and "nan" not in text


def test_the_command(fits: Fits, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "table2"
    evaluate("table2", output=folder)
    assert fits.done == [f"{family}{k}" for family in FAMILIES for k in (1, 2, 3)]
    assert "after match" in capsys.readouterr().out
    evaluate("table2", output=folder, json=True)
    told = json.loads(capsys.readouterr().out)
    assert len(told["fabrics"]) == 9 and set(told["means"]) == {"analysis", "match"}
    assert told["means"]["match"]["count"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ((), "evaluate table2 needs a folder to write to"),
        (("photos", "-o", "x"), "evaluate table2 makes its own fabrics"),
        (("-o", "x", "--count", 0), "--count: 0 fabrics are none"),
        (("-o", "x", "--seed", -1), "--seed: -1 is not between"),
        (("-o", "x", "--stages", "match"), "--stages: the other stages start from the analysis"),
        (("-o", "file"), "cannot make the folder"),
    ],
)
def test_bad_requests_are_one_line(
    arguments: tuple, line: str, fits: Fits, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert _run(["evaluate", "table2", *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    assert not out and line in err and len(err.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["file"] and not fits.done


def test_results_of_other_options_and_broken_files_are_not_mixed_in(fits: Fits, tmp_path: Path) -> None:
    evaluate_table2(tmp_path, count=1)
    for other in ({"seed": 1}, {"quality": "standard"}, {"stages": ("analysis",)}):
        with pytest.raises(UsdfabError, match="other options"):
            evaluate_table2(tmp_path, count=1, **other)  # type: ignore[arg-type]
    with pytest.raises(UsdfabError, match="no quality"):
        evaluate_table2(tmp_path, quality="best")
    for text in ("{", "[]", '{"about": 3}', (tmp_path / "table2.json").read_text()):
        (tmp_path / "twill1.json").write_text(text)
        with pytest.raises(UsdfabError, match=r"no result|other options"):
            evaluate_table2(tmp_path, count=1)
    assert fits.done == NAMES
