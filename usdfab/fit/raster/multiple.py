"""Light that fibers scatter more than once, as the diffuse term that gives it: k_d as a function of C.

A picture with one scattering and a diffuse term (Li et al. 2024, eq. 10) can be explained by many pairs of C and k_d.
In cloth there is no choice: what light is left over after one scattering follows from C. Tied to it, k_d adds nothing
to be found, and the colours of the picture tell C.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float64]

LEAST = 1e-3
"""k_d below this is taken for this: its logarithm has an end."""


@dataclass(frozen=True, eq=False)
class DiffuseMap:
    """k_d of fibers with albedo C, measured for one cloth.

    Parameters
    ----------
    albedo: (L,)
        Rising, from 0 to 1.
    diffuse: (2, L)
        k_d of the fibers of warp and weft where all fibers have the albedo.
    crossing: (2,)
        What part of the logarithm of a system's k_d follows from the albedo of the other: light that has crossed over.
    system: (K,)
        0 for the warp's colours, 1 for the weft's.
    """

    albedo: Floats
    diffuse: Floats
    crossing: Floats
    system: NDArray[np.int64]

    def __call__(self, albedo: Tensor) -> Tensor:
        """k_d (K, 3) of colours with albedo (K, 3); differentiable. The other system counts with its mean."""
        means = [albedo[torch.from_numpy(self.system == k)].mean(dim=0) for k in range(2)]
        rows = []
        for row, k in enumerate(self.system.tolist()):
            own, other = (self._curve(k, c) for c in (albedo[row], means[1 - k]))
            # A product: light that has crossed over is taken by the other system's fibers and by the own ones.
            rows.append(own ** (1.0 - self.crossing[k]) * other ** self.crossing[k])
        return torch.stack(rows)

    def _curve(self, system: int, albedo: Tensor) -> Tensor:
        """Straight between the measured points."""
        xs, ys = torch.from_numpy(self.albedo), torch.from_numpy(self.diffuse[system])
        at = torch.searchsorted(xs, albedo.detach().contiguous()).clamp(1, len(xs) - 1)
        x, y = xs[at - 1], ys[at - 1]
        return (y + (albedo - x) / (xs[at] - x) * (ys[at] - y)).clamp(min=LEAST)


def crossing_part(own: Floats, other: Floats, seen: Floats) -> float:
    """x in [0, 1] with own^(1 - x) other^x nearest to ``seen`` in its logarithm, all (N,)."""
    a, b, c = (np.log(np.maximum(values, LEAST)) for values in (own, other, seen))
    return float(np.clip(np.dot(c - a, b - a) / max(float((b - a) @ (b - a)), 1e-12), 0.0, 1.0))
