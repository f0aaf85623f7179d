"""Views of a data set's samples as training sees them: turned, cropped, recoloured, uneven, photographed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fit.dataset.augment import Camera, photographed, sample_camera
from usdfab.fit.network.inputs import prepared
from usdfab.fit.network.turns import TURNS, cropped, recolored
from usdfab.fit.network.unevenness import sample_unevenness, uneven
from usdfab.srgb import srgb_to_linear

REVISION = 3
"""Raised whenever the same sample and number give another view."""

CROP_SHARE = 0.5
"""Part of the views that show a part of the picture, enlarged."""

SMALLEST_CROP = 0.55
LEAST_YARNS = 4.0
"""A crop shows at least so many yarns of each system."""


def view(
    pixels: NDArray[np.float32], fabric: FabricParameters, index: int, number: int
) -> tuple[NDArray[np.float32], FabricParameters]:
    """View ``number`` of a sample: a prepared picture, and the fabric that it shows.

    Number 0 is the render as it is; all others are random, the same each time: odd ones as a camera shows them, even
    ones as rendered.
    """
    if number == 0:
        return prepared(pixels), fabric
    rng = np.random.default_rng([index, number])
    turn = TURNS[int(rng.integers(len(TURNS)))]
    red, green, blue = (int(c) for c in rng.integers(3, size=3))
    pixels, fabric = recolored(pixels, fabric, (red, green, blue))
    if rng.random() < CROP_SHARE:
        least = LEAST_YARNS / min(fabric.warp.count, fabric.weft.count)
        share = rng.uniform(min(1.0, max(SMALLEST_CROP, least)), 1.0)
        pixels, fabric = cropped(pixels, fabric, share, (float(rng.random()), float(rng.random())))
    shown = as_photographed(pixels, fabric, rng) if number % 2 else pixels
    return prepared(turn.picture(shown)), turn.fabric(fabric)


def as_photographed(
    pixels: NDArray[np.float32], fabric: FabricParameters, rng: np.random.Generator
) -> NDArray[np.float32]:
    """A linear picture (H, W, 3) of ``fabric`` as a random camera shows it, decoded, its yarns a little uneven."""
    shown = uneven(pixels, fabric, sample_unevenness(rng), rng)
    return srgb_to_linear(photographed(shown, scaled(sample_camera(rng), pixels), rng))


def scaled(camera: Camera, pixels: NDArray) -> Camera:
    """A camera with its spots as large in a picture of another size as they are in one of 256 pixels."""
    factor = min(pixels.shape[:2]) / 256.0
    return replace(camera, blur=camera.blur * factor, sharpening_radius=camera.sharpening_radius * factor)
