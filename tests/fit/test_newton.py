"""Gauss-Newton: finds the least, leaves what nothing tells at its prior, names what is no number, resumes."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.descent import State, first_state, load_state
from usdfab.fit.newton import gauss_newton

NAMES = ("warp.crimp", "weft.twist", "gain")
START = torch.tensor([0.5, -0.4, 0.3], dtype=torch.float64)
TRUTH = torch.tensor([-0.2, 0.6, 0.3], dtype=torch.float64)
WEIGHTS = torch.full((40,), 1.0 / 40)
MATRIX = torch.randn((40, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
MATRIX[:, 2] = 0.0


def seen(x: Tensor) -> Tensor:
    """Nothing tells the third number."""
    return (torch.tanh(MATRIX @ (x - TRUTH)) + 0.1 * (MATRIX @ (x - TRUTH))).float()


def prior(x: Tensor) -> Tensor:
    return 1e-4 * (x - START).square().sum()


def same(a: State, b: State) -> bool:
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(State)]
    return all(torch.equal(x, y) if isinstance(x, Tensor) else x == y for x, y in pairs)


def test_what_is_told_is_found_and_the_rest_stays() -> None:
    state, interrupted = gauss_newton(seen, WEIGHTS, prior, first_state(START), 8, NAMES)
    assert not interrupted
    assert torch.allclose(state.best[:2], TRUTH[:2], atol=0.01)
    assert float(state.best[2]) == pytest.approx(float(START[2]), abs=1e-9)
    assert all(b <= a for a, b in zip(state.losses, state.losses[1:], strict=False))
    assert state.best_loss == state.losses[-1]


def test_a_prior_off_the_start_is_gone_to_where_nothing_else_tells() -> None:
    state, _ = gauss_newton(seen, WEIGHTS, lambda x: (x[2] - 0.8) ** 2, first_state(START), 8, NAMES)
    assert float(state.best[2]) == pytest.approx(0.8, abs=0.01)


def test_what_neither_picture_nor_prior_tells_stays() -> None:
    state, _ = gauss_newton(seen, WEIGHTS, lambda x: 0.0 * x.sum(), first_state(START), 8, NAMES)
    assert torch.allclose(state.best[:2], TRUTH[:2], atol=0.01)
    assert float(state.best[2]) == pytest.approx(float(START[2]), abs=1e-9)


@pytest.mark.parametrize("stop", [1, 3])
def test_resumed_is_undisturbed_bit_for_bit(tmp_path: Path, stop: int) -> None:
    whole, _ = gauss_newton(seen, WEIGHTS, prior, first_state(START), 5, NAMES)
    path = tmp_path / "state.safetensors"
    gauss_newton(seen, WEIGHTS, prior, first_state(START), stop, NAMES, checkpoint=path, job="j")
    rest, _ = gauss_newton(seen, WEIGHTS, prior, load_state(path, "j"), 5, NAMES)
    assert same(rest, whole)


def test_control_c_in_a_round_keeps_the_rounds_before(tmp_path: Path) -> None:
    calls = []

    def residuals(x: Tensor) -> Tensor:
        calls.append(x)
        if len(calls) == 12:
            raise KeyboardInterrupt
        return seen(x)

    path = tmp_path / "state.safetensors"
    state, interrupted = gauss_newton(residuals, WEIGHTS, prior, first_state(START), 5, NAMES, checkpoint=path)
    assert interrupted
    assert len(state.losses) == 2
    assert same(load_state(path, ""), state)
    rest, _ = gauss_newton(seen, WEIGHTS, prior, state, 5, NAMES)
    whole, _ = gauss_newton(seen, WEIGHTS, prior, first_state(START), 5, NAMES)
    assert same(rest, whole)


def test_a_step_too_far_is_shortened_and_named() -> None:
    def walled(x: Tensor) -> Tensor:
        return seen(x) if x[1] < 0.3 else torch.full((1,), torch.nan)

    state, _ = gauss_newton(walled, WEIGHTS, prior, first_state(START), 4, NAMES)
    assert any("weft.twist moved most" in note for note in state.notes)
    assert math.isfinite(state.best_loss)
    assert state.best_loss < state.losses[0]
    assert float(state.best[1]) < 0.3


def test_a_number_without_derivative_is_named_and_waits() -> None:
    def edge(x: Tensor) -> Tensor:
        return seen(x) if x[0] <= START[0] else torch.full((40,), torch.inf)

    state, _ = gauss_newton(edge, WEIGHTS, prior, first_state(START), 1, NAMES)
    assert any("beside warp.crimp was not finite" in note for note in state.notes)
    assert state.best[0] == START[0]
    assert state.best[1] != START[1]


def test_a_start_without_a_loss_is_refused() -> None:
    with pytest.raises(UsdfabError, match="not finite at the start"):
        gauss_newton(lambda x: seen(x) * torch.nan, WEIGHTS, prior, first_state(START), 2, NAMES)


def displaced(x: Tensor) -> Tensor:
    """Like ``seen``, with another place of its least."""
    return seen(x) + 0.3 * torch.tanh(MATRIX[:, 0]).float()


def test_a_wrong_model_beside_the_right_one_does_not_displace_the_least() -> None:
    looked: list[Tensor] = []

    def right(x: Tensor) -> Tensor:
        looked.append(x)
        return seen(x)

    alone, _ = gauss_newton(displaced, WEIGHTS, prior, first_state(START), 6, NAMES)
    assert float((alone.best[:2] - TRUTH[:2]).abs().max()) > 0.1
    state, _ = gauss_newton(displaced, WEIGHTS, prior, first_state(START), 6, NAMES, exact=right)
    assert torch.allclose(state.best[:2], TRUTH[:2], atol=0.01)
    # The right one is looked at once at the start and at most twice in a round.
    assert len(looked) <= 1 + 2 * 6


def test_what_the_right_model_refuses_is_halved_or_left() -> None:
    far = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    small = torch.eye(3, dtype=torch.float64)
    weights = torch.ones(3)

    def quick(x: Tensor) -> Tensor:
        return (small @ (x - far)).float()

    halved, _ = gauss_newton(
        quick, weights, lambda x: 0.0 * x.sum(), first_state(0.0 * far), 1, NAMES,
        exact=lambda x: quick(x) if x[0] < 0.8 else quick(0.0 * x),
    )  # fmt: skip
    assert float(halved.best[0]) == pytest.approx(0.5, abs=0.02)
    left, _ = gauss_newton(
        quick, weights, lambda x: 0.0 * x.sum(), first_state(0.0 * far), 2, NAMES, exact=lambda x: quick(-x)
    )
    assert torch.equal(left.best, 0.0 * far)
    assert left.losses[-1] == left.losses[0]


def test_resumed_beside_the_right_model_is_undisturbed(tmp_path: Path) -> None:
    whole, _ = gauss_newton(displaced, WEIGHTS, prior, first_state(START), 4, NAMES, exact=seen)
    path = tmp_path / "state.safetensors"
    gauss_newton(displaced, WEIGHTS, prior, first_state(START), 2, NAMES, exact=seen, checkpoint=path, job="j")
    rest, _ = gauss_newton(displaced, WEIGHTS, prior, load_state(path, "j"), 4, NAMES, exact=seen)
    assert same(rest, whole)
