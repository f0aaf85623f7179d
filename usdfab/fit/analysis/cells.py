"""Cell vectors: every crossing of a rectified photo reduced to a few numbers.

Per cell: mean orientation (coarse and fine), mean luma, the first even harmonic of luma along u and along v (a yarn is
brighter along its middle), two mean opponent colours, and the mean encoded RGB.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.fit.analysis.features import LUMA_WEIGHTS, Array, Features
from usdfab.fit.analysis.rectify import SUB

Bool = NDArray[np.bool_]

ORIENTATION, FIBERS, LUMA, LUMA_U, LUMA_V, CHROMA_A, CHROMA_B = range(7)

_CENTRE = (np.arange(SUB) + 0.5) / SUB - 0.5
_WAVE = np.sqrt(2) * np.cos(2 * np.pi * _CENTRE) / SUB
_FLAT = np.full(SUB, 1.0 / SUB)


@dataclass(frozen=True)
class CellMap:
    """The cells of one grid at one offset.

    Parameters
    ----------
    vectors: (7, R, K)
        See the module; row 0 is the lowest weft. Channels have deviation about 1 over the photo.
    rgb: (R, K, 3)
        Mean encoded colour.
    rgb_noise:
        Variance of encoded colour inside cells, summed over RGB.
    valid: (R, K) bool
        Cells lying in the photo.
    offset:
        Samples (v, u) by which the cells start into the rectified map.
    """

    vectors: Array
    rgb: Array
    rgb_noise: float
    valid: Bool
    offset: tuple[int, int]


def channels(features: Features, blur: float) -> Array:
    """(8, H, W): orientation, fibers, luma, two opponent colours (deviation about 1) and encoded RGB, all blurred.

    ``blur`` is in pixels. Opponent colours that vary far less than lightness does are left small: they are noise.
    """
    size = min(features.luma.shape)
    rgb = [ndimage.gaussian_filter(c, blur) for c in np.moveaxis(features.encoded, -1, 0)]
    light = (features.encoded @ LUMA_WEIGHTS).std()
    out = []
    for m in (features.orientation, features.fibers, features.luma):
        m = ndimage.gaussian_filter(m, blur)
        out.append((m - m.mean()) / (m.std() + 1e-12))
    for colour in (rgb[0] - rgb[1], rgb[2] - (rgb[0] + rgb[1]) / 2):
        c = colour - ndimage.gaussian_filter(colour, size / 5)
        out.append(c / np.hypot(c.std(), 0.15 * light + 0.005))
    return np.stack(out + rgb)


def cell_map(rectified: Array, inside: Bool, offset: tuple[int, int]) -> CellMap:
    """Cut sampled channels (8, h, w) into cells that start at ``offset`` (v, u).

    There is one row and one column of cells less than the map could hold, at every offset.
    """
    c, h, w = rectified.shape
    oy, ox = offset
    rows, cols = h // SUB - 1, w // SUB - 1
    block = rectified[:, oy : oy + rows * SUB, ox : ox + cols * SUB].reshape(c, rows, SUB, cols, SUB)
    valid = inside[oy : oy + rows * SUB, ox : ox + cols * SUB].reshape(rows, SUB, cols, SUB).mean((1, 3)) > 0.85
    mean = block.mean((2, 4))
    luma = block[2]
    along_u = np.einsum("rvku,u->rk", luma, _WAVE) / SUB
    along_v = np.einsum("rvku,v->rk", luma, _WAVE) / SUB
    vectors = np.stack([mean[0], mean[1], mean[2], along_u, along_v, mean[3], mean[4]])
    square = np.einsum("crvku,crvku->crk", block[5:], block[5:]) / SUB**2
    noise = float((square - mean[5:] ** 2)[:, valid].mean(1).sum()) if valid.any() else 0.0
    return CellMap(vectors, np.moveaxis(mean[5:], 0, -1), noise, valid, offset)
