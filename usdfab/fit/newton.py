"""Gauss-Newton on residuals of a picture's statistics: few rounds, each with a derivative of every statistic.

A picture tells some parameters well and of others next to nothing. Adam moves both at the same speed, so that the
second kind wander while the first converge. Here each moves as far as the statistics say (Levenberg 1944, Marquardt
1963), and what they do not tell stays at its prior. Derivatives are differences over steps wide enough that the
aliasing of thin fibers averages out.

The residuals may be those of a quick model, with a dear one beside it that is right: then each round looks at the dear
one once or twice. The quick model's residuals are moved by how far the two lie apart where the round begins, and what
comes out is kept only if the dear one says so, too (space mapping, Bandler et al. 2004). So the quick model gives
derivatives, and where it is wrong does not displace the least.

A state is saved after each round; a round that is broken off is begun again, to the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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

LONGEST = 2.0
"""No number moves farther in a step, in that space."""

INNER_STEPS = 8
"""Reweightings in a step."""

FIRST_DAMPING = 1e-2
DAMPINGS = (0.1, 1.0, 10.0, 100.0)
"""Tried in each round, times the last that was good; relative to each number's curvature."""

LEAST_DAMPING = 1e-4
STEPS_TO_EXACT = 2
"""Steps of a round, each with derivatives of its own, before exact residuals are looked at."""

RETRY = 0.5
"""Part of a round's step that is looked at where the dear residuals refuse the whole."""

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
    exact: Residuals | None = None,
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
    exact:
        Residuals whose loss counts, too dear to be differentiated; ``residuals`` then are but like them.
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
    search = _Search(residuals, exact, weights.numpy(), prior, names)
    interrupted = False
    try:
        with deterministic():
            place = search.at(state.vector)
            if not state.losses:
                loss = search.loss(state.vector, place.true)
                if not math.isfinite(loss):
                    raise UsdfabError("the loss is not finite at the start", remedy="start from other parameters")
                state = replace(
                    state, scale=FIRST_DAMPING, best=state.vector, best_loss=loss, best_iteration=0, losses=(loss,)
                )
            while state.iteration <= rounds and state.scale < GIVE_UP:
                state, place = search.round(state, place)
                if checkpoint:
                    save_state(state, checkpoint, job)
                if progress:
                    progress(state.iteration - 1, rounds, state.losses[-1])
    except KeyboardInterrupt:
        interrupted = True
    if checkpoint and state.losses:
        save_state(state, checkpoint, job)
    return state, interrupted


@dataclass(frozen=True, eq=False)
class _Place:
    """Residuals (R,) at a vector: those that have derivatives, and those that count."""

    seen: Singles
    true: Singles


class _Search:
    def __init__(
        self, residuals: Residuals, exact: Residuals | None, weights: Singles, prior: Prior, names: Sequence[str]
    ) -> None:
        self._residuals, self._exact, self._weights, self._prior = residuals, exact, weights, prior
        self._names = names

    def at(self, vector: Tensor, seen: Singles | None = None) -> _Place:
        """Both kinds of residuals; ``seen`` where they are known."""
        seen = _numbers(self._residuals, vector) if seen is None else seen
        return _Place(seen, seen if self._exact is None else _numbers(self._exact, vector))

    def loss(self, vector: Tensor, found: Singles) -> float:
        if len(found) != len(self._weights) or not np.isfinite(found).all():
            return math.nan
        with torch.no_grad():
            return soft_l1(found, self._weights) + float(self._prior(vector))

    def round(self, state: State, place: _Place) -> tuple[State, _Place]:
        """The state after one step, or where there are exact residuals after some; or the same place with more
        damping."""
        notes = list(state.notes)
        there, seen, loss, damping = state.vector, place.seen, state.best_loss, state.scale
        for _ in range(1 if self._exact is None else STEPS_TO_EXACT):
            found = self._step(there, seen, place, damping, f"iteration {state.iteration}", notes)
            if found is None or not found[0] < loss:
                break
            loss, damping, there, seen = found
        if there is not state.vector:
            for part in (1.0,) if self._exact is None else (1.0, RETRY):
                trial = state.vector + part * (there - state.vector)
                reached = self.at(trial, seen if part == 1.0 else None)
                loss = self.loss(trial, reached.true)
                if loss < state.best_loss:
                    state = replace(
                        state, vector=trial, trial=trial, best=trial, best_loss=loss, best_iteration=state.iteration,
                        scale=max(damping, LEAST_DAMPING), losses=(*state.losses, loss), notes=tuple(notes),
                    )  # fmt: skip
                    return state, reached
        scale = state.scale * DAMPINGS[-1] * 10.0
        return replace(state, scale=scale, losses=(*state.losses, state.best_loss), notes=tuple(notes)), place

    def _step(
        self, here: Tensor, seen: Singles, place: _Place, scale: float, which: str, notes: list[str]
    ) -> tuple[float, float, Tensor, Singles] | None:
        """The best of some damped steps: expected loss, damping, where it leads, residuals there."""
        jacobian, blind = self._jacobian(here, seen)
        if blind:
            notes.append(f"{which}: the picture beside {few_names(blind)} was not finite: not moved in this round")
        slope, bend = self._prior_slopes(here)
        held = np.array([name in blind for name in self._names])
        best: tuple[float, float, Tensor, Singles] | None = None
        for factor in DAMPINGS:
            damping = factor * scale
            step = _least(self._expected(place, seen), jacobian, self._weights, slope, bend, damping, held)
            trial = here + torch.from_numpy(step)
            found = _numbers(self._residuals, trial)
            loss = self.loss(trial, self._expected(place, found))
            if not math.isfinite(loss):
                moved = self._names[int(np.abs(step).argmax())]
                notes.append(f"{which}: the loss, after {moved} moved most, was not finite; a shorter step instead")
            elif best is None or loss < best[0]:
                best = loss, damping, trial, found
        return best

    def _expected(self, place: _Place, found: Singles) -> Singles:
        """The residuals that count where the others are ``found``."""
        if self._exact is None or len(found) != len(place.true):
            return found
        return place.true + (found - place.seen)

    def _jacobian(self, here: Tensor, seen: Singles) -> tuple[Singles, list[str]]:
        """(F, R) derivatives of the residuals, and the names of what has none."""
        rows, blind = np.zeros((len(here), len(seen)), dtype=np.float32), []
        for k, name in enumerate(self._names):
            beside = here.clone()
            beside[k] += STEP
            found = _numbers(self._residuals, beside)
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


def _numbers(residuals: Residuals, vector: Tensor) -> Singles:
    with torch.no_grad():
        return np.asarray(residuals(vector).numpy(), dtype=np.float32)


def _least(
    residuals: Singles,
    jacobian: Singles,
    weights: Singles,
    slope: Floats,
    bend: Floats,
    damping: float,
    held: NDArray[np.bool_],
) -> Floats:
    """(F,) the damped step to the least of the loss where residuals and the prior's slope run straight on; 0 where
    ``held``.

    A sum of absolute values is far from a paraboloid: one step to the least of that which touches it is short, so more
    follow without new derivatives (iteratively reweighted least squares).
    """
    free = np.flatnonzero(~held)
    step = np.zeros(len(slope))
    extra = np.zeros((len(slope), len(slope)))
    for k in range(INNER_STEPS if len(free) else 0):
        found = residuals if k == 0 else residuals + step.astype(np.float32) @ jacobian
        matrix, gradient = normal_equations(found, jacobian, weights)
        if k == 0:
            # Each number is damped by its own curvature: what a picture tells little of is not held by what it tells
            # much of.
            own = np.diag(matrix + bend)
            extra = damping * np.diag(np.maximum(own, 1e-6 * own.mean() + 1e-12))
        matrix = matrix + bend + extra
        gradient = gradient + slope + bend @ step + extra @ step
        step[free] -= np.linalg.solve(matrix[np.ix_(free, free)], gradient[free])
        step = np.clip(step, -LONGEST, LONGEST)
    return step
