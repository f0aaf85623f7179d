"""The ablation of stage 2: every figure has its ways, judged alike, and its pictures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_network import small_net

from usdfab.cli.evaluate import run
from usdfab.errors import UsdfabError
from usdfab.fit.raster_ablation import (
    FIGURES,
    Figure,
    Way,
    evaluate_ablation,
    format_ablation,
    of_figure,
    planned_files,
    write_ablation,
)
from usdfab.fit.raster_evaluation import ABLATIONS, JUDGED, Recovery
from usdfab.fit.raster_stage import StageSettings
from usdfab.imaging import read_image

QUICK = StageSettings(width=40, supersampling=1, iterations=2, rate=0.05, levels=(1, 2), prior=0.0)


def made_up() -> list[Way]:
    """A result of every way of every figure, with numbers that tell them apart."""
    ways = {(weave, way): None for figure in FIGURES for weave in figure.weaves for way in figure.ways}
    results = []
    for k, (weave, way) in enumerate(ways):
        before = dict.fromkeys(JUDGED, 0.2)
        recovery = Recovery(weave, 0, way, before, before | {"crimp": 0.01 * k}, 2.0, 1.0, 5, 1.0)
        results.append(Way(recovery, 1.0 + k, 0.1 * k, np.full((6, 4, 3), 0.5), np.full((6, 4, 3), 0.1)))
    return results


def test_figures_take_known_ways_and_share_fits() -> None:
    assert {way for figure in FIGURES for way in figure.ways} == set(ABLATIONS)
    results = made_up()
    assert len(results) == 10
    losses = of_figure(results, FIGURES[1])
    assert [r.recovery.weave for r in losses["full"]] == ["twill0", "plain"]
    assert losses["full"][0] is of_figure(results, FIGURES[0])["full"][0]


def test_tables_have_a_row_for_each_way_with_means_over_fabrics() -> None:
    results = made_up()
    shading, losses, prior, note = format_ablation(results).split("\n\n")
    assert shading.startswith("figure 15, shading: twill0 1\n") and "satin 1" in prior and "raster picture" in note
    row = next(line for line in losses.splitlines() if line.startswith("texture only"))
    both = of_figure(results, FIGURES[1])["texture only"]
    expected = np.mean([r.texture for r in both]), np.mean([r.color for r in both])
    cells = row.removeprefix("texture only").split()
    assert [float(c) for c in cells[:2]] == pytest.approx(expected, abs=1e-3)
    beta = losses.splitlines()[1].split().index("beta")
    assert float(cells[beta]) == pytest.approx(100 * np.mean([r.recovery.after["crimp"] for r in both]), abs=0.05)
    assert "figure 18" not in format_ablation([r for r in results if r.recovery.weave != "satin"])


def test_pictures_show_the_target_and_then_each_way(tmp_path: Path) -> None:
    results = made_up()
    paths = planned_files(tmp_path / "out", 1)
    write_ablation(results, paths)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {p.name for p in paths.values()}
    document = json.loads(paths["ablation"].read_text())
    assert document["pictures"]["figure18_satin_1.png"] == ["target", "full", "no prior"]
    assert len(document["results"]) == 10
    pixels = read_image(paths["figure18_satin_1"]).pixels
    assert pixels.shape[:2] == (6, 3 * 4 + 2 * 8)
    assert pixels[3, 1, 0] > 0.4 > pixels[3, 14, 0]
    with pytest.raises(UsdfabError, match="the file exists"):
        planned_files(tmp_path / "out", 1)
    assert planned_files(tmp_path / "out", 1, overwrite=True) == paths
    (tmp_path / "file").write_text("")
    with pytest.raises(UsdfabError, match="cannot make the folder"):
        planned_files(tmp_path / "file" / "out", 1)


def test_only_the_ablation_writes_files(tmp_path: Path) -> None:
    with pytest.raises(UsdfabError, match="writes no files"):
        run("raster", output=tmp_path)


def test_one_weave_is_chosen_for_the_raster_stage_only() -> None:
    with pytest.raises(UsdfabError, match=r"'tweed' is not judged.*plain, twill0, twill1, satin"):
        run("raster", weave="tweed")
    with pytest.raises(UsdfabError, match="takes no weave"):
        run("ablation", weave="plain")


@pytest.mark.slow
def test_ways_are_fitted_from_one_start_and_judged_alike(tmp_path: Path) -> None:
    net = small_net(tmp_path, torch.float32)
    figure = Figure(17, "losses", ("plain",), ("full", "texture only"))
    told: list[tuple[int, int]] = []
    full, texture = evaluate_ablation(
        1, 0, QUICK, fibers=6, figures=(figure,), net=net, progress=lambda k, of, _: told.append((k, of))
    )
    assert told[-1] == (4, 4)
    assert full.recovery.before == texture.recovery.before
    assert np.array_equal(full.target, texture.target)
    # The way without the colour loss is judged by it too; its own loss has but one part.
    assert texture.color > 0.0
    assert texture.recovery.best_loss == pytest.approx(texture.texture, rel=1e-3)
    assert full.recovery.best_loss == pytest.approx(full.texture + full.color, rel=1e-3)
    again = evaluate_ablation(1, 0, QUICK, fibers=6, figures=(replace(figure, ways=("full",)),), net=net)
    assert np.array_equal(again[0].render, full.render)
