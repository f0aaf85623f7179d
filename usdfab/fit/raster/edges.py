"""Gradients through silhouettes, crossings of fibers, and the rims of shadows.

What a pixel sees jumps where one fiber covers another, and a jump has no derivative. As nvdiffrast does (Laine et al.
2020, section 3.5), two neighbouring pixels p, q between which something jumps are blended by where between their
middles the jump lies: at p + t (q - p), t in [0, 1] a differentiable function of the vertices. The pixel whose middle
lies on the wrong side gets |t - 1/2| of the other's value. That is antialiasing along one axis of the picture, so each
jump is blended along the axis to which it is more nearly normal, and only there: twice would count it twice.

Where a jump lies comes from *jump functions* g, which are negative at one pixel and positive at the other:
h - 1 of the covering fiber at its silhouette; the difference of two depths where fibers run into each other; h - 1 of
the shadow's caster, seen from the lamp, at the rim of a shadow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from usdfab.fit.raster.curves import as_numpy
from usdfab.fit.raster.segments import INLINE
from usdfab.tracer.intrinsics import KERNEL

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Pairs:
    """Pairs of neighbouring pixels, as indices into the flattened picture; ``q`` is to the right of or below ``p``.

    ``r`` is a neighbour of p in the other direction, at whose side a jump function tells how it runs there. ``before``
    and ``after`` are the next pixels in line, on the far sides of p and q; p and q themselves at the picture's border.
    """

    p: Ints
    q: Ints
    r: Ints
    before: Ints
    after: Ints

    def __getitem__(self, chosen: NDArray) -> Pairs:
        return Pairs(*(getattr(self, name)[chosen] for name in ("p", "q", "r", "before", "after")))


def pixel_pairs(height: int, width: int) -> tuple[Pairs, Pairs]:
    """All pairs along the rows and along the columns of a picture of at least 2 x 2 pixels."""
    number = np.arange(height * width).reshape(height, width)
    below = np.vstack([number[1:], number[-2]])
    return _pairs_along_rows(number, below), _pairs_along_rows(number.T, np.hstack([number[:, 1:], number[:, -2:-1]]).T)


def _pairs_along_rows(number: Ints, aside: Ints) -> Pairs:
    before = np.hstack([number[:, :1], number[:, :-1]])
    after = np.hstack([number[:, 1:], number[:, -1:]])
    return Pairs(*(a.ravel() for a in (number[:, :-1], number[:, 1:], aside[:, :-1], before[:, :-1], after[:, 1:])))


@njit(**INLINE)
def crossing(at_p, at_q):
    """t in [0, 1] where a jump function that runs straight from ``at_p`` to ``at_q`` passes zero."""
    difference = at_q - at_p
    return min(max(-at_p / (difference if abs(difference) > 1e-9 else 1e-9), 0.0), 1.0)


@njit(**INLINE)
def crossing_slopes(at_p, at_q):
    """Derivatives of ``crossing`` by its arguments."""
    difference = at_q - at_p
    if abs(difference) <= 1e-9 or not 0.0 <= -at_p / difference <= 1.0:
        return 0.0, 0.0
    t = -at_p / difference
    return (t - 1.0) / difference, -t / difference


@dataclass(frozen=True)
class Jumps:
    """Where between pixels things jump: t (M,) in [0, 1], counted from ``pairs.p``.

    ``smooth_p``, ``smooth_q`` (M,) say where the next pixel in line shows the same thing as p, or as q, so that the two
    tell how it changes towards the jump.
    """

    pairs: Pairs
    t: Tensor
    smooth_p: NDArray[np.bool_]
    smooth_q: NDArray[np.bool_]


def blended(values: Tensor, parts: list[Jumps]) -> Tensor:
    """Values of pixels (N, C) float64, those of pairs blended by where the jumps between them lie.

    On either side of a jump the values run straight on (or, where nothing is known of them, stay as they are) up to the
    jump, and each pixel is the mean over its width. A jump that passes the middle of a pixel then changes nothing
    suddenly: the pixel takes the other side's value there, which is the same. All parts blend the values as they were.
    """
    for part in parts:
        if part.t.shape != part.pairs.p.shape:
            raise ValueError(f"{len(part.pairs.p)} pairs have {tuple(part.t.shape)} jumps")
    result: Tensor = _Blended.apply(values, parts, *(part.t for part in parts))
    return result


class _Blended(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, parts: list[Jumps], *ts: Tensor) -> Tensor:
        ctx.save_for_backward(values, *ts)
        ctx.parts = parts
        old = np.ascontiguousarray(as_numpy(values), dtype=np.float64)
        new = old.copy()
        for part, t in zip(parts, ts, strict=True):
            _blend(*_arguments(part), as_numpy(t), old, new)
        return torch.from_numpy(new)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_result: Tensor) -> tuple[Tensor | None, ...]:
        values, *ts = ctx.saved_tensors
        old, given = as_numpy(values), np.ascontiguousarray(as_numpy(by_result))
        by_values, by_ts = given.copy(), []
        for part, t in zip(ctx.parts, ts, strict=True):
            by_t = np.zeros(len(t))
            _blend_slopes(*_arguments(part), as_numpy(t), old, given, by_values, by_t)
            by_ts.append(torch.from_numpy(by_t))
        return torch.from_numpy(by_values), None, *by_ts


def _arguments(part: Jumps) -> tuple[NDArray, ...]:
    pairs = part.pairs
    return pairs.p, pairs.q, pairs.before, pairs.after, part.smooth_p, part.smooth_q


@njit(**KERNEL)
def _blend(p, q, before, after, smooth_p, smooth_q, t, old, new):
    for m in range(len(p)):
        width, middle = 0.5 - t[m], 0.5 * (t[m] + 0.5)
        target = p[m] if width > 0.0 else q[m]
        for c in range(old.shape[1]):
            at_p, at_q = old[p[m], c], old[q[m], c]
            # Not below zero: what is bright at the rim of a fiber only does not run on.
            slope_p = max(at_p - old[before[m], c], -at_p) if smooth_p[m] else 0.0
            slope_q = min(old[after[m], c] - at_q, at_q) if smooth_q[m] else 0.0
            # Integral over x from t to 1/2 of what lies beyond the jump minus what lies before it, x counted from p.
            new[target, c] += width * (at_q - slope_q - at_p + (slope_q - slope_p) * middle)


@njit(**KERNEL)
def _blend_slopes(p, q, before, after, smooth_p, smooth_q, t, old, given, by_old, by_t):
    for m in range(len(p)):
        width, middle = 0.5 - t[m], 0.5 * (t[m] + 0.5)
        target = p[m] if width > 0.0 else q[m]
        for c in range(old.shape[1]):
            at_p, at_q = old[p[m], c], old[q[m], c]
            runs_p = smooth_p[m] and at_p - old[before[m], c] >= -at_p
            runs_q = smooth_q[m] and old[after[m], c] - at_q <= at_q
            slope_p, slope_q = 0.0, 0.0
            if smooth_p[m]:
                slope_p = at_p - old[before[m], c] if runs_p else -at_p
            if smooth_q[m]:
                slope_q = old[after[m], c] - at_q if runs_q else at_q
            g = given[target, c]
            bend = slope_q - slope_p
            by_t[m] += g * (0.5 * width * bend - (at_q - slope_q - at_p + bend * middle))
            g *= width
            by_p, by_q, by_slope_p, by_slope_q = -g, g, -g * middle, g * (middle - 1.0)
            if runs_p:
                by_p += by_slope_p
                by_old[before[m], c] -= by_slope_p
            elif smooth_p[m]:
                by_p -= by_slope_p
            if runs_q:
                by_q -= by_slope_q
                by_old[after[m], c] += by_slope_q
            elif smooth_q[m]:
                by_q += by_slope_q
            by_old[p[m], c] += by_p
            by_old[q[m], c] += by_q
