"""Training: it learns, goes on bit for bit, holds materials out; weights files, whole and damaged; the command."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parent))

import torch
from neural_examples import SMALL, lively, small_dataset
from safetensors.torch import load_file, save_file

from usdfab.errors import UsdfabError
from usdfab.neural.examples import Examples, Split, load_examples, material_inputs, split
from usdfab.neural.material_file import (
    SHIPPED,
    Weights,
    load_material_network,
    rounded,
    save_material_network,
    shipped_path,
)
from usdfab.neural.measures import measures, table
from usdfab.neural.network import KINDS
from usdfab.neural.training import TrainSettings, train

Run = Callable[..., tuple[int, str, str]]
QUICK = TrainSettings(epochs=3, batch=128)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_dataset(tmp_path_factory.mktemp("surfaces") / "set", settings=replace(SMALL, kind="both"))


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    from usdfab.cli.main import _run

    def call(*arguments: object) -> tuple[int, str, str]:
        code = _run([str(a) for a in arguments])
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


def test_held_out_parts_share_nothing(folder: Path) -> None:
    examples = load_examples(folder, "reflection")
    assert len(examples) == 8 and examples.queries.shape == (8, 64, 8)
    data = split(examples, 0)
    sizes = [len(part) for part in (data.learned, data.materials, data.weaves)]
    assert sum(sizes) == 8 and sizes[0] > 0 and sizes[2] > 0
    assert not set(data.weaves.weaves.tolist()) & set(data.learned.weaves.tolist())
    tiles = [{t.numpy().tobytes() for t in part.parameters} for part in (data.learned, data.materials)]
    assert not tiles[0] & tiles[1]
    again = split(examples, 0)
    assert torch.equal(again.learned.tiles, data.learned.tiles)
    assert len(split(examples, 0, held_out_weaves=0).weaves) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "rate", "share"), [("lean", 4e-3, 0.2), ("paper", 1e-3, 0.6)])
def test_one_material_is_learned_by_heart(architecture: str, rate: float, share: float) -> None:
    """512 answers of one material in 250 steps: the loss is a small part of what knowing nothing but the mean gives."""
    how = TrainSettings(architecture, epochs=250, batch=512, rate=rate, augment=False, diffuse_weight=0.1)
    data, nothing = one_material(512)
    assert train(data, how).history[-1][1] < share * nothing


def test_a_few_answers_are_learned_by_heart() -> None:
    """As above, but quick: 64 answers."""
    data, nothing = one_material(64)
    how = TrainSettings(epochs=120, batch=256, augment=False, diffuse_weight=0.1)
    assert train(data, how).history[-1][1] < 0.2 * nothing


def one_material(count: int) -> tuple[Split, float]:
    """Answers of one material, and the loss of always saying their mean."""
    from usdfab.neural.aggregation import aggregate
    from usdfab.neural.dataset_draws import draw_material, draw_queries

    settings = replace(SMALL, queries=count)
    material, queries = draw_material(settings, 0), draw_queries(settings, 0, "reflection")
    targets = torch.from_numpy(aggregate(material, queries, samples=256, threads=1).copy())[None]
    tiles, parameters = material_inputs([material])
    whole = Examples(tiles, parameters, torch.from_numpy(queries)[None], targets, torch.zeros(1, dtype=torch.long))
    none = whole.of(torch.zeros(0, dtype=torch.long))
    specular = torch.log1p(100 * targets[0, :, 2:]).var(dim=0).sum()
    return Split(whole, none, none), 0.4 * float(specular) + 0.1 * float(targets[0, :, :2].var(dim=0).sum())


def test_interrupted_training_goes_on_bit_for_bit(folder: Path, tmp_path: Path) -> None:
    data = split(load_examples(folder, "reflection"), 0)
    whole = train(data, QUICK)
    state = tmp_path / "state.safetensors"
    stops = iter(range(10_000))

    def stop(done: int, total: int, text: str) -> None:
        if next(stops) == total // 2:
            raise KeyboardInterrupt

    assert train(data, QUICK, checkpoint=state, progress=stop).interrupted
    parts = train(data, QUICK, checkpoint=state, resume=True)
    assert parts.history == whole.history and not parts.interrupted
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, parts.network.state_dict()[name]), name
    other = train(data, replace(QUICK, seed=1))
    assert not torch.equal(other.network.state_dict()["first.weight"], whole.network.state_dict()["first.weight"])
    for settings, wrong in ((replace(QUICK, seed=1), "another version"), (replace(QUICK, epochs=9), "another version")):
        with pytest.raises(UsdfabError, match=wrong):
            train(data, settings, checkpoint=state, resume=True)
    state.write_bytes(state.read_bytes()[:100])
    with pytest.raises(UsdfabError, match="cannot be read"):
        train(data, QUICK, checkpoint=state, resume=True)


def test_killed_training_goes_on(folder: Path, tmp_path: Path, run: Run) -> None:
    """kill -9 in the middle, then the same command with --resume: the file of a run in one piece."""
    options = ["--epochs", "8", "--batch", "64", "-q"]
    command = [sys.executable, "-m", "usdfab.cli.main", "train", "neural", str(folder)]
    killed = subprocess.Popen([*command, "-o", str(tmp_path / "a.safetensors"), *options])
    state = tmp_path / "a.training.safetensors"
    until = time.monotonic() + 240
    while not state.exists() and killed.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert state.exists() and not (tmp_path / "a.safetensors").exists()
    assert run("train", "neural", folder, "-o", tmp_path / "a.safetensors", *options, "--resume")[0] == 0
    assert not state.exists()
    assert run("train", "neural", folder, "-o", tmp_path / "b.safetensors", *options)[0] == 0
    resumed, whole = (load_material_network(tmp_path / f"{name}.safetensors", "reflection") for name in "ab")
    assert resumed.about == whole.about
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name]), name


def test_loss_that_is_not_finite_ends_in_one_line(folder: Path) -> None:
    data = split(load_examples(folder, "reflection"), 0)
    broken = replace(data.learned, targets=torch.full_like(data.learned.targets, float("nan")))
    with pytest.raises(UsdfabError, match="not finite in epoch 1"):
        train(replace(data, learned=broken), QUICK)


def test_measures_of_a_perfect_and_of_a_silent_network(folder: Path) -> None:
    examples = load_examples(folder, "transmission")

    class Known(torch.nn.Module):
        """Answers what is true, or nothing."""

        kind, curvature = "transmission", 1000.0

        def __init__(self, share: float) -> None:
            super().__init__()
            self.share, self.at = share, 0

        def encode(self, tiles: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
            return tiles

        def decode(self, codes: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
            true = self.share * examples.targets[self.at : self.at + len(codes)]
            self.at += len(codes)
            return torch.cat([true[..., :2], torch.log1p(1000 * true[..., 2:])], dim=-1)

        def components(self, outputs: torch.Tensor) -> torch.Tensor:
            return torch.cat([outputs[..., :2], torch.expm1(outputs[..., 2:]) / 1000], dim=-1)

    perfect, silent = measures(Known(1.0), examples), measures(Known(0.0), examples)  # type: ignore[arg-type]
    assert max(perfect[name] for name in ("loss", "diffuse", "specular", "value")) < 1e-3
    assert all(silent[name] == pytest.approx(1.0, rel=1e-3) for name in ("diffuse", "specular", "value"))


# --- weights files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("architecture", ["lean", "paper"])
def test_saved_networks_answer_as_before(architecture: str, tmp_path: Path) -> None:
    network = rounded(lively(architecture))
    path = tmp_path / "w.safetensors"
    save_material_network(Weights(network, {"a": 1}), path)
    again = load_material_network(path, "reflection")
    assert again.about == {"a": 1} and again.network.architecture == architecture
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, again.network.state_dict()[name]), name
    with pytest.raises(UsdfabError, match="for reflection, not transmission"):
        load_material_network(path, "transmission")


def test_wrong_weights_files_end_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    with pytest.raises(UsdfabError, match="no such file"):
        load_material_network(path, "reflection")
    save_material_network(Weights(lively("lean"), {}), path)
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(UsdfabError, match="no whole weights file"):
        load_material_network(path, "reflection")
    path.write_bytes(good)
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        about = file.metadata()
    tensors = load_file(path)
    for change, said in (
        ({"format": "usdfab-neural-material/0"}, "has format"),
        ({"interface": "tile 32"}, "another version"),
        ({"architecture": "fat"}, "other names or shapes"),
        ({"options": "{}}"}, "other names or shapes"),
    ):
        save_file(tensors, path, about | change)
        with pytest.raises(UsdfabError, match=said):
            load_material_network(path, "reflection")
    save_file(tensors | {"last.bias": torch.full((4,), float("inf"))}, path, about)
    with pytest.raises(UsdfabError, match="not finite"):
        load_material_network(path, "reflection")
    save_file({n: t for n, t in tensors.items() if n != "last.bias"}, path, about)
    with pytest.raises(UsdfabError, match="other names or shapes"):
        load_material_network(path, "reflection")


@pytest.mark.parametrize("kind", KINDS)
def test_shipped_weights_are_whole_and_small(kind: str) -> None:
    assert kind in SHIPPED
    weights = load_material_network(None, kind)
    assert weights.network.kind == kind
    # What the file says of itself: better than knowing nothing by far, also on weaves that it has not seen.
    errors = weights.about["errors"]
    for part in ("held_out_materials", "held_out_weaves"):
        assert errors[part]["diffuse"] < 0.3 and errors[part]["value"] < 0.3
    assert sum(p.stat().st_size for p in shipped_path(kind).parent.iterdir()) < 5e6


@pytest.mark.parametrize(("kind", "bound"), [("reflection", 0.25), ("transmission", 0.35)])
def test_shipped_weights_agree_with_the_surface_model(kind: str, bound: float) -> None:
    """On a weave and a material of no data set: a 2/2 twill. Far away, where the network matters most."""
    from neural_examples import random_queries

    from usdfab.neural.aggregation import aggregate
    from usdfab.neural.decoder import plans_of
    from usdfab.neural.surface_material import SurfaceMaterial, weave_from_bits

    material = SurfaceMaterial(weave_from_bits("0011/0110/1100/1001"), (0.3, -0.2), (0.5, 0.4), 0.4, 1.1)
    queries = random_queries(3000, 9, below=kind == "transmission")
    queries[:, 2] = np.random.default_rng(1).uniform(0.8, 4.0, len(queries))
    true = aggregate(material, queries, transmission=kind == "transmission", samples=1024, threads=1)
    found = plans_of(load_material_network(None, kind).network, [material])[0].decode(queries)
    silent = float(np.abs(true).sum())
    assert np.abs(found - true).sum() < bound * silent


# --- the command -----------------------------------------------------------------------------------------------------


def test_command_writes_files_curves_and_errors(folder: Path, tmp_path: Path, run: Run) -> None:
    output = tmp_path / "w.safetensors"
    options = ["--epochs", 2, "--batch", 128, "--kind", "both", "--curves", tmp_path / "curves", "-q", "--json"]
    code, out, err = run("train", "neural", folder, "-o", output, *options)
    assert (code, err) == (0, "")
    networks = json.loads(out)["networks"]
    assert [Path(n["output"]).name for n in networks] == ["w-reflection.safetensors", "w-transmission.safetensors"]
    assert sorted(p.name for p in (tmp_path / "curves").iterdir()) == ["lean-reflection.png", "lean-transmission.png"]
    weights = load_material_network(tmp_path / "w-transmission.safetensors", "transmission")
    data = split(load_examples(folder, "transmission"), 0)
    told, found = weights.about["errors"]["learned"], table(weights.network, data)["learned"]
    assert told == pytest.approx(found, rel=1e-4)
    code, _, err = run("train", "neural", folder, "-o", output, *options)
    assert code == 2 and "the file exists" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--epochs", "0"], "--epochs: 0 epochs are none"),
        (["--batch", "1"], "--batch"),
        (["--learning-rate", "-1"], "--learning-rate"),
        (["--device", "tpu"], "--device: there is no device 'tpu'"),
        (["--hold-out-weaves", "-1"], "--hold-out-weaves"),
        (["--architecture", "fat"], "fat"),
    ],
)
def test_wrong_options_end_in_one_line(options: list[str], said: str, folder: Path, tmp_path: Path, run: Run) -> None:
    code, _, err = run("train", "neural", folder, "-o", tmp_path / "w.safetensors", *options)
    assert code == 2 and said in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_no_data_set_ends_in_one_line(tmp_path: Path, run: Run) -> None:
    code, _, err = run("train", "neural", tmp_path, "-o", tmp_path / "w.safetensors")
    assert code == 2 and "there is no data set here" in err and err.count("\n") == 1
