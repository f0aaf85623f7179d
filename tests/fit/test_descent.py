"""Adam that resumes to the same numbers, takes steps back from NaN, and survives Ctrl-C."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.descent import MAX_SETBACKS, SAVE_EVERY, State, descend, first_state, load_state

START = torch.tensor([1.5, -0.7, 0.3], dtype=torch.float64)
NAMES = ("a", "b", "c")


def rosenbrock(x: Tensor) -> Tensor:
    return ((1.0 - x[:-1]) ** 2 + 10.0 * (x[1:] - x[:-1] ** 2) ** 2).sum()


def same(a: State, b: State) -> bool:
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(State)]
    return all(torch.equal(x, y) if isinstance(x, Tensor) else x == y for x, y in pairs)


def test_steps_are_those_of_torch_adam() -> None:
    state, _ = descend(rosenbrock, first_state(START), 30, 0.05, NAMES)
    x = START.clone().requires_grad_()
    adam = torch.optim.Adam([x], lr=0.05)
    losses = []
    for _ in range(30):
        adam.zero_grad()
        value = rosenbrock(x)
        losses.append(value.item())
        value.backward()
        adam.step()
    assert state.losses == pytest.approx(losses, rel=1e-9)
    assert torch.allclose(state.trial, x, rtol=1e-9)
    assert state.best_loss == pytest.approx(min(losses))
    assert float(rosenbrock(state.best)) == state.best_loss


@pytest.mark.parametrize("stop", [SAVE_EVERY, SAVE_EVERY + 2])
def test_resumed_is_undisturbed_bit_for_bit(tmp_path: Path, stop: int) -> None:
    whole, _ = descend(rosenbrock, first_state(START), 20, 0.05, NAMES)
    path = tmp_path / "state.safetensors"
    descend(rosenbrock, first_state(START), stop, 0.05, NAMES, checkpoint=path, job="j")
    rest, _ = descend(rosenbrock, load_state(path, "j"), 20, 0.05, NAMES)
    assert same(rest, whole)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_control_c_keeps_the_best_and_the_state(tmp_path: Path) -> None:
    calls = []

    def loss(x: Tensor) -> Tensor:
        calls.append(x)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return rosenbrock(x)

    path = tmp_path / "state.safetensors"
    state, interrupted = descend(loss, first_state(START), 20, 0.05, NAMES, checkpoint=path)
    assert interrupted
    assert state.iteration == 7
    assert float(rosenbrock(state.best)) == min(state.losses)
    assert same(load_state(path, ""), state)
    rest, _ = descend(rosenbrock, state, 20, 0.05, NAMES)
    whole, _ = descend(rosenbrock, first_state(START), 20, 0.05, NAMES)
    assert same(rest, whole)


def wall(x: Tensor) -> Tensor:
    """Descends towards a region without a value: the square root of what is below 0.1."""
    return torch.sqrt(x[0] - 0.1) + x[1] ** 2


def test_a_loss_that_is_no_number_halves_the_step_and_names_what_moved() -> None:
    start = torch.tensor([0.3, 0.0], dtype=torch.float64)
    state, _ = descend(wall, first_state(start), 12, 0.15, ("flattening", "twist"))
    assert any(math.isnan(x) for x in state.losses)
    assert math.isfinite(state.best_loss)
    assert state.best_loss < float(wall(start))
    assert state.scale < 1.0
    assert "flattening" in state.notes[0]


def test_a_gradient_that_is_no_number_names_its_parameter() -> None:
    def loss(x: Tensor) -> Tensor:
        # The slope of a square root at 0 is infinite.
        return x[0] + (x[1] if x[1] > 0.9 else torch.sqrt(x[1] - x[1].detach()) + x[1].detach())

    start = torch.tensor([0.0, 1.0], dtype=torch.float64)
    state, _ = descend(loss, first_state(start), 6, 0.08, ("warp.crimp", "weft.twist"))
    assert any("gradient to weft.twist" in note for note in state.notes)
    assert state.vector.isfinite().all()
    assert state.best.isfinite().all()


def test_no_way_out_ends_with_the_best() -> None:
    calls = []

    def loss(x: Tensor) -> Tensor:
        calls.append(x)
        return (x**2).sum() * (1.0 if len(calls) < 4 else torch.nan)

    state, interrupted = descend(loss, first_state(START), 50, 0.05, NAMES)
    assert not interrupted
    assert state.iteration == 3 + MAX_SETBACKS
    assert state.best_loss == min(state.losses[:3])
    assert "ended after" in state.notes[-1]


def test_a_start_without_a_loss_is_refused() -> None:
    with pytest.raises(UsdfabError, match="not finite at the start"):
        descend(lambda x: x.sum() * torch.nan, first_state(START), 5, 0.05, NAMES)


def test_foreign_and_damaged_checkpoints_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    descend(rosenbrock, first_state(START), 2, 0.05, NAMES, checkpoint=path, job="one")
    with pytest.raises(UsdfabError, match="belongs to another"):
        load_state(path, "two")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(UsdfabError, match="cannot be read"):
        load_state(path, "one")


WORKER = """
import sys, time, torch
from pathlib import Path
from usdfab.fit.descent import descend, first_state
def loss(x):
    time.sleep(0.02)
    return ((1 - x[:-1]) ** 2 + 10 * (x[1:] - x[:-1] ** 2) ** 2).sum()
start = torch.tensor([1.5, -0.7, 0.3], dtype=torch.float64)
descend(loss, first_state(start), 10_000, 0.05, "abc", checkpoint=Path(sys.argv[1]), job="j")
"""


def test_kill_in_mid_iteration_loses_a_few_iterations_at_most(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    worker = subprocess.Popen([sys.executable, "-c", WORKER, str(path)])
    try:
        end = time.monotonic() + 120
        while not path.exists() and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.15)
    finally:
        os.kill(worker.pid, signal.SIGKILL)
        worker.wait()
    state = load_state(path, "j")
    assert state.iteration >= SAVE_EVERY
    target = state.iteration + 7
    rest, _ = descend(rosenbrock, state, target, 0.05, NAMES)
    whole, _ = descend(rosenbrock, first_state(START), target, 0.05, NAMES)
    assert rest.losses == pytest.approx(whole.losses, rel=1e-12)
