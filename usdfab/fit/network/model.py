"""The networks: ``robust``, which ``usdfab fit`` uses, and ``paper``, the baseline of Li et al. 2024, section 5.3.

``robust`` has three parts that learn by themselves. *Counts*: convolutions along the logarithmic frequency axis, for
which another scale is a shift. *Weave*: from the spectrum of the lattice, in which all scales are alike, and the
texture. *Numbers*: mean and variance of every target, from texture, detail, lattice and counts. Weave and numbers are
small ensembles whose members differ by chance. All know the symmetry of cloth by seeing samples in eight turns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from usdfab.fit.network.detail import DETAIL_SIZE, folded
from usdfab.fit.network.inputs import even, gram
from usdfab.fit.network.labels import LABELS
from usdfab.fit.network.spectra import BIN_WIDTH, FREQUENCIES, LATTICE_SIZE
from usdfab.fit.network.targets import INDEX, TARGETS

TEXTURE_COMPONENTS = 128
LATTICE_COMPONENTS = 64
DETAIL_COMPONENTS = 128
HIDDEN = 96
MEMBERS = 4
"""Of each ensemble."""

MIN_LOG_VARIANCE, MAX_LOG_VARIANCE = -6.0, 1.0
"""Of standardised targets, whose variance before a look at the picture is 1 (log 0)."""


class Reduced(nn.Module):
    """Standardised principal components of a vector; fitted once, not trained."""

    mean: Tensor
    scale: Tensor
    directions: Tensor

    def __init__(self, size: int, components: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.register_buffer("directions", torch.zeros(size, components))

    def fit(self, rows: Tensor) -> None:
        """Set from examples (R, size)."""
        self.mean = rows.mean(dim=0)
        self.scale = 1.0 / rows.std(dim=0).clamp(min=1e-4)
        x = ((rows - self.mean) * self.scale).clamp(-6.0, 6.0)
        variances, vectors = principal(x, self.directions.shape[1])
        # Late components are mostly noise: whitened only half, they count less.
        reduced = vectors * (variances.clamp(min=1e-6) * variances[0]) ** -0.25
        # A small vector has fewer components than are asked for; the others are 0.
        self.directions = F.pad(reduced, (0, self.directions.shape[1] - reduced.shape[1]))

    def forward(self, x: Tensor) -> Tensor:
        """(B, components) of (B, size), of magnitude 1 or less."""
        return ((x - self.mean) * self.scale).clamp(-6.0, 6.0) @ self.directions


def principal(x: Tensor, wanted: int) -> tuple[Tensor, Tensor]:
    """The largest variances (k,) of rows x (R, D) about 0 and their directions (D, k), by subspace iteration."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(x.shape[1], min(2 * wanted, x.shape[1]), generator=generator).to(x)
    for _ in range(8):
        basis = torch.linalg.qr(x.T @ (x @ basis))[0]
    within = x @ basis
    variances, vectors = torch.linalg.eigh(within.T @ within / len(x))
    variances, vectors = variances.flip(0)[:wanted], basis @ vectors.flip(1)[:, :wanted]
    # Either sign is right; the same one is taken every time.
    return variances, vectors * torch.sign(vectors.gather(0, vectors.abs().argmax(dim=0, keepdim=True)))


class Ensemble(nn.Module):
    """``members`` perceptrons of two hidden layers side by side, each (B, inside) to (B, outside)."""

    def __init__(self, inside: int, hidden: int, outside: int, members: int, dropout: float) -> None:
        super().__init__()
        sizes = (inside, hidden, hidden, outside)
        self.weights = nn.ParameterList(
            nn.Parameter(torch.randn(members, a, b) * math.sqrt((2.0 if b != outside else 0.1) / a))
            for a, b in pairwise(sizes)
        )
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(members, 1, b)) for b in sizes[1:])
        self.dropout = dropout

    def forward(self, x: Tensor) -> Tensor:
        """(members, B, outside)."""
        y = x.expand(len(self.weights[0]), *x.shape)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            y = torch.baddbmm(bias, F.dropout(y, self.dropout, self.training), weight)
            if k < len(self.weights) - 1:
                y = F.leaky_relu(y, 0.1)
        return y


class Counts(nn.Module):
    """Log-probability of each frequency bin being a system's yarn frequency, from the spectra of both axes."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            [
                nn.Conv1d(6, width, 9, padding=4),
                nn.Conv1d(width, width, 9, padding=8, dilation=2),
                nn.Conv1d(width, width, 9, padding=16, dilation=4),
            ]
        )
        self.last = nn.Conv1d(width, 1, 1)

    def forward(self, spectra: Tensor) -> Tensor:
        """(B, 2, BINS) logits of warp and weft, of (B, 2, 3, BINS)."""
        own = torch.stack([spectra.flatten(1, 2), spectra.flip(1).flatten(1, 2)], dim=1).flatten(0, 1)
        x = own * 0.3
        for k, layer in enumerate(self.layers):
            y = F.leaky_relu(layer(F.dropout1d(x, 0.1, self.training) if k else x), 0.1)
            x = y if k == 0 else x + y
        return self.last(x)[:, 0].unflatten(0, (-1, 2))


class Robust(nn.Module):
    """See the module. ``components`` of the texture's layers, see ``inputs.split``; ``texture`` its numbers."""

    parts = ("counts", "weave", "numbers")
    target_mean: Tensor
    target_scale: Tensor
    centre: Tensor
    shrinkage: Tensor
    widening: Tensor
    weave_temperature: Tensor
    count_temperature: Tensor

    def __init__(self, components: Sequence[int], texture: int) -> None:
        super().__init__()
        self.components = tuple(components)
        outputs = 2 * len(TARGETS)
        self.texture = Reduced(texture, TEXTURE_COMPONENTS)
        self.lattice = Reduced(LATTICE_SIZE, LATTICE_COMPONENTS)
        self.register_buffer("target_mean", torch.zeros(2, len(TARGETS)))
        self.register_buffer("target_scale", torch.ones(2, len(TARGETS)))
        self.detail = Reduced(DETAIL_SIZE, DETAIL_COMPONENTS)
        inside = TEXTURE_COMPONENTS + LATTICE_COMPONENTS
        self.counts = Counts()
        self.weave = Ensemble(inside, HIDDEN, len(LABELS), MEMBERS, 0.3)
        self.numbers = Ensemble(inside + DETAIL_COMPONENTS + 3, HIDDEN, 2 * outputs, MEMBERS, 0.2)
        # Set by calibration on pictures that were not learned from.
        # For the wide prior and for Table 4: the prior's mean, and how far estimates and deviations are stretched.
        self.register_buffer("centre", torch.zeros(2, 2, len(TARGETS)))
        self.register_buffer("shrinkage", torch.ones(2, 2, len(TARGETS)))
        self.register_buffer("widening", torch.ones(2, 2, len(TARGETS)))
        self.register_buffer("weave_temperature", torch.ones(()))
        self.register_buffer("count_temperature", torch.ones(()))

    def fit_inputs(self, texture: Tensor, detail: Tensor, lattice: Tensor, values: Tensor, known: Tensor) -> None:
        """Set what is not trained from the examples of the training part."""
        self.texture.fit(even(texture, self.components))
        self.detail.fit(folded(detail))
        self.lattice.fit(lattice)
        # Both systems share one scale: every picture also occurs turned by a quarter.
        weight = known.float()
        total = weight.sum(dim=(0, 1)).clamp(min=1.0)
        mean = (values * weight).sum(dim=(0, 1)) / total
        variance = ((values - mean).square() * weight).sum(dim=(0, 1)) / total
        self.target_mean = mean.expand(2, -1).clone()
        self.target_scale = variance.sqrt().clamp(min=1e-3).expand(2, -1).clone()

    def reduced(self, texture: Tensor, detail: Tensor, lattice: Tensor) -> Tensor:
        """What the numbers take, (B, components): texture, lattice and, which the weave does not take, detail."""
        parts = [self.texture(even(texture, self.components)), self.lattice(lattice), self.detail(folded(detail))]
        return torch.cat(parts, dim=1)

    def blinded(self, x: Tensor, which: Tensor) -> Tensor:
        """``reduced`` inputs with the texture of some rows (B,) replaced by the mean texture."""
        return torch.cat([x[:, :TEXTURE_COMPONENTS].masked_fill(which[:, None], 0.0), x[:, TEXTURE_COMPONENTS:]], dim=1)

    def standardised(self, values: Tensor) -> Tensor:
        """Targets (..., 2, P) less their mean, over their scale."""
        return (values - self.target_mean) / self.target_scale

    def number_outputs(self, x: Tensor, counts: Tensor, table4: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log variances (members, B, 2, P) of standardised targets.

        ``counts`` (B, 2) log counts; ``table4`` (B,) whether the fabric is known to come from Table 4 of Li et al.
        2024, whose fabrics are much more alike than cloth is.
        """
        k = INDEX["count"]
        hint = (counts - self.target_mean[:, k]) / self.target_scale[:, k]
        kind = 2.0 * table4.to(x)[:, None] - 1.0
        y = self.numbers(torch.cat([x, hint, kind], dim=1)).unflatten(2, (2, 2, len(TARGETS)))
        return y[:, :, 0], MAX_LOG_VARIANCE - F.softplus(MAX_LOG_VARIANCE - y[:, :, 1]).clamp(
            max=MAX_LOG_VARIANCE - MIN_LOG_VARIANCE
        )

    def number_estimates(self, x: Tensor, counts: Tensor, table4: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (B, 2, P) of the targets, of all members together, calibrated."""
        means, log_variances = self.number_outputs(x, counts, table4)
        mean = means.mean(dim=0)
        variance = log_variances.exp().mean(dim=0) + means.var(dim=0, unbiased=False)
        which = table4.long()
        mean = self.centre[which] + (mean - self.centre[which]) * self.shrinkage[which]
        deviation = variance.sqrt() * self.widening[which]
        return mean * self.target_scale + self.target_mean, deviation * self.target_scale

    def weave_outputs(self, x: Tensor) -> Tensor:
        """Logits (members, B, LABELS)."""
        return self.weave(x[:, : TEXTURE_COMPONENTS + LATTICE_COMPONENTS])

    def weave_probabilities(self, x: Tensor) -> Tensor:
        """(B, LABELS), the mean of all members, calibrated."""
        return (self.weave_outputs(x) * self.weave_temperature).softmax(dim=2).mean(dim=0)

    def count_probabilities(self, spectra: Tensor) -> Tensor:
        """(B, 2, BINS) for warp and weft, calibrated."""
        return (self.counts(spectra) * self.count_temperature).softmax(dim=2)


def bin_targets(log_counts: Tensor, spread: float = 0.7) -> Tensor:
    """(..., BINS) soft labels: a normal distribution about each log count (...), ``spread`` bins wide."""
    centres = torch.from_numpy(FREQUENCIES).log().to(log_counts)
    return (-0.5 * ((centres - log_counts[..., None]) / (spread * BIN_WIDTH)).square()).softmax(dim=-1)


class Paper(nn.Module):
    """Gram matrices, two layers of 256, a softmax of the weave and 28 numbers by sigmoid (Li et al. 2024, 5.3).

    ``low`` and ``high`` (28,) are the ranges that the sigmoids are remapped to; see ``paper.RANGES``.
    """

    parts = ("paper",)
    mean: Tensor
    scale: Tensor

    def __init__(self, components: Sequence[int], weaves: int, numbers: int) -> None:
        super().__init__()
        self.components = tuple(components)
        inside = sum(q * (q + 1) // 2 for q in components)
        self.register_buffer("mean", torch.zeros(inside))
        self.register_buffer("scale", torch.ones(inside))
        self.paper = nn.ModuleList([nn.Linear(inside, 256), nn.Linear(256, 256)])
        self.last = nn.Linear(256, weaves + numbers)
        self.weaves = weaves

    def fit_inputs(self, texture: Tensor) -> None:
        """Set the inputs' mean and scale from examples (R, D)."""
        rows = gram(texture, self.components)
        self.mean, self.scale = rows.mean(dim=0), 1.0 / rows.std(dim=0).clamp(min=1e-4)

    def forward(self, texture: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the weaves (B, weaves) and shares of the ranges (B, numbers)."""
        x = ((gram(texture, self.components) - self.mean) * self.scale).clamp(-6.0, 6.0)
        for layer in self.paper:
            x = F.leaky_relu(layer(x), 0.01)
        y = self.last(x)
        return y[:, : self.weaves], y[:, self.weaves :].sigmoid()


def parameter_count(module: nn.Module) -> int:
    """Trained numbers of a network."""
    return sum(p.numel() for p in module.parameters())
