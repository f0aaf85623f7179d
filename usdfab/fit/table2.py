"""Table 2 of Li et al. 2024: how far a recovered fabric's parameters are from the truth, and the paper's own numbers.

An error is |estimate - truth| over the width of the parameter's range in Table 4 (6 sigma for a normal distribution),
averaged over the yarn systems and, for colours, the channels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, FabricParameters, System
from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fit.match_space import MOVES

SYMBOLS = {
    "albedo": "C",
    "roughness_longitudinal": "gamma_M",
    "roughness_primary": "gamma_M0",
    "roughness_azimuthal": "gamma_N",
    "twist": "alpha",
    "crimp": "beta",
    "inclination": "u_max",
    "radius": "e_yarn",
    "count": "n",
    "fiber_count": "m",
    "migration": "G",
    "irregularity": "Q",
}
"""The rows of the table below the weave, in its order: names of ``YarnParameters`` and the paper's symbols."""

PAPER_FABRICS = tuple(f"{family}{k}" for family in ("plain", "twill", "satin") for k in (1, 2, 3))
"""The paper's columns."""

PAPER_ERRORS: dict[str, tuple[float, ...]] = {
    "albedo": (0.66, 6.58, 4.03, 4.28, 9.13, 3.84, 5.09, 11.24, 4.06),
    "roughness_longitudinal": (13.60, 14.75, 5.70, 11.85, 4.55, 2.93, 0.05, 0.23, 0.41),
    "roughness_primary": (8.05, 5.92, 12.93, 34.34, 7.73, 15.57, 0.95, 0.32, 0.93),
    "roughness_azimuthal": (28.42, 6.02, 19.19, 5.92, 5.82, 19.79, 14.64, 12.81, 3.35),
    "twist": (3.21, 5.63, 8.23, 11.50, 9.57, 3.71, 10.49, 13.87, 5.29),
    "crimp": (4.00, 3.08, 1.01, 1.83, 1.17, 5.54, 2.38, 1.46, 0.17),
    "inclination": (10.11, 9.04, 27.61, 2.43, 3.46, 11.93, 19.25, 14.00, 5.61),
    "radius": (0.60, 0.92, 1.22, 2.37, 2.43, 6.03, 0.05, 1.38, 0.22),
    "count": (0.50, 2.25, 1.00, 0.75, 0.38, 1.88, 2.13, 10.63, 2.25),
    "fiber_count": (1.17, 2.22, 0.87, 2.81, 4.09, 2.74, 0.63, 0.64, 1.76),
    "migration": (4.10, 1.94, 2.50, 6.81, 3.89, 2.64, 3.68, 1.81, 0.90),
    "irregularity": (0.21, 0.21, 0.27, 0.08, 0.35, 0.14, 0.20, 0.07, 0.14),
}
"""Percent for each of ``PAPER_FABRICS``. All nine weaves were right."""

PAPER_MEANS = {name: round(sum(values) / len(values), 2) for name, values in PAPER_ERRORS.items()}
"""Percent, over the paper's nine fabrics after all three of its stages."""


def column_of(weave: str) -> str:
    """The column of Table 4 that one of ``PAPER_WEAVES`` is drawn from."""
    return weave.removesuffix("_rot90")


def range_width(name: str, weave: str, system: System) -> float:
    """Width of a parameter's range: Table 4's in the weave (6 sigma for a normal distribution), else the soft range.

    The radius' is relative to the sample's side.
    """
    parameter = PARAMETER_BY_NAME[name]
    if parameter.paper is None:
        return parameter.soft[1] - parameter.soft[0]
    return parameter.paper[column_of(weave)][0 if system == "weft" else 1].width()


def range_errors(
    fabric: FabricParameters, truth: FabricParameters, weave: str, names: Sequence[str] = tuple(SYMBOLS)
) -> dict[str, float]:
    """|estimate - truth| over the width of the range, a fraction, by name.

    Parameters
    ----------
    fabric:
        The estimate. Where it has several colours in a system, each of them is an estimate of the truth's one colour.
        Yarns are counted over the truth's size.
    truth:
        Drawn from Table 4.
    weave:
        The one of ``PAPER_WEAVES`` that the truth is.
    names:
        Fields of ``YarnParameters``.
    """
    result = {}
    for name in names:
        parts = []
        for axis, system in enumerate(SYSTEMS):  # ends are counted along x, picks along y
            # Table 4's lengths are relative to the sample's side.
            width = range_width(name, weave, system) * (truth.size[0] if name == "radius" else 1.0)
            found, right = (_values(f, system, name) for f in (fabric, truth))
            if name == "count":
                found = found * truth.size[axis] / fabric.size[axis]
            parts.append(float(np.abs(found - right).mean()) / width)
        result[name] = float(np.mean(parts))
    return result


def _values(fabric: FabricParameters, system: System, name: str) -> NDArray[np.float64]:
    yarn = fabric.system(system)
    return np.atleast_1d(np.asarray(yarn.colors() if name == "albedo" else getattr(yarn, name), dtype=np.float64))


def never_estimated(stages: Sequence[str], twist_seen: bool = True) -> tuple[str, ...]:
    """Rows of the table that none of these stages of ``usdfab fit`` estimates: there the fit still has its prior.

    Parameters
    ----------
    stages:
        Those that ran so far.
    twist_seen:
        Whether the analysis saw how the fibers of any yarns run; where it did not, its twist is a prior too.
    """
    left = []
    for name in SYMBOLS:
        known = [stage for stage in stages if _estimates(stage, name)]
        if name == "twist" and not twist_seen:
            known = [stage for stage in known if stage != "analysis"]
        if not known:
            left.append(name)
    return tuple(left)


def _estimates(stage: str, name: str) -> bool:
    return name in MOVES if stage == "match" else stage in PARAMETER_BY_NAME[name].stages
