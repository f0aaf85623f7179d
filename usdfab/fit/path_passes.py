"""Where stage 3 has pictures and their derivatives from: any renderer of a fabric's optics, or passes recycled.

Noise is what makes this stage slow: a path that meets the lamp through a narrow lobe is hundreds of times as bright as
its pixel. Optics change little from one iteration to the next, so what earlier iterations rendered is still worth
nearly as much as what the next one renders, and is used again. Measured on plain cloth of Table 4 (96 x 96 pixels, 16
samples per pixel and iteration, optics 20 % off at the start; errors in percent of the range): with Adam and separate
passes the albedos' error of 7.7 was 6.5 after 20 iterations, with recycled passes and model steps 1.6 after 15.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric.optics import Optics
from usdfab.fit.path_settings import PathSettings
from usdfab.usd.scene import Camera, Scene

Floats = NDArray[np.float64]

MEMORY = 0.9
"""What a pass counts in the next iteration where optics stand still: the noise is that of nineteen passes."""

STRIDE = 0.3
"""Relative change of an optical parameter that halves what earlier passes count: derivatives reach only so far."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A noisy picture and a sample of its noise.

    Parameters
    ----------
    image: (H, W, 3)
        Linear Rec. 709.
    noise: (H, W, 3)
        Half the difference of the two independent halves of which ``image`` is the mean: as large as the noise in
        ``image``, uncorrelated with it, and 0 in the mean.
    """

    image: Floats
    noise: Floats

    @property
    def finite(self) -> bool:
        """Whether all of it are numbers."""
        return bool(np.isfinite(self.image).all() and np.isfinite(self.noise).all())


class Renderer(Protocol):
    """A picture (H, W, 3) as a function of a fabric's optics, and gradients of losses of it."""

    size: tuple[int, int]

    @property
    def optics(self) -> Optics:
        """Those of the fabric itself."""

    def render(self, optics: Floats, spp: int, seed: int) -> Floats:
        """(H, W, 3)."""

    def gradient(self, optics: Floats, adjoint: Floats, spp: int, seed: int) -> Floats:
        """(P,) derivatives of the sum of ``adjoint`` times picture."""


class JacobianRenderer(Renderer, Protocol):
    """A renderer that also gives the derivative of each pixel."""

    def gradient_images(self, optics: Floats, spp: int, seed: int, block: int = 1) -> tuple[Floats, Floats]:
        """(H, W, 3) and (P, H, W, 3)."""


def make_renderer(scene: Scene, camera: Camera, size: tuple[int, int], settings: PathSettings) -> Renderer:
    """The renderer of ``settings.backend``.

    Raises
    ------
    UsdfabError
        As the renderers do.
    """
    if settings.backend == "mitsuba":
        from usdfab.mi.differentiable import DifferentiableRenderer  # type: ignore[import-not-found,unused-ignore]

        return DifferentiableRenderer(scene, camera, size, max_depth=settings.max_depth, device=settings.device)
    from usdfab.tracer.differentiable import DifferentiableTracer

    return DifferentiableTracer(
        scene, camera, size, max_depth=settings.max_depth, keep=settings.keep, threads=settings.threads
    )


class SeparatePasses:
    """A picture and then a gradient with another seed: unbiased where the loss is linear in the picture's noise."""

    def __init__(self, renderer: Renderer, settings: PathSettings) -> None:
        self._renderer, self._settings = renderer, settings
        self._vector, self._iteration = renderer.optics.vector(), 0

    def picture(self, vector: Floats, iteration: int) -> Picture:
        """For these optics (P,)."""
        self._vector, self._iteration = vector, iteration
        half = max(1, self._settings.spp // 2)
        a, b = (self._renderer.render(vector, half, pass_seed(self._settings.seed, iteration, k)) for k in (0, 1))
        return Picture(0.5 * (a + b), 0.5 * (a - b))

    def gradient(self, adjoint: Floats) -> Floats:
        """(P,) for the picture that was asked for last."""
        seed = pass_seed(self._settings.seed, self._iteration, 2)
        return self._renderer.gradient(self._vector, adjoint, self._settings.gradient_spp, seed)

    def state(self) -> dict[str, NDArray]:
        """What the next iteration needs; nothing."""
        return {}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from ``state``."""


class RecycledPasses:
    """Running means of pictures and of their derivatives, moved along to the optics of each iteration.

    With a mean picture I and mean derivatives J at the last optics, I + J d is the picture at optics that differ by d,
    up to second order; the next pass joins it with the weight of its samples, older ones fade.
    """

    def __init__(self, renderer: JacobianRenderer, settings: PathSettings) -> None:
        self._renderer, self._settings = renderer, settings
        width, height = renderer.size
        vector = renderer.optics.vector()
        self._image, self._noise = np.zeros((height, width, 3)), np.zeros((height, width, 3))
        self._jacobian = np.zeros((len(vector), height, width, 3))
        self._vector, self._weight = vector, 0.0

    def picture(self, vector: Floats, iteration: int) -> Picture:
        """For these optics (P,)."""
        half = max(1, (self._settings.spp + self._settings.gradient_spp) // 2)
        (a, by_a), (b, by_b) = (
            self._renderer.gradient_images(vector, half, pass_seed(self._settings.seed, iteration, k)) for k in (0, 1)
        )
        seen, jacobian = Picture(0.5 * (a + b), 0.5 * (a - b)), 0.5 * (by_a + by_b)
        if not (seen.finite and np.isfinite(jacobian).all()):
            return Picture(np.full_like(a, np.nan), seen.noise)  # the means stay as they are
        moved_by = float(np.max(np.abs(vector - self._vector) / (np.abs(vector) + 0.05)))
        old = MEMORY * self._weight / (1.0 + (moved_by / STRIDE) ** 2)
        share = 2 * half / (old + 2 * half)
        moved = self._image + np.tensordot(vector - self._vector, self._jacobian, axes=1)
        self._image = moved + share * (seen.image - moved)
        self._noise = self._noise + share * (seen.noise - self._noise)
        self._jacobian = self._jacobian + share * (jacobian - self._jacobian)
        self._vector, self._weight = vector.copy(), old + 2 * half
        return Picture(self._image, self._noise)

    @property
    def jacobian(self) -> Floats:
        """(P, H, W, 3) derivatives of the picture that was asked for last."""
        return self._jacobian

    def gradient(self, adjoint: Floats) -> Floats:
        """(P,) for the picture that was asked for last."""
        return np.tensordot(self._jacobian, adjoint, axes=3)

    def state(self) -> dict[str, NDArray]:
        """What the next iteration needs; later iterations leave these arrays as they are."""
        return {
            "mean_image": self._image,
            "mean_noise": self._noise,
            "mean_jacobian": self._jacobian,
            "mean_vector": self._vector,
            "mean_weight": np.array(self._weight),
        }

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from ``state``."""
        self._image, self._noise = state["mean_image"].copy(), state["mean_noise"].copy()
        self._jacobian = state["mean_jacobian"].copy()
        self._vector, self._weight = state["mean_vector"].copy(), float(state["mean_weight"])


def pass_seed(seed: int, iteration: int, which: int) -> int:
    """A seed of its own for each pass of each iteration."""
    return int(np.random.SeedSequence([seed, iteration, which]).generate_state(1)[0] >> 1)
