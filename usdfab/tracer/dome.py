"""The dome light's texture: the radiance of a direction, and directions drawn by it.

Pole along +y of the dome's frame, middle of the image towards +z, left quarter towards +x (``usd.scene``). ``light`` is
a row of ``lights.py`` as a tuple: 2:5 multiplier, 5:14 rotation world -> dome (rows).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}


def image_distribution(image: NDArray) -> tuple[NDArray, NDArray]:
    """Cumulative distributions for drawing texels by brightness times solid angle.

    Rows (H+1,) float64, columns (H, W+1) float32: panoramas are large. A texel too dim to have a width in float32 is
    not drawn and has density 0; rays that the BSDF draws find it.
    """
    height, width = image.shape[:2]
    columns = np.zeros((height, width + 1), dtype=np.float32)
    sums = np.zeros(height)
    for row, pixels, i in zip(columns, image, range(height), strict=True):
        cumulative = np.cumsum(pixels.max(axis=1) + 1e-9, dtype=np.float64)
        sums[i] = cumulative[-1] * math.sin((i + 0.5) * math.pi / height)
        row[1:] = cumulative / cumulative[-1]
    rows = np.r_[0.0, np.cumsum(sums)]
    return rows / rows[-1], columns


@njit(**_OPTIONS)
def _texel(cdf, u):
    """Index and place within it for a uniform number."""
    k = min(max(np.searchsorted(cdf, u, side="right") - 1, 0), len(cdf) - 2)
    width = cdf[k + 1] - cdf[k]
    return k, (u - cdf[k]) / width if width > 0.0 else 0.5


@njit(**_OPTIONS)
def dome_value(light, image, rows, columns, x, y, z):
    """(r, g, b, pdf): radiance from a direction and the solid-angle density with which ``sample_dome`` draws it."""
    lx = light[5] * x + light[6] * y + light[7] * z
    ly = light[8] * x + light[9] * y + light[10] * z
    lz = light[11] * x + light[12] * y + light[13] * z
    norm = math.sqrt(lx * lx + ly * ly + lz * lz)
    polar = math.acos(min(1.0, max(-1.0, ly / norm)))
    u = 0.5 - math.atan2(lx, lz) / (2.0 * math.pi)
    u, v = u - math.floor(u), polar / math.pi
    height, width = image.shape[0], image.shape[1]
    i, j = min(int(v * height), height - 1), min(int(u * width), width - 1)
    density = (rows[i + 1] - rows[i]) * height * (columns[i, j + 1] - columns[i, j]) * width
    pdf = density / (2.0 * math.pi * math.pi * max(math.sin(polar), 1e-9))
    return light[2] * image[i, j, 0], light[3] * image[i, j, 1], light[4] * image[i, j, 2], pdf


@njit(**_OPTIONS)
def sample_dome(light, rows, columns, u1, u2):
    """A unit direction drawn by the texture."""
    i, fi = _texel(rows, u1)
    j, fj = _texel(columns[i], u2)
    polar = math.pi * (i + fi) / len(columns)
    around = 2.0 * math.pi * ((j + fj) / (columns.shape[1] - 1) - 0.5)
    sin = math.sin(polar)
    lx, ly, lz = -sin * math.sin(around), math.cos(polar), sin * math.cos(around)
    # The dome's rotation is orthogonal up to scale: its inverse is the transpose, renormalised.
    x = light[5] * lx + light[8] * ly + light[11] * lz
    y = light[6] * lx + light[9] * ly + light[12] * lz
    z = light[7] * lx + light[10] * ly + light[13] * lz
    norm = math.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm
