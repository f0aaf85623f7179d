"""From a photo to a guess and to a fabric: the same in every turn and exposure, relative to the whole photo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw
from network_examples import net, prepared_rows

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import NAMED_WEAVES
from usdfab.fit.analysis import analyze_photo
from usdfab.fit.features import FeatureNet
from usdfab.fit.network import predict as predicting, stage
from usdfab.fit.network.fit import fit_network
from usdfab.fit.network.labels import LABELS
from usdfab.fit.network.network_file import Weights
from usdfab.fit.network.predict import Guess, likeliest, predict, turned_back, values_back
from usdfab.fit.network.spectra import FREQUENCIES
from usdfab.fit.network.targets import INDEX
from usdfab.fit.network.training import TrainSettings
from usdfab.fit.network.turns import Turn
from usdfab.fit.priors import fabric_from_analysis


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fit_network(prepared_rows(100), TrainSettings(epochs=6, batch=16)).weights


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> FeatureNet:
    return net(tmp_path_factory.mktemp("net"))


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return draw(Cloth(NAMED_WEAVES["twill0"].matrix, 12.0, 15.0, rotation=0.03, size=300))


@pytest.fixture(scope="module")
def guess(weights: Weights, network: FeatureNet, photo: np.ndarray) -> Guess:
    return predict(photo, weights, network)


def test_probabilities_and_counts(guess: Guess) -> None:
    assert guess.weave.shape == (len(LABELS),) and guess.weave.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(guess.count_odds.sum(axis=1), 1.0)
    # The rows that it was trained on have one peak at the count, and so has drawn cloth, or at the double.
    for count, truth in zip(guess.counts, (12.0, 15.0), strict=True):
        assert min(abs(count / truth - 1.0), abs(count / (2.0 * truth) - 1.0)) < 0.05
    np.testing.assert_allclose(np.exp(guess.values[:, INDEX["count"]]), guess.counts)
    assert (guess.sigma > 0.0).all() and ((guess.count_confidence >= 0.0) & (guess.count_confidence <= 1.0)).all()


def test_the_likeliest_count_lies_between_bins() -> None:
    for truth in (6.3, 17.7):
        odds = np.stack([np.exp(-0.5 * ((np.log(FREQUENCIES) - np.log(c)) / 0.02) ** 2) for c in (truth, 30.0)])
        odds[:, :9] += 0.3 * odds.max()
        assert likeliest(odds) == pytest.approx([truth, 30.0], rel=2e-3)


def test_a_turned_photo_gives_the_turned_guess(
    guess: Guess, weights: Weights, network: FeatureNet, photo: np.ndarray
) -> None:
    for turn in (Turn(1), Turn(0, True)):
        turned = predict(np.ascontiguousarray(turn.picture(photo)), weights, network)
        # The four looks are no whole group: what they see of a turned photo differs a little.
        np.testing.assert_allclose(turned_back(turned.weave, turn), guess.weave, atol=0.1)
        np.testing.assert_allclose(turned.counts[::-1] if turn.quarters else turned.counts, guess.counts, rtol=0.01)
        back = values_back(turned.values, turn)
        assert np.abs((back - guess.values) / guess.sigma)[:, 1:].max() < 0.5


def test_exposure_does_not_matter(guess: Guess, weights: Weights, network: FeatureNet, photo: np.ndarray) -> None:
    again = predict(0.3 * photo, weights, network)
    np.testing.assert_allclose(again.values, guess.values, atol=0.02)


def test_an_oblong_photo_shows_more_yarns(
    guess: Guess, weights: Weights, network: FeatureNet, photo: np.ndarray
) -> None:
    wide = np.concatenate([photo[:, :75][:, ::-1], photo, photo[:, -75:][:, ::-1]], axis=1)
    found = predict(wide, weights, network)
    np.testing.assert_allclose(found.counts, guess.counts * [1.5, 1.0], rtol=1e-6)
    np.testing.assert_allclose(found.values, guess.values, atol=1e-5)


def test_the_papers_network_is_not_asked_about_photos(network: FeatureNet, photo: np.ndarray) -> None:
    paper = fit_network(prepared_rows(), TrainSettings("paper", epochs=1)).weights
    with pytest.raises(UsdfabError, match="does not know real photos"):
        predict(photo, paper, network)


def test_the_stage(
    weights: Weights, network: FeatureNet, photo: np.ndarray, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(predicting, "feature_net", lambda *_: network)
    analysis = analyze_photo(photo)
    shown = fabric_from_analysis(analysis, 3e-3)[0]
    fabric, notes = stage.guessed_fabric(analysis, shown, photo, weights)
    assert fabric.size == shown.size and fabric.warp.albedo == shown.warp.albedo
    assert notes[0].startswith("network: weave ") and "with probability" in notes[0]
    # Albedos are found by rendering, which is not this test's matter.
    asked = []
    monkeypatch.setattr(stage, "brightness_curves", lambda fabric, paths, **_: asked.append((fabric, paths)))
    monkeypatch.setattr(stage, "with_inverted_albedo", lambda fabric, *_, **__: (fabric, ("a note",)))
    said: list[tuple[str, int, int]] = []
    outcome, again = stage.run_network(
        analysis, shown, photo, weights=weights, albedo_paths=7, progress=lambda *a: said.append(a)
    )
    assert (outcome.name, outcome.fabric, again) == ("network", fabric, fabric) and outcome.notes == (*notes, "a note")
    assert asked == [(fabric, 7)] and said == [("network", 0, 7)] and outcome.seconds > 0.0
