"""What stage 3 does about the noise in its pictures before the loss sees them.

Means of a picture are right with noise, statistics of its texture are not: noise adds to covariances, and what bends
(a ReLU, the roll-off of highlights) turns it into a shift. Measured on plain cloth of Table 4 (96 x 96 pixels, gamma_N
0.15) where one picture was compared with a nearly clean one of the same optics: at 16 samples per pixel the texture and
colour losses had their least value at albedos 2.8 % off; with the same noise added to the clean picture 1.7 %; denoised
0.1 %. At 64 samples: 0.4, 0.4 and 0.2 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, median_filter

from usdfab.imaging.lens import through_lens

Floats = NDArray[np.float64]

LIMIT = 3.0
"""Times the brightness around it that a pixel keeps."""

WINDOW = 5
"""Side in pixels of the window whose median is the brightness around a pixel."""

SPREAD = 4.0
"""Standard deviation in pixels of how far the rest is spread."""

SMOOTH = 1.5
"""Standard deviation in pixels over which relative derivatives are averaged where the picture is denoised."""


class Cleaned(Protocol):
    """A picture for the loss, and how derivatives go with it."""

    @property
    def image(self) -> Floats:
        """(H, W, 3)."""

    def derivatives(self, jacobian: Floats) -> Floats:
        """(P, H, W, 3) derivatives of ``image`` from those of the noisy picture."""

    def transposed(self, adjoint: Floats) -> Floats:
        """(H, W, 3) derivative of a loss by the noisy picture from that by ``image``."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Fireflies spread without loss of light: what a pixel has too much of goes to those around it.

    A few paths carry much light through narrow lobes; whether this pixel finds one or its neighbour is chance.

    Parameters
    ----------
    image: (H, W, 3)
        With the sum of the noisy picture.
    kept: (H, W, 1)
        Part of each pixel that stays in its place.
    """

    image: Floats
    kept: Floats

    @classmethod
    def of(cls, image: Floats) -> Spread:
        """For a noisy picture (H, W, 3)."""
        brightness = image.mean(axis=-1)
        around = np.maximum(gaussian_filter(median_filter(brightness, WINDOW, mode="mirror"), 1.0), 0.0)
        excess = brightness > LIMIT * around
        kept = np.ones_like(brightness)
        kept[excess] = LIMIT * around[excess] / brightness[excess]
        return cls(spread(image, kept[..., None]), kept[..., None])

    def derivatives(self, jacobian: Floats) -> Floats:
        """As ``Cleaned``."""
        return np.stack([spread(part, self.kept) for part in jacobian])

    def transposed(self, adjoint: Floats) -> Floats:
        """As ``Cleaned``."""
        return self.kept * adjoint + (1.0 - self.kept) * _blurred(adjoint, SPREAD)


@dataclass(frozen=True, eq=False)
class Denoised:
    """A denoised picture whose mean colour is the noisy one's.

    The denoiser has no useful derivative. What changes with the optics is taken to change in proportion: derivatives
    are divided by the noisy picture, both blurred, and multiplied by the denoised one.

    Parameters
    ----------
    image: (H, W, 3)
        Denoised.
    ratio: (H, W, 3)
        ``image`` over the blurred noisy picture.
    """

    image: Floats
    ratio: Floats

    @classmethod
    def of(cls, image: Floats, denoiser: Callable[[Floats], Floats]) -> Denoised:
        """For a noisy picture (H, W, 3); ``denoiser`` may change its mean."""
        calm = denoiser(np.maximum(Spread.of(image).image, 0.0))
        mean = np.maximum(calm.mean(axis=(0, 1)), 1e-12)
        calm = calm * np.maximum(image.mean(axis=(0, 1)), 0.0) / mean
        blurred = _blurred(image, SMOOTH)
        return cls(calm, calm / np.maximum(blurred, 1e-3 * max(float(blurred.mean()), 1e-12)))

    def derivatives(self, jacobian: Floats) -> Floats:
        """As ``Cleaned``."""
        return np.stack([self.ratio * _blurred(part, SMOOTH) for part in jacobian])

    def transposed(self, adjoint: Floats) -> Floats:
        """As ``Cleaned``."""
        return _blurred(self.ratio * adjoint, SMOOTH)


@dataclass(frozen=True, eq=False)
class Photographed:
    """A cleaned picture as a camera shows it, ``blur`` pixels from sharp (``imaging.lens``)."""

    clean: Cleaned
    blur: float

    @property
    def image(self) -> Floats:
        """As ``Cleaned``."""
        return through_lens(self.clean.image, self.blur)

    def derivatives(self, jacobian: Floats) -> Floats:
        """As ``Cleaned``."""
        return through_lens(self.clean.derivatives(jacobian), self.blur)

    def transposed(self, adjoint: Floats) -> Floats:
        """As ``Cleaned``; the lens is its own transpose."""
        return self.clean.transposed(through_lens(adjoint, self.blur))


def spread(image: Floats, kept: Floats) -> Floats:
    """A picture (H, W, 3) with the part ``1 - kept`` of each pixel blurred; linear, and keeps the sum."""
    stays = kept * image
    return stays + _blurred(image - stays, SPREAD)


def _blurred(image: Floats, deviation: float) -> Floats:
    # `reflect` repeats the border pixel, which makes the blur its own transpose and keeps the sum.
    return gaussian_filter(image, (deviation, deviation, 0.0), mode="reflect")
