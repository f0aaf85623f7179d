"""Training learns, is the same every time whether interrupted or not, and says in one line what stands in its way."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from network_examples import basis, drawn_rows, prepared_rows, rows
from safetensors.torch import load_file, save_file

from usdfab.errors import UsdfabError
from usdfab.fit.network import checkpoint as checkpoints, network_file, training
from usdfab.fit.network.calibration import calibrate
from usdfab.fit.network.fit import fit_network, quick_errors
from usdfab.fit.network.model import Ensemble, Robust, bin_targets, principal
from usdfab.fit.network.network_file import Weights, load_network, save_network
from usdfab.fit.network.paper import NUMBERS, RANGES, numbers, shares, width
from usdfab.fit.network.spectra import BIN_WIDTH, BINS, FREQUENCIES
from usdfab.fit.network.splits import split_of
from usdfab.fit.network.targets import INDEX
from usdfab.fit.network.training import TrainSettings, shifted, train

SHORT = TrainSettings(epochs=4)


@pytest.fixture(scope="module")
def trained() -> Weights:
    """A few epochs on rows whose answers are in their inputs."""
    return fit_network(prepared_rows(200), TrainSettings(epochs=15, batch=16), learning_curve=True).weights


def test_it_learns_what_the_inputs_hold_and_nothing_else(trained: Weights) -> None:
    found = quick_errors(trained, rows(80, seed=9))
    assert found["weave"] < 0.1 and found["count"] < 0.1
    skill = trained.skill
    assert skill["irregularity"] < 0.8
    # The crimp is nowhere in the inputs: the estimate falls back to the prior's mean.
    assert 0.97 < skill["crimp"] < 1.03
    network, test = trained.network, rows(80, seed=9)
    assert isinstance(network, Robust)
    with torch.no_grad():
        x = network.reduced(test.texture, test.detail, test.lattice)
        spread = network.standardised(network.number_estimates(x, test.values[:, :, 0], test.table4)[0]).std(dim=(0, 1))
    assert float(spread[INDEX["crimp"]]) < 0.3 < float(spread[INDEX["irregularity"]])
    curve = trained.about["learning_curve"]
    sizes = sorted(map(int, curve))
    assert len(sizes) == 3 and sizes[0] < sizes[1] < sizes[2] == trained.about["data"]["training_samples"]
    assert curve[str(sizes[2])]["weave"] <= curve[str(sizes[0])]["weave"]


def test_calibrated_deviations_cover_two_thirds(trained: Weights) -> None:
    network, test = trained.network, rows(120, seed=11)
    assert isinstance(network, Robust)
    with torch.no_grad():
        x = network.reduced(test.texture, test.detail, test.lattice)
        mean, deviation = network.number_estimates(x, test.values[:, :, 0], test.table4)
    z = ((mean - test.values) / deviation)[:, :, 1:]
    inside = (z.abs() < 1.0).float().mean(dim=(0, 1))
    assert 0.6 < float(inside.mean()) < 0.76 and float(inside.min()) > 0.5


def test_each_prior_is_calibrated_by_itself(trained: Weights) -> None:
    """Fabrics that differ less than the others are brought near their own mean."""
    network, test = trained.network, rows(120, seed=13)
    assert isinstance(network, Robust)
    k = INDEX["crimp"]
    test.values[:, :, k] = torch.where(test.table4[:, None], 2.0 + 0.01 * test.values[:, :, k], test.values[:, :, k])
    before = calibrate(network, rows(120, seed=12))
    assert set(calibrate(network, test)) == set(before)
    with torch.no_grad():
        x = network.reduced(test.texture, test.detail, test.lattice)
        mean, deviation = network.number_estimates(x, test.values[:, :, 0], test.table4)
    wanted = test.values[test.table4][..., k]
    assert float((mean[test.table4][..., k] - wanted).square().mean().sqrt()) < 0.02
    assert float(deviation[test.table4][..., k].mean()) < 0.02 < 0.5 < float(deviation[~test.table4][..., k].mean())
    calibrate(network, rows(120, seed=12))


def test_calibration_finds_a_known_overconfidence(trained: Weights) -> None:
    network = trained.network
    assert isinstance(network, Robust)
    test = rows(120, seed=12)
    before = calibrate(network, test)
    first = [float(network.weave_temperature), float(network.count_temperature)]
    with torch.no_grad():
        network.counts.last.weight.mul_(2.0)
        network.counts.last.bias.mul_(2.0)
    after = calibrate(network, test)
    with torch.no_grad():
        network.counts.last.weight.mul_(0.5)
        network.counts.last.bias.mul_(0.5)
    assert float(network.weave_temperature) == first[0]
    assert float(network.count_temperature) == pytest.approx(0.5 * first[1], rel=0.1)
    assert before == after
    calibrate(network, test)


def test_the_same_seed_gives_the_same_weights_and_another_does_not() -> None:
    data = prepared_rows()
    first, again, other = (train(data, replace(SHORT, seed=s)).network.state_dict() for s in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


@pytest.mark.parametrize("model", ["robust", "paper"])
def test_an_interrupted_run_goes_on_to_the_same_weights(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, settings = prepared_rows(), replace(SHORT, model=model, epochs=5)
    whole = train(data, settings)
    state = tmp_path / "state.safetensors"

    def interrupt(done: int, total: int, text: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    half = train(data, settings, checkpoint=state, progress=interrupt)
    assert half.interrupted and state.is_file()
    resumed = train(data, settings, checkpoint=state, resume=True)
    assert resumed.history == whole.history and resumed.best == whole.best
    expected = whole.network.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in resumed.network.state_dict().items())
    # Of another run, or damaged: refused in one line.
    with pytest.raises(UsdfabError, match="other data, settings"):
        train(data, replace(settings, seed=5), checkpoint=state, resume=True)
    state.write_bytes(state.read_bytes()[:1000])
    with pytest.raises(UsdfabError, match="cannot be read"):
        train(data, settings, checkpoint=state, resume=True)
    save_file({"a": torch.zeros(1)}, state)
    with pytest.raises(UsdfabError, match="no checkpoint"):
        train(data, settings, checkpoint=state, resume=True)


def test_a_full_disk_keeps_the_older_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = tmp_path / "state.safetensors"
    train(prepared_rows(), SHORT, checkpoint=state)
    before = state.read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoints, "save_file", full)
    with pytest.raises(UsdfabError, match="the disk is full"):
        train(prepared_rows(), SHORT, checkpoint=state)
    assert state.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == [state.name]
    monkeypatch.setattr(network_file, "save_file", full)
    fitted = fit_network(prepared_rows(), SHORT).weights
    with pytest.raises(UsdfabError, match="the disk is full"):
        save_network(fitted, tmp_path / "weights.safetensors")
    assert [p.name for p in tmp_path.iterdir()] == [state.name]


def test_the_paper_model_learns_from_renders_of_table_4_alone() -> None:
    chosen = training.chosen_rows(rows(), TrainSettings("paper"))
    assert bool(chosen.table4.all()) and bool((chosen.number == 0).all()) and int(chosen.label.max()) < 7
    assert len(chosen) == 30
    fitted = fit_network(prepared_rows(), TrainSettings("paper", epochs=3))
    network = fitted.weights.network
    with torch.no_grad():
        logits, found = network(rows().whole)
    assert logits.shape == (120, 7) and found.shape == (120, 28)
    assert float(found.min()) >= 0.0 and float(found.max()) <= 1.0
    assert set(quick_errors(fitted.weights, rows())) == {"weave"}


def test_the_papers_numbers() -> None:
    assert len(NUMBERS) == 14 and RANGES.shape == (2, 14, 2)
    assert (RANGES[..., 0] < RANGES[..., 1]).all()
    # Weft and warp of Table 4: e_yarn of twill0 and satin are its ends.
    np.testing.assert_allclose(RANGES[1, NUMBERS.index("radius")], (0.0053, 0.108))
    np.testing.assert_allclose(RANGES[0, NUMBERS.index("count")], (5.0, 11.0))
    assert width("fiber_count", "satin_rot90", "warp") == pytest.approx(30.0)
    assert width("irregularity", "plain", "weft") == pytest.approx(0.6)
    found = numbers(torch.tensor([[0.0] * 14 + [1.0] * 14]))
    assert found["count"].tolist() == [[5.0, 13.0]]
    from usdfab.fabric.sampling import sample_fabric
    from usdfab.fit.network.targets import encode

    fabric = sample_fabric("plain", np.random.default_rng(0))
    back = numbers(shares(torch.from_numpy(encode(fabric)[0])[None]))
    assert back["count"][0].tolist() == pytest.approx([fabric.warp.count, fabric.weft.count], rel=1e-4)
    assert back["radius"][0, 1] * fabric.size[1] == pytest.approx(fabric.weft.radius, rel=1e-4)


def test_shifted_spectra_move_with_their_counts() -> None:
    torch.manual_seed(0)
    counts = torch.log(torch.tensor([[8.0, 20.0], [5.0, 40.0]])).repeat(50, 1)
    spectra = bin_targets(counts)[:, :, None].repeat(1, 1, 3, 1)
    moved, where = shifted(spectra, counts)
    assert float((where - counts).abs().max()) > 4 * BIN_WIDTH
    centres = torch.from_numpy(FREQUENCIES).log().float()
    np.testing.assert_allclose((moved * centres).sum(dim=-1).mean(dim=2), where, atol=0.3 * BIN_WIDTH)


def test_soft_labels_are_a_distribution_about_the_count() -> None:
    found = bin_targets(torch.log(torch.tensor([10.0])))[0]
    assert found.shape == (BINS,) and float(found.sum()) == pytest.approx(1.0)
    centres = torch.from_numpy(FREQUENCIES).log().float()
    assert float((found * centres).sum()) == pytest.approx(np.log(10.0), abs=1e-3)


def test_principal_directions_equal_an_eigendecomposition() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(300, 20)) * 0.7 ** np.arange(20)
    variances, vectors = principal(torch.from_numpy(x), 4)
    expected, directions = np.linalg.eigh(x.T @ x / 300)
    np.testing.assert_allclose(variances.numpy(), expected[::-1][:4], rtol=1e-4)
    np.testing.assert_allclose(np.abs(np.sum(vectors.numpy() * directions[:, ::-1][:, :4], axis=0)), 1.0, atol=1e-3)


def test_drawn_cloth_teaches_counts_and_weave() -> None:
    """A handful of renders is too few to tell the weave; drawn cloth with the same signs makes up for that."""
    few = prepared_rows(16)
    settings, test = TrainSettings(epochs=30, batch=8), rows(100, seed=9)
    alone = quick_errors(fit_network(few, settings).weights, test)
    fitted = fit_network(replace(few, drawn=drawn_rows(300)), settings)
    helped = quick_errors(fitted.weights, test)
    assert helped["weave"] < alone["weave"]
    assert fitted.weights.about["data"]["drawn"] == 300
    network = fitted.weights.network
    assert isinstance(network, Robust)
    x = torch.ones(2, 320)
    found = network.blinded(x, torch.tensor([True, False]))
    assert found[0, :128].abs().sum() == 0 and found[0, 128:].eq(1).all() and found[1].eq(1).all()


def test_an_ensemble_is_its_members_side_by_side() -> None:
    torch.manual_seed(3)
    ensemble = Ensemble(5, 7, 2, 3, 0.0).eval()
    x = torch.randn(4, 5)
    for k, found in enumerate(ensemble(x)):
        y = x
        for layer in range(3):
            y = y @ ensemble.weights[layer][k] + ensemble.biases[layer][k]
            y = torch.nn.functional.leaky_relu(y, 0.1) if layer < 2 else y
        torch.testing.assert_close(found, y)


def test_parts_never_share_a_sample() -> None:
    parts = [split_of(i) for i in range(200)]
    assert [parts.count(p) for p in ("train", "validation", "test")] == [140, 20, 40]
    # Both priors are in every part: samples come in pairs.
    assert all(parts[i] == parts[i + 1] for i in range(0, 200, 2))


def test_weights_there_and_back(trained: Weights, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_network(trained, path)
    again = load_network(path)
    assert again.about == trained.about
    state = trained.network.state_dict()
    # Calibrated with the numbers that the file keeps, so that nothing changes on the way.
    assert all(torch.equal(t, state[name]) for name, t in again.network.state_dict().items())
    assert all(torch.equal(a, b) for a, b in zip(again.basis.directions, basis().directions, strict=True))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other/1"}, "has format 'other/1'"),
        ({"targets": "0"}, "another version of usdfab .targets differ"),
        ({"labels": "[]"}, "another version"),
        ({"inputs": "[0]"}, "another version"),
        ({"about": "{}"}, "other names or shapes"),
        ({"about": '{"model": "huge"}'}, "other names or shapes"),
    ],
)
def test_weights_of_another_version_are_refused(
    trained: Weights, tmp_path: Path, change: dict[str, str], said: str
) -> None:
    path = tmp_path / "weights.safetensors"
    save_network(trained, path)
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        about = dict(file.metadata())
    save_file(load_file(path), path, about | change)
    with pytest.raises(UsdfabError, match=said) as caught:
        load_network(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_weights_are_refused(trained: Weights, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_network(trained, path)
    whole = path.read_bytes()
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        about = dict(file.metadata())
    tensors = load_file(path)
    for name, wrong, said in (
        ("network.weave.biases.1", torch.zeros(4, 1, 95), "names or shapes"),
        ("network.target_mean", torch.full_like(tensors["network.target_mean"], torch.nan), "not finite"),
    ):
        save_file({**tensors, name: wrong}, path, about)
        with pytest.raises(UsdfabError, match=said):
            load_network(path)
    del tensors["network.target_mean"]
    save_file(tensors, path, about)
    with pytest.raises(UsdfabError, match="names or shapes"):
        load_network(path)
    for content in (whole[: len(whole) // 2], b"", b"no weights"):
        path.write_bytes(content)
        with pytest.raises(UsdfabError, match="no whole weights file"):
            load_network(path)
    with pytest.raises(UsdfabError, match="no such file"):
        load_network(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"model": "big"}, "no model"),
        ({"epochs": 0}, "are none"),
        ({"seed": -1}, "not between"),
        ({"share": 0.0}, "no part"),
    ],
)
def test_settings_that_make_no_sense(wrong: dict, said: str) -> None:
    with pytest.raises(UsdfabError, match=said):
        TrainSettings(**wrong)


def test_too_few_samples_and_a_missing_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsdfabError, match="no GPU that torch can use"):
        train(prepared_rows(), SHORT, device="cuda")
    with pytest.raises(UsdfabError, match="no device"):
        train(prepared_rows(), SHORT, device="tpu")
    with pytest.raises(UsdfabError, match="no samples to stop by"):
        train(prepared_rows(4), SHORT)


def test_a_loss_that_is_not_finite_ends_the_run() -> None:
    data = prepared_rows()
    data.rows.values[0, 0, 3] = torch.nan
    with pytest.raises(UsdfabError, match="is not finite in epoch 1"):
        train(data, SHORT)
