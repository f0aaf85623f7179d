"""A photo turned upright and brought to another scale, for whatever is compared with renders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage


def straightened(photo: NDArray, rotation: float, pixels_per_meter: float, scale: float) -> NDArray[np.float32]:
    """A photo turned upright and brought to another scale.

    Parameters
    ----------
    photo: (H, W, 3)
        Linear.
    rotation:
        Of the cloth in the photo, radians, counter-clockwise as seen.
    pixels_per_meter, scale:
        Of the photo, and of the result.

    Returns
    -------
    target:
        (h, w, 3), without the corners that the turn leaves empty; antialiased where it shrinks.
    """
    factor = scale / pixels_per_meter
    pixels = np.asarray(photo, dtype=np.float64)
    if factor < 1.0:
        pixels = ndimage.gaussian_filter(pixels, (0.5 * (1.0 / factor - 1.0),) * 2 + (0.0,))
    height, width = pixels.shape[:2]
    inner = _inscribed(width, height, rotation)
    rows, columns = (max(1, int(side * factor)) for side in (inner[1], inner[0]))
    y, x = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in ((rows, inner[1]), (columns, inner[0])))
    y, x = np.broadcast_arrays(y[:, None], x[None, :])
    # Rows run down: counter-clockwise as seen is (x cos + y sin, -x sin + y cos).
    cos, sin = np.cos(rotation), np.sin(rotation)
    places = [-x * sin + y * cos + 0.5 * (height - 1), x * cos + y * sin + 0.5 * (width - 1)]
    channels = [ndimage.map_coordinates(pixels[..., c], places, order=3, mode="nearest") for c in range(3)]
    return np.clip(np.stack(channels, axis=-1), 0.0, None).astype(np.float32)


def _inscribed(width: int, height: int, rotation: float) -> tuple[float, float]:
    """Sides of the largest upright rectangle of the photo's aspect in the photo turned about its middle."""
    cos, sin = abs(np.cos(rotation)), abs(np.sin(rotation))
    factor = min(width / (width * cos + height * sin), height / (width * sin + height * cos))
    return width * factor, height * factor
