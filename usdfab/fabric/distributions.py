"""The few distributions that Table 4 of Li et al. 2024 is written in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Distribution(Protocol):
    """What can be sampled, and how wide it is."""

    def sample(self, rng: np.random.Generator) -> float:
        """One draw."""
        ...

    def width(self) -> float:
        """Width of the range by which estimation errors are divided (six sigma for a normal distribution)."""
        ...


@dataclass(frozen=True)
class Uniform:
    """U(low, high)."""

    low: float
    high: float

    def sample(self, rng: np.random.Generator) -> float:
        return float(rng.uniform(self.low, self.high))

    def width(self) -> float:
        return self.high - self.low


@dataclass(frozen=True)
class Normal:
    """N(mean, sigma)."""

    mean: float
    sigma: float

    def sample(self, rng: np.random.Generator) -> float:
        return float(rng.normal(self.mean, self.sigma))

    def width(self) -> float:
        return 6.0 * self.sigma


@dataclass(frozen=True)
class Clamped:
    """``scale * max(base, low)``."""

    base: Normal
    low: float
    scale: float = 1.0

    def sample(self, rng: np.random.Generator) -> float:
        return self.scale * max(self.base.sample(rng), self.low)

    def width(self) -> float:
        return self.scale * self.base.width()
