"""The color of a fiber under point lights: single scattering plus a diffuse term (Li et al. 2024, eq. 10)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from usdfab.fit.raster.hits import dot
from usdfab.scattering.fiber_torch import PackedFiber, eval_fiber

DIFFUSE_WEIGHT = 0.5
"""w_d of eq. 10: how much of the diffuse term follows the fiber's normal, the rest that of the cloth."""


@dataclass(frozen=True)
class Look:
    """What light does in a fabric, in torch.

    Parameters
    ----------
    albedo, diffuse: (K, 3)
        C and k_d of each colour, rows as ``usdfab.fabric.optics.Optics.albedo``.
    roughness: (2, 3)
        Rows warp and weft, columns gamma_M, gamma_N, gamma_M0.
    ior: (2,)
    gain:
        Exposure: factor of the picture.
    """

    albedo: Tensor
    diffuse: Tensor
    roughness: Tensor
    ior: Tensor
    gain: Tensor


class Surface(NamedTuple):
    """Fibers at N hits: unit tangent (N, 3), offset h (N,), direction of the camera ray (N, 3), and how wide the pixel
    is in h (N,)."""

    tangent: Tensor
    h: Tensor
    ray: Tensor
    spread: Tensor

    def only(self, rows: Tensor) -> Surface:
        """Of some of the hits."""
        return Surface(self.tangent[rows], self.h[rows], self.ray[rows], self.spread[rows])


PIECE = 0.45
"""Widest part of a fiber, in the angle gamma = arc sine of h, over which attenuation and normal count as constant."""


def piece_count(surface: Surface) -> Tensor:
    """(N,) int64: into how many parts ``pieces`` should cut what pixels see; near a fiber's side, where most changes,
    more."""
    low, high = _gammas(surface)
    return torch.ceil((high - low).detach() / PIECE).clamp_min(1.0).to(torch.int64)


def pieces(surface: Surface, number: int) -> list[tuple[Surface, Tensor]]:
    """What pixels see of the fibers' width, cut into parts of equal angle, and their shares (N,) of it, sum 1."""
    low, high = _gammas(surface)
    bounds = [torch.sin(low + (high - low) * (k / number)) for k in range(number + 1)]
    width = bounds[-1] - bounds[0]
    return [(surface._replace(h=0.5 * (a + b), spread=b - a), (b - a) / width) for a, b in itertools.pairwise(bounds)]


def _gammas(surface: Surface) -> tuple[Tensor, Tensor]:
    """The range of the angle gamma that pixels see."""
    low, high = ((surface.h + side * surface.spread).clamp(-1.0 + 1e-6, 1.0 - 1e-6) for side in (-0.5, 0.5))
    return torch.asin(low), torch.asin(high)


def radiance(
    material: PackedFiber | None, diffuse: Tensor | None, surface: Surface, to_lamp: Tensor, lit: Tensor
) -> Tensor:
    """Light of one lamp of intensity 1 that goes back along the camera ray, (N, 3), times the squared distance.

    Parameters
    ----------
    material:
        Of the fibers, or None without single scattering.
    diffuse: (3,) or (N, 3) or None
        k_d.
    to_lamp: (N, 3)
        Unit vectors.
    lit: (N,)
        How much of the lamp is seen, from 0 to 1.
    """
    tangent, h, ray, spread = surface
    sin_to = -dot(ray, tangent)
    sin_ti = dot(to_lamp, tangent)
    # Frame of the normal plane: e along wo projected into it, f = axis x e.
    f = torch.linalg.cross(ray, tangent, dim=-1)
    f = f / torch.sqrt(dot(f, f) + 1e-12)[:, None]
    e = torch.linalg.cross(f, tangent, dim=-1)
    along_e, along_f = dot(to_lamp, e), dot(to_lamp, f)
    result = torch.zeros((), dtype=ray.dtype)
    if material is not None:
        cos_to = torch.sqrt((1.0 - sin_to**2).clamp_min(1e-8))
        cos_ti = torch.sqrt((along_e**2 + along_f**2).clamp_min(1e-8))
        # The direction exactly along the fiber has no azimuth, and no gradient of it.
        phi = torch.atan2(along_f, torch.where(along_e.abs() + along_f.abs() > 1e-6, along_e, 1e-6))
        result = result + eval_fiber(material, h, sin_to, cos_to, sin_ti, cos_ti, phi, spread)
    if diffuse is not None:
        inner = h.clamp(-1.0 + 1e-6, 1.0 - 1e-6)
        fiber_cos = (torch.sqrt(1.0 - inner**2) * along_e - inner * along_f).clamp_min(0.0)
        cloth_cos = to_lamp[:, 2].clamp_min(0.0)
        cosine = DIFFUSE_WEIGHT * fiber_cos + (1.0 - DIFFUSE_WEIGHT) * cloth_cos
        result = result + diffuse * (cosine / math.pi)[:, None]
    return result * lit[:, None]
