"""Gauss-Newton on residuals of a picture's statistics: few rounds, each with a derivative of every statistic.

A picture tells some parameters well and of others next to nothing. Adam moves both at the same speed, so that the
second kind wander while the first converge. Here each moves as far as the statistics say (Levenberg 1944, Marquardt
1963), and what they do not tell stays at its prior. Derivatives are differences over steps wide enough that the
aliasing of thin fibers averages out.

A state is saved after each round; a round that is broken off is begun again, to the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.descent import Progress, State, few_names, save_state
from usdfab.fit.match_steps import normal_equations, soft_l1
from usdfab.torch_run import deterministic

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

STEP = 0.1
"""Of the differences, in the space without bounds: 2.5 % of a range at its middle."""

LONGEST = 1.0
"""No number moves farther in a round, in that space."""

FIRST_DAMPING = 1e-3
DAMPINGS = (0.1, 1.0, 10.0, 100.0)
"""Tried in each round, times the last that was good; relative to the mean curvature."""

GIVE_UP = 1e6
"""A damping beyond which no step is left to speak of."""

Residuals = Callable[[Tensor], Tensor]
Prior = Callable[[Tensor], Tensor]


def gauss_newton(
    residuals: Residuals,
    weights: Tensor,
    prior: Prior,
    state: State,
    rounds: int,
    names: Sequence[str],
    *,
    checkpoint: Path | None = None,
    job: str = "",
    progress: Progress | None = None,
) -> tuple[State, bool]:
    """Go on from ``state`` (of ``descent.first_state``) until ``rounds`` are done or no step helps.

    Parameters
    ----------
    residuals:
        Of a vector (F,): (R,), the same every time for the same vector. Where one is not finite, which may then be
        the only one, it is a step too far.
    weights: (R,)
        Of the residuals' absolute values, of which the loss is the sum, smoothed at 0.
    prior:
        What is added to the loss: a twice differentiable function of the vector.
    names: (F,)
        Of the vector's entries, for people.
    checkpoint, job, progress:
        As for ``descent.descend``.

    Returns
    -------
    state, interrupted:
        ``state.scale`` holds the damping; ``state.losses`` that of the start and after each round.

    Raises
    ------
    UsdfabError
        If the start has no finite loss.
    """
    search = _Search(residuals, weights.numpy(), prior, names)
    interrupted = False
    try:
        with deterministic():
            seen = search.residuals(state.vector)
            if not state.losses:
                loss = search.loss(state.vector, seen)
                if not math.isfinite(loss):
                    raise UsdfabError("the loss is not finite at the start", remedy="start from other parameters")
                state = replace(
                    state, scale=FIRST_DAMPING, best=state.vector, best_loss=loss, best_iteration=0, losses=(loss,)
                )
            while state.iteration <= rounds and state.scale < GIVE_UP:
                state, seen = search.round(state, seen)
                if checkpoint:
                    save_state(state, checkpoint, job)
                if progress:
                    progress(state.iteration - 1, rounds, state.losses[-1])
    except KeyboardInterrupt:
        interrupted = True
    if checkpoint and state.losses:
        save_state(state, checkpoint, job)
    return state, interrupted


class _Search:
    def __init__(self, residuals: Residuals, weights: Singles, prior: Prior, names: Sequence[str]) -> None:
        self._residuals, self._weights, self._prior, self._names = residuals, weights, prior, names

    def residuals(self, vector: Tensor) -> Singles:
        with torch.no_grad():
            return np.asarray(self._residuals(vector).numpy(), dtype=np.float32)

    def loss(self, vector: Tensor, seen: Singles) -> float:
        if len(seen) != len(self._weights) or not np.isfinite(seen).all():
            return math.nan
        with torch.no_grad():
            return soft_l1(seen, self._weights) + float(self._prior(vector))

    def round(self, state: State, seen: Singles) -> tuple[State, Singles]:
        """The state after the best of some damped steps, or the same place with more damping."""
        place, notes = state.vector, list(state.notes)
        jacobian, blind = self._jacobian(place, seen)
        here = f"iteration {state.iteration}"
        if blind:
            notes.append(f"{here}: the picture beside {few_names(blind)} was not finite: not moved in this round")
        matrix, gradient = normal_equations(seen, jacobian, self._weights)
        slope, bend = self._prior_slopes(place)
        held = np.array([name in blind for name in self._names])
        best: tuple[float, float, Tensor, Singles] | None = None
        for factor in DAMPINGS:
            damping = factor * state.scale
            step = _step(matrix + bend, gradient + slope, damping, held)
            trial = place + torch.from_numpy(step)
            found = self.residuals(trial)
            loss = self.loss(trial, found)
            if not math.isfinite(loss):
                moved = self._names[int(np.abs(step).argmax())]
                notes.append(f"{here}: the loss, after {moved} moved most, was not finite; a shorter step instead")
            elif best is None or loss < best[0]:
                best = loss, damping, trial, found
        if best is None or not best[0] < state.best_loss:
            scale = state.scale * DAMPINGS[-1] * 10.0
            return replace(state, scale=scale, losses=(*state.losses, state.best_loss), notes=tuple(notes)), seen
        loss, damping, trial, found = best
        state = replace(
            state, vector=trial, trial=trial, best=trial, best_loss=loss, best_iteration=state.iteration,
            scale=max(damping, 1e-6), losses=(*state.losses, loss), notes=tuple(notes),
        )  # fmt: skip
        return state, found

    def _jacobian(self, place: Tensor, seen: Singles) -> tuple[Singles, list[str]]:
        """(F, R) derivatives of the residuals, and the names of what has none."""
        rows, blind = np.zeros((len(place), len(seen)), dtype=np.float32), []
        for k, name in enumerate(self._names):
            beside = place.clone()
            beside[k] += STEP
            found = self.residuals(beside)
            if np.isfinite(found).all():
                rows[k] = (found - seen) / np.float32(STEP)
            else:
                blind.append(name)
        return rows, blind

    def _prior_slopes(self, place: Tensor) -> tuple[Floats, Floats]:
        """Gradient (F,) of the prior and its curvature (F, F), that along its hills left out."""
        vector = place.detach().clone().requires_grad_()
        (slope,) = torch.autograd.grad(self._prior(vector), vector)
        bend = torch.autograd.functional.hessian(self._prior, place.detach()).numpy()
        values, axes = np.linalg.eigh(0.5 * (bend + bend.T))
        return slope.numpy(), (axes * np.maximum(values, 0.0)) @ axes.T


def _step(matrix: Floats, gradient: Floats, damping: float, held: NDArray[np.bool_]) -> Floats:
    """(F,) the damped Newton step; 0 where ``held``."""
    free = np.flatnonzero(~held)
    step = np.zeros(len(gradient))
    if len(free):
        inner = matrix[np.ix_(free, free)]
        extra = damping * max(np.trace(inner) / len(free), 1e-12)
        step[free] = -np.linalg.solve(inner + extra * np.eye(len(free)), gradient[free])
    return np.clip(step, -LONGEST, LONGEST)
