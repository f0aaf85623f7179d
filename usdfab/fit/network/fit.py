"""From prepared data to weights that can be shipped: training, calibration, the learning curve, what is told of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from usdfab._version import __version__
from usdfab.fit.network.calibration import calibrate
from usdfab.fit.network.model import Robust, parameter_count
from usdfab.fit.network.network_file import Weights, rounded
from usdfab.fit.network.spectra import FREQUENCIES
from usdfab.fit.network.store import Prepared, Rows
from usdfab.fit.network.training import Trained, TrainSettings, train

DEFAULT_EPOCHS = {"robust": 60, "paper": 400}
SHARES = (0.25, 0.5)
"""Parts of the training samples of a learning curve, beside all of them."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Calibrated weights; ``history`` and ``best`` as of ``training.Trained``."""

    weights: Weights
    history: dict[str, list[tuple[float, float]]]
    best: dict[str, int]
    interrupted: bool


def fit_network(
    data: Prepared,
    settings: TrainSettings,
    *,
    device: str = "cpu",
    checkpoint: Path | None = None,
    resume: bool = False,
    learning_curve: bool = False,
    progress: Progress | None = None,
) -> Fitted:
    """Train and calibrate; parameters and errors as ``training.train``.

    Parameters
    ----------
    learning_curve:
        Also train on ``SHARES`` of the samples; the errors on the test part go into ``Weights.about``.
    """
    found = train(data, settings, device=device, checkpoint=checkpoint, resume=resume, progress=progress)
    weights = _weights(data, settings, found)
    curve: dict[str, dict[str, float]] = {}
    if learning_curve and not found.interrupted:
        test = data.rows.of("test")
        for share in SHARES:
            part = train(data, replace(settings, share=share), device=device, progress=progress)
            if part.interrupted:
                break
            curve[str(part.training_samples)] = quick_errors(_weights(data, settings, part), test)
        curve[str(found.training_samples)] = quick_errors(weights, test)
        weights.about["learning_curve"] = curve
    return Fitted(weights, found.history, found.best, found.interrupted)


def _weights(data: Prepared, settings: TrainSettings, found: Trained) -> Weights:
    about: dict[str, Any] = {
        "model": settings.model,
        "usdfab": __version__,
        "settings": asdict(settings.filled()),
        "best_epochs": found.best,
        "trained_numbers": parameter_count(found.network),
        "data": {
            "samples": data.samples,
            "training_samples": found.training_samples,
            "views": int(data.rows.number.max()) + 1,
            "drawn": 0 if data.drawn is None or settings.model == "paper" else len(data.drawn),
            **{name: getattr(data.settings, name) for name in ("prior", "seed", "size", "spp", "denoised")},
        },
    }
    weights = rounded(Weights(found.network, data.basis, about))
    if isinstance(found.network, Robust):
        about["skill"] = calibrate(found.network, data.rows.of("validation"))
    return weights


def quick_errors(weights: Weights, rows: Rows) -> dict[str, float]:
    """Errors on stored views, one look each: for learning curves.

    ``weave``: part that is wrong; ``count``: part off by more than 5 %; ``numbers``: mean over the targets of the root
    mean square error, in deviations of the prior. Of the paper's network the weave alone.
    """
    network = weights.network
    with torch.no_grad():
        if not isinstance(network, Robust):
            rows = rows.where(rows.table4 & (rows.number == 0))
            return {"weave": float((network(rows.whole)[0].argmax(dim=1) != rows.label).float().mean())}
        x = network.reduced(rows.texture, rows.detail, rows.lattice)
        counts = torch.from_numpy(FREQUENCIES).log().float()[network.count_probabilities(rows.spectra).argmax(dim=2)]
        wrong = (counts - rows.values[:, :, 0]).abs() > 0.05
        mean, _ = network.number_estimates(x, counts, rows.table4)
        known = rows.known.float()
        error = ((network.standardised(mean) - network.standardised(rows.values)).square() * known).sum(dim=(0, 1))
        rms = (error / known.sum(dim=(0, 1)).clamp(min=1.0)).sqrt()[1:]
        return {
            "weave": float((network.weave_probabilities(x).argmax(dim=1) != rows.label).float().mean()),
            "count": float(wrong.float().mean()),
            "numbers": float(rms.mean()),
        }
