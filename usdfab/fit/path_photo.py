"""The photo that stage 3 compares renders with: at their size, and which size that is."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fit.features import FeatureNet
from usdfab.fit.path_loss import as_tensor
from usdfab.fit.path_settings import PathSettings
from usdfab.fit.texture import Target, smallest_side
from usdfab.usd.scene import Camera

Floats = NDArray[np.float64]

ASPECT_TOLERANCE = 0.02


def picture_size(photo: NDArray, camera: Camera, settings: PathSettings) -> tuple[int, int]:
    """(width, height) in pixels of the renders: ``settings.side`` along the longer side, never more than the photo.

    Raises
    ------
    UsdfabError
        For a photo that is no finite RGB picture or whose aspect is not the camera's.
    """
    if photo.ndim != 3 or photo.shape[2] != 3 or 0 in photo.shape:
        raise UsdfabError(f"expected a picture (height, width, 3), got the shape {photo.shape}", place="photo")
    if not np.isfinite(photo).all():
        raise UsdfabError("it holds numbers that are not finite", place="photo")
    height, width = photo.shape[:2]
    seen = float(camera.tan_half[0] / camera.tan_half[1])
    if abs(width / height / seen - 1.0) > max(ASPECT_TOLERANCE, 1.0 / min(width, height)):
        raise UsdfabError(
            f"it has {width} x {height} pixels, an aspect of {width / height:.3f}, but the camera's is {seen:.3f}",
            place="photo",
            remedy="crop the photo to what the camera sees",
        )
    factor = min(1.0, settings.side / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def reduced_photo(photo: NDArray, size: tuple[int, int]) -> Floats:
    """The photo (H, W, 3) averaged over the pixels of a render of a size (width, height)."""
    pixels = torch.nn.functional.interpolate(as_tensor(photo), (size[1], size[0]), mode="area")
    return np.moveaxis(pixels[0].double().numpy(), 0, -1)


def photo_target(photo: Floats, net: FeatureNet, levels: tuple[int, ...]) -> Target:
    """The photo's texture at those levels for which it is large enough.

    Raises
    ------
    UsdfabError
        If it is too small for all of them.
    """
    fitting = tuple(level for level in levels if smallest_side(net, (level,)) <= min(photo.shape[:2]))
    return Target.from_image(as_tensor(photo), net, fitting or (min(levels),))
