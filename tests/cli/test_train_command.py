"""``usdfab train`` and ``usdfab evaluate network`` on drawn cloth: the whole way, and everything that stands in it."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("torch")
sys.path += [str(Path(__file__).parent.parent / "fit"), str(Path(__file__).parent.parent / "fit" / "network")]

from network_examples import drawn_dataset, net

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("drawn")
    drawn_dataset(root)
    return root


@pytest.fixture(autouse=True)
def small(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small feature network instead of VGG, which is tested by itself."""
    from usdfab.fit.network import evaluation, inputs, photo_evaluation, store

    network = net(tmp_path_factory.mktemp("net"))
    for module in (inputs, evaluation, photo_evaluation):
        monkeypatch.setattr(module, "feature_net", lambda *_: network)
    monkeypatch.setattr(store, "DRAWN_CHUNK", 2)


@pytest.fixture(scope="module")
def made(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a few epochs, with their inputs and curves beside them."""
    from usdfab.cli.main import _run
    from usdfab.fit.network import inputs, store

    folder = tmp_path_factory.mktemp("made")
    network = net(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs, "feature_net", lambda *_: network)
        patch.setattr(store, "DRAWN_CHUNK", 2)
        options = [
            "--epochs",
            "2",
            "--views",
            "2",
            "--drawn",
            "1",
            "--curves",
            str(folder / "curves"),
            "--learning-curve",
            "-q",
        ]
        assert _run(["train", "fit-network", str(dataset), "-o", str(folder / "w.safetensors"), *options]) == 0
    return folder


def test_what_is_written(made: Path, dataset: Path, run: Run) -> None:
    names = sorted(p.name for p in made.iterdir())
    assert names == ["curves", "net.safetensors", "w.inputs", "w.safetensors"]
    assert sorted(p.name for p in (made / "curves").iterdir()) == ["counts.png", "numbers.png", "weave.png"]
    # A basis, twelve samples and a file of drawn cloths.
    assert len(list((made / "w.inputs").iterdir())) == 14
    code, out, err = run("train", "fit-network", dataset, "-o", made / "w.safetensors", "--epochs", 2, "--views", 2,
                         "--drawn", 1, "--overwrite", "--json", "-q")  # fmt: skip
    assert (code, err) == (0, "")
    about = json.loads(out)["about"]
    assert about["model"] == "robust" and about["data"]["training_samples"] == 8 and about["data"]["samples"] == 12
    assert about["data"]["drawn"] == 2
    assert about["data"]["size"] == 64 and about["data"]["spp"] == 1 and set(about["skill"]) >= {"count", "crimp"}


def test_evaluation(made: Path, dataset: Path, run: Run, tmp_path: Path) -> None:
    code, out, err = run("evaluate", "network", made / "w.safetensors", dataset)
    assert (code, err) == (0, "")
    assert "1 samples of Table 4, as rendered" in out and "1 samples of wide prior" in out and "gamma_M0" in out
    assert "weave right" in out and "in 1 sigma" in out
    code, out, _ = run("evaluate", "network", made / "w.safetensors", dataset, "--no-analysis", "--json")
    report = json.loads(out)["report"]
    assert set(report["wide"]["errors"]) == {"prior", "network", "combined"}
    assert report["table4"]["samples"] == 1 and report["training_samples"] == 8


def test_photos(made: Path, run: Run, tmp_path: Path) -> None:
    import numpy as np
    from cloth_drawing import Cloth, draw

    from usdfab.fabric.weave import plain
    from usdfab.imaging import write_image

    write_image(tmp_path / "cloth.png", draw(Cloth(plain().matrix, 10, 12, size=240)).astype(np.float32))
    note = "about 10 yarns across horizontally and 12 vertically"
    (tmp_path / "SOURCES.csv").write_text(f'file,weave,notes\ncloth.png,plain,"{note}"\n')
    code, out, err = run("evaluate", "network", made / "w.safetensors", "--photos", tmp_path)
    assert (code, err) == (0, ""), err
    assert "analysis: classes right 1 of 1, counts within 10 % 2 of 2" in out and "combined: classes right" in out
    _, out, _ = run("evaluate", "network", made / "w.safetensors", "--photos", tmp_path, "--json")
    said = json.loads(out)["photos"]
    assert said["summary"]["analysis"] == {"classes_right": 1, "counts_right": 2}
    assert said["rows"][0]["combined"]["counts"][0] > 0


def test_the_papers_model(made: Path, dataset: Path, run: Run, tmp_path: Path) -> None:
    paper = tmp_path / "paper.safetensors"
    code, _, err = run("train", "fit-network", dataset, "-o", paper, "--model", "paper", "--epochs", 2, "--views", 2,
                       "--inputs", made / "w.inputs")  # fmt: skip
    assert code == 0 and "paper: best in epoch" in err and "MB, from 4 samples" in err
    code, out, _ = run("evaluate", "network", paper, dataset, "--no-analysis")
    assert code == 0 and "Table 4" in out and "wide" not in out
    code, _, err = run("evaluate", "network", paper, "--photos", made)
    assert code == 2 and len(err.splitlines()) == 1


def test_a_data_set_that_grows_adds_to_the_inputs(dataset: Path, run: Run, tmp_path: Path) -> None:
    root = tmp_path / "set"
    drawn_dataset(root, 12)
    options = ("--epochs", 1, "--views", 1, "--drawn", 0, "-q", "--overwrite")
    assert run("train", "fit-network", root, "-o", tmp_path / "w.safetensors", *options)[0] == 0
    before = {p.name: p.read_bytes() for p in (tmp_path / "w.inputs").iterdir()}
    drawn_dataset(root, 14)
    code, _, err = run("train", "fit-network", root, "-o", tmp_path / "w.safetensors", *options)
    assert code == 0, err
    after = {p.name: p.read_bytes() for p in (tmp_path / "w.inputs").iterdir()}
    assert len(after) == len(before) + 2 and {name: after[name] for name in before} == before


def one_line(result: tuple[int, str, str], said: str) -> None:
    code, out, err = result
    assert code == 2 and out == "" and said in err and len(err.splitlines()) == 1, err


def test_bad_input(made: Path, dataset: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    new = tmp_path / "new.safetensors"

    def train(*more: object, root: Path = dataset, output: Path = new) -> tuple[int, str, str]:
        return run("train", "fit-network", root, "-o", output, "--epochs", 1, "--views", 1, "--drawn", 0, "-q", *more)

    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    one_line(train("--device", "cuda"), "no GPU that torch can use")
    one_line(train("--device", "abacus"), "no device 'abacus'")
    one_line(train(root=tmp_path), "there is no data set here")
    one_line(train(output=made / "w.safetensors"), "the file exists")
    one_line(train(output=tmp_path / "new.bin"), "cannot write '.bin' weights")
    one_line(train("--curves", made), "something in the way")
    one_line(run("train", "fit-network", dataset, "-o", new, "--epochs", 0), "0 epochs are none")
    one_line(run("train", "fit-network", dataset, "-o", new, "--views", 0), "0 views are none")
    one_line(run("train", "fit-network", dataset, "-o", new, "--drawn", -1, "--views", 1), "-1 drawn cloths cannot be")
    one_line(run("evaluate", "network", made / "w.safetensors"), "a data set or --photos")
    one_line(run("evaluate", "network", made / "none.safetensors", dataset), "no such file")
    one_line(run("evaluate", "raster", "--photos", tmp_path), "takes no data set")
    assert not new.exists()


def test_data_sets_that_cannot_be_learned_from(dataset: Path, made: Path, run: Run, tmp_path: Path) -> None:
    root = tmp_path / "set"

    def train(name: str) -> tuple[int, str, str]:
        return run("train", "fit-network", root, "-o", tmp_path / f"{name}.safetensors", "--epochs", 1, "--views", 1,
                   "--drawn", 0)  # fmt: skip

    shutil.copytree(dataset, root)
    manifest = root / "dataset.json"
    said = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(said | {"table": "0123456789abcdef"}))
    one_line(train("table"), "was made with another parameter table")
    manifest.write_text(json.dumps(said))
    image = root / "loose" / "000003.exr"
    whole = image.read_bytes()
    image.write_bytes(whole[:-100])
    one_line(train("image"), "the image is damaged or cut off")
    image.write_bytes(whole)
    (root / "shards" / "shard-00000.tar").write_bytes(b"\0" * 5000)
    one_line(train("shard"), "the shard is damaged or cut off")
    (root / "shards" / "shard-00000.tar").unlink()
    for path in (root / "loose").iterdir():
        if int(path.stem) > 3:
            path.unlink()
    one_line(train("few"), "no samples to stop by")


def test_inputs_of_something_else_are_refused(dataset: Path, made: Path, run: Run, tmp_path: Path) -> None:
    kept = tmp_path / "inputs"
    shutil.copytree(made / "w.inputs", kept)

    def train() -> tuple[int, str, str]:
        return run("train", "fit-network", dataset, "-o", tmp_path / "w.safetensors", "--inputs", kept, "--views", 2,
                   "--drawn", 0)  # fmt: skip

    sample = kept / "000004.safetensors"
    content = sample.read_bytes()
    shutil.copy(kept / "000005.safetensors", sample)
    one_line(train(), "the inputs were made otherwise (image)")
    sample.write_bytes(content[: len(content) // 2])
    one_line(train(), "the inputs are damaged")


def test_a_full_disk_keeps_what_was_computed(
    dataset: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    from usdfab.fit.network import store

    real, calls = store.save_file, []

    def full(*arguments: object) -> None:
        calls.append(arguments)
        if len(calls) > 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(*arguments)

    monkeypatch.setattr(store, "save_file", full)
    # Nothing is drawn after such an error.
    monkeypatch.setattr(store, "drawn_cloth", None)
    output = tmp_path / "w.safetensors"
    result = run("train", "fit-network", dataset, "-o", output, "--epochs", 1, "--views", 1, "-q")
    one_line(result, "the disk is full")
    assert len(list((tmp_path / "w.inputs").iterdir())) == 4
    monkeypatch.undo()
