"""How many points the fibers of a fabric's repeat take, and where that is too many.

Drafts can repeat after hundreds of ends and picks. The number of points is known before any is made, so that a repeat
that does not fit into memory is refused, or thinned, at once.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters, System, YarnParameters

MAX_PATCH_POINTS = 30_000_000
"""Most points on the fibers of all variants of a patch. Building takes about 170 bytes for each, 5 GB, and minutes."""

EASY_PATCH_POINTS = 12_000_000
"""What drafts are thinned to: 2 GB, half a minute on two cores."""

FEWEST_FIBERS = 6
"""Yarns are not thinned below this many fibers."""

PATH_TRACING_VERTICES = 40
"""Vertices per segment for path tracing (Li et al. 2024, section 6.1)."""


def patch_points(
    fabric: FabricParameters, vertices_per_segment: int = PATH_TRACING_VERTICES, copies: tuple[int, int] = (1, 1)
) -> int:
    """Points on all fibers of one variant of the patch, flyaways not counted."""
    return sum(
        max(fabric.system(s).fiber_count, fabric.system(s).ply_count) * _segments(fabric, s) for s in SYSTEMS
    ) * (vertices_per_segment * copies[0] * copies[1])


def _segments(fabric: FabricParameters, system: str) -> int:
    """Runs on one side of the cloth, over all yarns of the repeat."""
    picks, ends = fabric.repeat()
    matrix = fabric.weave.matrix if system == "weft" else fabric.weave.matrix.T
    changes = int((matrix != np.roll(matrix, 1, axis=1)).sum())
    return changes * (picks // fabric.weave.picks) * (ends // fabric.weave.ends)


def check_points(fabric: FabricParameters, vertices_per_segment: int, copies: tuple[int, int], variants: int) -> None:
    """Raise ``UsdfabError`` if so many variants of the patch have more than ``MAX_PATCH_POINTS`` points."""
    points = variants * patch_points(fabric, vertices_per_segment, copies)
    if points > MAX_PATCH_POINTS:
        picks, ends = fabric.repeat()
        raise UsdfabError(
            f"one repeat of {picks} picks and {ends} ends has {points:.2g} fiber points in {variants} variants, "
            f"above {MAX_PATCH_POINTS:.2g}",
            remedy="set fewer variants or a lower both.fiber_count, or choose colour sequences that fit the weave",
        )


def affordable_variants(
    fabric: FabricParameters, vertices_per_segment: int, copies: tuple[int, int], most: int | None = None
) -> int:
    """The fabric's number of variants, or as many as fit: a large repeat hardly needs any, the eye finds none in it."""
    points = patch_points(fabric, vertices_per_segment, copies)
    return max(1, min(fabric.variants, (most or MAX_PATCH_POINTS) // max(1, points)))


def thinned(fabric: FabricParameters) -> tuple[FabricParameters, tuple[str, ...]]:
    """``fabric`` within ``EASY_PATCH_POINTS``, and what was changed: first fewer variants, then fewer, thicker fibers.

    The filled part of each yarn's cross-section stays.

    Raises
    ------
    UsdfabError
        If even ``FEWEST_FIBERS`` in each yarn are too many.
    """
    points = patch_points(fabric)
    if points * fabric.variants <= EASY_PATCH_POINTS:
        return fabric, ()
    picks, ends = fabric.repeat()
    why = f"the repeat of {picks} picks and {ends} ends is large"
    variants = affordable_variants(fabric, PATH_TRACING_VERTICES, (1, 1), EASY_PATCH_POINTS)
    fabric = replace(fabric, variants=variants)
    if points * variants <= EASY_PATCH_POINTS:
        return fabric, (f"{why}: variants are set to {variants}",)
    share = EASY_PATCH_POINTS / points
    yarns: dict[System, YarnParameters] = {}
    for system in SYSTEMS:
        yarn = fabric.system(system)
        count = min(yarn.fiber_count, max(FEWEST_FIBERS, yarn.ply_count, math.floor(yarn.fiber_count * share)))
        thicker = yarn.fiber_radius * math.sqrt(yarn.fiber_count / count)
        yarns[system] = replace(yarn, fiber_count=count, fiber_radius=thicker)
    fabric = fabric.with_systems(yarns)
    check_points(fabric, PATH_TRACING_VERTICES, (1, 1), variants)
    counts = f"{yarns['warp'].fiber_count} fibers in each end and {yarns['weft'].fiber_count} in each pick"
    return fabric, (f"{why}: variants are set to 1, with {counts}; set both.fiber_count for close-ups",)
