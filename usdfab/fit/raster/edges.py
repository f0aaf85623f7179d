"""Gradients through silhouettes, crossings of fibers, and the rims of shadows.

What a pixel sees jumps where one fiber covers another, and a jump has no derivative. As nvdiffrast does (Laine et al.
2020, section 3.5), two neighbouring pixels p, q between which something jumps are blended by where between their
middles the jump lies: at p + t (q - p), t in [0, 1] a differentiable function of the vertices. The pixel in which the
jump lies gets |t - 1/2| of what the other sees, as it would look here. That is antialiasing along one axis of the
picture, so each jump is blended along the axis to which it is more nearly normal, and only there: twice would count it
twice.

*As it would look here*, since a jump that passes the middle of a pixel must change nothing suddenly: what is not
continuous there has no gradient. A fiber's color changes steeply towards its rim, so what its neighbouring pixel shows
will not do; nor will its light, where one fiber leans on another and the shadow ends with it (``rims``); and where two
fibers leave a gap narrower than a pixel, what lies in it is neither's (``jumps``).

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

    ``r`` is a neighbour of p in the other direction, at whose side a jump function tells how it runs there.
    """

    p: Ints
    q: Ints
    r: Ints

    def __getitem__(self, chosen: NDArray) -> Pairs:
        return Pairs(self.p[chosen], self.q[chosen], self.r[chosen])


def pixel_pairs(height: int, width: int) -> tuple[Pairs, Pairs]:
    """All pairs along the rows and along the columns of a picture of at least 2 x 2 pixels."""
    number = np.arange(height * width).reshape(height, width)
    below = np.vstack([number[1:], number[-2]])
    return _pairs_along_rows(number, below), _pairs_along_rows(number.T, np.hstack([number[:, 1:], number[:, -2:-1]]).T)


def _pairs_along_rows(number: Ints, aside: Ints) -> Pairs:
    return Pairs(*(a.ravel() for a in (number[:, :-1], number[:, 1:], aside[:, :-1])))


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

    ``step`` (M, C) is how much the values on the other side of the jump are more than those on this side, both as they
    are in the middle of the pixel in which the jump lies (``inside``).
    """

    pairs: Pairs
    t: Tensor
    step: Tensor


def inside(pairs: Pairs, t: Tensor) -> Ints:
    """(M,) the pixels in which the jumps at t lie."""
    return np.where(as_numpy(t) < 0.5, pairs.p, pairs.q)


def outside(pairs: Pairs, t: Tensor) -> Ints:
    """(M,) the other pixels of the pairs."""
    return np.where(as_numpy(t) < 0.5, pairs.q, pairs.p)


def blended(values: Tensor, parts: list[Jumps]) -> Tensor:
    """Values of pixels (N, C) float64, those of pairs blended by where the jumps between them lie.

    The pixel in which a jump lies takes its part of what is beyond.
    """
    for part in parts:
        if part.t.shape != part.pairs.p.shape or part.step.shape != (len(part.t), values.shape[1]):
            raise ValueError(
                f"{len(part.pairs.p)} pairs have {tuple(part.t.shape)} jumps of {tuple(part.step.shape)} values"
            )
    result: Tensor = _Blended.apply(
        values, [part.pairs for part in parts], *(part.t for part in parts), *(part.step for part in parts)
    )
    return result


class _Blended(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, pairs: list[Pairs], *jumps: Tensor) -> Tensor:
        ctx.save_for_backward(*jumps)
        ctx.pairs = pairs
        new = np.array(as_numpy(values), dtype=np.float64)
        for part, t, step in zip(pairs, jumps[: len(pairs)], jumps[len(pairs) :], strict=True):
            _blend(part.p, part.q, as_numpy(t), np.ascontiguousarray(as_numpy(step)), new)
        return torch.from_numpy(new)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_result: Tensor) -> tuple[Tensor | None, ...]:
        jumps, count = ctx.saved_tensors, len(ctx.pairs)
        given = np.ascontiguousarray(as_numpy(by_result))
        by_ts, by_steps = [], []
        for part, t, step in zip(ctx.pairs, jumps[:count], jumps[count:], strict=True):
            by_t, by_step = np.zeros(len(t)), np.zeros(tuple(step.shape))
            _blend_slopes(
                part.p, part.q, as_numpy(t), np.ascontiguousarray(as_numpy(step)), given, by_t, by_step
            )  # fmt: skip
            by_ts.append(torch.from_numpy(by_t))
            by_steps.append(torch.from_numpy(by_step))
        return by_result, None, *by_ts, *by_steps


@njit(**KERNEL)
def _blend(p, q, t, step, new):
    for m in range(len(p)):
        target, width = (p[m], 0.5 - t[m]) if t[m] < 0.5 else (q[m], t[m] - 0.5)
        for c in range(new.shape[1]):
            new[target, c] += width * step[m, c]


@njit(**KERNEL)
def _blend_slopes(p, q, t, step, given, by_t, by_step):
    for m in range(len(p)):
        target, width, sign = (p[m], 0.5 - t[m], -1.0) if t[m] < 0.5 else (q[m], t[m] - 0.5, 1.0)
        for c in range(given.shape[1]):
            by_t[m] += sign * given[target, c] * step[m, c]
            by_step[m, c] = width * given[target, c]
