"""Random fabrics from Table 4 of Li et al. 2024, with the paper's impossible combinations rejected."""

from __future__ import annotations

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric.distributions import Uniform
from usdfab.fabric.fabric import FabricParameters, YarnParameters
from usdfab.fabric.parameters import YARN_PARAMETERS
from usdfab.fabric.weave import NAMED_WEAVES, PAPER_WEAVES

COVER_RANGE = (0.75, 1.2)
"""Accepted width over spacing of each yarn system; outside, yarns overlap by half or form a loose grid."""

_SATIN_COVER = {"warp": Uniform(0.9, 1.1), "weft": Uniform(0.8, 1.1)}
_SATIN_WEFT_MIN_RADIUS = 0.02


def sample_fabric(weave: str, rng: np.random.Generator, side: float = 5e-3) -> FabricParameters:
    """A random fabric of one of the paper's seven weaves.

    Parameters
    ----------
    weave:
        One of ``PAPER_WEAVES``.
    rng:
        Source of randomness.
    side:
        Side of the square sample in metres; Table 4's lengths are relative to it.
    """
    if weave not in PAPER_WEAVES:
        raise UsdfabError(f"Table 4 has no weave '{weave}'", remedy=f"use one of {', '.join(PAPER_WEAVES)}")
    column = weave.removesuffix("_rot90")
    while True:
        fabric = FabricParameters(
            NAMED_WEAVES[weave],
            (side, side),
            warp=_draw(column, "warp", rng, side),
            weft=_draw(column, "weft", rng, side),
            seed=int(rng.integers(2**31)),
            name="Sampled",
        )
        if all(COVER_RANGE[0] <= fabric.cover(s) <= COVER_RANGE[1] for s in ("warp", "weft")):
            return fabric


def _draw(column: str, system: str, rng: np.random.Generator, side: float) -> YarnParameters:
    which = 0 if system == "weft" else 1
    values: dict = {}
    for parameter in YARN_PARAMETERS:
        if parameter.paper is None:
            continue
        distribution = parameter.paper[column][which]
        if parameter.kind == "color":
            values[parameter.name] = tuple(distribution.sample(rng) for _ in range(3))
        else:
            value = distribution.sample(rng)
            values[parameter.name] = round(value) if parameter.kind == "int" else value
    if column == "satin":
        if system == "weft":
            values["radius"] = max(values["radius"], _SATIN_WEFT_MIN_RADIUS)
        cover = _SATIN_COVER[system].sample(rng)
        values["flattening"] = cover / (2 * values["radius"] * values["count"])
    values["radius"] *= side
    # Q is not in Table 4 (the paper does not initialise it by the network): its whole range in stage 2 is (0, 1).
    values["irregularity"] = float(rng.uniform(0.0, 0.4))
    return YarnParameters(**values)
