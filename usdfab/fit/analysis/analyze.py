"""From one photo to :class:`PhotoAnalysis`: the steps in order, the confidences, the warnings, the refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from usdfab.errors import NoFabricError, UsdfabError
from usdfab.fabric.weave import Weave
from usdfab.fit.analysis.assumed import assumed_analysis
from usdfab.fit.analysis.choose import Hypothesis, rank_hypotheses
from usdfab.fit.analysis.evidence import LEAST_LATTICE, fine_slope, lattice_evidence
from usdfab.fit.analysis.features import Array, extract
from usdfab.fit.analysis.known import NOTHING, Known
from usdfab.fit.analysis.rectify import STEP, Phase
from usdfab.fit.analysis.result import PhotoAnalysis, YarnSystem
from usdfab.fit.analysis.yarns import Blocks, colour_sequence, cut, gap_mask, twist, widths, yarn_colours

LEAST_PIXELS = 64
"""Smallest side of a photo that is looked at."""
SIDE = (256, 560)
"""The shorter side is brought into this range of pixels; spacings are reported in pixels of the photo as given."""
LEAST_CONTRAST = 1e-3
"""Between the brightest and the darkest hundredth of the pixels, linear."""
CLEAR = 10.0
"""Nats of lead over the next different answer that count as clear."""


def analyze_photo(
    linear: ArrayLike, place: str = "photo", *, force: bool = False, known: Known = NOTHING
) -> PhotoAnalysis:
    """Estimate yarn counts, weave, colours, widths, gaps and twist of the woven cloth on one photo.

    Use it on a photo taken square to the cloth, yarns within about 15 degrees of the image axes, showing 3 to about 45
    yarns each way. It needs no training data. About 3 s for 480 x 480 pixels on one core.

    Parameters
    ----------
    linear: (H, W, 3) float
        Linear RGB in [0, 1], row 0 at the top. Values outside are clipped.
    place:
        What to call the photo in an error, usually its file name.
    force:
        Where no fabric is found, go on with the best guess and a warning that says so.
    known:
        What need not be found. A photo that looks more like another weave than the one that is given is not refused,
        but a warning says so.

    Raises
    ------
    NoFabricError
        If the photo has no contrast, or shows no woven lattice.
    UsdfabError
        If the array is no RGB photo, or smaller than 64 pixels.
    """
    photo = _checked(linear, place)
    light = photo.mean(2)
    contrast = float(np.quantile(light, 0.99) - np.quantile(light, 0.01))
    if contrast < LEAST_CONTRAST:
        problem = (
            f"the photo has no contrast (all black, all white or one colour): {contrast:.1g} of {LEAST_CONTRAST:g}"
        )
        if force:
            return assumed_analysis(photo, _forced(problem))
        raise NoFabricError(problem, place=place, remedy="check exposure and focus")
    scale = _working_scale(photo.shape)
    working = _resized(photo, scale)
    features = extract(working)
    ranked = rank_hypotheses(features, known)
    evidence = lattice_evidence(features, ranked[0], bool(known.weaves)) if ranked else None
    confidence = evidence.confidence if evidence else 0.0
    warnings: tuple[str, ...] = ()
    if confidence < LEAST_LATTICE:
        problem = evidence.problem() if evidence else (
            "no woven lattice found: no spacing repeats across and down (fine detail has "
            f"{10 ** fine_slope(features):.0f} times less power than coarse)"
        )  # fmt: skip
        # Who names the weave says that there is one.
        given = bool(known.weaves and ranked)
        if not force and not given:
            raise NoFabricError(
                problem,
                place=place,
                remedy="take a sharp photo square to the cloth that shows 5 to 40 yarns each way, or use --force",
            )
        if not ranked:
            return assumed_analysis(photo, _forced(problem))
        warnings = () if given else (_forced(problem),)
    best = ranked[0]
    if known.weaves:
        warnings += _contradiction(best, rank_hypotheses(features, Known(counts=known.counts)))
    blocks = cut(working, features, best)
    warp_f, weft_f = mean_frequency(best.warp), mean_frequency(best.weft)
    open_, gap_sure = gap_mask(blocks)
    warp_width, weft_width, gap_cover = widths(open_, blocks)
    tilts = (float(np.arctan2(warp_f[1], warp_f[0])), float(np.arctan2(-weft_f[0], weft_f[1])))
    h, w = working.shape[:2]
    count_sure = [1.0 if known.counts else count_confidence(ranked, axis) for axis in (0, 1)]
    warp = _system(False, blocks, w * warp_f[0], warp_f, scale, tilts[0], count_sure[0], warp_width, gap_sure)
    weft = _system(True, blocks, h * weft_f[1], weft_f, scale, tilts[1], count_sure[1], weft_width, gap_sure)
    weave, certain = whole_repeat(best)
    weave_sure = 1.0 if known.weaves else weave_confidence(ranked)
    partial = PhotoAnalysis(
        shape=(photo.shape[0], photo.shape[1]),
        warp=warp,
        weft=weft,
        rotation=-(tilts[0] + tilts[1]) / 2,
        skew=tilts[1] - tilts[0],
        rotation_confidence=confidence * min(1.0, 0.5 * (best.warp.coherence + best.weft.coherence)),
        gap_cover=gap_cover,
        gap_confidence=gap_sure * confidence,
        weave=weave,
        weave_class=weave.classify(),
        weave_confidence=weave_sure if certain or known.weaves else 0.5 * weave_sure,
        lattice_confidence=confidence,
        warnings=warnings,
        detail=(evidence.sharpness.coarse, evidence.sharpness.fine, evidence.slope) if evidence else None,
        weave_known=bool(known.weaves),
        counts_known=known.counts is not None,
    )
    return _with_warnings(partial)


def _contradiction(given: Hypothesis, free: list[Hypothesis]) -> tuple[str, ...]:
    """Where the photo clearly looks like another weave than the given one, a sentence that says so."""
    other = whole_repeat(free[0])[0]
    lead = free[0].score - given.score
    if lead < CLEAR or other.equivalent(whole_repeat(given)[0]):
        return ()
    return (
        f"The photo looks more like another weave than the one that was given: {other.classify()}, "
        f"{other.picks} x {other.ends} repeat, by {lead:.0f} nats.",
    )


def _forced(problem: str) -> str:
    return f"Forced: {problem}."


def count_confidence(ranked: list[Hypothesis], axis: int) -> float:
    """Confidence of the count of one system (0 warp, 1 weft): the lead over the best different count."""
    best = ranked[0]

    def frequency(item: Hypothesis) -> float:
        return item.warp.fx if axis == 0 else item.weft.fy

    others = [h.score for h in ranked if abs(np.log(frequency(h) / frequency(best))) > 0.08]
    lead = best.score - max(others, default=best.score - 2 * CLEAR)
    coherence = (best.warp if axis == 0 else best.weft).coherence
    return float(np.tanh(max(lead, 0) / CLEAR) * np.clip(coherence / 0.8, 0, 1))


def weave_confidence(ranked: list[Hypothesis]) -> float:
    """Confidence of the weave: the lead over the best hypothesis with another weave."""
    best, own = ranked[0], whole_repeat(ranked[0])[0]
    others = [h.score for h in ranked[1:] if not whole_repeat(h)[0].equivalent(own)]
    lead = best.score - max(others, default=best.score - 2 * CLEAR)
    return float(np.tanh(max(lead, 0) / CLEAR) * np.clip(best.fit.score / 20, 0, 1))


def whole_repeat(hypothesis: Hypothesis) -> tuple[Weave, bool]:
    """One reduced repeat starting at the lowest, leftmost whole crossing; and whether the photo shows all of it."""
    lattice, pattern = hypothesis.fit.lattice, np.asarray(hypothesis.fit.pattern)
    valid = hypothesis.cells.valid
    rows, cols = np.flatnonzero(valid.any(1)), np.flatnonzero(valid.any(0))
    matrix = np.roll(lattice.matrix(pattern), (-rows[0], -cols[0]), (0, 1))
    # Rolling the rectangle is exact: it is a whole repeat in both directions.
    shown = lattice.shape[0] <= len(rows) and lattice.shape[1] <= len(cols)
    return Weave(matrix, "estimated").reduced(), shown


def mean_frequency(phase: Phase) -> tuple[float, float]:
    """Yarn frequency (fx, fy) over the whole photo, cycles per pixel, with the mean slope of the phase field."""
    rows, cols = phase.field.shape
    y, x = np.mgrid[0:rows, 0:cols] * float(STEP)
    design = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    slope = np.linalg.lstsq(design, phase.field.ravel(), rcond=None)[0]
    return phase.fx + float(slope[0]), phase.fy + float(slope[1])


def _system(
    weft: bool,
    blocks: Blocks,
    count: float,
    frequency: tuple[float, float],
    scale: float,
    tilt: float,
    count_sure: float,
    width: float,
    width_sure: float,
) -> YarnSystem:
    colour, yarns, scatter = yarn_colours(blocks, weft)
    direction, angle, twist_sure = twist(blocks, weft, tilt)
    up = blocks.weft_up if weft else ~blocks.weft_up
    seen = int((up & blocks.valid).sum())
    return YarnSystem(
        count=float(count),
        spacing=float(1 / np.hypot(*frequency) / scale),
        count_confidence=count_sure,
        width=width,
        width_confidence=width_sure * count_sure,
        colour=colour,
        colour_confidence=float(np.clip(1 - scatter / 0.2, 0, 1) * np.clip(seen / 12, 0, 1)),
        yarn_colours=yarns,
        colour_sequence=colour_sequence(yarns),
        twist=direction,
        fiber_angle=angle,
        twist_confidence=twist_sure,
    )


def _checked(linear: ArrayLike, place: str) -> Array:
    photo: NDArray[np.float64] = np.asarray(linear, dtype=np.float64)
    if photo.ndim != 3 or photo.shape[2] != 3:
        raise UsdfabError(f"expected an RGB photo (H, W, 3), got an array of shape {photo.shape}", place=place)
    if min(photo.shape[:2]) < LEAST_PIXELS:
        raise UsdfabError(
            f"{photo.shape[1]} x {photo.shape[0]} pixels are too few",
            place=place,
            remedy=f"give a photo of at least {LEAST_PIXELS} pixels, better 480 pixels or more, each way",
        )
    if not np.isfinite(photo).all():
        raise UsdfabError("the photo holds values that are not finite", place=place)
    return np.clip(photo, 0.0, 1.0)


def _working_scale(shape: tuple[int, ...]) -> float:
    side = min(shape[:2])
    if side > SIDE[1]:
        return 480 / side
    return SIDE[0] / side if side < SIDE[0] else 1.0


def _resized(photo: Array, scale: float) -> Array:
    if scale == 1.0:
        return photo
    if scale < 1:
        photo = ndimage.gaussian_filter(photo, (0.4 / scale, 0.4 / scale, 0))
    h, w = (round(n * scale) for n in photo.shape[:2])
    y = (np.arange(h) + 0.5) * photo.shape[0] / h - 0.5
    x = (np.arange(w) + 0.5) * photo.shape[1] / w - 0.5
    grid = np.meshgrid(y, x, indexing="ij")
    return np.stack([ndimage.map_coordinates(photo[..., c], grid, order=1, mode="nearest") for c in range(3)], -1)


def _with_warnings(a: PhotoAnalysis) -> PhotoAnalysis:
    out = []
    if a.lattice_confidence < 0.6:
        out.append("The lattice of yarns is faint; treat all estimates as rough.")
    for name, system in (("warp (vertical yarns)", a.warp), ("weft (horizontal yarns)", a.weft)):
        if system.count_confidence < 0.4:
            out.append(f"The count of the {name}, {system.count:.1f}, could be wrong; another fits nearly as well.")
        if system.count < 4:
            out.append(f"Only {system.count:.1f} yarns of the {name} are seen; a wider view would be safer.")
        if system.colour_confidence < 0.4:
            out.append(f"The colour of the {name} varies much or is seldom seen.")
        if system.twist_confidence < 0.3:
            out.append(f"The twist of the {name} is not clear.")
    if a.weave_confidence < 0.4:
        out.append(f"The weave ({a.weave_class}, {a.weave.picks} x {a.weave.ends}) is uncertain.")
    if a.gap_confidence < 0.4:
        out.append("The yarns are dark: gaps and shadows cannot be told apart, the widths are guesses.")
    if abs(a.skew) > np.radians(6):
        out.append(f"The two yarn systems are {np.degrees(abs(a.skew)):.0f} degrees off a right angle.")
    return replace(a, warnings=(*a.warnings, *out))
