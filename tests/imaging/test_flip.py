"""FLIP against values of its authors' evaluator (flip-evaluator 1.7, LDR, 67 pixels per degree), and its limits."""

from __future__ import annotations

import numpy as np
import pytest

from usdfab.errors import UsdfabError
from usdfab.imaging import flip, flip_map


def pattern(kind: int) -> np.ndarray:
    """(40, 56, 3) linear pictures that a formula makes."""
    y, x = np.mgrid[0:40, 0:56].astype(np.float64)
    if kind == 0:
        return 0.5 + 0.5 * np.stack([np.sin(x / 3), np.sin(y / 5), np.sin((x + y) / 7)], axis=-1)
    if kind == 1:
        return np.stack([x / 55, y / 39, 0.3 + 0.0 * x], axis=-1)
    return np.repeat((((x // 8 + y // 8) % 2) * 0.8 + 0.1)[..., None], 3, axis=-1)


@pytest.mark.parametrize(
    "a,b,mean,most", [(0, 1, 0.931961, 0.985998), (1, 2, 0.894729, 0.990142), (0, 2, 0.893945, 0.991931)]
)
def test_it_agrees_with_its_authors_evaluator(a: int, b: int, mean: float, most: float) -> None:
    errors = flip_map(pattern(a), pattern(b))
    assert errors.mean() == pytest.approx(mean, abs=2e-5)
    assert errors.max() == pytest.approx(most, abs=2e-5)
    assert flip(pattern(b), pattern(a)) == pytest.approx(mean, abs=2e-5)


def test_limits() -> None:
    green, blue = (np.broadcast_to(np.array(c, dtype=float), (8, 8, 3)) for c in ((0, 1, 0), (0, 0, 1)))
    assert flip(green, green) == 0.0
    assert flip(green, blue) == pytest.approx(1.0)
    assert flip(green, green + 0.5) > 0.0 == flip(green, green * 1.0)
    # Brighter than the screen is as bright as the screen.
    assert flip(green * 1.0, green * 3.0) == 0.0
    with pytest.raises(UsdfabError, match="FLIP"):
        flip(green, blue[:4])
    with pytest.raises(UsdfabError, match="FLIP"):
        flip(green[..., 0], blue[..., 0])
