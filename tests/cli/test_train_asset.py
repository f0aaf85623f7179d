"""``usdfab train neural --asset``: from a fabric file to pictures with its own network."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

pytest.importorskip("torch")

from usdfab.imaging import read_image
from usdfab.usd.fabric_io import read_fabric

SMALL = ("--backend", "neural", "--resolution", 8, "-q")


@pytest.fixture
def few(monkeypatch):
    """Few judges, which cost most of a run that is as short as here."""
    monkeypatch.setattr("usdfab.neural.asset_queries.JUDGES", 4)
    monkeypatch.setattr("usdfab.neural.asset_queries.JUDGE_SAMPLES", 4)


def test_a_fabric_gets_a_network_that_is_used(run, tiny, tmp_path, few):
    cloth = tmp_path / "cloth.usda"
    shutil.copy(tiny, cloth)
    assert run("render", cloth, "-o", tmp_path / "before.exr", *SMALL)[0] == 0
    train = ("train", "neural", "--asset", cloth, "--quality", "draft", "--queries", 24)
    code, out, err = run(*train, "--json")
    assert code == 0, err
    said = json.loads(out)
    weights = tmp_path / "cloth.neural.safetensors"
    assert said["output"] == str(weights) and weights.stat().st_size < 250_000
    for kind in ("reflection", "transmission"):
        assert set(said["about"]["errors"][kind]) == {"before", "after"}
    # Beside the fabric, named as seen from there; what made it is gone.
    assert "asset usdfab:neural:weights = @./cloth.neural.safetensors@" in cloth.read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["before.exr", weights.name, cloth.name]
    assert read_fabric(cloth).neural_weights == str(weights)
    code, _, err = run("render", cloth, "-o", tmp_path / "after.exr", *SMALL)
    before, after = (read_image(tmp_path / f"{name}.exr").pixels for name in ("before", "after"))
    assert code == 0 and not err and not np.allclose(before, after) and np.isfinite(after).all()
    # It goes along when both files are moved, and with edits that change no fiber.
    moved = tmp_path / "moved"
    moved.mkdir()
    shutil.copy(cloth, moved)
    shutil.copy(weights, moved)
    assert run("edit", moved / "cloth.usda", "-o", moved / "named.usda", "--set", "name=Other", "-q")[0] == 0
    code, _, err = run("render", moved / "named.usda", "-o", moved / "a.exr", *SMALL)
    assert code == 0 and not err and np.array_equal(read_image(moved / "a.exr").pixels, after)
    assert run(*train)[0] == 2  # the file exists


def test_weights_that_cannot_be_used(run, tiny, tmp_path, few):
    cloth, dyed = tmp_path / "cloth.usda", tmp_path / "dyed.usda"
    shutil.copy(tiny, cloth)
    code, _, err = run("train", "neural", "--asset", cloth, "--queries", 8, "-q", "--quality", "draft")
    assert code == 0, err
    weights = tmp_path / "cloth.neural.safetensors"
    # A fabric that changed: the shared networks, and a warning.
    assert run("edit", cloth, "-o", dyed, "--set", "warp.albedo=.1,.2,.3", "-q")[0] == 0
    code, out, _ = run("render", dyed, "-o", tmp_path / "a.exr", *SMALL, "--json")
    assert code == 0 and any("is not used" in warning for warning in json.loads(out)["warnings"])
    code, _, err = run("render", dyed, "-o", tmp_path / "b.exr", *SMALL, "--strict")
    assert code == 2 and "was trained on, which is not used" in err and err.count("\n") == 1
    whole = weights.read_bytes()
    for content, said in ((whole[:-100], "no whole file"), (b"", "no whole file"), (None, "do not exist")):
        if content is None:
            weights.unlink()
        else:
            weights.write_bytes(content)
        code, _, err = run("render", cloth, "-o", tmp_path / "c.exr", *SMALL)
        assert code == 2 and said in err and str(weights) in err and err.count("\n") == 1
        assert not (tmp_path / "c.exr").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("data", "--asset", "a.usda"), "one of them"),
        ((), "one of them"),
        (("--asset", "a.usda", "--epochs", 3), "--epochs: does not go with --asset"),
        (("data", "-o", "a.safetensors", "--queries", 3), "--queries: is for --asset"),
        (("data",), "--output: a file to write is needed"),
        (("--asset", "none.usda"), "none.usda"),
        (("--asset", "a.usda", "-o", "a.txt"), "cannot write '.txt' weights"),
    ],
)
def test_options_that_make_no_sense(run, tmp_path, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("train", "neural", *options)
    assert code == 2 and not out and said in err and err.count("\n") == 1


def test_numbers_out_of_range(run, tiny, tmp_path):
    cloth = tmp_path / "cloth.usda"
    shutil.copy(tiny, cloth)
    for options in (("--queries", 0), ("--seed", -1)):
        code, _, err = run("train", "neural", "--asset", cloth, *options)
        assert code == 2 and options[0] in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [cloth]
