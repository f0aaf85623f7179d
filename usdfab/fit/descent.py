"""Gradient descent that can be interrupted, goes on where it stopped to the same result, and survives NaN.

Adam (Kingma and Ba 2015) on one vector of unbounded numbers. The best vector seen is kept. Where the loss or its
gradient is not finite, the descent goes back to the last good vector and takes half the step from there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.files import whole_file
from usdfab.torch_run import deterministic

FORMAT = "usdfab-descent/1"
BETAS, EPSILON = (0.9, 0.999), 1e-8
"""Adam's, as Kingma and Ba 2015 give them."""

MAX_SETBACKS = 8
"""After so many halved steps in a row the descent ends with what it has."""

SAVE_EVERY = 5
"""Iterations between checkpoints."""

_TENSORS = ("vector", "mean", "square", "trial", "best")


@dataclass(frozen=True, eq=False)
class State:
    """A descent between two iterations.

    Parameters
    ----------
    vector: (F,)
        Where loss and gradient were last finite; with ``mean`` and ``square`` (F,), Adam's moments there, after its
        gradient.
    trial: (F,)
        What is looked at next.
    best: (F,), best_loss, best_iteration
        The best vector seen. ``best_iteration`` is -1 before the first.
    steps:
        Gradients in the moments.
    scale:
        Factor of the step, below 1 after setbacks.
    setbacks:
        In a row.
    losses:
        Of every iteration so far; NaN where it was set back.
    notes:
        Sentences for people.
    """

    vector: Tensor
    mean: Tensor
    square: Tensor
    trial: Tensor
    best: Tensor
    best_loss: float = math.inf
    best_iteration: int = -1
    steps: int = 0
    scale: float = 1.0
    setbacks: int = 0
    losses: tuple[float, ...] = ()
    notes: tuple[str, ...] = field(default=())

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return len(self.losses)


def first_state(vector: Tensor) -> State:
    """Before the first iteration."""
    start = vector.detach().clone()
    zero = torch.zeros_like(start)
    return State(start, zero, zero, start, start)


Loss = Callable[[Tensor], Tensor]
Progress = Callable[[int, int, float], None]
"""Called with (iterations done, iterations to do, loss)."""


def descend(
    loss: Loss,
    state: State,
    iterations: int,
    rate: float,
    names: Sequence[str],
    *,
    checkpoint: Path | None = None,
    job: str = "",
    progress: Progress | None = None,
) -> tuple[State, bool]:
    """Go on from ``state`` until ``iterations`` are done.

    Parameters
    ----------
    loss:
        Of a vector (F,), differentiable, the same every time for the same vector.
    rate:
        Adam's step.
    names: (F,)
        Of the vector's entries, for people.
    checkpoint:
        Where the state is saved every ``SAVE_EVERY`` iterations and at the end; ``job`` says which descent it is.

    Returns
    -------
    state, interrupted:
        ``interrupted`` after Ctrl-C; the state is saved then, too.

    Raises
    ------
    UsdfabError
        If the start itself has no finite loss.
    """
    interrupted = False
    try:
        with deterministic():
            while state.iteration < iterations and state.setbacks < MAX_SETBACKS:
                state = _step(loss, state, rate, names)
                if checkpoint and state.iteration % SAVE_EVERY == 0:
                    save_state(state, checkpoint, job)
                if progress:
                    progress(state.iteration, iterations, state.losses[-1])
    except KeyboardInterrupt:
        interrupted = True
    if state.setbacks >= MAX_SETBACKS:
        state = replace(state, notes=(*state.notes, f"ended after {MAX_SETBACKS} halved steps in a row"))
    if checkpoint and state.iteration:
        save_state(state, checkpoint, job)
    return state, interrupted


def _step(loss: Loss, state: State, rate: float, names: Sequence[str]) -> State:
    trial = state.trial.clone().requires_grad_()
    value = loss(trial)
    (gradient,) = torch.autograd.grad(value, trial)
    number = float(value.detach())
    bad = (~gradient.isfinite()).nonzero()[:, 0].tolist()
    if bad or not math.isfinite(number):
        return _set_back(state, rate, number, names, [names[k] for k in bad])
    if number < state.best_loss:
        state = replace(state, best=state.trial, best_loss=number, best_iteration=state.iteration)
    state = replace(
        state,
        vector=state.trial,
        mean=BETAS[0] * state.mean + (1.0 - BETAS[0]) * gradient,
        square=BETAS[1] * state.square + (1.0 - BETAS[1]) * gradient**2,
        steps=state.steps + 1,
        setbacks=0,
        losses=(*state.losses, number),
    )
    return replace(state, trial=_next(state, rate))


def _next(state: State, rate: float) -> Tensor:
    mean = state.mean / (1.0 - BETAS[0] ** state.steps)
    square = state.square / (1.0 - BETAS[1] ** state.steps)
    return state.vector - state.scale * rate * mean / (square.sqrt() + EPSILON)


def _set_back(state: State, rate: float, number: float, names: Sequence[str], bad: Sequence[str]) -> State:
    finite = math.isfinite(number)
    if not state.steps:
        whose = f"the gradient to {few_names(bad)}" if finite else "the loss"
        raise UsdfabError(f"{whose} is not finite at the start", remedy="start from other parameters")
    moved = names[int((state.trial - state.vector).abs().argmax())]
    which = f"gradient to {few_names(bad)} was" if finite else f"loss, after {moved} moved most, was"
    note = f"iteration {state.iteration + 1}: the {which} not finite; half the step from there on"
    state = replace(
        state,
        scale=0.5 * state.scale,
        setbacks=state.setbacks + 1,
        losses=(*state.losses, math.nan),
        notes=(*state.notes, note),
    )
    return replace(state, trial=_next(state, rate))


def few_names(names: Sequence[str]) -> str:
    """The first three of them, and how many more."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def save_state(state: State, path: Path, job: str) -> None:
    """Write a checkpoint, whole or not at all: safetensors with the numbers as JSON in its metadata."""
    numbers = {
        "best_loss": state.best_loss,
        "best_iteration": state.best_iteration,
        "steps": state.steps,
        "scale": state.scale,
        "setbacks": state.setbacks,
        "losses": list(state.losses),
        "notes": list(state.notes),
    }
    tensors = {name: getattr(state, name).clone().contiguous() for name in _TENSORS}
    with whole_file(path) as temporary:
        save_file(tensors, temporary, {"format": FORMAT, "job": job, "state": json.dumps(numbers)})


def load_state(path: Path, job: str) -> State:
    """Read a checkpoint of the same ``job``.

    Raises
    ------
    UsdfabError
        For a file that is no checkpoint, is damaged, or belongs to another job.
    """
    place = str(path)
    try:
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
            if about.get("format") != FORMAT:
                raise UsdfabError("no checkpoint of a fit", place=place, remedy="delete it, or fit without --resume")
            if about.get("job") != job:
                raise UsdfabError(
                    "the checkpoint belongs to another photo, start or quality",
                    place=place,
                    remedy="fit without --resume to start again",
                )
            tensors = {name: file.get_tensor(name) for name in _TENSORS}
            numbers: dict[str, Any] = json.loads(about["state"])
            values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in numbers.items()}
            return State(**tensors, **values)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, UsdfabError):
            raise
        raise UsdfabError("the checkpoint cannot be read", place=place, remedy="fit without --resume") from error
