"""The 28 numbers of Li et al. 2024, section 5.3: which they are, their ranges, and what errors are divided by."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from usdfab.fabric import SYSTEMS
from usdfab.fabric.distributions import Clamped, Distribution, Normal, Uniform
from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fit.network.targets import Floats, decode

NUMBERS = (
    "twist", "radius", "fiber_count", "count", "migration", "migration_rate", "inclination", "crimp", "albedo_r",
    "albedo_g", "albedo_b", "roughness_longitudinal", "roughness_azimuthal", "roughness_primary",
)  # fmt: skip
"""Of each yarn system, in the paper's order; the radius is relative to the picture's side, as in Table 4."""

ROWS = {
    "C": ("albedo_r", "albedo_g", "albedo_b"), "gamma_M": ("roughness_longitudinal",),
    "gamma_M0": ("roughness_primary",), "gamma_N": ("roughness_azimuthal",), "alpha": ("twist",), "beta": ("crimp",),
    "u_max": ("inclination",), "e_yarn": ("radius",), "n": ("count",), "m": ("fiber_count",), "G": ("migration",),
    "Q": ("irregularity",),
}  # fmt: skip
"""Rows of Table 2 and what they average."""

PAPER_MEANS = {
    "weave": 0.0, "C": 5.43, "gamma_M": 6.01, "gamma_M0": 9.64, "gamma_N": 12.88, "alpha": 7.94, "beta": 2.29,
    "u_max": 11.49, "e_yarn": 1.69, "n": 2.42, "m": 1.88, "G": 3.14, "Q": 0.19,
}  # fmt: skip
"""Percent; means of Table 2 after all of the paper's stages."""


def table4(name: str, label: str, system: str) -> Distribution:
    """Table 4's distribution of a number of one of the paper's weaves; raises ``KeyError`` where there is none."""
    parameter = PARAMETER_BY_NAME["albedo" if name.startswith("albedo") else name]
    if parameter.paper is None:
        raise KeyError(name)
    return parameter.paper[label.removesuffix("_rot90")][0 if system == "weft" else 1]


def width(name: str, label: str, system: str) -> float:
    """What errors of Table 2 are divided by: the width of Table 4's range (6 sigma of a normal distribution).

    The irregularity is not in Table 4: the soft range.
    """
    try:
        return table4(name, label, system).width()
    except KeyError:
        low, high = PARAMETER_BY_NAME[name].soft
        return high - low


def _ends(distribution: Distribution) -> tuple[float, float]:
    if isinstance(distribution, Uniform):
        return distribution.low, distribution.high
    if isinstance(distribution, Normal):
        return distribution.mean - 3.0 * distribution.sigma, distribution.mean + 3.0 * distribution.sigma
    assert isinstance(distribution, Clamped)
    low, high = _ends(distribution.base)
    return distribution.scale * max(low, distribution.low), distribution.scale * high


def _range(name: str, system: str) -> tuple[float, float]:
    ends = [_ends(table4(name, label, system)) for label in ("plain", "twill0", "twill1", "satin")]
    return min(low for low, _ in ends), max(high for _, high in ends)


RANGES: Floats = np.array([[_range(name, system) for name in NUMBERS] for system in SYSTEMS])
"""(2, 14, 2): lower and upper end over all weaves, three sigma for normal distributions."""


def shares(values: Tensor) -> Tensor:
    """Where targets (B, 2, P) lie in ``RANGES``, (B, 28), clipped to 0 and 1."""
    found = decode(values.double().numpy())
    natural = np.stack([found[name] for name in NUMBERS], axis=-1)
    low, high = RANGES[..., 0], RANGES[..., 1]
    return torch.from_numpy(np.clip((natural - low) / (high - low), 0.0, 1.0)).float().flatten(1)


def numbers(found: Tensor) -> dict[str, Floats]:
    """The 14 numbers in their units by name, each (B, 2), of shares (B, 28)."""
    natural = RANGES[..., 0] + (RANGES[..., 1] - RANGES[..., 0]) * found.double().numpy().reshape(-1, 2, len(NUMBERS))
    return {name: natural[..., k] for k, name in enumerate(NUMBERS)}
