"""Unfinished runs of stage 3 as files: saved whole or not at all, loaded without running anything (no pickle)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.fit.stage_file import load_stage, save_stage

Floats = NDArray[np.float64]

FORMAT = "usdfab-path-stage/1"


@dataclass
class State:
    """Where the optimisation stands after ``iteration`` iterations; N coordinates, the last one the gain's logarithm.

    Parameters
    ----------
    coordinates, first, second: (N,)
        The point, and Adam's means of gradients and of their squares.
    best: (N,)
        The point to go back to and the result so far.
    rate:
        Learning rate; halved after each failure.
    losses: (T, 4)
        Total, texture, colour and prior of each iteration; not a number where it failed.
    history: (T, N)
        Points whose losses these are.
    curvature: (N, N)
        Of the loss at the last point; 0 where it is not known.
    """

    iteration: int
    failures: int
    rate: float
    coordinates: Floats
    first: Floats
    second: Floats
    best: Floats
    losses: Floats
    history: Floats
    curvature: Floats

    @classmethod
    def begin(cls, coordinates: Floats, rate: float) -> State:
        """Before the first iteration."""
        n = len(coordinates)
        return cls(
            0, 0, rate, coordinates.copy(), np.zeros(n), np.zeros(n), coordinates.copy(), np.zeros((0, 4)),
            np.zeros((0, n)), np.zeros((n, n)),
        )  # fmt: skip


def save_state(path: Path, identity: str, state: State, passes: dict[str, NDArray]) -> None:
    """Write a checkpoint. After an error an older file is still there and nothing else is.

    Parameters
    ----------
    identity:
        Checksum of everything that the run depends on.
    passes:
        What the passes need to go on.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    arrays: dict = {f.name: np.asarray(getattr(state, f.name)) for f in fields(state)}
    arrays |= {f"pass_{key}": value for key, value in passes.items()}
    save_stage(path, FORMAT, identity, arrays)


def load_state(path: Path, identity: str) -> tuple[State, dict[str, NDArray]]:
    """Read what ``save_state`` wrote for the same run.

    Raises
    ------
    UsdfabError
        If the file is damaged, something else, or of a run with other inputs.
    """
    return load_stage(path, FORMAT, identity, _read)


def _read(arrays: dict[str, NDArray]) -> tuple[State, dict[str, NDArray]]:
    values = {f.name: arrays[f.name] for f in fields(State)}
    state = State(
        int(values.pop("iteration")), int(values.pop("failures")), float(values.pop("rate")), **values
    )  # fmt: skip
    n = len(state.coordinates)
    if state.losses.shape != (state.iteration, 4) or state.history.shape != (state.iteration, n):
        raise ValueError
    return state, {key.removeprefix("pass_"): array for key, array in arrays.items() if key.startswith("pass_")}
