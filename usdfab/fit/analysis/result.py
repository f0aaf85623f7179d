"""What the analysis of a photo returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric.weave import Weave

Array = NDArray[np.float64]
Twist = Literal["S", "Z", "none"]


@dataclass(frozen=True)
class YarnSystem:
    """Estimates for the warp (vertical yarns) or the weft (horizontal yarns). Confidences are in [0, 1].

    Parameters
    ----------
    count: float
        Yarns crossed on a line over the photo: for the warp on a horizontal line over its width, for the weft on a
        vertical one over its height.
    spacing: float
        Distance between neighbouring yarns, at right angles to them, pixels.
    count_confidence: float
    width: float
        Width of a yarn as a fraction of the spacing, (0, 1]; 1 where no gap is seen.
    width_confidence: float
    colour: (3,)
        Mean colour where the system is on top, linear RGB of the photo.
    colour_confidence: float
    yarn_colours: (n, 3)
        The same yarn by yarn, linear RGB: ends from left to right, picks from bottom to top.
    colour_sequence: (p, 3)
        The smallest periodic description of ``yarn_colours``: (1, 3) for a solid system.
    twist: "S", "Z" or "none"
        Twist direction of the yarn surface.
    fiber_angle: float
        Angle of the surface fibers to the yarn axis, radians, positive for Z.
    twist_confidence: float
    """

    count: float
    spacing: float
    count_confidence: float
    width: float
    width_confidence: float
    colour: Array
    colour_confidence: float
    yarn_colours: Array
    colour_sequence: Array
    twist: Twist
    fiber_angle: float
    twist_confidence: float


@dataclass(frozen=True)
class PhotoAnalysis:
    """Everything read from one photo of woven cloth.

    Parameters
    ----------
    shape: (int, int)
        Rows and columns of the photo, pixels.
    warp, weft: YarnSystem
    rotation: float
        Rotation of the cloth in the photo, radians, positive counter-clockwise as seen.
    skew: float
        Angle between the two systems minus 90 degrees, radians: the tilt of the warp minus that of the weft,
        counter-clockwise.
    rotation_confidence: float
    gap_cover: float
        Fraction of the photo that is open between the yarns.
    gap_confidence: float
    weave: Weave
        One repeat, reduced. It starts at the lowest, leftmost whole crossing of the photo: row 0 at the bottom,
        1 = weft on top.
    weave_class: str
        ``weave.classify()``.
    weave_confidence: float
    lattice_confidence: float
        That the photo shows a woven lattice at all, with these two spacings.
    warnings: tuple of str
        Plain sentences about what is uncertain.
    detail: (float, float, float) or None
        How little fine detail there is, in decades of power: ``coarse`` and ``fine`` of ``evidence.YarnSharpness``, and
        ``evidence.fine_slope``.
    weave_known, counts_known: bool
        Whether these were given rather than found; their confidences are 1 then.
    """

    shape: tuple[int, int]
    warp: YarnSystem
    weft: YarnSystem
    rotation: float
    skew: float
    rotation_confidence: float
    gap_cover: float
    gap_confidence: float
    weave: Weave
    weave_class: str
    weave_confidence: float
    lattice_confidence: float
    warnings: tuple[str, ...]
    detail: tuple[float, float, float] | None = None
    weave_known: bool = False
    counts_known: bool = False

    @property
    def warp_count(self) -> float:
        """Vertical yarns counted across horizontally."""
        return self.warp.count

    @property
    def weft_count(self) -> float:
        """Horizontal yarns counted vertically."""
        return self.weft.count

    @property
    def matrix(self) -> NDArray[np.uint8]:
        """The weave matrix, (picks, ends) uint8."""
        return self.weave.matrix
