"""Networks of fabrics' own: training, files, and what the renderer makes of them."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path += [str(Path(__file__).parent), str(Path(__file__).parent.parent / "tracer")]

import torch
from neural_examples import lively
from scenes import cloth_material, fabric, look, plane, scene

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, weave_from_name
from usdfab.neural.asset_file import fabric_digest, load_asset_network, rounded_material, save_asset_network
from usdfab.neural.asset_network import TO_RGB, AssetMaterial
from usdfab.neural.asset_queries import LIGHTS, AssetQueries, draw_asset_queries, produce_queries, remove_pieces
from usdfab.neural.asset_training import AssetSettings, answers_of, relative_error, relative_loss, train_asset
from usdfab.neural.fiber_answers import FiberAnswers
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS
from usdfab.neural.render import render
from usdfab.neural.stage_scene import build
from usdfab.usd.scene import PointLight

CLOTH = fabric("twill 2/1")
SHARED = {kind: Weights(lively("lean", kind), {}) for kind in KINDS}
SETTINGS = AssetSettings(queries=150, samples=1, epochs=3, batch=512)


def made_up(queries: int = 150, noise: float = 0.5, seed: int = 0) -> AssetQueries:
    """Answers of a cloth that is no cloth: smooth functions of place and directions, with noise of mean 1."""
    rng = np.random.default_rng(seed)
    drawn = [draw_asset_queries(queries, seed + k) for k in range(2)]
    seen, lights = (np.stack([d[k] for d in drawn]).astype(np.float32) for k in (0, 1))
    shade = (0.1 + 0.1 * lights[..., 2] ** 2) * (1.0 + 0.3 * np.cos(2 * np.pi * seen[:, :, None, None, 0]))
    colors = shade[..., None] * np.array([1.0, 0.5, 0.05, 0.25])
    factors = rng.gamma(1.0 / noise**2, noise**2, (2, *shade.shape, 1))
    return AssetQueries(seen, lights, (colors * factors).astype(np.float32))


@pytest.fixture(scope="module")
def material() -> AssetMaterial:
    """A material that was trained a little, with the numbers that a file keeps."""
    return rounded_material(trained())


def trained(cloth: FabricParameters = CLOTH, **more) -> AssetMaterial:
    return train_asset(cloth, made_up(), made_up(40, seed=7), SHARED, SETTINGS, **more).material


def test_noise_is_averaged_out() -> None:
    """Twice as good as its noisy examples by far, and right in the mean."""
    data = made_up(2000, noise=1.0)
    settings = replace(SETTINGS, epochs=6, batch=1024)
    done = train_asset(CLOTH, data, made_up(40, seed=7), SHARED, settings)
    exact = made_up(400, noise=1e-3, seed=3)
    for number, kind in enumerate(KINDS):
        queries, answers = exact.of_kind(number)
        found = answers_of(done.material.networks[kind], queries) * done.material.scale[number]
        true = answers[0]
        assert np.allclose(found.mean(axis=(0, 1)), true.mean(axis=(0, 1)), rtol=0.08)
        error = np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2))
        assert error < 0.25
        assert done.history[kind][-1][1] < done.history[kind][0][1]


def test_errors_are_free_of_the_noise_of_what_is_true() -> None:
    rng = np.random.default_rng(0)
    exact = rng.random((20_000, 3)) + 0.5
    noisy = exact * rng.gamma(1.0, 1.0, (2, *exact.shape))
    assert relative_error(exact, noisy) < 0.15 < relative_error(1.3 * exact, noisy)
    assert relative_error(1.3 * exact, noisy) == pytest.approx(0.3, abs=0.05)


def test_the_loss_is_least_at_the_mean() -> None:
    true = torch.tensor([[0.0], [0.4]]).repeat(1, 4)
    for found, sign in ((0.1, -1), (0.2, 0), (0.3, 1)):
        guess = torch.full((2, 4), found, requires_grad=True)
        relative_loss(guess, true, torch.full((4,), 0.2)).backward()
        total = float(guess.grad[:, 0].sum())  # type: ignore[index]
        assert abs(total) < 1e-6 if sign == 0 else total * sign > 0


def test_the_same_run_in_one_piece_or_two(tmp_path) -> None:
    whole = trained()

    def stop(done: int, total: int, text: str) -> None:
        if done > 0.6 * total:
            raise KeyboardInterrupt

    first = train_asset(
        CLOTH, made_up(), made_up(40, seed=7), SHARED, SETTINGS, folder=tmp_path, job="a", progress=stop
    )
    assert first.interrupted and set(first.material.networks) == set(KINDS)
    second = trained(folder=tmp_path, job="a", resume=True)
    for kind in KINDS:
        for name, tensor in whole.networks[kind].learned().items():
            assert torch.equal(tensor, second.networks[kind].learned()[name])
    with pytest.raises(UsdfabError, match="belongs to other data"):
        trained(folder=tmp_path, job="b", resume=True)


def test_pieces_of_an_interrupted_run_are_taken(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("usdfab.neural.asset_queries.JUDGES", 2)
    monkeypatch.setattr("usdfab.neural.asset_queries.JUDGE_SAMPLES", 2)
    fibers, folder = FiberAnswers(CLOTH), tmp_path / "pieces"
    learned, judges = produce_queries(fibers, folder, "job", 30, 1, 5, threads=1)
    assert learned.answers.shape == (1, 2, 30, 2, LIGHTS, 4) and judges.answers.shape == (2, 2, 2, 2, LIGHTS, 4)
    assert np.isfinite(learned.answers).all() and learned.answers.max() > 0
    (folder / "back-03.safetensors").write_bytes(b"damaged")
    asked = []

    class Counted(FiberAnswers):
        def ask(self, *arguments, **more):
            asked.append(more["back"])
            return fibers.ask(*arguments, **more)

    again = Counted.__new__(Counted)
    second, _ = produce_queries(again, folder, "job", 30, 1, 5, resume=True, threads=1)
    assert asked == [True] and np.array_equal(second.answers, learned.answers)
    produce_queries(again, folder, "other", 30, 1, 5, resume=True, threads=1)
    assert len(asked) == 1 + 28
    remove_pieces(folder)
    assert not folder.exists()


def test_drawn_queries_fill_their_ranges() -> None:
    footprints, lights = draw_asset_queries(500, 1)
    assert np.allclose(np.linalg.norm(lights, axis=-1), 1.0) and (lights[:, 0, :, 2] > 0).all()
    assert (lights[:, 1, :, 2] < 0).all() and (np.linalg.norm(footprints[:, 3:], axis=1) < 1).all()
    assert np.histogram(footprints[:, 2], [0, 1, 5])[0].tolist() == [250, 250]
    # Uniform over the disk: the mean of r^2 is a half.
    assert np.mean(lights[..., :2] ** 2) == pytest.approx(0.25, abs=0.01)


def test_a_file_holds_what_was_trained(tmp_path, material) -> None:
    path = tmp_path / "a.safetensors"
    save_asset_network(replace(material, about={"a": 1}), CLOTH, path)
    read = load_asset_network(path, CLOTH)
    assert read is not None and read.tile == material.tile == (3, 3) and read.about == {"a": 1}
    assert np.array_equal(read.albedo, material.albedo)
    queries = made_up(20).of_kind(0)[0][0]
    for one, other in zip(material.plans(), read.plans(), strict=True):
        assert np.array_equal(one.decode(queries), other.decode(queries))
    # The compiled decoder answers as the network does.
    found = material.plans()[0].decode(queries)
    assert np.allclose(found, answers_of(material.networks["reflection"], np.stack([queries] * 2))[0], atol=2e-3)
    # Names, prints and where the file lies change no fiber; all else makes the weights stale.
    same = replace(CLOTH, name="other", albedo_map="a.png", neural_weights=str(path))
    assert fabric_digest(same) == fabric_digest(CLOTH) and load_asset_network(path, same) is not None
    dyed = CLOTH.with_systems({"warp": replace(CLOTH.warp, albedo=(0.1, 0.2, 0.3))})
    for other in (dyed, replace(CLOTH, seed=5), replace(CLOTH, weave=weave_from_name("plain"))):
        assert load_asset_network(path, other) is None


def test_files_that_cannot_be_used(tmp_path, material) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "a.safetensors"
    save_asset_network(material, CLOTH, path)
    with pytest.raises(UsdfabError, match="do not exist"):
        load_asset_network(tmp_path / "none.safetensors", CLOTH)
    half = tmp_path / "half.safetensors"
    half.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(UsdfabError, match="no whole file"):
        load_asset_network(half, CLOTH)
    save_file({"a": torch.zeros(1)}, half, {"format": "usdfab-neural-asset/9"})
    with pytest.raises(UsdfabError, match="has format"):
        load_asset_network(half, CLOTH)
    about = {"format": "usdfab-neural-asset/1", "interface": "old", "fabric": fabric_digest(CLOTH)}
    save_file({"a": torch.zeros(1)}, half, about)
    with pytest.raises(UsdfabError, match="of another version"):
        load_asset_network(half, CLOTH)
    from usdfab.neural.asset_file import INTERFACE

    save_file({"a": torch.zeros(1)}, half, about | {"interface": INTERFACE})
    with pytest.raises(UsdfabError, match="other names or shapes"):
        load_asset_network(half, CLOTH)
    with pytest.raises(UsdfabError, match="architecture paper cannot be fine-tuned"):
        train_asset(
            CLOTH, made_up(8), made_up(8), {k: Weights(lively("paper", k), {}) for k in KINDS}, SETTINGS
        )  # fmt: skip


def test_the_renderer_takes_a_fabrics_own_network(tmp_path, material) -> None:
    path = tmp_path / "a.safetensors"
    save_asset_network(material, CLOTH, path)
    lamp = PointLight("/Lamp", np.array([0.02, 0.01, 0.05]), np.full(3, 2e-3))
    own = replace(CLOTH, neural_weights=str(path))
    tinted = replace(plane(0.04), albedo=np.full((2, 3, 3), 0.5))
    camera = look((0.0, 0.0, 0.06), (0.0, 0.0, 0.0), (0.1, 0.1))

    def shown(mesh, cloth: FabricParameters, **more) -> np.ndarray:
        ready = build(scene([mesh], [cloth_material()], [lamp], [cloth]), SHARED, {}, **more)
        return render(ready, camera, (4, 4), (0, 0, 4, 4)).pixels

    plain = shown(plane(0.04), own)
    assert not np.allclose(plain, shown(plane(0.04), CLOTH))
    assert np.array_equal(shown(plane(0.04), own, own=False), shown(plane(0.04), CLOTH))
    # Blue is half of green in what it learned, and a print takes the colours but not the gloss.
    half = shown(tinted, own)
    ready = build(scene([plane(0.04)], [cloth_material()], [lamp], [own]), SHARED, {})
    assert np.array_equal(ready.albedo[0], (material.scale[:, :, None] * TO_RGB).astype(np.float32))
    gloss = 2 * half - plain
    assert (gloss > -1e-6).all() and np.allclose(gloss[..., 0], gloss[..., 2], atol=1e-6) and gloss.max() > 0
    stale = replace(own, seed=3)
    made = build(scene([plane(0.04)], [cloth_material()], [lamp], [stale]), SHARED, {})
    assert any("is not used" in warning and str(path) in warning for warning in made.warnings)
    with pytest.raises(UsdfabError, match=r"is not what .* was trained on"):
        build(scene([plane(0.04)], [cloth_material()], [lamp], [stale]), SHARED, {}, strict=True)
    # No encoder, so no limit of the weave.
    rows = "/".join("1" * k + "0" + "1" * (16 - k) for k in range(17))
    large = replace(CLOTH, weave=fabric(rows).weave)
    save_asset_network(replace(material, tile=(17, 17)), large, path)
    made = build(
        scene([plane(0.04)], [cloth_material()], [lamp], [replace(large, neural_weights=str(path))]), SHARED, {}
    )
    assert np.allclose(made.cloth.repeats[:2], 17 * np.array(large.cell))
