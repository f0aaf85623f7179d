"""Gauss-Newton on a sum of absolute values, with derivatives that are learned on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

SOFT = 0.05
"""Residuals below this count by their squares: an absolute value has no curvature at 0."""


def soft_l1(residuals: Singles, weights: Singles) -> float:
    """``sum w (sqrt(r^2 + SOFT^2) - SOFT)``, the smooth sum of absolute values."""
    r = residuals.astype(np.float64)
    return float(np.dot(weights, np.sqrt(r * r + SOFT * SOFT) - SOFT))


def normal_equations(residuals: Singles, jacobian: Singles, weights: Singles) -> tuple[Floats, Floats]:
    """Matrix (P, P) and gradient (P,) of the quadratic that lies above ``soft_l1`` and touches it at ``residuals``.

    Parameters
    ----------
    residuals, weights: (R,)
    jacobian: (P, R)
        Derivatives of the residuals, one row for each coordinate.

    Notes
    -----
    ``sqrt(r^2 + s^2)`` lies below its tangent as a function of ``r^2``, so the iteratively reweighted squares with
    weights ``w / sqrt(r^2 + s^2)`` never overshoot it where the residuals are linear.
    """
    scale = weights / np.sqrt(residuals * residuals + np.float32(SOFT * SOFT))
    scaled = jacobian * scale
    return (scaled @ jacobian.T).astype(np.float64), (scaled @ residuals).astype(np.float64)


def damped_step(
    matrix: Floats, gradient: Floats, point: Floats, spread: Floats, prior: float, damping: float, longest: float
) -> Floats:
    """The step (P,) to the least of the quadratic, the prior ``prior / 2 sum (x / spread)^2`` and a damping.

    ``damping`` is relative to the mean of the matrix' diagonal; no coordinate moves by more than ``longest``.
    """
    inverse = prior / spread**2
    hessian = matrix + np.diag(inverse + damping * max(np.trace(matrix) / len(matrix), 1e-12))
    step = -np.linalg.solve(hessian, gradient + inverse * point)
    return np.clip(step, -longest, longest)


def broyden_update(jacobian: Singles, step: Floats, change: Singles) -> None:
    """Make ``jacobian`` (P, R) map ``step`` to the ``change`` (R,) that it caused, changed as little as possible.

    Broyden 1965, in place. No step teaches nothing.
    """
    direction = step.astype(np.float32)
    if not direction.any():
        return
    miss = change - direction @ jacobian
    jacobian += np.outer(direction / float(direction @ direction), miss)


def best_step(look: Callable[[int], T], start: int, loss: Callable[[T], float]) -> tuple[T, int]:
    """What is seen at the whole number of least loss that single steps down from ``start`` lead to, and the number."""
    best, at = look(start), start
    for way in (1, -1):
        while loss(there := look(at + way)) < loss(best):
            best, at = there, at + way
        if at != start:
            break
    return best, at
