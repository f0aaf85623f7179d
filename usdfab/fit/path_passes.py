"""Where stage 3 has pictures and their derivatives from: any renderer of a fabric's optics, or passes recycled.

Noise is what makes this stage slow: a path that meets the lamp through a narrow lobe is hundreds of times as bright as
its pixel. Optics change little from one iteration to the next, so what earlier iterations rendered is still worth
nearly as much as what the next one renders, and is used again.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric.optics import Optics
from usdfab.fit.path_settings import PathSettings
from usdfab.usd.scene import Camera, Scene

Floats = NDArray[np.float64]

MEMORY = 0.9
"""What a pass counts in the next iteration: ten passes together, with the noise of nineteen."""


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

    def image(self, vector: Floats, iteration: int) -> Floats:
        """The picture (H, W, 3) for these optics (P,)."""
        self._vector, self._iteration = vector, iteration
        return self._renderer.render(vector, self._settings.spp, pass_seed(self._settings.seed, iteration, 0))

    def gradient(self, adjoint: Floats) -> Floats:
        """(P,) for the picture that was asked for last."""
        seed = pass_seed(self._settings.seed, self._iteration, 1)
        return self._renderer.gradient(self._vector, adjoint, self._settings.gradient_spp, seed)

    def state(self) -> dict[str, NDArray]:
        """What the next iteration needs; nothing."""
        return {}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from ``state``."""


class RecycledPasses:
    """Running means of pictures and of their derivatives, moved along to the optics of each iteration.

    With a mean picture I and mean derivatives J at the last optics, I + J d is the picture at optics that differ by d,
    up to second order; the next pass joins it with the weight of its samples, older ones fade by ``MEMORY``.
    """

    def __init__(self, renderer: JacobianRenderer, settings: PathSettings) -> None:
        self._renderer, self._settings = renderer, settings
        width, height = renderer.size
        vector = renderer.optics.vector()
        self._image = np.zeros((height, width, 3))
        self._jacobian = np.zeros((len(vector), height, width, 3))
        self._vector, self._weight = vector, 0.0

    def image(self, vector: Floats, iteration: int) -> Floats:
        """The picture (H, W, 3) for these optics (P,)."""
        spp = self._settings.spp + self._settings.gradient_spp
        seed = pass_seed(self._settings.seed, iteration, 0)
        image, jacobian = self._renderer.gradient_images(vector, spp, seed)
        if not (np.isfinite(image).all() and np.isfinite(jacobian).all()):
            return image  # the caller takes a step back; the means stay as they are
        old = MEMORY * self._weight
        share = spp / (old + spp)
        moved = self._image + np.tensordot(vector - self._vector, self._jacobian, axes=1)
        self._image = moved + share * (image - moved)
        self._jacobian = self._jacobian + share * (jacobian - self._jacobian)
        self._vector, self._weight = vector.copy(), old + spp
        return self._image

    def gradient(self, adjoint: Floats) -> Floats:
        """(P,) for the picture that was asked for last."""
        return np.tensordot(self._jacobian, adjoint, axes=3)

    def state(self) -> dict[str, NDArray]:
        """What the next iteration needs; later iterations leave these arrays as they are."""
        return {
            "mean_image": self._image,
            "mean_jacobian": self._jacobian,
            "mean_vector": self._vector,
            "mean_weight": np.array(self._weight),
        }

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from ``state``."""
        self._image, self._jacobian = state["mean_image"].copy(), state["mean_jacobian"].copy()
        self._vector, self._weight = state["mean_vector"].copy(), float(state["mean_weight"])


def pass_seed(seed: int, iteration: int, which: int) -> int:
    """A seed of its own for each pass of each iteration."""
    return int(np.random.SeedSequence([seed, iteration, which]).generate_state(1)[0] >> 1)
