"""How far a network may be believed: fitted on the validation part after training, for ``robust``."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from usdfab.fit.network.model import Robust, bin_targets
from usdfab.fit.network.spectra import FREQUENCIES
from usdfab.fit.network.store import Rows
from usdfab.fit.network.targets import NAMES

TEMPERATURES = np.exp(np.linspace(np.log(0.25), np.log(2.0), 25))
"""Factors on logits that are tried."""


def calibrate(network: Robust, rows: Rows) -> dict[str, float]:
    """Set the network's temperatures, its shrinkage towards the prior's mean, and the scale of its uncertainties.

    Returns
    -------
    skill:
        For each target the root mean square error over that of the prior's mean, both systems together.

    Notes
    -----
    Numbers are calibrated for fabrics of the wide prior and of Table 4 by themselves, by all where there are none of
    them; the skill is the wide prior's. Counts and weave are judged on all.
    """
    with torch.no_grad():
        network.centre.zero_()
        for name in ("shrinkage", "widening", "weave_temperature", "count_temperature"):
            getattr(network, name).fill_(1.0)
        x = network.reduced(rows.texture, rows.detail, rows.lattice)
        logits = network.counts(rows.spectra)
        goal = bin_targets(rows.values[:, :, 0])
        losses = [float(-(goal * (t * logits).log_softmax(dim=2)).sum(dim=2).mean()) for t in TEMPERATURES]
        network.count_temperature.fill_(float(TEMPERATURES[int(np.argmin(losses))]))
        members = network.weave_outputs(x)
        losses = []
        for t in TEMPERATURES:
            chance = (t * members).softmax(dim=2).mean(dim=0)
            losses.append(float(-chance.gather(1, rows.label[:, None]).clamp(min=1e-9).log().mean()))
        network.weave_temperature.fill_(float(TEMPERATURES[int(np.argmin(losses))]))
        hint = torch.from_numpy(FREQUENCIES).log().float()[network.count_probabilities(rows.spectra).argmax(dim=2)]
        mean, deviation = network.number_estimates(x, hint, rows.table4)
        found, wanted = network.standardised(mean), network.standardised(rows.values)
        spread = deviation / network.target_scale
        known = rows.known.float()
        for kind in (1, 0):
            # Photos are like the wide prior's cloth. In Table 4 the weave tells much else, by how it was drawn.
            judged = known * (rows.table4 == bool(kind))[:, None, None].float()
            judged = judged if judged.any() else known
            middle = (wanted * judged).sum(dim=(0, 1)) / judged.sum(dim=(0, 1)).clamp(min=1.0)
            # Least squares of the truth on the estimate, between no trust and full trust.
            trust = (
                _sum((found - middle) * (wanted - middle), judged) / _sum((found - middle).square(), judged)
            ).clamp(max=1.0)
            error = middle + trust * (found - middle) - wanted
            network.centre[kind] = middle
            network.shrinkage[kind] = trust
            network.widening[kind] = (_sum((error / spread).square(), judged) / _sum(judged, judged)).sqrt()
        # Those of the wide prior, which came last.
        skill = (_sum(error.square(), judged) / _sum((wanted - middle).square(), judged)).sqrt()
    return dict(zip(NAMES, [round(float(s), 4) for s in skill], strict=True))


def _sum(values: Tensor, known: Tensor) -> Tensor:
    """Over rows and systems; 0 and less become a little more than 0."""
    return (values * known).sum(dim=(0, 1)).clamp(min=1e-9)
