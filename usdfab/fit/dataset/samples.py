"""What sample number i of a data set is: a pure function of (seed, prior, i), whoever asks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fabric.sampling import sample_fabric
from usdfab.fabric.sampling_weaves import weave_class
from usdfab.fabric.sampling_wide import sample_class, sample_wide
from usdfab.fabric.weave import PAPER_WEAVES
from usdfab.fibers.fibers import closed_twist
from usdfab.fibers.tiles import tile_copies
from usdfab.fit.dataset.views import SampleView, paper_view, sample_view, unrepeated

Prior = Literal["paper", "wide"]
PRIORS: tuple[Prior, Prior] = ("paper", "wide")
CHOICES = (*PRIORS, "both")

MAX_INDEX = 10**6
"""Samples are numbered below this."""


@dataclass(frozen=True)
class Sample:
    """A fabric and how it is looked at. ``label`` is its class, one of ``sampling_weaves.CLASSES``."""

    index: int
    prior: Prior
    label: str
    fabric: FabricParameters
    view: SampleView


def draw_sample(choice: str, seed: int, index: int) -> Sample:
    """Sample ``index`` of the data set with this seed.

    With ``both``, even samples come from Table 4 and odd ones from the wide prior. Table 4's seven weaves take turns,
    so that any run of seven of its samples holds each once.

    Raises
    ------
    UsdfabError
        For a prior that does not exist, and a negative seed or index.
    """
    if choice not in CHOICES:
        raise UsdfabError(f"there is no '{choice}'", place="--prior", remedy=f"choose {', '.join(CHOICES)}")
    if seed < 0 or not 0 <= index < MAX_INDEX:
        raise UsdfabError(f"seed {seed} or index {index} is out of range", remedy=f"stay from 0 to {MAX_INDEX - 1}")
    number = index // 2 if choice == "both" else index
    prior: Prior = PRIORS[index % 2] if choice == "both" else choice  # type: ignore[assignment]
    rng = np.random.default_rng([seed, PRIORS.index(prior), number])
    if prior == "paper":
        label = PAPER_WEAVES[number % len(PAPER_WEAVES)]
        fabric = replace(sample_fabric(label, rng), variants=1)
        return Sample(index, prior, label, fabric, paper_view(fabric))
    fabric = _closed(sample_wide(sample_class(rng), rng))
    return Sample(index, prior, weave_class(fabric.weave), fabric, sample_view(fabric, rng))


def _closed(fabric: FabricParameters) -> FabricParameters:
    """``fabric`` with the twists of plied yarns that its tile really gets, so that labels are true."""
    tile = unrepeated(fabric)
    across, up = tile_copies(tile)
    picks, ends = tile.repeat()
    length = {"weft": ends * across, "warp": picks * up}
    yarns = {}
    for system in SYSTEMS:
        yarn = fabric.system(system)
        if yarn.ply_count > 1:
            yarns[system] = replace(yarn, twist=closed_twist(yarn.twist, length[system], yarn.ply_count))
    return fabric.with_systems(yarns)
