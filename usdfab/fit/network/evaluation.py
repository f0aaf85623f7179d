"""The network judged on pictures that it has not learned from, alone and together with the analysis of the photo.

Samples of Table 4 are shown as they were rendered, as Li et al. 2024 do; their errors are those of Table 2, in percent
of the parameter's range. Samples of the wide prior are shown as cameras show them; their errors are in percent of six
standard deviations of the prior, in the numbers of ``targets``. Both are means over warp and weft.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fabric.weave import PAPER_WEAVES
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.fit.dataset.augment import photographed, sample_camera
from usdfab.fit.dataset.reader import read_dataset
from usdfab.fit.features import FeatureNet, fast_dtype
from usdfab.fit.network.combine import analysis_values, combine
from usdfab.fit.network.inputs import feature_net, prepared, texture_vectors
from usdfab.fit.network.labels import family_of, weave_label
from usdfab.fit.network.model import Paper, Robust
from usdfab.fit.network.network_file import Weights
from usdfab.fit.network.paper import ROWS, numbers, width
from usdfab.fit.network.predict import Guess, predict
from usdfab.fit.network.splits import split_of
from usdfab.fit.network.targets import NAMES, Floats, decode, encode
from usdfab.fit.network.views import scaled
from usdfab.fit.priors import fabric_from_analysis
from usdfab.srgb import srgb_to_linear

WAYS = ("prior", "analysis", "network", "combined")
"""Who estimates. ``prior``: the mean of the training part's fabrics of the same prior; where the analysis refuses a
picture, it counts as that."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Judged:
    """One sample.

    ``labels``: weave by way. ``errors``: by way and row of Table 2 (Table 4's samples) or target, fractions of the
    range. ``count_errors``: (2,) relative, by way. ``deviations``: (2, P) errors of the network over its sigma, not a
    number where there is nothing to know.
    """

    index: int
    table4: bool
    label: str
    labels: dict[str, str]
    errors: dict[str, dict[str, float]]
    count_errors: dict[str, Floats]
    deviations: Floats
    sigmas: Floats
    refused: bool


@dataclass(frozen=True, eq=False)
class Report:
    """All samples of the test part; ``scale`` (P,) are the wide prior's standard deviations."""

    samples: tuple[Judged, ...]
    scale: Floats
    training_samples: int
    about: dict[str, Any] = field(default_factory=dict)


def evaluate_network(
    weights: Weights,
    dataset: str | Path,
    *,
    analysis: bool = True,
    limit: int | None = None,
    net: FeatureNet | None = None,
    progress: Progress | None = None,
) -> Report:
    """Judge a network on the test part of a data set.

    Parameters
    ----------
    analysis:
        Also analyse each picture (some seconds each), and combine.
    limit:
        Only the first so many of the test part.

    Raises
    ------
    UsdfabError
        For a damaged data set, and one whose test part is empty.
    """
    net = net or feature_net(fast_dtype())
    stored = list(read_dataset(dataset))
    known: dict[bool, list[FabricParameters]] = {True: [], False: []}
    for one in stored:
        if split_of(one.index) == "train":
            known[one.sample.prior == "paper"].append(one.sample.fabric)
    tests = list(islice((s for s in stored if split_of(s.index) == "test"), limit))
    if isinstance(weights.network, Paper):
        tests = [s for s in tests if s.sample.prior == "paper"]
    if not tests or not all(known[s.sample.prior == "paper"] for s in tests):
        raise UsdfabError(
            "the data set has no test part, or nothing to compare it with", place=str(dataset),
            remedy="make more: usdfab dataset fabrics --count",
        )  # fmt: skip
    priors = {table4: _moments(fabrics) for table4, fabrics in known.items() if fabrics}
    judged = []
    for done, one in enumerate(tests):
        if progress:
            progress(done, len(tests))
        table4 = one.sample.prior == "paper"
        photo = one.image if table4 else _photo(one.image, one.index)
        seen = _analysis(photo) if analysis else None
        judged.append(_judge(weights, net, photo, one.sample.fabric, one.index, table4, priors[table4], seen))
    scale = priors[False][1] if False in priors else priors[True][1]
    return Report(tuple(judged), scale, sum(map(len, known.values())), weights.about)


def _moments(fabrics: list[FabricParameters]) -> tuple[Floats, Floats]:
    """Mean (2, P) and deviation (P,) of the targets of fabrics."""
    values, known = (np.stack(part) for part in zip(*(encode(f) for f in fabrics), strict=True))
    total = np.maximum(known.sum(axis=0), 1)
    mean = (values * known).sum(axis=0) / total
    every = np.maximum(known.sum(axis=(0, 1)), 1)
    middle = (values * known).sum(axis=(0, 1)) / every
    deviation = np.sqrt((np.square(values - middle) * known).sum(axis=(0, 1)) / every)
    return mean, np.maximum(deviation, 1e-3)


def _photo(image: NDArray[np.float32], index: int) -> NDArray[np.float32]:
    """A render as a random camera shows it, linear; the same for a sample every time."""
    rng = np.random.default_rng([index, 77])
    return srgb_to_linear(photographed(image, scaled(sample_camera(rng), image), rng))


def _analysis(photo: NDArray) -> tuple[PhotoAnalysis, FabricParameters] | None:
    # Renders may be brighter than white; a camera exposes for them.
    bright = float(np.quantile(photo, 0.99))
    try:
        found = analyze_photo(np.asarray(photo, dtype=np.float64) * (0.9 / bright if bright > 0.9 else 1.0))
    except UsdfabError:
        return None
    return found, fabric_from_analysis(found, 1e-3)[0]


def _judge(
    weights: Weights, net: FeatureNet, photo: NDArray, fabric: FabricParameters, index: int, table4: bool,
    prior: tuple[Floats, Floats], seen: tuple[PhotoAnalysis, FabricParameters] | None,
) -> Judged:  # fmt: skip
    truth, known = encode(fabric)
    label = weave_label(fabric.weave)
    labels: dict[str, str] = {"prior": "plain"}
    found: dict[str, dict[str, Floats]] = {"prior": decode(prior[0])}
    targets = {"prior": prior[0]}
    deviations = sigmas = np.full(truth.shape, np.nan)
    guess: Guess | None = None
    if isinstance(weights.network, Robust):
        guess = predict(photo, weights, net, table4=table4)
        labels["network"], found["network"] = guess.label, guess.natural()
        targets["network"] = guess.values
        deviations = np.where(known, (guess.values - truth) / guess.sigma, np.nan)
        sigmas = guess.sigma
    else:
        labels["network"], found["network"] = _paper_says(weights, net, photo)
    if seen is not None:
        labels["analysis"] = weave_label(seen[0].weave)
        targets["analysis"] = analysis_values(*seen)[0]
        found["analysis"] = decode(targets["analysis"])
        if guess is not None:
            both = combine(guess, *seen, weights.skill)
            labels["combined"] = both.label
            targets["combined"], found["combined"] = both.values, decode(both.values)
    elif guess is not None:
        labels["combined"] = guess.label
        targets["combined"], found["combined"] = guess.values, guess.natural()
    errors = {
        way: _table2(values, fabric, label) if table4 else _scaled(targets[way], truth, known, prior[1])
        for way, values in found.items()
    }
    counts = np.array([fabric.warp.count, fabric.weft.count])
    return Judged(
        index, table4, label, labels, errors, {way: values["count"] / counts - 1.0 for way, values in found.items()},
        deviations, sigmas, seen is None,
    )  # fmt: skip


def _paper_says(weights: Weights, net: FeatureNet, photo: NDArray) -> tuple[str, dict[str, Floats]]:
    network = weights.network
    assert isinstance(network, Paper)
    with torch.no_grad():
        texture = torch.from_numpy(texture_vectors(net, weights.basis, prepared(photo)[None]))
        logits, shares = network(texture)
    return PAPER_WEAVES[int(logits[0].argmax())], {name: value[0] for name, value in numbers(shares).items()}


def _table2(found: dict[str, Floats], fabric: FabricParameters, label: str) -> dict[str, float]:
    """Errors by row of Table 2, fractions of Table 4's ranges."""
    truth = decode(encode(fabric)[0])
    result = {}
    for row, names in ROWS.items():
        if not all(name in found for name in names):
            continue
        parts = [
            abs(float(found[name][k]) - float(truth[name][k])) / width(name, label, system)
            for name in names
            for k, system in enumerate(SYSTEMS)
        ]
        result[row] = float(np.mean(parts))
    return result


def _scaled(values: Floats, truth: Floats, known: NDArray[np.bool_], scale: Floats) -> dict[str, float]:
    """Errors by target, fractions of six deviations of the prior; targets without a meaning are left out."""
    error = np.where(known, np.abs(values - truth) / (6.0 * scale), np.nan)
    return {name: float(np.nanmean(error[:, k])) for k, name in enumerate(NAMES) if known[:, k].any()}


def weave_accuracy(samples: tuple[Judged, ...], way: str, *, family: bool = False) -> float:
    """Part of the samples whose label (or family) a way finds; a refusal is wrong."""
    right = 0
    for one in samples:
        found = one.labels.get(way)
        right += found is not None and (family_of(found) == family_of(one.label) if family else found == one.label)
    return right / len(samples) if samples else float("nan")


def mean_errors(samples: tuple[Judged, ...], way: str) -> dict[str, float]:
    """Mean error by row; where a way has refused a picture the prior's counts."""
    names = dict.fromkeys(name for one in samples for name in one.errors.get(way, one.errors["prior"]))
    result = {}
    for name in names:
        values = [e[name] for one in samples if name in (e := one.errors.get(way, one.errors["prior"]))]
        result[name] = float(np.mean(values))
    return result


def counts_within(samples: tuple[Judged, ...], way: str, tolerance: float) -> float:
    """Part of the counts within a relative tolerance; a refusal is wrong."""
    found = [np.abs(one.count_errors.get(way, np.full(2, np.inf))) <= tolerance for one in samples]
    return float(np.mean(found)) if samples else float("nan")


def within_one_sigma(samples: tuple[Judged, ...]) -> dict[str, float]:
    """Part of the network's errors below its sigma, by target; 0.68 if it is right about itself."""
    z = np.stack([one.deviations for one in samples])
    with np.errstate(invalid="ignore"):
        inside = np.where(np.isnan(z), np.nan, np.abs(z) < 1.0)
    return {name: float(np.nanmean(inside[:, :, k])) for k, name in enumerate(NAMES) if not np.isnan(z[:, :, k]).all()}


def surprise(samples: tuple[Judged, ...], scale: Floats) -> dict[str, float]:
    """Mean negative log likelihood of the truth in nats, less that of the prior's own spread, by target.

    Below 0 the network's word is worth more than the prior.
    """
    result = {}
    for k, name in enumerate(NAMES):
        z = np.concatenate([one.deviations[:, k] for one in samples])
        sigma = np.concatenate([one.sigmas[:, k] for one in samples])
        known = ~np.isnan(z)
        if known.any():
            nll = 0.5 * np.square(z[known]) + np.log(sigma[known] / scale[k])
            result[name] = float(nll.mean() - 0.5)
    return result
