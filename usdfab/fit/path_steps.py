"""How stage 3 goes on from a point: Adam, or Gauss-Newton on all statistics that the loss compares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.fit.path_loss import ANCHOR_DEVIATION, GAIN_DEVIATION, LossValue, PathLoss
from usdfab.fit.path_space import OpticsSpace

Floats = NDArray[np.float64]

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-8
"""Adam's (Kingma and Ba 2015)."""

DIFFERENCE = 0.05
"""Change of a coordinate by which the derivatives of statistics are taken."""

ROUNDS = 5
"""Of reweighting in a model step."""

FLOOR = 0.1
"""Residuals below this part of the mean of their statistic count as squares, others as absolute values."""

DAMPING = 1e-3
"""Added to the diagonal of the normal equations, relative to it (Marquardt) and to ``FAINT`` of its mean."""

FAINT = 1e-2


def adam_step(
    gradient: Floats, first: Floats, second: Floats, steps: int, rate: float
) -> tuple[Floats, Floats, Floats]:
    """What to add to the point, and the new means of gradients and squares; ``steps`` counts from 1."""
    first = FIRST_DECAY * first + (1.0 - FIRST_DECAY) * gradient
    second = SECOND_DECAY * second + (1.0 - SECOND_DECAY) * gradient**2
    mean, square = first / (1.0 - FIRST_DECAY**steps), second / (1.0 - SECOND_DECAY**steps)
    return -rate * mean / (np.sqrt(square) + EPSILON), first, second


def gradient_by_point(
    value: LossValue, by_vector: Floats, space: OpticsSpace, point: Floats, loss: PathLoss, gain: bool
) -> Floats:
    """(N + 1,) from a loss and its derivatives (P,) through the picture; that by the gain is 0 where it is fixed."""
    total = by_vector.copy()
    total[-8:-2] += value.roughness.ravel()
    by_coordinate = space.slope(point[:-1]) * total[space.free] + anchor_slope(point, space, loss)
    return np.append(by_coordinate, value.log_gain if gain else 0.0)


def anchor_loss(point: Floats, space: OpticsSpace, loss: PathLoss) -> float:
    """The weighted anchor, 0 at the start."""
    return 0.5 * float(np.vdot(anchor_slope(point, space, loss), point[:-1] - space.coordinates(space.start)))


def anchor_slope(point: Floats, space: OpticsSpace, loss: PathLoss) -> Floats:
    """(N,) its derivatives by the coordinates."""
    return _anchor_curvature(space, loss) * (point[:-1] - space.coordinates(space.start))


def _anchor_curvature(space: OpticsSpace, loss: PathLoss) -> Floats:
    """(N,) 0 for albedos: each picture shows them, and those near 1 by a small part of their coordinate."""
    rough = space.free >= len(space.start) - 8
    return np.where(rough, loss.weights.anchor / ANCHOR_DEVIATION**2, 0.0)


def model_step(
    image: Floats, jacobian: Floats, point: Floats, space: OpticsSpace, loss: PathLoss, trust: float, gain: bool
) -> tuple[Floats, Floats]:
    """What to add to ``point`` (N + 1,) to come to the least loss, at most ``trust`` in each coordinate.

    Statistics are taken to be linear in the coordinates; their derivatives are differences of the statistics of
    pictures ``image`` (H, W, 3) with a little of each derivative ``jacobian`` (P, H, W, 3) added. The sum of absolute
    values is minimised by squares that are reweighted ``ROUNDS`` times. Also returns the curvature (N + 1, N + 1) of
    the texture and colour losses, by which they rise around their least value.
    """
    moves = [*(jacobian[space.free] * space.slope(point[:-1])[:, None, None, None]), *([image] if gain else [])]
    count = len(moves)
    residuals = loss.residuals(np.stack([image, *(image + DIFFERENCE * move for move in moves)]), float(point[-1]))
    rows = [((r[1:] - r[0]) / DIFFERENCE, r[0], weight) for r, weight in residuals]
    fixed_slope, fixed_curvature = _prior(point, space, loss, gain)
    change, seen = np.zeros(count), np.zeros((count, count))
    for _ in range(ROUNDS):
        seen, slope = np.zeros((count, count)), fixed_slope + fixed_curvature * change
        step = rows[0][0].new_tensor(change)
        for by_point, at, weight in rows:
            now = at + step @ by_point
            size = now.abs()
            weighted = by_point * (weight / size.clamp(min=max(FLOOR * float(size.mean()), 1e-12)))
            seen = seen + (weighted @ by_point.T).double().numpy()
            slope = slope + (weighted @ now).double().numpy()
        normal = seen + np.diag(fixed_curvature)
        # What the statistics hardly depend on stays where it is.
        normal = normal + np.diag(DAMPING * (np.diag(normal) + FAINT * np.diag(normal).mean()) + 1e-12)
        change = np.clip(change - np.linalg.solve(normal, slope), -trust, trust)
    if gain:
        return change, seen
    return np.append(change, 0.0), np.pad(seen, (0, 1))


def _prior(point: Floats, space: OpticsSpace, loss: PathLoss, gain: bool) -> tuple[Floats, Floats]:
    """Slope and curvature (N,) or (N + 1,) of the priors by the coordinates; bends of the coordinates left out."""
    slopes = space.slope(point[:-1])
    curvature = np.zeros(len(space.start))
    curvature[-8:-2] = loss.prior_curvature()
    gradient = np.zeros(len(space.start))
    gradient[-8:-2] = loss.prior_slope(space.vector(point[:-1])[-8:-2].reshape(2, 3)).ravel()
    result = (
        slopes * gradient[space.free] + anchor_slope(point, space, loss),
        slopes**2 * curvature[space.free] + _anchor_curvature(space, loss),
    )
    if not gain:
        return result
    stiff = loss.weights.prior / GAIN_DEVIATION**2
    return np.append(result[0], stiff * point[-1]), np.append(result[1], stiff)
