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

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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


def crossing(at_p: Tensor, at_q: Tensor) -> Tensor:
    """t in [0, 1] where a jump function that runs straight from ``at_p`` to ``at_q`` passes zero."""
    difference = at_q - at_p
    safe = torch.where(difference.abs() > 1e-9, difference, torch.full_like(difference, 1e-9))
    return (-at_p / safe).clamp(0.0, 1.0)


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
    """Values of pixels (N, C), those of pairs blended by where the jumps between them lie.

    On either side of a jump the values run straight on (or, where nothing is known of them, stay as they are) up to the
    jump, and each pixel is the mean over its width. A jump that passes the middle of a pixel then changes nothing
    suddenly: the pixel takes the other side's value there, which is the same. All parts blend the values as they were.
    """
    result = values
    for part in parts:
        p, q = torch.from_numpy(part.pairs.p), torch.from_numpy(part.pairs.q)
        slope_p = torch.from_numpy(part.smooth_p)[:, None] * (values[p] - values[torch.from_numpy(part.pairs.before)])
        slope_q = torch.from_numpy(part.smooth_q)[:, None] * (values[torch.from_numpy(part.pairs.after)] - values[q])
        # Not below zero: what is bright at the rim of a fiber only does not run on.
        slope_p, slope_q = torch.maximum(slope_p, -values[p]), torch.minimum(slope_q, values[q])
        # Integral over x from t to 1/2 of what lies beyond the jump minus what lies before it, x counted from p.
        width = (0.5 - part.t)[:, None]
        at_p = values[q] - slope_q - values[p]
        moved = width * (at_p + (slope_q - slope_p) * (0.5 * (part.t + 0.5))[:, None])
        towards_p = (width > 0.0) * moved
        result = result.index_add(0, p, towards_p).index_add(0, q, moved - towards_p)
    return result
