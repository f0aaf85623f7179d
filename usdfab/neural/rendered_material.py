"""Which material the networks are asked about for a cloth: one of those that they learned, seen from either side."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from usdfab.neural.surface_material import PAPER_GAP, SurfaceMaterial

LARGEST_TWIST = math.radians(30.0)


def reversed_material(material: SurfaceMaterial) -> SurfaceMaterial:
    """The cloth turned about its warp: what was below is on top, left is right; a twist stays what it is."""
    return replace(material, weave=~material.weave[:, ::-1])


def learned_material(material: SurfaceMaterial) -> tuple[SurfaceMaterial, float]:
    """A material among those that networks are trained on, and by how much more of the cloth its yarns should cover.

    Networks know one gap and twists up to 30 degrees (Table 2 of Chen et al. 2024).
    """
    twist = tuple(float(np.clip(t, -LARGEST_TWIST, LARGEST_TWIST)) for t in material.twist)
    known = replace(material, twist=(twist[0], twist[1]), gap=PAPER_GAP)
    return known, (1.0 - material.gap) / (1.0 - PAPER_GAP)
