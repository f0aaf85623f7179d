"""The network's guess and the analysis of the same photo as one estimate, each as far as it may be trusted.

Counts and weaves are choices: both sides' probabilities are multiplied. What is measured is averaged with the inverse
variances as weights. Where the network is not better than the prior's mean it does not speak.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, FabricParameters, Weave, YarnParameters
from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fit.analysis import PhotoAnalysis
from usdfab.fit.network.labels import LABELS, typical_weave, weave_label
from usdfab.fit.network.predict import Guess
from usdfab.fit.network.targets import INDEX, NAMES, Floats, decode, encode
from usdfab.fit.priors import MIN_CONFIDENCE

COUNT_TRUST = (0.5, 0.97)
WEAVE_TRUST = (0.55, 0.85)
"""Chance that the analysis is right at confidence 0 and 1. On renders outside the test part its counts are right where
it is unsure, too; on fifteen labelled photos four of seven unsure ones are. Its exact weave is wrong in a fifth of the
renders where it is sure (2/2 for 3/1 twill, say)."""

COUNT_DOUBT = 0.06
WEAVE_DOUBT = 0.15
"""Chance that the network's probabilities say nothing, because a photo is unlike all that it has learned from. On the
labelled photos one of seventeen counts that it is sure of is wrong."""

SAME_COUNT = 0.1
"""Counts whose logarithms are closer are the same answer."""

ANALYSIS_SIGMA = {"count": 0.01, "cover": 0.2, "twist": 2.0}
"""Deviations, in the targets' numbers, of what the analysis measures where it is confident."""

MIN_SKILL = 0.8
"""Targets whose error on validation is not below this part of the prior's are left to the analysis and the priors."""

BETTER_THAN_ASSUMED = ("height", "crimp", "fiber_count")
"""Targets that ``priors`` assumes worse than the network, which is heard on them as soon as it is better than the
prior's mean: on ten held-out renders of the wide prior the assumed ones were off by 13.4, 18.8 and 29.8 % of six
deviations of the prior, the network by 8.7, 13.8 and 15.0 %."""

NEVER = ("albedo_r", "albedo_g", "albedo_b", "packing")
"""Not taken from the network: colours are found by rendering, and the packing is no matter of pictures."""

PLIED = 0.6
"""Estimate of ``plied`` from which a yarn is taken as plied."""

PLY_UNTWIST = -0.7
"""Twist of the fibers in a ply over that of the plies, of plied yarns that only the network has seen."""

LOWEST_FLYAWAYS = 0.3
"""Flyaways per cell below which a yarn is left smooth."""


@dataclass(frozen=True, eq=False)
class Combined:
    """One estimate of both.

    Parameters
    ----------
    weave, label, weave_confidence:
        The analysis' weave where both agree on its label, else the typical weave of the label.
    counts: (2,)
        Yarns of warp and weft across the whole photo; ``count_confidence`` (2,) probabilities.
    values, sigma: (2, P)
        Targets and their deviations; infinite where neither side knows anything.
    notes:
        Sentences for people.
    """

    weave: Weave
    label: str
    weave_confidence: float
    counts: Floats
    count_confidence: Floats
    values: Floats
    sigma: Floats
    notes: tuple[str, ...]


def combine(guess: Guess, analysis: PhotoAnalysis, shown: FabricParameters, skill: Mapping[str, float]) -> Combined:
    """The estimate of both.

    Parameters
    ----------
    shown:
        ``priors.fabric_from_analysis`` of the same analysis.
    skill:
        ``Weights.skill``.
    """
    notes: list[str] = []
    counts, count_odds, moved = np.zeros(2), np.zeros(2), False
    for row, system in enumerate(SYSTEMS):
        seen = getattr(analysis, system)
        if analysis.counts_known:
            counts[row], count_odds[row] = seen.count, 1.0
            continue
        counts[row], count_odds[row] = combined_count(guess, row, seen.count, seen.count_confidence)
        if abs(math.log(counts[row] / seen.count)) > SAME_COUNT:
            moved = True
            notes.append(f"the network sees {counts[row]:.1f} yarns of the {system}, the analysis {seen.count:.1f}")
    # A weave read on a wrong lattice is no evidence.
    confidence = 0.0 if moved else analysis.weave_confidence
    mine = weave_label(analysis.weave)
    # Neither is the network's, on its own lattice.
    other_lattice = bool((np.abs(np.log(counts / guess.counts)) > SAME_COUNT).any())
    seen_weave = np.full(len(LABELS), 1.0 / len(LABELS)) if other_lattice and not moved else guess.weave
    odds = combined_weave(seen_weave, mine, confidence, trusted=not moved)
    if analysis.weave_known:
        odds = np.array([float(label == mine) for label in LABELS])
    label = LABELS[int(odds.argmax())]
    weave = analysis.weave
    if label != mine:
        weave = typical_weave(label)
        notes.append(f"the network takes the weave for {label.replace('_', ' ')}, the analysis for {mine}")
    values, sigma = _values(guess, analysis, shown, skill)
    values[:, INDEX["count"]] = np.log(counts)
    return Combined(weave, label, float(odds.max()), counts, count_odds, values, sigma, tuple(notes))


def combined_count(guess: Guess, row: int, count: float, confidence: float) -> tuple[float, float]:
    """The count of one system (0 warp, 1 weft) and its probability, from the guess and the analysis' count."""
    axis = np.log(guess.count_axis[row])
    mine = (1.0 - COUNT_DOUBT) * guess.count_odds[row] + COUNT_DOUBT / len(axis)
    right = _trust(COUNT_TRUST, confidence)
    near = np.exp(-0.5 * ((axis - math.log(count)) / 0.03) ** 2)
    total = near.sum()
    other = (right * near / total if total > 1e-12 else 0.0) + (1.0 - right) / len(axis)
    odds = mine * other / (mine * other).sum()
    # Neighbouring bins are one answer.
    smooth = np.convolve(odds, np.ones(5), mode="same")
    best = math.exp(axis[int(smooth.argmax())])
    probability = float(odds[np.abs(axis - math.log(best)) < SAME_COUNT].sum())
    for candidate in (count, float(guess.counts[row])):
        if abs(math.log(candidate / best)) < SAME_COUNT:
            return candidate, probability
    return best, probability


def combined_weave(odds: Floats, label: str, confidence: float, *, trusted: bool = True) -> Floats:
    """Probabilities (L,) of the weave, from the network's and the analysis' label; without it if not ``trusted``."""
    mine = (1.0 - WEAVE_DOUBT) * odds + WEAVE_DOUBT / len(LABELS)
    right = _trust(WEAVE_TRUST, confidence) if trusted else 1.0 / len(LABELS)
    other = np.full(len(LABELS), (1.0 - right) / (len(LABELS) - 1))
    other[LABELS.index(label)] = right
    both = mine * other
    return np.asarray(both / both.sum())


def average(first: Floats, first_sigma: Floats, second: Floats, second_sigma: Floats) -> tuple[Floats, Floats]:
    """Inverse-variance mean of two independent estimates and its deviation; an infinite deviation has no weight."""
    weights = [np.where(np.isfinite(s), 1.0 / np.square(s), 0.0) for s in (first_sigma, second_sigma)]
    total = weights[0] + weights[1]
    known = total > 0.0
    safe = np.where(known, total, 1.0)
    mean = (weights[0] * first + weights[1] * second) / safe
    return np.where(known, mean, first), np.where(known, 1.0 / np.sqrt(safe), np.inf)


def speaks(skill: Mapping[str, float]) -> NDArray[np.bool_]:
    """(P,) Which targets the network is heard on."""
    limits = {name: 1.0 if name in BETTER_THAN_ASSUMED else MIN_SKILL for name in NAMES}
    return np.array([skill.get(name, 1.0) < limits[name] and name not in NEVER for name in NAMES])


def analysis_values(analysis: PhotoAnalysis, shown: FabricParameters) -> tuple[Floats, Floats]:
    """Targets (2, P) as the analysis measures them, priors where it does not, and deviations, infinite for priors."""
    values, _ = encode(shown)
    sigma = np.full(values.shape, np.inf)
    for row, system in enumerate(SYSTEMS):
        seen = getattr(analysis, system)
        values[row, INDEX["count"]] = math.log(seen.count)
        sure = {
            "count": seen.count_confidence,
            "cover": seen.width_confidence if seen.width < 0.97 else 0.0,
            "twist": seen.twist_confidence,
        }
        for name, confidence in sure.items():
            if confidence >= MIN_CONFIDENCE or name == "count":
                sigma[row, INDEX[name]] = ANALYSIS_SIGMA[name] / max(confidence, 0.05)
    return values, sigma


def _values(
    guess: Guess, analysis: PhotoAnalysis, shown: FabricParameters, skill: Mapping[str, float]
) -> tuple[Floats, Floats]:
    theirs, their_sigma = analysis_values(analysis, shown)
    mine_sigma = np.where(speaks(skill), guess.sigma, np.inf)
    # Where neither measures, the analysis' prior stays.
    return average(theirs, their_sigma, guess.values, mine_sigma)


def fabric_of(shown: FabricParameters, combined: Combined, heard: NDArray[np.bool_]) -> FabricParameters:
    """The fabric of an estimate; colours and what nobody has measured are those of ``shown``.

    Parameters
    ----------
    heard: (P,)
        ``speaks`` of the network.
    """
    found = decode(combined.values)
    known = {name: bool(heard[k]) for k, name in enumerate(NAMES)}
    yarns: dict[Any, YarnParameters] = {}
    for row, (system, side) in enumerate(zip(SYSTEMS, shown.size, strict=True)):
        old = shown.system(system)
        spacing = side / float(combined.counts[row])
        scale = spacing / (side / old.count)
        values: dict[str, float] = {"count": float(combined.counts[row]), "radius": old.radius * scale}
        if abs(math.log(scale)) > SAME_COUNT:
            # Yarn by yarn colours belong to the lattice that was given up.
            values["yarn_albedo"] = ()  # type: ignore[assignment]
        if known["cover"]:
            flattening = float(found["flattening"][row]) if known["height"] else old.flattening
            values["flattening"] = _soft("flattening", flattening)
            values["radius"] = 0.5 * float(found["cover"][row]) * spacing / values["flattening"]
        if known["fiber_count"]:
            values["fiber_count"] = round(_soft("fiber_count", float(found["fiber_count"][row])))
        for name in ("inclination", "crimp", "irregularity", "migration", "migration_rate", *_ROUGHNESSES):
            if known[name]:
                values[name] = _soft(name, float(found[name][row]))
        plied = known["plied"] and float(found["plied"][row]) > PLIED
        if known["twist"]:
            limit = 1.0 if plied else 0.6
            values["twist"] = float(np.clip(found["twist"][row], -limit, limit))
        if plied:
            values["ply_count"] = 2
            values["ply_twist"] = PLY_UNTWIST * values.get("twist", old.twist)
        if known["flyaways"] and float(found["flyaways"][row]) > LOWEST_FLYAWAYS:
            values["flyaway_density"] = float(found["flyaways"][row]) / spacing
            values["flyaway_length"] = _soft("flyaway_length", 1.2 * spacing)
        yarns[system] = replace(old, **values)  # type: ignore[arg-type]
    return replace(shown, weave=combined.weave).with_systems(yarns)


_ROUGHNESSES = ("roughness_longitudinal", "roughness_azimuthal", "roughness_primary")


def _soft(name: str, value: float) -> float:
    low, high = PARAMETER_BY_NAME[name].soft
    return min(max(value, low), high)


def _trust(ends: tuple[float, float], confidence: float) -> float:
    return ends[0] + (ends[1] - ends[0]) * min(max(confidence, 0.0), 1.0)
