"""Learning curves as pictures: losses over epochs, errors over the number of samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging import write_image

TRAINING, VALIDATION = (0.6, 0.25, 0.05), (0.05, 0.1, 0.4)
"""Colours (linear) of the two curves."""


def curves_picture(
    curves: Sequence[tuple[Sequence[float], tuple[float, float, float]]], size: tuple[int, int] = (480, 240)
) -> NDArray[np.float32]:
    """Curves (values, colour) in one picture (H, W, 3): places in their order to the right, values upwards.

    All share one scale from the smallest to the largest value; grey lines at its tenths.
    """
    width, height = size
    every = np.concatenate([np.asarray(values, dtype=np.float64) for values, _ in curves])
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    span = max(high - low, 1e-9)
    picture = np.ones((height, width, 3), dtype=np.float32)
    picture[np.linspace(0, height - 1, 11).astype(int)] = 0.8
    row = np.arange(height)[:, None]
    for values, color in curves:
        at = np.interp(np.linspace(0, max(len(values) - 1, 1), width), np.arange(len(values)), values)
        level = (height - 1) * (0.97 - 0.94 * (at - low) / span)
        # As thick as the step to the neighbouring column, so that a steep curve is no row of dots.
        picture[np.abs(row - level) <= 1.0 + np.abs(np.gradient(level))] = color
    return picture


def write_curves(
    history: dict[str, list[tuple[float, float]]], folder: Path, *, overwrite: bool = False
) -> dict[str, Path]:
    """``PART.png`` for each part of a network: losses of training (brown) and validation (blue) over the epochs.

    Raises
    ------
    UsdfabError
        If the folder cannot be made, or a picture is there already.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror})", place=str(folder)) from error
    paths = {}
    for part, losses in history.items():
        if len(losses) > 1:
            learned, judged = zip(*losses, strict=True)
            picture = curves_picture([(learned, TRAINING), (judged, VALIDATION)])
            paths[part] = write_image(folder / f"{part}.png", picture, overwrite=overwrite)
    return paths
