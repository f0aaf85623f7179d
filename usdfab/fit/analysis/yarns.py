"""Colour, width and twist of the two yarn systems, measured on a grid whose weave is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fit.analysis.choose import Hypothesis
from usdfab.fit.analysis.features import LUMA_WEIGHTS, Array, Features
from usdfab.fit.analysis.rectify import SUB
from usdfab.fit.analysis.result import Twist
from usdfab.imaging.color import linear_to_srgb

Bool = NDArray[np.bool_]

CORE = slice(2, 6)
"""The middle half of a cell, in samples."""
SAME_COLOUR = 0.07
"""Distance in encoded RGB below which two yarns count as one colour."""


@dataclass(frozen=True)
class Blocks:
    """Maps cut into the cells of a hypothesis: arrays (..., R, SUB, K, SUB), axes row, v, column, u."""

    linear: Array
    tensor: Array
    weft_up: Bool
    valid: Bool


def cut(linear: Array, features: Features, hypothesis: Hypothesis) -> Blocks:
    """Sample the linear photo (H, W, 3) and the fine structure tensor in the cells of ``hypothesis``."""
    oy, ox = hypothesis.cells.offset
    rows, cols = hypothesis.cells.valid.shape

    def blocks(maps: Array) -> Array:
        part = hypothesis.grid.sample(maps)[:, oy : oy + rows * SUB, ox : ox + cols * SUB]
        return part.reshape(len(maps), rows, SUB, cols, SUB)

    return Blocks(
        blocks(np.moveaxis(linear, -1, 0)), blocks(features.tensor), hypothesis.weft_up, hypothesis.cells.valid
    )


def yarn_colours(blocks: Blocks, weft: bool) -> tuple[Array, Array, float]:
    """Colour of a system (3,), of its yarns (n, 3), and the mean scatter of one yarn (encoded RGB).

    The median over the cell's core keeps highlights and stray fibers out. Yarns that are nowhere on top in the photo
    get the colour of the system.
    """
    core = np.median(blocks.linear[:, :, CORE][..., CORE], axis=(2, 4))
    core = np.moveaxis(core, 0, -1)
    up = blocks.valid & (blocks.weft_up if weft else ~blocks.weft_up)
    if not weft:
        core, up = core.transpose(1, 0, 2), up.T
    seen = core[up]
    if len(seen) == 0:
        return np.full(3, np.nan), np.zeros((0, 3)), 1.0
    # Yarns that only graze the photo are left out, inside ones never on top keep the mean colour.
    present = blocks.valid.any(1) if weft else blocks.valid.any(0)
    mean = _trimmed(seen)
    colours, scatter = [], []
    for cells, mask in zip(core[present], up[present], strict=True):
        if not mask.any():
            colours.append(mean)
            continue
        colours.append(_trimmed(cells[mask]))
        scatter.append(np.abs(linear_to_srgb(cells[mask]) - linear_to_srgb(colours[-1])).mean())
    return mean, np.array(colours), float(np.mean(scatter))


def _trimmed(colours: Array) -> Array:
    """Mean of (n, 3) colours without the brightest and darkest fifth."""
    order = np.argsort(colours @ LUMA_WEIGHTS)
    cut = len(order) // 5
    return colours[order[cut : len(order) - cut]].mean(0)


def colour_sequence(colours: Array, max_period: int = 16) -> Array:
    """Smallest periodic description (p, 3) of the colours of successive yarns (n, 3), linear RGB.

    A period is taken if each yarn then lies near the mean of its class, in encoded RGB; (1, 3) where all yarns are
    alike, all of ``colours`` where nothing repeats at least twice.
    """
    n = len(colours)
    encoded = linear_to_srgb(colours)
    for period in range(1, min(max_period, n // 2) + 1):
        means = np.array([encoded[k::period].mean(0) for k in range(period)])
        rest = np.linalg.norm(encoded - means[np.arange(n) % period], axis=1)
        if np.sqrt((rest**2).mean()) < SAME_COLOUR and np.quantile(rest, 0.9) < 2 * SAME_COLOUR:
            return np.array([colours[k::period].mean(0) for k in range(period)])
    return colours.copy()


def gap_mask(blocks: Blocks) -> tuple[Array, float]:
    """Open places: (R, SUB, K, SUB) float 0 or 1, and a confidence.

    A place is open if it is much darker than the core of the darker yarn of its crossing. The confidence falls where
    the yarns themselves are dark, for then nothing tells gap from shadow.
    """
    light = np.tensordot(LUMA_WEIGHTS, blocks.linear, 1)
    core = np.median(light[:, CORE][..., CORE], axis=(1, 3))
    yarn = np.full(core.shape, np.inf)
    for mask, axis in ((blocks.weft_up & blocks.valid, 1), (~blocks.weft_up & blocks.valid, 0)):
        number = mask.sum(axis, keepdims=True)
        mean = np.where(mask, core, 0.0).sum(axis, keepdims=True) / np.maximum(number, 1)
        yarn = np.minimum(yarn, np.where(number > 0, mean, np.inf))
    yarn = np.minimum(yarn, np.median(core[blocks.valid]))
    open_ = light < 0.2 * yarn[:, None, :, None]
    level = float(np.median(core[blocks.valid]))
    return open_.astype(float), float(np.clip(level / 0.1, 0.1, 1.0))


def widths(open_: Array, blocks: Blocks) -> tuple[float, float, float]:
    """Width of warp and weft as fractions of the spacing, and the open fraction, from :func:`gap_mask`.

    Along the border between two wefts only the warp covers the ground, so the closed part there is the warp width;
    and the other way round.
    """
    weight = blocks.valid[:, None, :, None] * np.ones((1, SUB, 1, SUB))
    border = [0, SUB - 1]
    warp = 1 - _mean(open_[:, border], weight[:, border])
    weft = 1 - _mean(open_[..., border], weight[..., border])
    return float(np.clip(warp, 0.05, 1)), float(np.clip(weft, 0.05, 1)), _mean(open_, weight)


def _mean(x: Array, weight: Array) -> float:
    return float((x * weight).sum() / max(weight.sum(), 1e-9))


def twist(blocks: Blocks, weft: bool, tilt: float) -> tuple[Twist, float, float]:
    """Twist of a system: (direction, fiber angle in radians with Z positive, confidence).

    ``tilt`` is the clockwise tilt of the yarn axis from its image axis (radians, y down). Fibers of a Z yarn run like
    the middle stroke of the letter when the yarn stands upright, that is turned clockwise from the yarn axis, for
    either system. The mean double-angle vector is taken over the cores where the system is on top; the scatter over
    cells gives the confidence.
    """
    up = blocks.valid & (blocks.weft_up if weft else ~blocks.weft_up)
    if up.sum() < 3:
        return "none", 0.0, 0.0
    jxx, jyy, jxy = blocks.tensor[:, :, CORE][..., CORE].sum(axis=(2, 4))
    # Gradient angle (clockwise from +x, y down); fibers run at right angles to it. The yarn axis does so to the
    # frequency of its system, so that gradient minus frequency direction is fiber minus axis.
    double = ((jxx - jyy) + 2j * jxy)[up] / (jxx + jyy + 1e-12)[up]
    reference = tilt if not weft else tilt + np.pi / 2
    double = double * np.exp(-2j * reference)
    mean = double.mean()
    angle = float(np.angle(mean) / 2)
    sideways = double.imag
    error = float(sideways.std() / np.sqrt(len(sideways))) + 1e-9
    significance = abs(float(sideways.mean())) / error
    confidence = float(np.clip((significance - 2) / 8, 0, 1) * np.clip(abs(mean) / 0.3, 0, 1))
    if significance < 3 or abs(angle) < np.radians(3):
        return "none", angle, confidence
    return ("Z" if angle > 0 else "S"), angle, confidence
