"""What is taken for granted where a photo shows nothing and the person wants a fabric all the same."""

from __future__ import annotations

import numpy as np

from usdfab.fabric.weave import weave_from_name
from usdfab.fit.analysis.features import Array
from usdfab.fit.analysis.result import PhotoAnalysis, YarnSystem

YARNS = 12.0
"""Along the shorter side of the photo."""


def assumed_analysis(photo: Array, why: str) -> PhotoAnalysis:
    """A plain weave in the mean colour of a photo (H, W, 3), all confidences 0; ``why`` is its warning."""
    rows, columns = photo.shape[:2]
    spacing = min(rows, columns) / YARNS
    colour = photo.mean(axis=(0, 1))

    def system(side: int) -> YarnSystem:
        count = side / spacing
        yarns = np.tile(colour, (max(1, round(count)), 1))
        return YarnSystem(
            count=count, spacing=spacing, count_confidence=0.0, width=1.0, width_confidence=0.0, colour=colour,
            colour_confidence=0.0, yarn_colours=yarns, colour_sequence=colour[None], twist="none", fiber_angle=0.0,
            twist_confidence=0.0,
        )  # fmt: skip

    weave = weave_from_name("plain")
    return PhotoAnalysis(
        shape=(rows, columns), warp=system(columns), weft=system(rows), rotation=0.0, skew=0.0, rotation_confidence=0.0,
        gap_cover=0.0, gap_confidence=0.0, weave=weave, weave_class=weave.classify(), weave_confidence=0.0,
        lattice_confidence=0.0,
        warnings=(why, f"Nothing was measured: a plain weave of {YARNS:g} yarns along the shorter side is assumed."),
    )  # fmt: skip
