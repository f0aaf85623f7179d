"""One tile of a woven surface as images: the normal and orientation maps that the encoder reads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.neural.surface_kernel import WARP, WEFT, sample_tile
from usdfab.neural.surface_material import SurfaceMaterial, weave_from_bits

PIXELS_RANGE = (4, 4096)


@dataclass(frozen=True, eq=False)
class SurfaceTile:
    """One repeat of the weave, seen from above, one sample at each pixel's centre.

    Frame: x along the weft, y along the warp, z up. Pixel (r, c) lies at x = (c + 0.5) / P, y = (r + 0.5) / P of the
    tile: row 0 is at the *bottom* (small y), as row 0 of a weave is the lowest pick.

    Parameters
    ----------
    normal: (P, P, 3) float32
        Unit normal n_p; (0, 0, 1) in gaps.
    orientation: (P, P, 3) float32
        Unit fiber direction t_p, orthogonal to the normal; (0, 0, 0) in gaps.
    yarn: (P, P) uint8
        What is on top: 0 weft, 1 warp, 2 gap.
    size: (2,) cells
        (columns, rows) of the weave: the tile is stretched to a square of pixels where they differ.
    """

    normal: NDArray[np.float32]
    orientation: NDArray[np.float32]
    yarn: NDArray[np.uint8]
    size: tuple[int, int]

    def channels(self) -> NDArray[np.float32]:
        """(6, P, P) float32: normal x, y, z, orientation x, y, z; the encoder's input."""
        return np.ascontiguousarray(np.concatenate([self.normal, self.orientation], axis=2).transpose(2, 0, 1))


def surface_tile(material: SurfaceMaterial, pixels: int = 64, *, scaled: bool = False) -> SurfaceTile:
    """The maps of one tile, ``pixels`` on each side.

    The height scale beta is left out (taken as 1) unless ``scaled``: the encoder gets roughness and height scale as
    numbers beside the image. The gap is in the image. What gaps hold: see ``SurfaceTile``.
    """
    low, high = PIXELS_RANGE
    if not low <= pixels <= high:
        raise UsdfabError(f"a tile of {pixels} pixels is not between {low} and {high}")
    cells, yarns = packed_geometry(material)
    normal = np.zeros((pixels, pixels, 3), dtype=np.float32)
    orientation = np.zeros((pixels, pixels, 3), dtype=np.float32)
    yarn = np.zeros((pixels, pixels), dtype=np.uint8)
    beta = material.height_scale if scaled else 1.0
    sample_tile(cells, yarns, material.half_width, beta, normal, orientation, yarn)
    return SurfaceTile(normal, orientation, yarn, (material.columns, material.rows))


def packed_geometry(material: SurfaceMaterial) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``cells`` (rows, columns, 3) and ``yarns`` (2, 3) as ``surface_kernel`` takes them."""
    warp, weft = 0, 1
    yarns = np.empty((2, 3))
    for system, index in ((WARP, warp), (WEFT, weft)):
        psi = material.twist[index]
        yarns[system] = math.sin(psi), math.cos(psi), material.inclination[index]
    return packed_cells(material.bits()), yarns


@lru_cache(maxsize=64)
def packed_cells(bits: str) -> NDArray[np.float64]:
    """(rows, columns, 3): system on top, middle of its segment from the cell's start along the yarn, segment length."""
    weave = weave_from_bits(bits)
    cells = np.empty((*weave.shape, 3))
    cells[..., 0] = np.where(weave, WARP, WEFT)
    for on_top, along in ((weave, 0), (~weave, 1)):
        period = weave.shape[along]
        for row, column in zip(*np.nonzero(on_top), strict=True):
            line, here = (on_top[:, column], row) if along == 0 else (on_top[row], column)
            before = next(k for k in range(period) if not line[(here - k - 1) % period])
            after = next(k for k in range(period) if not line[(here + k + 1) % period])
            length = before + 1 + after
            cells[row, column, 1:] = 0.5 * length - before, length
    cells.setflags(write=False)
    return cells
