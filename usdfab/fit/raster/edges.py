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
    right = np.hstack([number[:, 1:], number[:, -2:-1]])
    return (
        Pairs(number[:, :-1].ravel(), number[:, 1:].ravel(), below[:, :-1].ravel()),
        Pairs(number[:-1].ravel(), number[1:].ravel(), right[:-1].ravel()),
    )


def crossing(at_p: Tensor, at_q: Tensor) -> Tensor:
    """t in [0, 1] where a jump function that runs straight from ``at_p`` to ``at_q`` passes zero."""
    difference = at_q - at_p
    safe = torch.where(difference.abs() > 1e-9, difference, torch.full_like(difference, 1e-9))
    return (-at_p / safe).clamp(0.0, 1.0)


def blended(values: Tensor, parts: list[tuple[Pairs, Tensor]]) -> Tensor:
    """Values of pixels (N, C), those of pairs blended by where the jumps between them lie.

    Parameters
    ----------
    parts:
        Pairs and t (M,) in [0, 1], counted from ``pairs.p``; all blend the values as they were.
    """
    result = values
    for pairs, t in parts:
        p, q = torch.from_numpy(pairs.p), torch.from_numpy(pairs.q)
        difference = values[q] - values[p]
        result = result.index_add(0, p, (0.5 - t).clamp_min(0.0)[:, None] * difference)
        result = result.index_add(0, q, (0.5 - t).clamp_max(0.0)[:, None] * difference)
    return result
