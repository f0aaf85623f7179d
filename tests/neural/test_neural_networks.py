"""Networks against the same formulas in NumPy, their symmetries, gradients and compiled decoders."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parent))

import torch
from neural_examples import lively, random_queries
from numpy.typing import NDArray

from usdfab.neural.decoder import plan_of, plans_of
from usdfab.neural.encoding import angles, encoded_footprint
from usdfab.neural.examples import material_inputs
from usdfab.neural.lean_network import FEATURES, SIDES, TEXELS, LeanNetwork, lookup
from usdfab.neural.network import compressed, loss, parameter_count
from usdfab.neural.paper_network import PaperNetwork
from usdfab.neural.surface_material import SurfaceMaterial, weave_from_bits
from usdfab.neural.symmetry import SYMMETRIES, transformed_components, transformed_queries, transformed_tile
from usdfab.neural.training import ARCHITECTURES

MATERIALS = [
    SurfaceMaterial(weave_from_bits("001/010/100"), twist=(0.5, -0.3), inclination=(0.6, 0.3), roughness=0.25),
    SurfaceMaterial(weave_from_bits("0011/0110/1100/1001"), twist=(0.0, 0.4), height_scale=1.7),
]


def leaky(x: NDArray) -> NDArray:
    return np.where(x > 0, x, 0.01 * x)


def linear(network: torch.nn.Module, name: str, x: NDArray) -> NDArray:
    state = {k: v.numpy().astype(np.float64) for k, v in network.state_dict().items()}
    y = x @ state[f"{name}.weight"].T
    return y + state[f"{name}.bias"] if f"{name}.bias" in state else y


def numpy_blobs(queries: NDArray) -> NDArray:
    """One-blobs of u, v and size, written with loops."""
    found = np.zeros((len(queries), 24))
    for row, (u, v, size) in enumerate(queries[:, :3].astype(float)):
        for part, x in enumerate((u, v, np.sqrt(min(size, 5.0) / 5.0))):
            for k in range(8):
                away = abs(x - (k + 0.5) / 8)
                away = min(away, 1 - away) if part < 2 else away
                found[row, 8 * part + k] = np.exp(-0.5 * (8 * away) ** 2)
    return found


def numpy_lookup(code: NDArray, query: NDArray) -> NDArray:
    """A mip map's value as its definition says, one query."""
    u, v, size = (float(n) for n in query[:3])
    level = min(max(np.log2(max(size, 1e-6) * 32) - 1, 0.0), 5.0)
    total = np.zeros(code.shape[1])
    first = 0
    for number, side in enumerate(SIDES):
        share = max(0.0, 1 - abs(level - number))
        texels = code[first : first + side * side].reshape(side, side, -1)
        for i in range(-1, side + 1):
            for j in range(-1, side + 1):
                weight = max(0.0, 1 - abs(u * side - 0.5 - j)) * max(0.0, 1 - abs(v * side - 0.5 - i))
                total += share * weight * texels[i % side, j % side]
        first += side * side
    return total


def test_footprints_are_encoded_as_defined() -> None:
    queries = random_queries(50)
    assert np.allclose(encoded_footprint(torch.from_numpy(queries)).numpy(), numpy_blobs(queries), atol=2e-6)
    # The tile's left and right border are one place.
    sides = torch.tensor([[0.0, 0.3, 1.0, 0, 0, 1, 0, 0], [1.0, 0.3, 1.0, 0, 0, 1, 0, 0]])
    assert torch.allclose(*encoded_footprint(sides))


def test_half_vectors_are_halfway() -> None:
    queries = random_queries(50)
    found = angles(torch.from_numpy(queries)).numpy()
    outgoing = np.c_[queries[:, 6:], np.sqrt(np.maximum(1 - (queries[:, 6:] ** 2).sum(axis=1), 0))]
    assert np.allclose(np.linalg.norm(found[:, 5:], axis=1), 1, atol=1e-5)
    cosines = [(found[:, 5:] * w).sum(axis=1) for w in (queries[:, 3:6], outgoing)]
    assert np.allclose(*cosines, atol=1e-5)


def test_pyramid_is_looked_up_as_a_mip_map() -> None:
    rng = np.random.default_rng(1)
    codes = rng.normal(size=(2, TEXELS, FEATURES)).astype(np.float32)
    queries = np.stack([random_queries(40, seed) for seed in (1, 2)])
    found = lookup(torch.from_numpy(codes), torch.from_numpy(queries)).numpy()
    expected = [[numpy_lookup(code, q) for q in some] for code, some in zip(codes, queries, strict=True)]
    assert np.allclose(found, expected, atol=2e-4)


def test_paper_decoder_is_its_formula() -> None:
    network, queries = lively("paper"), random_queries(60)
    code = np.random.default_rng(2).normal(size=(1, 64)).astype(np.float32)
    with torch.no_grad():
        found = network.decode(torch.from_numpy(code), torch.from_numpy(queries[None]))[0].numpy()
    x = np.concatenate([np.repeat(code, len(queries), axis=0), numpy_blobs(queries)], axis=1)
    for name in ("fusion.0", "fusion.1"):
        x = leaky(linear(network, name, x))
    x = leaky(linear(network, "angular_in", np.concatenate([x, queries[:, 3:]], axis=1)))
    x = leaky(linear(network, "angular_block.second", leaky(linear(network, "angular_block.first", x))) + x)
    x = linear(network, "angular_out", leaky(linear(network, "angular_hidden", x)))
    assert np.ptp(x, axis=0).min() > 1e-3
    assert np.allclose(found, x, atol=1e-5)


def test_architectures_have_the_sizes_of_the_paper_and_less() -> None:
    paper, lean = PaperNetwork("reflection"), LeanNetwork("reflection")
    assert paper.encode(torch.rand(2, 6, 64, 64), torch.rand(2, 2)).shape == (2, 64)
    # ResNet-18 without its last stage and its classifier, three more input channels (7 x 7 x 64 numbers each): 2.79 M.
    stages = sum(parameter_count(part) for part in (paper.stem, paper.stages))
    assert abs(stages - (11_689_512 - 513_000 - 8_393_728 + 3 * 49 * 64)) < 2e4
    assert parameter_count(lean) < 100_000
    assert lean.encode(torch.rand(2, 6, 64, 64), torch.rand(2, 2)).shape == (2, TEXELS, FEATURES)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("kind", ["reflection", "transmission"])
def test_compiled_decoder_answers_as_torch(architecture: str, kind: str) -> None:
    network = lively(architecture, kind)
    queries = random_queries(700, below=kind == "transmission")
    tiles, parameters = material_inputs(MATERIALS)
    with torch.no_grad():
        expected = network(tiles, parameters, torch.from_numpy(np.stack([queries, queries]))).numpy()
    assert np.abs(expected[0] - expected[1]).max() > 1e-4
    for plan, wanted in zip(plans_of(network, MATERIALS), expected, strict=True):
        found = plan.decode(queries)
        assert np.abs(found - wanted).max() <= 2e-5 * (1 + np.abs(wanted).max())
        assert (found >= 0).all()


def test_decoding_does_not_depend_on_threads_or_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    from usdfab.neural import decoder

    plan = plans_of(lively("lean"), MATERIALS[:1])[0]
    queries = random_queries(1500)
    whole = plan.decode(queries)
    monkeypatch.setattr(decoder, "PIECE", 256)
    assert np.array_equal(plan.decode(queries, threads=3), whole)
    assert np.array_equal(plan.decode(queries[512:600]), whole[512:600])
    assert plan.decode(queries[:0]).shape == (0, 4)


def test_shifting_a_cloth_shifts_its_pyramid() -> None:
    network = lively("lean")
    tiles, parameters = material_inputs(MATERIALS[:1])
    with torch.no_grad():
        code = network.encode(tiles, parameters)
        moved = network.encode(tiles.roll((32, -32), (2, 3)), parameters)
    # Half a tile is a whole number of texels on all levels but the last, which is one texel.
    first = 0
    for side in SIDES:
        a, b = (c[:, first : first + side * side].reshape(1, side, side, -1) for c in (code, moved))
        assert torch.allclose(a.roll((side // 2, -(side // 2)), (1, 2)), b, atol=1e-4)
        first += side * side


def test_loss_is_the_papers() -> None:
    rng = np.random.default_rng(3)
    outputs, targets = rng.random((2, 30, 4)), rng.random((2, 30, 4))
    g = targets.copy()
    g[..., 2:] = np.log(100 * targets[..., 2:] + 1)
    square = ((outputs - g) ** 2).mean(axis=(0, 1))
    wanted = 0.4 * (square[2] + square[3]) + 0.1 * (square[0] + square[1])
    assert float(loss(torch.tensor(outputs), torch.tensor(targets), 100.0)) == pytest.approx(wanted, rel=1e-9)
    network = LeanNetwork("reflection")
    again = network.components(compressed(torch.tensor(targets), 100.0))
    assert np.allclose(again.numpy(), targets, rtol=1e-9)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_gradients_are_those_of_finite_differences(architecture: str) -> None:
    network = lively(architecture).double()
    tiles, parameters = (t.double() for t in material_inputs(MATERIALS))
    queries = torch.from_numpy(np.stack([random_queries(20, 5)] * 2)).double()
    targets = torch.rand(2, 20, 4, dtype=torch.float64)

    def value() -> torch.Tensor:
        return loss(network.decode(network.encode(tiles, parameters), queries), targets, 100.0)

    value().backward()
    rng = np.random.default_rng(0)
    parts = [(n, p) for n, p in network.named_parameters() if p.ndim > 1]
    for name, parameter in [parts[k] for k in rng.choice(len(parts), 5, replace=False)]:
        direction = torch.from_numpy(rng.normal(size=tuple(parameter.shape)))
        assert parameter.grad is not None
        slope, step = float((parameter.grad * direction).sum()), 1e-7
        with torch.no_grad():
            parameter += step * direction
            up = float(value())
            parameter -= 2 * step * direction
            down = float(value())
            parameter += step * direction
        assert slope == pytest.approx((up - down) / (2 * step), rel=2e-3, abs=1e-5), name


@pytest.mark.parametrize("number", range(SYMMETRIES))
def test_mirrored_and_turned_cloths_are_what_the_surface_model_says(number: int) -> None:
    """A transformed tile and its queries against a material that is made mirrored and turned."""
    from usdfab.neural.aggregation import aggregate
    from usdfab.neural.surface_tile import surface_tile

    material = MATERIALS[0]
    weave, (warp, weft) = material.weave, material.twist
    inclination = material.inclination
    for bit in (1, 2):
        if number & bit:
            # Mirrored: S twist becomes Z.
            weave, warp, weft = np.flip(weave, axis=2 - bit), -warp, -weft
    if number & 4:
        # Mirrored at the diagonal: warp becomes weft.
        weave, warp, weft, inclination = ~weave.T, -weft, -warp, inclination[::-1]
    other = SurfaceMaterial(
        weave, (warp, weft), (inclination[0], inclination[1]), material.roughness, material.height_scale
    )
    tile = torch.from_numpy(surface_tile(material).channels())
    expected = surface_tile(other).channels()
    found = transformed_tile(tile, number).numpy()
    # A pixel in the middle of a border between yarns may fall to either side.
    assert (np.abs(found - expected).max(axis=0) > 1e-4).mean() < 0.02

    queries = torch.from_numpy(random_queries(40, 6))
    queries[:, 2].clamp_(max=3.0)
    asked = transformed_queries(queries, number)
    first, second = (aggregate(m, q.numpy(), samples=8192, threads=1) for m, q in ((material, queries), (other, asked)))
    wanted = transformed_components(torch.from_numpy(first), number).numpy()
    close = np.abs(second - wanted) <= 0.02 * np.abs(wanted) + 1.5e-3
    assert close.mean() > 0.95 and np.abs(second - wanted).max() < 0.02


def test_lean_decoder_is_small_enough_for_two_cores() -> None:
    """Ten frames a second of 1280 x 720 pixels leave two cores of 60 GFLOP/s 6.5 thousand multiplications a pixel."""
    network = LeanNetwork("reflection")
    code = network.encode(torch.rand(1, 6, 64, 64), torch.rand(1, 2))[0]
    assert plan_of(network, code).multiplications == 24 * 32 + 2 * 32 * 32 + 32 * 4
