"""The fit says what in the photo makes it unsure, and about which parameters."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.fit.doubts import Doubt, find_doubts
from usdfab.fit.photo_input import Photo, load_photo
from usdfab.imaging import linear_to_srgb, srgb_to_linear

SAMPLE = Path(__file__).parents[2] / "samples" / "microscope.png"


@cache
def sample() -> tuple[Photo, PhotoAnalysis]:
    photo = load_photo(SAMPLE, 4e-3)
    return photo, analyze_photo(photo.pixels)


def doubts(pixels: NDArray, analysed: bool = True) -> dict[str, Doubt]:
    """Of the sample's photo after something was done to it; colours and lattice are read anew only where asked."""
    pixels = np.clip(pixels, 0.0, 1.0).astype(np.float32)
    clipped = float((pixels.max(axis=2) >= 0.98).mean())
    photo = replace(sample()[0], pixels=pixels, clipped=(clipped, 0.0))
    return {d.cause: d for d in find_doubts(photo, analyze_photo(pixels) if analysed else sample()[1])}


def test_the_sample_itself_raises_none() -> None:
    assert find_doubts(*sample()) == ()


def test_blur() -> None:
    found = doubts(ndimage.gaussian_filter(sample()[0].pixels, (3, 3, 0)))
    assert set(found) == {"blur"}
    assert {"twist", "fiber_count"} <= set(found["blur"].parameters)


def test_sharpening_halos() -> None:
    encoded = linear_to_srgb(sample()[0].pixels)
    soft = ndimage.gaussian_filter(encoded, (1.0, 1.0, 0))
    assert "sharpening" not in doubts(srgb_to_linear(soft))
    halos = np.clip(encoded + 2.0 * (encoded - ndimage.gaussian_filter(encoded, (2, 2, 0))), 0, 1)
    found = doubts(srgb_to_linear(halos))
    assert "sharpening" in found and "blur" not in found
    assert {"radius", "roughness_primary"} <= set(found["sharpening"].parameters)


def test_clipped_highlights() -> None:
    found = doubts(2.5 * sample()[0].pixels, analysed=False)
    assert set(found) == {"clipped"}
    assert {"albedo", "roughness_longitudinal"} <= set(found["clipped"].parameters)
    assert "% of the photo's pixels" in found["clipped"].said


def test_clipping_is_counted_before_pixels_are_averaged(tmp_path: Path) -> None:
    from usdfab.imaging import write_image

    pixels = np.full((2100, 2100, 3), 0.3, dtype=np.float32)
    pixels[::5, ::5] = 1.0
    write_image(tmp_path / "large.png", pixels)
    photo = load_photo(tmp_path / "large.png", 4e-3)
    assert photo.clipped[0] == pytest.approx(0.04)
    assert photo.pixels.max() < 0.6


def test_dark_cloth() -> None:
    found = doubts(0.02 * sample()[0].pixels)
    assert "dark" in found
    assert "weft.albedo" in found["dark"].parameters
    assert "luminance" in found["dark"].said


def test_warp_and_weft_of_one_colour() -> None:
    photo, seen = sample()
    apart = np.linalg.norm(linear_to_srgb(seen.warp.colour) - linear_to_srgb(seen.weft.colour))
    assert apart > 0.1  # the sample's own
    # The same threads all grey, and all equally bright over the width of a yarn.
    grey = photo.pixels.mean(axis=2)
    even = 0.3 * grey / (ndimage.gaussian_filter(grey, 12.0) + 0.02)
    found = doubts(np.repeat(even[..., None], 3, axis=2))
    assert "same colour" in found
    assert {"weave", "crimp", "albedo"} <= set(found["same colour"].parameters)
    # Grey alone is no reason while one system is brighter.
    for weft, same in ((0.42, True), (0.55, False)):
        analysis = replace(
            seen, warp=replace(seen.warp, colour=np.full(3, 0.4)), weft=replace(seen.weft, colour=np.full(3, weft))
        )
        assert ("same colour" in {d.cause for d in find_doubts(photo, analysis)}) == same


def test_parameters_have_the_tables_names() -> None:
    photo, seen = sample()
    black = replace(seen.warp, colour=np.full(3, 0.001))
    worst = replace(seen, warp=black, weft=replace(black), detail=(3.0, 4.0, 0.2))
    found = find_doubts(replace(photo, clipped=(0.5, 0.0)), worst)
    assert {d.cause for d in found} == {"same colour", "dark", "clipped", "blur", "sharpening"}
    for doubt in found:
        for name in doubt.parameters:
            assert name == "weave" or name.removeprefix("warp.").removeprefix("weft.") in PARAMETER_BY_NAME
        assert doubt.warning.startswith(doubt.said) and doubt.as_table()["cause"] == doubt.cause
