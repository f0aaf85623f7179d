"""A flat sample in the surface model, pixel by pixel, as the tracer shows it under the capture rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.fabric import FabricParameters
from usdfab.usd.rig import Rig

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """What each pixel of a picture sees of a cloth, in the frame of the cloth there (x weft, y warp, z normal).

    Parameters
    ----------
    shape:
        (height, width); rows from the top.
    hit: (height width,) bool
        Where there is cloth.
    queries: (N, 8)
        As ``aggregate`` takes them, one for each pixel with cloth.
    light: (N,)
        Irradiance across the light's direction.
    """

    shape: tuple[int, int]
    hit: NDArray[np.bool_]
    queries: Floats
    light: Floats

    def picture(self, colors: Floats) -> Floats:
        """(height, width, 3) from colours (N, 3) per unit of light."""
        image = np.zeros((self.shape[0] * self.shape[1], 3))
        image[self.hit] = colors * self.light[:, None]
        return image.reshape(*self.shape, 3)


def swatch_view(fabric: FabricParameters, rig: Rig, resolution: tuple[int, int], lamp: ArrayLike | None = None) -> View:
    """The swatch of ``usd.rig.swatch_scene`` for (width, height) pixels; ``lamp`` (3,): another place of the lamp."""
    width, height = resolution
    x = (np.arange(width) + 0.5) / width * rig.sample_size[0]
    y = (height - np.arange(height) - 0.5) / height * rig.sample_size[1]
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # The cloth's origin is the picture's lower left corner, the rig's is its middle.
    points = np.column_stack([places - 0.5 * np.asarray(rig.sample_size), np.zeros(len(places))])
    to_camera = np.array([0.0, 0.0, rig.camera_height]) - points
    to_light = np.asarray(rig.light_position if lamp is None else lamp, dtype=np.float64) - points
    distance = np.linalg.norm(to_light, axis=1)
    wo = to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    wi = to_light / distance[:, None]
    tile = np.array([fabric.weave.ends, fabric.weave.picks]) * fabric.cell
    pixel = np.asarray(rig.sample_size) / [width, height] / tile
    size = np.full(len(places), np.sqrt(pixel[0] * pixel[1]))
    queries = np.column_stack([np.mod(places / tile, 1.0), size, wi, wo[:, :2]])
    return View((height, width), np.ones(len(places), dtype=bool), queries, rig.light_intensity / distance**2)
