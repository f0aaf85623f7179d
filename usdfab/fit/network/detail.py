"""What lies below a yarn's spacing: the cloth with every crossing brought to one size, and numbers of its fine texture.

Width over spacing, roundness, twist and fibers of a yarn show at fractions of its spacing. With crossings of
``CELL`` x ``CELL`` pixels they look alike in all pictures, however many yarns these show.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from usdfab.fit.network.spectra import Frequency, to_lattice

Floats = NDArray[np.float64]

REVISION = 1
"""Raised whenever the same picture gives other numbers."""

CELL = 24
"""Pixels on a side of a crossing."""

MOST_CELLS = 9
"""Crossings along each side that are looked at, about the picture's middle."""

SHARE = 0.96
"""Part of the picture along each side that is used at most: a turned lattice should hardly leave it."""

ALIGN = 8
"""Sides are multiples of it: pooling leaves nothing out."""

HARMONICS = 8
"""Multiples of the yarns' frequencies whose power is taken."""

NEAR = 0.2
"""Cycles per crossing about a harmonic that count to it."""

BANDS = np.array([1.3, 2.3, 3.3, 4.6, 6.4, 8.6, 11.5])
"""Ends of the bands across the yarns, in cycles per crossing."""

SLOPES = np.array([-1.0, -0.6, -0.35, -0.2, -0.12, -0.06, 0.0, 0.06, 0.12, 0.2, 0.35, 0.6, 1.0])
"""Ends of the bins of frequency along the yarns over that across: fibers that lean show beside 0."""

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
DETAIL_SIZE = 2 * (HARMONICS + (len(BANDS) - 1) * (len(SLOPES) - 1)) + 4 * len(QUANTILES)

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def rectified(picture: NDArray[np.float32], warp: Frequency, weft: Frequency) -> NDArray[np.float32]:
    """The middle of a prepared picture (N, N, 3) with upright lattice, (H, W, 3), crossings ``CELL`` pixels large.

    H and W are multiples of ``ALIGN`` and depend on how many yarns the picture shows.
    """
    size = picture.shape[0]
    back = to_lattice(size, warp, weft)
    width, height = (_pixels(f.cycles) for f in (warp, weft))
    u = (np.arange(width) + 0.5 - 0.5 * width) / CELL
    v = (0.5 * height - np.arange(height) - 0.5) / CELL
    x, y = np.tensordot(back, np.stack(np.meshgrid(u, v)), axes=1)
    # Of normalised places, -1 and 1 are the picture's borders.
    places = torch.from_numpy(np.stack([x, -y], axis=-1) * (2.0 / size)).float()[None]
    image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None]
    image = _blurred(image, (_sigma(size, weft), _sigma(size, warp)))
    shown = F.grid_sample(image, places, mode="bicubic", padding_mode="reflection", align_corners=False)
    return np.ascontiguousarray(shown[0].permute(1, 2, 0).clamp(min=0.0).numpy())


def detail_vector(upright: NDArray[np.float32]) -> Floats:
    """(DETAIL_SIZE,) numbers of a rectified picture.

    For warp and weft: log power at ``HARMONICS`` and in ``BANDS`` and ``SLOPES``, over the power of all; then log
    quantiles of the luminance and of red, green and blue, over the mean luminance.
    """
    pixels = np.asarray(upright, dtype=np.float64)
    luma = pixels @ _LUMINANCE
    mean = float(luma.mean()) + 1e-9
    # The root evens out what highlights would drown.
    root = np.sqrt(luma / mean)
    parts = []
    for turned in (root, np.rot90(root)):
        power, across, along = _power(turned)
        total = float(power.sum()) + 1e-12
        near = np.abs(along) < NEAR
        harmonics = [power[near & (np.abs(across - k) < NEAR)].sum() for k in range(1, HARMONICS + 1)]
        slope = along / np.maximum(across, 1e-9)
        bins, _, _ = np.histogram2d(across.ravel(), slope.ravel(), (BANDS, SLOPES), weights=power.ravel())
        parts.append(np.log(np.r_[harmonics, bins.ravel()] / total + 1e-6))
    shares = np.concatenate([luma[..., None], pixels], axis=2).reshape(-1, 4) / mean
    parts.append(np.log(np.quantile(shares, QUANTILES, axis=0).T.ravel() + 1e-2))
    return np.concatenate(parts)


def folded(detail: torch.Tensor) -> torch.Tensor:
    """Detail vectors (B, DETAIL_SIZE) with means and half differences of what leans to either side.

    A mirror changes the sign of the differences and nothing else: they tell the twist, which is small beside the rest.
    """
    bands, slopes = len(BANDS) - 1, len(SLOPES) - 1
    sizes = [HARMONICS, bands * slopes] * 2
    *systems, quantiles = detail.split([*sizes, detail.shape[1] - sum(sizes)], dim=1)
    parts = []
    for part in systems:
        if part.shape[1] == HARMONICS:
            parts.append(part)
            continue
        bins = part.unflatten(1, (bands, slopes))
        right, left = bins[:, :, slopes // 2 :], bins.flip(2)[:, :, slopes // 2 :]
        parts += [(0.5 * (right + left)).flatten(1), (0.5 * (right - left)).flatten(1)]
    return torch.cat([*parts, quantiles], dim=1)


def _pixels(cycles: float) -> int:
    cells = min(float(MOST_CELLS), SHARE * cycles)
    return max(2 * ALIGN, int(cells * CELL) // ALIGN * ALIGN)


def _sigma(size: int, frequency: Frequency) -> float:
    """The blur in pixels before a spacing of ``size`` over the frequency is brought to ``CELL`` pixels."""
    return 0.5 * math.sqrt(max((size / frequency.cycles / CELL) ** 2 - 1.0, 0.0))


def _power(root: Floats) -> tuple[Floats, Floats, Floats]:
    """Half of the power spectrum of (H, W) values, and cycles per crossing across (0 and more) and along, upwards."""
    height, width = root.shape
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[1:-1]
    middle = float((root * window).sum() / window.sum())
    found = np.abs(np.fft.rfft2((root - middle) * window)) ** 2
    across, along = np.meshgrid(np.fft.rfftfreq(width) * CELL, -np.fft.fftfreq(height) * CELL)
    return found, across, along


def _blurred(image: torch.Tensor, sigmas: tuple[float, float]) -> torch.Tensor:
    """(1, C, H, W) under a Gaussian of ``sigmas`` pixels down and to the right, borders mirrored."""
    for axis, sigma in enumerate(sigmas):
        if sigma < 0.2:
            continue
        radius = max(1, round(3.0 * sigma))
        weights = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2)
        weights = weights / weights.sum()
        shape, pad = ((-1, 1), (0, 0, radius, radius)) if axis == 0 else ((1, -1), (radius, radius, 0, 0))
        kernel = weights.view(1, 1, *shape).expand(image.shape[1], 1, -1, -1)
        image = F.conv2d(F.pad(image, pad, mode="reflect"), kernel, groups=image.shape[1])
    return image
