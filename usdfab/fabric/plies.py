"""How round plies lie in a yarn's round cross-section: the touching circles of a plied yarn."""

from __future__ import annotations

import math


def ply_circles(count: int) -> tuple[float, float]:
    """Radius of each ply, and distance of its centre from the yarn's axis, both in yarn radii.

    The ``count`` equal circles touch the yarn's circle from inside and, from two plies on, their two neighbours:
    with ``s = sin(pi / count)``, ``distance = 1 / (1 + s)`` and ``radius = s / (1 + s)``. One ply fills the yarn.
    """
    if count < 2:
        return 1.0, 0.0
    s = math.sin(math.pi / count)
    return s / (1.0 + s), 1.0 / (1.0 + s)


def ply_fill(count: int) -> float:
    """Fraction of the yarn's cross-section that lies inside its plies; 1 for one ply."""
    radius, _ = ply_circles(count)
    return count * radius * radius if count > 1 else 1.0
