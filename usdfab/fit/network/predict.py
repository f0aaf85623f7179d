"""What a trained network says of one photo."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fit.features import FeatureNet, fast_dtype
from usdfab.fit.network.detail import detail_vector, rectified
from usdfab.fit.network.inputs import Basis, feature_net, prepared, texture_vectors
from usdfab.fit.network.labels import LABELS, typical_weave, weave_label
from usdfab.fit.network.model import Robust
from usdfab.fit.network.network_file import Weights
from usdfab.fit.network.spectra import (
    FREQUENCIES,
    Frequency,
    axis_spectra,
    lattice_spectrum,
    refined,
    texture_maps,
    turned_maps,
)
from usdfab.fit.network.targets import INDEX, decode
from usdfab.fit.network.turns import Turn

Floats = NDArray[np.float64]

LOOKS = (Turn(0), Turn(1), Turn(0, True), Turn(1, True))
"""Every photo is looked at in these turns, and the answers are averaged."""

COUNT_SIGMA = 0.012
"""Relative deviation of a count whose frequency was found: what is left when the right peak was chosen."""


@dataclass(frozen=True, eq=False)
class Guess:
    """What the network says; L ``LABELS``, P ``TARGETS``, rows of two are warp and weft.

    Parameters
    ----------
    weave: (L,)
        Probability of each label.
    counts: (2,)
        Yarns across the whole photo.
    count_sigma: (2,)
        Their relative deviation, given that the right peak was chosen.
    count_odds: (2, BINS)
        Probability of each count; see ``count_axis``.
    values, sigma: (2, P)
        Targets, without bounds, of the photo's middle square, and their deviations.
    stretch: (2,)
        Whole photo over middle square, along x and y.
    """

    weave: Floats
    counts: Floats
    count_sigma: Floats
    count_odds: Floats
    values: Floats
    sigma: Floats
    stretch: Floats

    @property
    def label(self) -> str:
        """The likeliest of ``LABELS``."""
        return LABELS[int(self.weave.argmax())]

    @property
    def count_confidence(self) -> Floats:
        """(2,) Probability within a tenth of the counts."""
        near = np.abs(np.log(self.count_axis / self.counts[:, None])) < 0.1
        return np.asarray((self.count_odds * near).sum(axis=1))

    @property
    def count_axis(self) -> Floats:
        """(2, BINS) yarns across the whole photo of each bin of ``count_odds``."""
        return FREQUENCIES * self.stretch[:, None]

    def natural(self) -> dict[str, Floats]:
        """Estimates (2,) in their units by name; lengths are relative to the middle square's side."""
        return decode(self.values)


def predict(photo: NDArray, weights: Weights, net: FeatureNet | None = None, *, table4: bool = False) -> Guess:
    """Look at a photo.

    Parameters
    ----------
    photo: (H, W, 3)
        Linear, cloth seen straight from above. What lies outside the middle square is not seen.
    weights:
        Of a ``robust`` network.
    net:
        The feature network, if it is at hand.
    table4:
        Whether the picture is a render of a fabric from Table 4 of Li et al. 2024. These differ less than cloth does.

    Raises
    ------
    UsdfabError
        For what is no picture, and for weights of the ``paper`` network, which knows Table 4's renders alone.
    """
    network = weights.network
    if not isinstance(network, Robust):
        raise UsdfabError("the paper's network does not know real photos", remedy="use weights of --model robust")
    net = net or feature_net(fast_dtype())
    height, width = np.asarray(photo).shape[:2]
    square = prepared(photo)
    maps = texture_maps(square)
    with torch.no_grad():
        # Turned pictures have the same spectra, with the axes exchanged.
        spectra = torch.from_numpy(axis_spectra(maps)).float()[None]
        odds = network.count_probabilities(spectra)[0].double().numpy()
        odds /= odds.sum(axis=1, keepdims=True)
        rough = likeliest(odds)
        found = refined(maps, (float(rough[0]), float(rough[1])))
        exact = np.array([f.cycles for f in found])
        looks = [_look(net, weights.basis, square, maps, found, turn) for turn in LOOKS]
        texture, detail, lattice = (torch.from_numpy(np.stack(part)).float() for part in zip(*looks, strict=True))
        hints = np.log(np.stack([exact if turn.quarters % 2 == 0 else exact[::-1] for turn in LOOKS]))
        kind = torch.full((len(LOOKS),), table4)
        x = network.reduced(texture, detail, lattice)
        weave = network.weave_probabilities(x).double().numpy()
        found_numbers = network.number_estimates(x, torch.from_numpy(hints).float(), kind)
        means, deviations = (t.double().numpy() for t in found_numbers)
    stretch = np.array([width, height]) / min(width, height)
    values = np.mean([values_back(m, turn) for m, turn in zip(means, LOOKS, strict=True)], axis=0)
    # The looks share their errors: averaging does not divide the variance by their number.
    variances = [values_back(d, turn, signed=False) ** 2 for d, turn in zip(deviations, LOOKS, strict=True)]
    sigma = np.sqrt(np.mean(variances, axis=0))
    values[:, INDEX["count"]] = np.log(exact)
    sigma[:, INDEX["count"]] = COUNT_SIGMA
    probability = np.mean([turned_back(p, turn) for p, turn in zip(weave, LOOKS, strict=True)], axis=0)
    return Guess(
        probability / probability.sum(), exact * stretch, np.full(2, COUNT_SIGMA), odds, values, sigma, stretch
    )


def estimates(guess: Guess, width: float) -> dict[str, tuple[Floats, Floats]]:
    """Estimates in their units by name with standard deviations to first order, each (2,): warp, weft.

    Parameters
    ----------
    width:
        Of the whole photo, in metres; ``radius`` is in metres, ``count`` of the whole photo.
    """
    middle = guess.natural()
    slopes = {name: np.zeros(2) for name in middle}
    for k in INDEX.values():
        moved = guess.values.copy()
        moved[:, k] += guess.sigma[:, k]
        high = decode(moved)
        moved[:, k] -= 2.0 * guess.sigma[:, k]
        low = decode(moved)
        for other in slopes:
            slopes[other] = slopes[other] + np.square(0.5 * (high[other] - low[other]))
    side = width / guess.stretch[0]
    found = {name: (middle[name], np.sqrt(slopes[name])) for name in middle}
    found["radius"] = (found["radius"][0] * side, found["radius"][1] * side)
    found["count"] = (guess.counts, guess.counts * guess.count_sigma)
    return found


def likeliest(odds: Floats) -> Floats:
    """(2,) counts of ``odds`` (2, BINS): the mean over the bins about the likeliest, finer than a bin."""
    near = np.abs(np.arange(odds.shape[1]) - odds.argmax(axis=1)[:, None]) <= 3
    return np.asarray(np.exp((odds * near) @ np.log(FREQUENCIES) / (odds * near).sum(axis=1)))


def turned_back(probabilities: Floats, turn: Turn) -> Floats:
    """Probabilities (L,) of the weave in a turned picture as those of the picture before."""
    return np.asarray(probabilities)[list(_labels_after(turn.quarters % 2))]


def values_back(values: Floats, turn: Turn, *, signed: bool = True) -> Floats:
    """Targets (2, P) of a turned picture as those of the picture before; deviations are not ``signed``."""
    back = values[::-1].copy() if turn.quarters % 2 else values.copy()
    if turn.mirrored and signed:
        back[:, INDEX["twist"]] *= -1.0
    return back


@lru_cache(maxsize=2)
def _labels_after(quarters: int) -> tuple[int, ...]:
    """For each label the label of the turned cloth; which of a family it is does not change."""
    turned = []
    for label in LABELS:
        after = weave_label(typical_weave(label).rotated(quarters))
        turned.append(LABELS.index(after))
    return tuple(turned)


def _look(
    net: FeatureNet, basis: Basis, square: NDArray[np.float32], maps: Floats, found: tuple[Frequency, Frequency],
    turn: Turn,
) -> tuple[NDArray, Floats, Floats]:  # fmt: skip
    """Texture, detail and lattice of the turned picture, each a vector."""
    warp, weft = (f.turned(turn) for f in (found if turn.quarters % 2 == 0 else found[::-1]))
    upright = rectified(np.ascontiguousarray(turn.picture(square)), warp, weft)
    texture = texture_vectors(net, basis, upright[None])[0]
    return texture, detail_vector(upright), lattice_spectrum(turned_maps(maps, turn), warp, weft).ravel()
