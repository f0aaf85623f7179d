"""Maps that wrap around: less noise without new seams, and values where rays hit nothing. NumPy and SciPy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

Map = NDArray[np.float32]

_RIDGE = 1e-3
"""Regularises the fits: guides vary by about 1 (they are standardised), so this is a share of their variance."""
_ROWS = 64


def guided(noisy: Map, guides: Map, weight: Map, radius: int) -> Map:
    """``noisy`` without most of its noise: locally a linear function of the guides (He, Sun and Tang 2013).

    In each square window a weighted linear regression of ``noisy`` on the guides; a texel gets the mean of the
    predictions of all windows that hold it. Where all weights are equal the mean over the whole map stays what it was,
    since the residuals of each regression sum to 0 and windows wrap around.

    Parameters
    ----------
    noisy: (H, W, C)
    guides: (H, W, G)
        Nearly free of noise.
    weight: (H, W)
        How much a texel of ``noisy`` counts, at least 0; texels of weight 0 get a prediction too.
    radius: texels
        Half the window's side.

    Returns
    -------
    (H, W, C) float32
    """
    height, width, channels = noisy.shape
    size = [min(2 * radius + 1, height), min(2 * radius + 1, width)]

    def mean(values: NDArray) -> NDArray:
        return uniform_filter(values, size=size, mode="wrap")

    weight = weight.astype(np.float64)
    total = mean(weight)
    scale = np.maximum(total, 1e-12)
    # Guides that vary by about 1, so that one ridge serves all.
    flat = guides.reshape(-1, guides.shape[-1])
    spread = flat.std(axis=0)
    guides = ((guides - flat.mean(axis=0)) / np.maximum(spread, 1e-9))[..., spread > 1e-6].astype(np.float64)
    count = guides.shape[-1]
    first = [mean(weight * guides[..., i]) / scale for i in range(count)]
    target = [mean(weight * noisy[..., c]) / scale for c in range(channels)]
    gram = np.empty((height, width, count, count))
    cross = np.empty((height, width, count, channels))
    for i in range(count):
        for j in range(i, count):
            gram[..., i, j] = mean(weight * guides[..., i] * guides[..., j]) / scale - first[i] * first[j]
            gram[..., j, i] = gram[..., i, j]
        gram[..., i, i] += _RIDGE
        for c in range(channels):
            cross[..., i, c] = mean(weight * guides[..., i] * noisy[..., c]) / scale - first[i] * target[c]
    slope = np.empty((height, width, count, channels))
    for row in range(0, height, _ROWS):
        part = slice(row, row + _ROWS)
        slope[part] = np.linalg.solve(gram[part], cross[part]) if count else 0.0
    out = np.empty((height, width, channels), np.float32)
    for c in range(channels):
        offset = target[c] - sum((slope[..., i, c] * first[i] for i in range(count)), np.zeros((height, width)))
        # Windows count by the weight that they hold, else the mean would shift.
        result = mean(total * offset)
        for i in range(count):
            result += mean(total * slope[..., i, c]) * guides[..., i]
        out[..., c] = result / np.maximum(mean(total), 1e-12)
    return out


def filled(values: Map, weight: Map) -> Map:
    """``values`` (H, W, C) where ``weight`` (H, W) > 0; elsewhere what is near, the map wrapped around."""
    known = weight > 0
    if known.all() or not known.any():
        return values
    out = np.where(known[..., None], values, 0.0).astype(np.float32)
    missing = ~known
    sigma = 1.0
    while missing.any():
        near = gaussian_filter(known.astype(np.float32), sigma, mode="wrap")
        usable = missing & (near > 1e-3)
        if usable.any():
            for c in range(values.shape[-1]):
                blurred = gaussian_filter(np.where(known, values[..., c], 0.0).astype(np.float32), sigma, mode="wrap")
                out[..., c][usable] = blurred[usable] / near[usable]
            missing &= ~usable
        sigma *= 2.0
    return out
