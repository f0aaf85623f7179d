"""From what the photo shows to a whole fabric: measured numbers where there are any, priors for the rest.

The priors are typical values of woven cloth, not measurements: they are what later stages of the fit start from.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import Color, FabricParameters, YarnParameters
from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fit.analysis import PhotoAnalysis, YarnSystem

SATIN_FLATTENING, FLATTENING = 2.0, 1.3
"""Width over height of a yarn in cloth with long floats, and in other cloth."""

FIBER_RADIUS = 8e-6
"""Radius of a cotton fiber in metres; sets how many fibers a yarn gets."""

FIBER_COUNT_RANGE = (30, 250)
TWIST_PRIOR = 0.08
"""Turns per cell where the photo does not show the twist; spun yarn is Z-twisted as a rule."""

CLOSED_COVER = 1.04
"""Width over spacing of yarns between which no gap is seen: neighbours touch and are squeezed a little."""

MIN_CONFIDENCE = 0.3
"""Estimates less certain than this give way to the prior."""

MAX_REPEAT_CELLS = 1600
"""A yarn-dyed repeat that needs more crossings than this is left to its mean colour."""

VARIED_CELLS = 256
"""Crossings of all variants of the repeat together beyond which a yarn-dyed fabric gets fewer variants."""

ASSUMED = (
    "fiber_count", "crimp", "inclination", "migration", "migration_rate", "irregularity", "roughness_longitudinal",
    "roughness_azimuthal", "roughness_primary",
)  # fmt: skip
"""What a photo's analysis does not measure."""


def fabric_from_analysis(
    analysis: PhotoAnalysis, width: float, seed: int = 0, name: str = "Fabric"
) -> tuple[FabricParameters, tuple[str, ...]]:
    """A fabric of the photo's size with the photo's structure; albedo is the photo's colour, not yet inverted.

    Parameters
    ----------
    analysis:
        What the photo shows.
    width:
        Physical width of the photo in metres.

    Returns
    -------
    fabric, notes:
        Notes are sentences on what the numbers of a fabric cannot say of the photo.
    """
    rows, columns = analysis.shape
    pixel = width / columns
    size = (width, rows * pixel)
    long_floats = analysis.weave_class == "satin"
    systems = {}
    spacing = {"warp": analysis.warp.spacing * pixel, "weft": analysis.weft.spacing * pixel}
    for this, other in (("warp", "weft"), ("weft", "warp")):
        seen: YarnSystem = getattr(analysis, this)
        systems[this] = _yarn(seen, size[0 if this == "warp" else 1], spacing[this], spacing[other], long_floats)
    fabric = FabricParameters(analysis.weave, size, systems["warp"], systems["weft"], seed, name)
    fabric, dyed_note = _with_yarn_colors(fabric, analysis)
    return fabric, dyed_note


def assumed_notes(analysis: PhotoAnalysis, start: FabricParameters, fabric: FabricParameters) -> tuple[str, ...]:
    """Sentences on what is assumed in a fitted fabric: numbers that no stage has moved from ``fabric_from_analysis``.

    Parameters
    ----------
    start, fabric:
        What ``fabric_from_analysis`` made of the analysis, and what became of it.
    """

    def stays(name: str, system: str) -> bool:
        return bool(getattr(getattr(start, system), name) == getattr(getattr(fabric, system), name))

    notes = [
        f"twist of the {system} is a prior"
        for system in ("warp", "weft")
        if getattr(analysis, system).twist_confidence < MIN_CONFIDENCE and stays("twist", system)
    ]
    names = [name.replace("_", " ") for name in ASSUMED if stays(name, "warp") and stays(name, "weft")]
    if names:
        notes.append(f"{', '.join(names)}: not estimated, typical values")
    return tuple(notes)


def _yarn(seen: YarnSystem, side: float, spacing: float, other_spacing: float, long_floats: bool) -> YarnParameters:
    flattening = SATIN_FLATTENING if long_floats else FLATTENING
    cover = seen.width if seen.width < 0.97 and seen.width_confidence >= MIN_CONFIDENCE else CLOSED_COVER
    half_width = 0.5 * max(cover, 0.3) * spacing
    radius = half_width / flattening
    packing = PARAMETER_BY_NAME["packing"].default
    fibers = packing * half_width * radius / FIBER_RADIUS**2  # type: ignore[operator]
    twist = TWIST_PRIOR
    if seen.twist_confidence >= MIN_CONFIDENCE:
        # On top of the yarn a fiber moves across by 2 pi alpha f e per cell, and the cell is the other spacing long.
        twist = math.tan(np.clip(seen.fiber_angle, -0.8, 0.8)) * other_spacing / (2.0 * math.pi * half_width)
    return YarnParameters(
        count=side / spacing,
        radius=radius,
        flattening=flattening,
        fiber_count=int(np.clip(round(fibers), *FIBER_COUNT_RANGE)),
        inclination=0.7,
        crimp=0.5 if long_floats else 0.8,
        twist=float(np.clip(twist, -0.6, 0.6)),
        irregularity=0.25,
        albedo=clipped_color(seen.colour),
        roughness_longitudinal=0.45,
        roughness_azimuthal=0.15,
        roughness_primary=0.15,
    )


def clipped_color(color: NDArray | tuple) -> Color:
    """A measured colour within (0, 1), as the parameter table takes it."""
    red, green, blue = np.clip(np.asarray(color, dtype=float), 0.002, 0.995)
    return float(red), float(green), float(blue)


def _with_yarn_colors(fabric: FabricParameters, analysis: PhotoAnalysis) -> tuple[FabricParameters, tuple[str, ...]]:
    notes = []
    for this in ("warp", "weft"):
        sequence = getattr(analysis, this).colour_sequence
        if len(sequence) < 2:
            continue
        yarn = replace(fabric.system(this), yarn_albedo=tuple(clipped_color(c) for c in sequence))
        dyed = replace(fabric, **{this: yarn})  # type: ignore[arg-type]
        picks, ends = dyed.repeat()
        if picks * ends > MAX_REPEAT_CELLS:
            notes.append(f"the {this}'s colour sequence needs a repeat of {picks} x {ends}; its mean colour is used")
        else:
            # A long repeat needs no variants against repetition, and each costs as much memory as the repeat.
            fabric = replace(dyed, variants=max(1, min(dyed.variants, VARIED_CELLS // (picks * ends))))
    return fabric, tuple(notes)
