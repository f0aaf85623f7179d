"""The loss of stage 3 for pictures from a renderer: its value, and its derivatives by picture, gain and roughness.

The same as in stage 2 (Li et al. 2024, eq. 12 to 14): texture, mean colour and the prior of the weave class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.fit.losses import ROUGHNESS_PRIORS, WIDE_PRIOR, roughness_prior
from usdfab.fit.texture import Target, color_loss, rolled_off, texture_loss, texture_statistics

Floats = NDArray[np.float64]

GAIN_DEVIATION = 0.1
"""Standard deviation of the logarithm of the exposure gain: brighter light and whiter fibers look much alike."""


ANCHOR_DEVIATION = 0.5
"""Of the coordinates of ``OpticsSpace`` from those of the start: an eighth of the range, in its middle."""


@dataclass(frozen=True)
class Weights:
    """How much the parts of the loss count.

    ``anchor`` is half the square of how far the roughnesses' coordinates are from the start, in ``ANCHOR_DEVIATION``:
    what the picture hardly shows stays where earlier stages have seen it.
    """

    texture: float = 1.0
    color: float = 1.0
    prior: float = 0.02
    anchor: float = 0.002


@dataclass(frozen=True, eq=False)
class LossValue:
    """A loss and its derivatives.

    Parameters
    ----------
    total:
        The weighted sum.
    terms:
        ``texture``, ``color`` and ``prior``, without weights.
    adjoint: (H, W, 3)
        Derivatives by the picture's linear values, before the gain.
    log_gain:
        Derivative by the logarithm of the gain.
    roughness: (2, 3)
        Derivatives of the prior; those that go through the picture are not in it.
    """

    total: float
    terms: dict[str, float]
    adjoint: Floats
    log_gain: float
    roughness: Floats

    @property
    def finite(self) -> bool:
        """Whether the loss and all derivatives are numbers."""
        return bool(
            np.isfinite(self.total)
            and np.isfinite(self.adjoint).all()
            and np.isfinite(self.log_gain)
            and np.isfinite(self.roughness).all()
        )


@dataclass(frozen=True, eq=False)
class PathLoss:
    """What pictures are judged by.

    Parameters
    ----------
    target:
        Of the photo.
    weave_class:
        Chooses the prior.
    weights:
        Of the parts.
    """

    target: Target
    weave_class: str
    weights: Weights = Weights()

    def matched(self, photo: Floats, noise: Floats) -> PathLoss:
        """The loss for pictures with noise: the photo (H, W, 3) is given ``noise`` of the same size and distribution.

        Noise adds to covariances and, through ReLUs and roll-off, to means. With it on both sides it does not pull the
        optics anywhere.
        """
        target = self.target
        noisy = Target.from_image(as_tensor(photo + noise), target.net, target.levels, target.kind)
        return replace(self, target=noisy)

    def __call__(self, image: Floats, log_gain: float, roughness: Floats) -> LossValue:
        """The loss of ``exp(log_gain) * image``.

        Parameters
        ----------
        image: (H, W, 3)
            Linear Rec. 709, finite.
        roughness: (2, 3)
            As ``Optics.roughness``.
        """
        pixels = as_tensor(image).requires_grad_()
        gain = torch.tensor(float(log_gain), dtype=torch.float64, requires_grad=True)
        rough = torch.tensor(roughness, dtype=torch.float64, requires_grad=True)
        shown = pixels * gain.exp().float()
        terms = {
            "texture": texture_loss(shown, self.target).double(),
            "color": color_loss(shown, self.target).double(),
            "prior": roughness_prior(self.weave_class, rough) + 0.5 * (gain / GAIN_DEVIATION) ** 2,
        }
        total = (
            self.weights.texture * terms["texture"]
            + self.weights.color * terms["color"]
            + self.weights.prior * terms["prior"]
        )
        total.backward()
        assert pixels.grad is not None and gain.grad is not None and rough.grad is not None
        return LossValue(
            float(total.detach()),
            {name: float(term.detach()) for name, term in terms.items()},
            np.moveaxis(pixels.grad[0].double().numpy(), 0, -1),
            float(gain.grad),
            rough.grad.numpy(),
        )

    def residuals(self, images: Floats, log_gain: float) -> list[tuple[torch.Tensor, float]]:
        """What the texture and colour losses sum the absolute values of: (B, n) differences, and their weight.

        Parameters
        ----------
        images: (B, H, W, 3)
            Linear Rec. 709.
        """
        with torch.no_grad():
            shown = torch.cat([as_tensor(image) for image in images]) * float(np.exp(log_gain))
            target = self.target
            found = texture_statistics(shown, target.net, target.levels, target.kind)
            rows = []
            for a, b, scale in zip(found, target.statistics, target.scales, strict=True):
                weight = self.weights.texture / (len(found) * float(scale) * b.numel())
                rows.append(((a - b).flatten(1), weight))
            mean = target.mean_color.to(shown)
            weight = self.weights.color / (3.0 * max(float(mean.mean()), 1e-3))
            rows.append((rolled_off(shown).mean(dim=(2, 3)) - mean, weight))
        return rows

    def prior_slope(self, roughness: Floats) -> Floats:
        """(2, 3) derivatives of the weighted prior by ``Optics.roughness``."""
        rough = torch.tensor(roughness, dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(roughness_prior(self.weave_class, rough), rough)
        return self.weights.prior * slope.numpy()

    def prior_curvature(self) -> Floats:
        """(6,) second derivatives of the weighted prior by ``Optics.roughness``, row by row."""
        longitudinal, primary = ROUGHNESS_PRIORS.get(self.weave_class, WIDE_PRIOR)
        one = np.array([longitudinal[1] ** -2, 0.0, primary[1] ** -2])
        return self.weights.prior * 0.5 * np.tile(one, 2)


def as_tensor(image: NDArray) -> torch.Tensor:
    """A picture (H, W, 3) as a float32 tensor (1, 3, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(np.asarray(image, dtype=np.float32), -1, 0))[None])
