"""What is no photo of woven cloth is refused, with a sentence."""

from __future__ import annotations

import numpy as np
import pytest
from cloth_drawing import Cloth, draw
from knit_drawing import draw_knit
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.errors import NoFabricError, UsdfabError
from usdfab.fit.analysis import analyze_photo

N = 240


def _grey(x: NDArray[np.float64]) -> NDArray[np.float64]:
    x = (x - x.min()) / (x.max() - x.min())
    return np.repeat(x[..., None], 3, axis=2)


def _face() -> NDArray[np.float64]:
    """An ellipse with two eyes, a nose and a mouth."""
    y, x = np.mgrid[0:N, 0:N] / N - 0.5
    face = 0.3 + 0.5 * np.exp(-(((x / 0.25) ** 2 + (y / 0.33) ** 2) ** 2))
    for eye in (-0.1, 0.1):
        face -= 0.4 * np.exp(-(((x - eye) / 0.04) ** 2 + ((y + 0.08) / 0.025) ** 2))
    return face - 0.3 * np.exp(-((x / 0.1) ** 2 + ((y - 0.15) / 0.02) ** 2))


def _no_cloth() -> dict[str, NDArray[np.float64]]:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:N, 0:N] / N
    points = np.zeros((N, N))
    points[rng.integers(0, N, 200), rng.integers(0, N, 200)] = 1
    return {
        "white noise": rng.random((N, N)),
        "smooth noise": ndimage.gaussian_filter(rng.standard_normal((N, N)), 6),
        "gradient": x + 0.5 * y,
        "noisy gradient": x + 0.5 * y + 0.01 * rng.standard_normal((N, N)),
        "blob": np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.05),
        "face": _face(),
        "stripes": 0.5 + 0.4 * np.sin(2 * np.pi * x * 14) + 0.02 * rng.standard_normal((N, N)),
        "leaning stripes": 0.5 + 0.4 * np.sin(2 * np.pi * y * 14 + 3 * x) + 0.05 * rng.standard_normal((N, N)),
        "rings": np.sin(2 * np.pi * np.hypot(x - 0.5, y - 0.5) * 20),
        "dots": ndimage.gaussian_filter(points, 4),
    }


SLOW = ("smooth noise", "noisy gradient", "blob", "stripes", "rings", "dots")


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in _no_cloth()])
def test_no_lattice(name: str) -> None:
    with pytest.raises(NoFabricError, match="no woven lattice") as caught:
        analyze_photo(_grey(_no_cloth()[name]), "picture.png")
    assert caught.value.place == "picture.png" and caught.value.remedy
    assert "best lattice" in caught.value.problem and "nats" in caught.value.problem


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant(level: float) -> None:
    with pytest.raises(NoFabricError, match="no contrast"):
        analyze_photo(np.full((128, 128, 3), level))
    forced = analyze_photo(np.full((128, 256, 3), level), force=True)
    assert forced.lattice_confidence == 0.0 and forced.weave_class == "plain"
    assert (forced.warp.count, forced.weft.count) == (24.0, 12.0)
    assert "no contrast" in forced.warnings[0] and "assumed" in forced.warnings[1]


@pytest.mark.parametrize(
    "options",
    [
        {"wales": 9, "courses": 12},
        pytest.param({"wales": 6, "courses": 7, "seed": 1}, marks=pytest.mark.slow),
        # Fine loops look like a lattice of crossings.
        {"wales": 12, "courses": 15, "seed": 3, "size": 300},
        pytest.param({"wales": 11, "courses": 13, "turned": True, "seed": 8, "size": 300}, marks=pytest.mark.slow),
    ],
)
def test_knitted_cloth(options: dict) -> None:
    with pytest.raises(NoFabricError, match="as loops of knitted cloth do"):
        analyze_photo(draw_knit(**options))


def test_blurred_beyond_recognition() -> None:
    cloth = draw(Cloth(np.eye(2, dtype=np.uint8), 8, 8, size=N))
    assert analyze_photo(ndimage.gaussian_filter(cloth, (1.5, 1.5, 0))).lattice_confidence > 0.5
    with pytest.raises(NoFabricError, match="too blurred"):
        analyze_photo(ndimage.gaussian_filter(cloth, (9, 9, 0)))


def test_force_goes_on_with_the_best_guess() -> None:
    knit = draw_knit()
    forced = analyze_photo(knit, force=True)
    assert forced.lattice_confidence == 0.0
    assert forced.warnings[0].startswith("Forced: no woven lattice found: columns lean left and right in turn")
    assert forced.warp.count == pytest.approx(18, rel=0.05)


def test_tiny() -> None:
    with pytest.raises(UsdfabError, match="too few"):
        analyze_photo(np.random.default_rng(0).random((63, 400, 3)))


@pytest.mark.parametrize("shape", [(100, 100), (100, 100, 4), (100, 100, 1)])
def test_no_rgb(shape: tuple[int, ...]) -> None:
    with pytest.raises(UsdfabError, match="RGB"):
        analyze_photo(np.zeros(shape))


def test_not_finite() -> None:
    photo = np.random.default_rng(0).random((100, 100, 3))
    photo[3, 3, 0] = np.nan
    with pytest.raises(UsdfabError, match="finite"):
        analyze_photo(photo)
