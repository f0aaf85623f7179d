"""``usdfab evaluate losses`` on a folder of drawings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_network import small_net

from usdfab.cli.evaluate import run
from usdfab.errors import UsdfabError
from usdfab.fit import extra
from usdfab.fit.features import load_features
from usdfab.fit.loss_evaluation import evaluate_losses, format_losses
from usdfab.imaging.image_output import write_image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three cloths that differ in period and direction, with grain."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:160, :160]
    for index, (a, b) in enumerate(((0.8, 0.8), (0.3, 0.5), (0.9, 0.1))):
        wave = 0.5 + 0.35 * np.sin(a * x) * np.cos(b * y)
        pixels = wave[..., None] * np.array([0.6, 0.5, 0.4 + 0.1 * index]) * rng.uniform(0.9, 1.1, (160, 160, 1))
        write_image(tmp_path / f"cloth{index}.png", pixels.astype(np.float32))
    return tmp_path


def test_cloths_are_told_apart_and_wrong_parameters_are_seen(folder: Path) -> None:
    gram, covariance = evaluate_losses(folder, load_features(), levels=(1, 2))
    assert (gram.kind, covariance.kind) == ("gram", "covariance")
    for quality in (gram, covariance):
        assert len(quality.same) == 3 and len(quality.other) == len(quality.matched) == 3
        assert max(quality.same) < min(quality.matched) and quality.right == 1.0 and quality.separation > 2.0
        assert quality.changed["turned by 90 degrees"][0] > 1.1
        assert quality.shifted < 0.5 * min(quality.other)
    table = format_losses([gram, covariance])
    assert "covariance" in table and f"{np.median(gram.same):.3f}" in table and "softened" in table


def test_the_command_prints_json(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture
) -> None:
    weights = tmp_path_factory.mktemp("weights")
    small_net(weights)
    run("losses", folder, features=str(weights / "net.safetensors"), json=True)
    result = json.loads(capsys.readouterr().out)
    assert [r["kind"] for r in result["losses"]] == ["gram", "covariance"]
    assert all(r["same_median"] > 0.0 for r in result["losses"])


def test_too_few_photos_and_no_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsdfabError, match="0 PNG photos are large enough"):
        evaluate_losses(tmp_path, small_net(tmp_path))
    monkeypatch.setattr(extra, "find_spec", lambda name: None if name == "torch" else name)
    with pytest.raises(UsdfabError, match=r"evaluate losses needs torch; pip install 'usdfab\[fit\]'"):
        run("losses", tmp_path)
