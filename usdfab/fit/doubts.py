"""What in a photo makes a fit unsure: measured, with the parameters that it concerns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from usdfab.fit.analysis import PhotoAnalysis
from usdfab.fit.photo_input import Photo
from usdfab.imaging import linear_to_srgb, luminance

SAME_COLOR = 0.06
"""Distance in sRGB values (of 0 to 1, three channels) below which warp and weft have one colour."""

DARK = 0.02
"""Luminance of yarns, of 0 to 1, below which their shadows cannot be told from gaps and sensor noise counts."""

CLIPPED = 0.01
"""Fraction of pixels at the top of their range."""

BLURRED = 2.6
"""Decades of ``YarnSharpness.fine``; at most 2.45 in sharp photos of cloth, 2.3 to 3.1 after a blur of a deviation of 2
of 480 pixels, 4 and more after one of 4."""

FLAT = 0.5
"""Decades of ``fine_slope``: at least 0.6 in photos of cloth; 0.2 to 0.5 for half of them once sharpened by 1.5."""

DARK_RIMS = 0.01
"""Fraction of pixels that are black amid bright ones: at most 0.007 in photos of cloth. A halo's dark side, cut off."""

BLACK, BRIGHT_ABOUT, WINDOW = 1.5 / 255.0, 0.2, 7
"""sRGB value of black, mean sRGB value of its surroundings, and their side in pixels."""


@dataclass(frozen=True)
class Doubt:
    """A reason to be unsure.

    Parameters
    ----------
    cause:
        A short name: same colour, dark, clipped, blur, sharpening.
    said:
        A sentence with what was measured.
    parameters:
        Names of the parameters that it concerns, as in the parameter table, with ``warp.`` or ``weft.`` where it
        concerns one system; ``weave``.
    """

    cause: str
    said: str
    parameters: tuple[str, ...]

    @property
    def warning(self) -> str:
        """For people."""
        return f"{self.said}; uncertain: {', '.join(self.parameters)}"

    def as_table(self) -> dict[str, Any]:
        """For ``--json``."""
        return {"cause": self.cause, "said": self.said, "parameters": list(self.parameters)}


SURFACE = ("roughness_longitudinal", "roughness_azimuthal", "roughness_primary")


def find_doubts(photo: Photo, analysis: PhotoAnalysis) -> tuple[Doubt, ...]:
    """All that is found."""
    found = [_same_color(analysis), *_dark(analysis), _clipped(photo), _blurred(analysis), _sharpened(photo, analysis)]
    return tuple(doubt for doubt in found if doubt is not None)


def _same_color(analysis: PhotoAnalysis) -> Doubt | None:
    warp, weft = (linear_to_srgb(np.clip(s.colour, 0.0, 1.0)) for s in (analysis.warp, analysis.weft))
    apart = float(np.linalg.norm(warp - weft))
    if apart > SAME_COLOR:
        return None
    weave = () if analysis.weave_known else ("weave",)
    # Li et al. 2024, figure 21.
    return Doubt(
        "same colour",
        f"warp and weft have one colour (they are {apart:.3f} apart, sRGB): the direction of their fibers alone tells "
        "which is on top",
        (*weave, "albedo", "radius", "flattening", "crimp", "inclination"),
    )


def _dark(analysis: PhotoAnalysis) -> list[Doubt]:
    doubts = []
    for name, system in (("warp", analysis.warp), ("weft", analysis.weft)):
        light = float(luminance(system.colour))
        if light < DARK:
            parameters = tuple(f"{name}.{p}" for p in ("albedo", "radius", "flattening", "twist", *SURFACE))
            said = f"the {name} is dark (luminance {light:.3f} of 1): gaps, shadows and fibers can hardly be told apart"
            doubts.append(Doubt("dark", said, parameters))
    return doubts


def _clipped(photo: Photo) -> Doubt | None:
    high = photo.clipped[0]
    if high < CLIPPED:
        return None
    said = f"{100 * high:.0f} % of the photo's pixels are at the top of their range: highlights are cut off"
    return Doubt("clipped", said, ("albedo", *SURFACE))


def _blurred(analysis: PhotoAnalysis) -> Doubt | None:
    if analysis.detail is None or analysis.detail[1] < BLURRED:
        return None
    said = (
        "the photo is blurred for yarns of this size (detail of a sixth of their spacing has "
        f"{10 ** -analysis.detail[1]:.1g} of the power of that of two thirds; in sharp photos 0.004 or more)"
    )
    return Doubt("blur", said, ("twist", "fiber_count", "irregularity", "migration", "flyaway_density", *SURFACE))


def _sharpened(photo: Photo, analysis: PhotoAnalysis) -> Doubt | None:
    rims = _dark_rims(photo)
    flat = analysis.detail is not None and analysis.detail[2] < FLAT
    if not flat and rims < DARK_RIMS:
        return None
    measured = []
    if flat and analysis.detail is not None:
        measured.append(
            f"fine detail has {10 ** -analysis.detail[2]:.1g} of the power of coarse, elsewhere 0.25 or less"
        )
    if rims >= DARK_RIMS:
        measured.append(f"{100 * rims:.1f} % of the pixels are black amid bright ones")
    said = f"the photo looks sharpened, or is noisy ({'; '.join(measured)}): halos pass for shadows and highlights"
    return Doubt("sharpening", said, ("albedo", "radius", "fiber_count", "irregularity", *SURFACE))


def _dark_rims(photo: Photo) -> float:
    encoded = linear_to_srgb(np.clip(photo.pixels, 0.0, 1.0))
    about = ndimage.uniform_filter(encoded.mean(axis=2), WINDOW)
    return float(((encoded.max(axis=2) <= BLACK) & (about > BRIGHT_ABOUT)).mean())
