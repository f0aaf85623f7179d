"""What stage 3 hands on: the point it settles on, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import optics_of
from usdfab.fit.path_checkpoint import State
from usdfab.fit.path_space import OpticsSpace

Floats = NDArray[np.float64]

RISE = 0.05
"""Part of the loss that no eye would tell."""

WINDOW = 5
"""The result is the mean of a fifth of the iterations, those in a row with the least mean loss."""


@dataclass(frozen=True, eq=False)
class PathResult:
    """What stage 3 found.

    Parameters
    ----------
    fabric:
        The refined fabric.
    gain:
        By which the render is multiplied to be as bright as the photo.
    losses: (T, 4)
        Total, texture, colour and prior of each iteration; not a number where an iteration failed.
    history: (T, P)
        ``Optics.vector`` at each iteration.
    gains: (T,)
        Exposure gains.
    names:
        Of the entries of ``history``.
    uncertainty: (P,)
        By how much each entry of the optics can change, the others following, until the loss has risen by ``RISE`` of
        itself; 0 for what is not estimated, not a number where Adam took the steps. Small where the picture shows it.
    loss:
        Mean total loss of the iterations that the result is the mean of.
    paths:
        Millions of camera paths in this process.
    seconds:
        In this process.
    interrupted:
        Whether Ctrl-C ended it early.
    """

    fabric: FabricParameters
    gain: float
    losses: Floats
    history: Floats
    gains: Floats
    names: tuple[str, ...]
    uncertainty: Floats
    loss: float
    paths: float
    seconds: float
    interrupted: bool = False

    def summary(self) -> dict[str, object]:
        """For ``--json``."""
        finite = self.losses[np.isfinite(self.losses[:, 0])]
        return {
            "iterations": len(self.losses),
            "failed_iterations": len(self.losses) - len(finite),
            "loss_first": float(finite[0, 0]),
            "loss": self.loss,
            "gain": self.gain,
            "optics": dict(zip(self.names, optics_of(self.fabric).vector().tolist(), strict=True)),
            "uncertainty": dict(zip(self.names, _json_numbers(self.uncertainty), strict=True)),
            "million_paths": self.paths,
            "seconds": self.seconds,
        }


def chosen_point(state: State) -> tuple[Floats, float]:
    """The mean point of those iterations in a row, a fifth of all, with the least mean loss; and that loss.

    The least single loss would be that of a lucky picture.
    """
    good = np.isfinite(state.losses[:, 0])
    losses, points = state.losses[good, 0], state.history[good]
    length = max(1, len(losses) // WINDOW)
    means = np.convolve(losses, np.full(length, 1.0 / length), mode="valid")
    first = int(np.argmin(means))
    return points[first : first + length].mean(axis=0), float(means[first])


def uncertainty_of(curvature: Floats, point: Floats, loss: float, space: OpticsSpace) -> Floats:
    """(P,) see ``PathResult.uncertainty``."""
    result = np.zeros(len(space.start))
    half = 0.5 * (space.high - space.low)
    used = np.flatnonzero(np.diag(curvature) > 0.0)
    result[space.free] = half if len(used) else np.nan
    if len(used) == 0:
        return result
    part = curvature[np.ix_(used, used)]
    # The ridge is for what the picture does not show at all.
    inverse = np.linalg.inv(part + 1e-9 * part.diagonal().max() * np.eye(len(used)))
    reach = np.sqrt(2.0 * RISE * loss * np.diag(inverse))
    known = used[used < space.size]
    result[space.free[known]] = np.minimum(space.slope(point[:-1])[known] * reach[: len(known)], half[known])
    return result


def _json_numbers(values: Floats) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]
