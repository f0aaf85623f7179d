"""A path-traced picture as a differentiable function in torch.

    image = torch_image(renderer, optics, spp=1024, gradient_spp=256, seed=0)   # (H, W, 3)
    loss(image).backward()                                                      # optics.grad (3 K + 8,)

Any renderer with ``render(optics, spp, seed)`` and ``gradient(optics, adjoint, spp, seed)`` will do:
`usdfab.mi.differentiable.DifferentiableRenderer`, for example. This is a ``torch.autograd.Function`` on these two
rather than a ``drjit.wrap``: that differentiates what Dr.Jit traced, with the very samples of the picture, where a
gradient free of bias needs samples of its own, and a number of them of its own; and it would tie torch to one backend.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Differentiable(Protocol):
    """What ``torch_image`` needs of a renderer."""

    def render(self, optics: Any, spp: int, seed: int) -> Floats:
        """(H, W, 3) linear picture of optics (3 K + 8,)."""
        ...

    def gradient(self, optics: Any, adjoint: Any, spp: int, seed: int) -> Floats:
        """(3 K + 8,) derivatives of <adjoint, picture>."""
        ...


def torch_image(
    renderer: Differentiable, optics: torch.Tensor, *, spp: int, gradient_spp: int, seed: int
) -> torch.Tensor:
    """(H, W, 3) picture of ``optics`` (3 K + 8,), with gradients, of its type and on its device.

    Parameters
    ----------
    spp, gradient_spp:
        Samples per pixel of the picture, and of its gradient.
    seed:
        From 0. The picture takes the seed 2 ``seed`` and the gradient 2 ``seed`` + 1: take another one each iteration.

    Raises
    ------
    UsdfabError
        As ``renderer.render``.
    """
    image: torch.Tensor = _Image.apply(optics, renderer, spp, gradient_spp, seed)
    return image


class _Image(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, optics: torch.Tensor, renderer: Differentiable, spp: int, gradient_spp: int, seed: int
    ) -> torch.Tensor:
        ctx.save_for_backward(optics)
        ctx.renderer, ctx.spp, ctx.seed = renderer, gradient_spp, 2 * seed + 1
        image = renderer.render(optics.detach().cpu().double().numpy(), spp, 2 * seed)
        return torch.from_numpy(np.ascontiguousarray(image)).to(optics)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, adjoint: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (optics,) = ctx.saved_tensors
        vector = optics.detach().cpu().double().numpy()
        found = ctx.renderer.gradient(vector, adjoint.detach().cpu().double().numpy(), ctx.spp, ctx.seed)
        return torch.from_numpy(found).to(optics), None, None, None, None
