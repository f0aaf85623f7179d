"""Looking up textures outside of kernels, with the numbers that kernels get."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.tracer.textures import Textures, load_texture_images, lookup, pack_textures
from usdfab.usd.scene import Texture


class TextureReader:
    """Colours of textures at texture coordinates. Each image is read once.

    Called with a texture and coordinates (N, 2), it gives colours (N, 3).

    Raises
    ------
    UsdfabError
        When an image cannot be read.
    """

    def __init__(self) -> None:
        self._packed: dict[int, tuple[Texture, Textures]] = {}

    def __call__(self, texture: Texture, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        if id(texture) not in self._packed:
            images, _ = load_texture_images([texture], strict=True)
            self._packed[id(texture)] = texture, pack_textures([texture], images)
        return _colors(self._packed[id(texture)][1], np.ascontiguousarray(uv, dtype=np.float64))


@njit(cache=True)
def _colors(textures, uv):
    out = np.empty((len(uv), 3))
    for k in range(len(uv)):
        out[k] = lookup(textures, 0, uv[k, 0], uv[k, 1])
    return out
