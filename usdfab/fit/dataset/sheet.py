"""A contact sheet of a data set's first samples."""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fit.dataset.reader import read_dataset
from usdfab.imaging import grid, write_image

BRIGHTEST = 0.9
"""The brightest hundredth of a picture darker or brighter than this is shown at it, as a camera would."""


def write_sheet(root: str | Path, target: Path, count: int, *, overwrite: bool = False) -> Path:
    """Draw the first ``count`` samples of a data set, each exposed by itself, as one picture.

    Raises
    ------
    UsdfabError
        For an empty or damaged data set, and where the picture cannot be written.
    """
    images = [exposed(stored.image) for stored in islice(read_dataset(root), count)]
    if not images:
        raise UsdfabError("there are no samples to draw", place=str(root))
    return write_image(target, grid(images, math.ceil(math.sqrt(len(images)))), overwrite=overwrite)


def exposed(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """A linear picture at the exposure that brings its 99th percentile to ``BRIGHTEST``."""
    bright = float(np.percentile(image, 99.0))
    return image * np.float32(BRIGHTEST / bright if bright > 0 else 1.0)
