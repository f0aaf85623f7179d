"""The distance of fits from photos, and the table over many photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_network import picture, small_net

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fit import features, fit_evaluation
from usdfab.fit.fit_evaluation import SAME_CLOTH, evaluate_fits, format_fits, gram_distance
from usdfab.fit.pipeline import Fit
from usdfab.fit.stages import StageOutcome
from usdfab.imaging import read_image, write_image
from usdfab.usd.fabric_io import read_fabric

YARN = YarnParameters(count=3, radius=3e-4, fiber_count=6)
CLOTH = FabricParameters(weave_from_name("plain"), (2e-3, 2e-3), YARN, YARN)


def image(seed: int) -> np.ndarray:
    return picture(seed)[0].permute(1, 2, 0).numpy()


def test_the_distance_is_symmetric_and_grows_with_the_difference(tmp_path: Path) -> None:
    net = small_net(tmp_path)
    one, other = image(1), image(2)
    assert gram_distance(one, one, net, (1, 2)) == 0.0
    assert gram_distance(one, other, net, (1, 2)) == pytest.approx(gram_distance(other, one, net, (1, 2)))
    near, far = (gram_distance(one, one + part * (other - one), net, (1, 2)) for part in (0.1, 0.8))
    assert 0.0 < near < far
    # Above white nothing is seen, as in a file.
    assert gram_distance(one + 5.0, one + 9.0, net, (1, 2)) == 0.0


@pytest.fixture
def fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Photos a.png and b.png; b is refused. The list grows by the name of each photo that is fitted."""
    done: list[str] = []

    def fit_photo(path: Path, *_: object, **options: object) -> Fit:
        done.append(path.stem)
        if path.stem == "b":
            raise UsdfabError("no woven fabric is seen", place=str(path))
        photo = read_image(path).pixels
        outcomes = tuple(StageOutcome(name, CLOTH, 1.5, exposure=1.2) for name in options["stages"])  # type: ignore[attr-defined]
        return Fit(CLOTH, None, photo, "--size", (), outcomes, exposure=1.2)  # type: ignore[arg-type]

    net = small_net(tmp_path, features.fast_dtype())
    monkeypatch.setattr(features, "load_features", lambda *_, **__: net)
    monkeypatch.setattr(fit_evaluation, "fit_photo", fit_photo)
    monkeypatch.setattr(fit_evaluation, "SIDE", 32)
    monkeypatch.setattr(fit_evaluation, "SAMPLES", 4)
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, name in enumerate("ab"):
        write_image(folder / f"{name}.png", image(k))
    return done


def test_each_photo_gets_an_asset_a_picture_and_a_row_and_is_fitted_once(fits: list[str], tmp_path: Path) -> None:
    photos, results = tmp_path / "photos", tmp_path / "results"
    rows = evaluate_fits(photos, results, stages=("analysis", "match"))
    assert fits == ["a", "b"]
    good, bad = rows
    assert list(good.distances) == ["analysis", "match"]
    assert good.distances["analysis"] == good.distances["match"] == good.last
    assert (good.exposure, good.seconds) == (1.2, 3.0)
    assert "no woven fabric" in bad.problem
    assert read_fabric(results / "a.usda").weave == CLOTH.weave
    assert read_image(results / "a.png").pixels.shape[1] > 3 * 32
    assert evaluate_fits(photos, results, stages=("analysis", "match")) == rows
    assert fits == ["a", "b"]
    table = format_fits(rows)
    assert f"within {SAME_CLOTH} of the photo: {int((good.last or 9.0) <= SAME_CLOTH)} of 2" in table
    assert "refused" in table


def test_an_interrupted_fit_is_no_result(fits: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos, results = tmp_path / "photos", tmp_path / "results"
    whole = fit_evaluation.fit_photo

    def broken_off(*arguments: object, **options: object) -> Fit:
        fit = whole(*arguments, **options)  # type: ignore[arg-type]
        return replace(fit, stages=(*fit.stages[:-1], replace(fit.stages[-1], interrupted=True)))

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(fit_evaluation, "fit_photo", broken_off)
        evaluate_fits(photos, results, names=("a.png",))
    assert not (results / "a.json").exists()
    assert evaluate_fits(photos, results, names=("a.png",))[0].distances
    assert fits == ["a", "a"]


def test_wrong_folders_are_one_line(fits: list[str], tmp_path: Path) -> None:
    photos, results = tmp_path / "photos", tmp_path / "results"
    with pytest.raises(UsdfabError, match="no photos"):
        evaluate_fits(tmp_path / "nothing", results)
    evaluate_fits(photos, results, names=("a.png",))
    with pytest.raises(UsdfabError, match="other options"):
        evaluate_fits(photos, results, names=("a.png",), quality="standard")
    (results / "a.json").write_text("{")
    with pytest.raises(UsdfabError, match="no result"):
        evaluate_fits(photos, results, names=("a.png",))
    (tmp_path / "file").write_text("")
    with pytest.raises(UsdfabError, match="folder"):
        evaluate_fits(photos, tmp_path / "file")
