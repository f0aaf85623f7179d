"""Is there a woven lattice? What speaks for it, measured piece by piece, and a sentence on what is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from usdfab.fit.analysis.agreement import fold_agreement
from usdfab.fit.analysis.choose import Hypothesis
from usdfab.fit.analysis.features import LUMA_WEIGHTS, Array, Features
from usdfab.fit.analysis.rectify import SUB

LEAST_LATTICE = 0.15
"""Lattice confidence below which a photo is refused."""

LEAST_YARNS = 3.0
"""Of each system."""

ENOUGH_NATS = 8.0
"""Evidence for the crossings at which a weave is as likely as not."""

ENOUGH_COHERENCE, ENOUGH_AGREEMENT = 0.7, (0.70, 0.82)
"""Coherence of the yarn frequencies that counts in full; agreement of the quarters that counts for nothing, in full."""

ZIGZAG = 0.18
"""Lean of the fibers from column to column, in turn to the left and to the right, above which cloth is knitted; at most
0.05 in photos of woven cloth, 0.2 to 0.6 in knitted cloth that still looks like a lattice."""

TOO_BLURRED = 4.0
"""Decades of ``YarnSharpness.coarse`` above which nobody can tell crossings; at most 2.2 in sharp photos of cloth."""

SMOOTH = 3.0
"""Decades of ``fine_slope`` above which a picture without a lattice is called blurred."""


@dataclass(frozen=True)
class YarnSharpness:
    """Decades by which the spectrum falls towards fine detail, wavelengths being parts of the yarn spacing.

    ``coarse``: from the spacing to a third of it; 0.7 to 2.2 in sharp photos of cloth. ``fine``: from two thirds to a
    sixth; 1 to 2.4. More where a photo is blurred, less where it is noisy or strongly sharpened.
    """

    coarse: float
    fine: float


@dataclass(frozen=True)
class LatticeEvidence:
    """What speaks for a woven lattice.

    Parameters
    ----------
    nats:
        By how much the crossings are explained better by a weave than by chance.
    coherence:
        How well both yarn frequencies hold over the whole photo, [0, 1].
    agreement:
        Correlation of the interlacing between the quarters of the photo, [-1, 1].
    yarns: (across, down)
        Of the best lattice.
    zigzag:
        See ``ZIGZAG``.
    slope:
        See ``fine_slope``.
    sharpness:
        At the scale of the yarns.
    """

    nats: float
    coherence: float
    agreement: float
    yarns: tuple[float, float]
    zigzag: float
    slope: float
    sharpness: YarnSharpness

    @property
    def confidence(self) -> float:
        """How surely there is a woven lattice, [0, 1].

        These must come together: the crossings make sense as a weave, both yarn frequencies hold over the whole photo,
        each quarter of the photo shows the repeat of the others, there are enough yarns to tell (four each way), the
        columns do not zigzag as loops do, and the photo is not blurred beyond recognition.
        """
        evidence = 1 / (1 + np.exp(-(self.nats - ENOUGH_NATS) / 3.0))
        coherence = np.clip(self.coherence / ENOUGH_COHERENCE, 0, 1)
        low, high = ENOUGH_AGREEMENT
        agreement = np.clip((self.agreement - low) / (high - low), 0, 1)
        enough = np.clip((min(self.yarns) - 2) / 2, 0, 1)
        if self.zigzag > ZIGZAG or self.sharpness.coarse > TOO_BLURRED:
            return 0.0
        return float(evidence * coherence * agreement * enough)

    def problem(self) -> str:
        """Why there is no woven lattice, with what was measured; the weightiest reason first."""
        across, down = self.yarns
        if self.zigzag > ZIGZAG:
            reason = f"columns lean left and right in turn by {self.zigzag:.2f} of 1, as loops of knitted cloth do"
        elif self.sharpness.coarse > TOO_BLURRED:
            reason = (
                f"too blurred, detail of a third of the yarn spacing has 1e-{self.sharpness.coarse:.0f} of the yarns' "
                "power, where sharp photos have 1e-2 or more"
            )
        elif self.slope > SMOOTH:
            reason = f"too blurred or too smooth, fine detail has 1e-{self.slope:.0f} of the power of coarse detail"
        elif min(across, down) < LEAST_YARNS:
            reason = f"too few yarns are seen, {across:.1f} across and {down:.1f} down"
        elif self.agreement < ENOUGH_AGREEMENT[0]:
            reason = "no repeat, or too few yarns to tell: quarters of the photo do not show the same pattern"
        else:
            reason = "nothing repeats in two directions the way crossing yarns do"
        return (
            f"no woven lattice found: {reason} (best lattice {across:.1f} x {down:.1f} yarns; evidence for a weave "
            f"{self.nats:.1f} of {ENOUGH_NATS:g} nats, spacing holds to {self.coherence:.2f} of {ENOUGH_COHERENCE:g}, "
            f"quarters agree to {self.agreement:.2f} of {ENOUGH_AGREEMENT[1]:g})"
        )


def lattice_evidence(features: Features, best: Hypothesis, given: bool = False) -> LatticeEvidence:
    """The evidence for a hypothesis; a weave that was ``given`` need not repeat on the photo: it agrees with itself."""
    h, w = features.luma.shape
    yarns = (abs(best.warp.fx) * w, abs(best.weft.fy) * h)
    return LatticeEvidence(
        float(best.fit.score),
        float(np.sqrt(best.warp.coherence * best.weft.coherence)),
        1.0 if given else fold_agreement(features, best),
        yarns,
        zigzag(features, best),
        fine_slope(features),
        yarn_sharpness(features, float(np.sqrt(w / yarns[0] * h / yarns[1]))),
    )


def zigzag(features: Features, hypothesis: Hypothesis) -> float:
    """How much fibers lean to the left and right in turn from one column of cells (or row) to the next, [0, 1].

    A knitted loop has two legs, mirrored: a column of left ones, a column of right ones. Woven yarns of one system
    lean alike, by their twist. Returned is the amplitude, with a period of two cells, of the sine of twice the lean,
    the mean over all of a column, weighted by edges.
    """
    oy, ox = hypothesis.cells.offset
    rows, cols = hypothesis.cells.valid.shape
    valid = np.kron(hypothesis.cells.valid, np.ones((SUB, SUB)))
    jxx, jyy, jxy = hypothesis.grid.sample(features.tensor)[:, oy : oy + rows * SUB, ox : ox + cols * SUB] * valid
    amplitudes = []
    for axis in (0, 1):
        seen = valid.sum(axis) > 0.3 * valid.shape[axis]
        lean = ((2.0 * jxy).sum(axis) / ((jxx + jyy).sum(axis) + 1e-12))[seen]
        phase = np.pi * np.arange(len(lean)) / SUB
        amplitudes.append(2.0 * abs(((lean - lean.mean()) * np.exp(1j * phase)).mean()) if len(lean) else 0.0)
    return float(max(amplitudes))


def fine_slope(features: Features) -> float:
    """Decades by which the spectrum falls from a wavelength of 1/25 of the shorter side to 1/72."""
    side = min(features.luma.shape)
    return spectral_fall(_encoded_luma(features), side / 25.0, side / 72.0)


def yarn_sharpness(features: Features, spacing: float) -> YarnSharpness:
    """The sharpness of a photo whose yarns are ``spacing`` pixels apart, the mean of both systems."""
    luma = _encoded_luma(features)
    return YarnSharpness(
        spectral_fall(luma, spacing, spacing / 3.0), spectral_fall(luma, spacing / 1.5, spacing / 6.0)
    )  # fmt: skip


def spectral_fall(luma: Array, coarse: float, fine: float) -> float:
    """log10 of the ratio of the mean powers in the half octaves about two wavelengths in pixels."""
    h, w = luma.shape
    window = np.outer(np.hanning(h), np.hanning(w))
    power = np.abs(np.fft.rfft2((luma - luma.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(h)[:, None], np.fft.rfftfreq(w)[None, :])
    low, high = (
        power[(frequency > 2**-0.25 / wavelength) & (frequency < 2**0.25 / wavelength)].mean()
        for wavelength in (coarse, max(fine, 2.0))
    )
    return float(np.log10((low + 1e-20) / (high + 1e-20)))


def _encoded_luma(features: Features) -> Array:
    return np.asarray(features.encoded @ LUMA_WEIGHTS)
