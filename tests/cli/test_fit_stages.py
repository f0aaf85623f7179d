"""``usdfab fit --stages`` and ``usdfab evaluate raster``."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from usdfab.fabric.weave import satin
from usdfab.fit import pipeline, raster_stage
from usdfab.fit.raster_stage import StageSettings
from usdfab.imaging import read_image, write_image
from usdfab.usd.fabric_io import read_fabric

PHOTO = Path(__file__).parents[2] / "samples" / "microscope.png"
QUICK = StageSettings(width=48, supersampling=1, iterations=2, levels=(1, 2), kind="gram")
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(raster_stage.QUALITIES, "draft", QUICK)
    monkeypatch.setattr(pipeline, "fit_photo", partial(pipeline.fit_photo, albedo_paths=1000))


@pytest.mark.slow
def test_both_stages_with_report(run: Run, quick: None, tmp_path: Path) -> None:
    out, report = tmp_path / "fabric.usda", tmp_path / "report"
    command = ("fit", PHOTO, "-o", out, "--size", "4mm", "--stages", "analysis,raster", "-q", "--json")
    code, text, err = run(*command, "--report", report, "--report-spp", 1)
    assert code == 0, err
    result = json.loads(text)
    analysis, raster = result["stages"]
    assert (analysis["name"], raster["name"]) == ("analysis", "raster")
    assert len(raster["losses"]) == 2
    assert raster["distance"] <= analysis["distance"]
    names = {"photo", "after_analysis", "swatch", "comparison", "difference", "drape", "raster_loss"}
    assert set(result["pictures"]) == names
    assert {p.name for p in report.iterdir()} == {f"{n}.png" for n in names} | {"report.html"}
    assert result["report"] == str(report / "report.html")
    sizes = {n: read_image(report / f"{n}.png").pixels.shape for n in names}
    assert sizes["comparison"][1] == 3 * sizes["photo"][1] + 16
    assert read_fabric(out).provenance.stages == ("analysis", "raster")
    assert {p.name for p in tmp_path.iterdir()} == {"fabric.usda", "report"}


@pytest.mark.slow
def test_a_killed_stage_leaves_its_state_and_is_resumed(
    run: Run, quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = tmp_path / "whole.usda", tmp_path / "broken.usda"
    command = ("fit", PHOTO, "--size", "4mm", "--stages", "analysis,raster", "-q")
    code, _, err = run(*command, "-o", whole)
    assert code == 0, err
    # As if killed after the first iteration: what the descent saved is all there is.
    monkeypatch.setitem(raster_stage.QUALITIES, "draft", replace(QUICK, iterations=1))
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
    code, _, err = run(*command, "-o", broken)
    assert code == 0, err
    monkeypatch.undo()
    monkeypatch.setitem(raster_stage.QUALITIES, "draft", QUICK)
    monkeypatch.setattr(pipeline, "fit_photo", partial(pipeline.fit_photo, albedo_paths=1000))
    assert (tmp_path / "broken.usda.raster.safetensors").exists()
    code, _, err = run(*command, "-o", broken, "--overwrite", "--resume")
    assert code == 0, err
    assert broken.read_text() == whole.read_text()
    assert not (tmp_path / "broken.usda.raster.safetensors").exists()


def test_no_fabric_has_an_exit_code_of_its_own(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "fit_photo", partial(pipeline.fit_photo, albedo_paths=200))
    photo, output = tmp_path / "wall.png", tmp_path / "x.usda"
    write_image(photo, np.full((80, 90, 3), 0.4))
    command = ("fit", photo, "-o", output, "--size", "3mm")
    code, out, err = run(*command, "--json")
    assert code == 3
    assert not out and len(err.strip().splitlines()) == 1
    assert "no contrast" in err
    assert [p.name for p in tmp_path.iterdir()] == ["wall.png"]
    code, out, err = run(*command, "--json", "--force")
    assert code == 0, err
    assert "warning: Forced: the photo has no contrast" in err
    assert any("no contrast" in note for note in read_fabric(output).provenance.notes)
    assert json.loads(out)["analysis"]["lattice_confidence"] == 0.0


def test_what_is_known_is_taken(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "fit_photo", partial(pipeline.fit_photo, albedo_paths=200))
    output = tmp_path / "x.usda"
    known = ("--weave", "satin 5/2", "--yarns", "12x12")
    code, out, err = run("fit", PHOTO, "-o", output, "--size", "4mm", *known, "--json")
    assert code == 0, err
    fabric, result = read_fabric(output), json.loads(out)["analysis"]
    assert fabric.weave.equivalent(satin(5, 2)) or fabric.weave.equivalent(satin(5, 3))
    assert (fabric.warp.count, fabric.weft.count) == pytest.approx((12, 12), rel=0.2)
    assert result["weave_confidence"] == result["warp"]["count_confidence"] == 1.0
    # The sample is no satin.
    assert "warning: The photo looks more like another weave than the one that was given: twill" in err
    assert {"the weave was given", "the counts were given, about 12 ends and 12 picks"} <= set(fabric.provenance.notes)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("fit", PHOTO, "--stages", "analysis,magic"), "--stages: there is no stage 'magic'"),
        (("fit", PHOTO, "--stages", "path"), "--stages: the other stages start from the analysis"),
        (("fit", PHOTO, "--crop", "1,2,3"), "--crop: '1,2,3' is no region"),
        (("fit", PHOTO, "--weave", "moire"), "--weave: unknown weave 'moire'; use one of basket,"),
        (("fit", PHOTO, "--yarns", "12"), "--yarns: '12' are no counts of yarns; give ends across and picks down"),
        (("fit", PHOTO, "--stages", "raster"), "--stages: the other stages start from the analysis"),
        (("evaluate", "raster", "folder"), "folder: evaluate raster makes its own fabrics"),
        (("evaluate", "raster", "--count", 0), "--count: there is nothing to fit"),
        (("evaluate", "losses"), "evaluate losses needs a folder"),
    ],
)
def test_refusals_are_one_line(run: Run, tmp_path: Path, arguments: tuple, line: str) -> None:
    output = ("-o", tmp_path / "x.usda") if arguments[0] == "fit" else ()
    code, out, err = run(*arguments, *output)
    assert code == 2
    assert not out
    assert line in err
    assert len(err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
