"""The color of a fiber under point lights: single scattering plus a diffuse term (Li et al. 2024, eq. 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usdfab.fit.raster.curves import as_numpy
from usdfab.fit.raster.hits import Meeting
from usdfab.fit.raster.segments import Floats, Geometry
from usdfab.fit.raster.shade_kernel import shade, shade_slopes
from usdfab.fit.raster.visibility import Seen
from usdfab.scattering.fiber_numba_wide import tilts
from usdfab.scattering.fiber_torch import pack_fiber


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


@dataclass(frozen=True, eq=False)
class Lighting:
    """What stays fixed in a picture's shading.

    Parameters
    ----------
    lamps: (L, 3)
        Places, in units of the geometry.
    intensity: (L, 3)
        Radiant intensity over the square of a unit.
    turn: (K, TILTS_SIZE)
        The cuticle tilts of all colours, of ``tilts``.
    single, diffuse:
        Which parts of the model count.
    unshadowed:
        How much of the diffuse term shadows do not take; none in the paper, see ``shade_kernel.UNSHADOWED``.
    """

    lamps: Floats
    intensity: Floats
    turn: Floats
    single: bool
    diffuse: bool
    unshadowed: float


def materials(look: Look, system: np.ndarray) -> Tensor:
    """(K, MATERIAL) constants of all colours; ``system`` (K,) is 0 for the warp's, 1 for the weft's."""
    which = torch.from_numpy(np.asarray(system, dtype=np.int64))
    rough = look.roughness[which]
    p = pack_fiber(look.albedo, rough[:, 0:1], rough[:, 1:2], rough[:, 2:3], look.ior[which][:, None])
    return torch.cat([p.sigma, p.eta, p.inv_s, p.d_scale, *p.inv_v, *p.m_scale, look.diffuse], dim=1)


def cuticle_turns(tilt: tuple[float, float], system: np.ndarray) -> Floats:
    """``Lighting.turn`` of the tilts (warp, weft), rad."""
    return np.stack([tilts(tilt[k]) for k in system])


def shaded(
    geometry: Geometry, seen: Seen, met: Meeting, lit: Tensor, spread: Tensor, material: Tensor, lighting: Lighting
) -> Tensor:
    """(N, 3) radiance of a picture's pixels, 0 where they see nothing.

    Parameters
    ----------
    lit: (N, L)
        How much of each lamp shines there.
    spread: (2,)
        Width of a pixel in h on warp and weft.
    material: (K, MATERIAL)
        Of ``materials``.
    """
    result: Tensor = _Shaded.apply(met.distance, met.tangent, met.h, lit, spread, material, geometry, seen, lighting)
    return result


class _Shaded(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, distance: Tensor, tangent: Tensor, h: Tensor, lit: Tensor, spread: Tensor, material: Tensor,
        geometry: Geometry, seen: Seen, lighting: Lighting,
    ) -> Tensor:  # fmt: skip
        ctx.save_for_backward(distance, tangent, h, lit, spread, material)
        ctx.fixed = geometry, seen, lighting
        colors = np.zeros((len(distance), 3))
        shade(*_arguments((distance, tangent, h, lit, spread, material), *ctx.fixed), colors)
        return torch.from_numpy(colors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_colors: Tensor) -> tuple[Tensor | None, ...]:
        given = np.ascontiguousarray(as_numpy(by_colors))
        results = [np.zeros(tuple(t.shape)) for t in ctx.saved_tensors]
        shade_slopes(*_arguments(ctx.saved_tensors, *ctx.fixed), given, *results)
        return *(torch.from_numpy(r) for r in results), None, None, None


def _arguments(tensors: tuple[Tensor, ...], geometry: Geometry, seen: Seen, lighting: Lighting) -> tuple[Any, ...]:
    return (
        *(np.ascontiguousarray(as_numpy(t)) for t in tensors), geometry.topology, geometry.color, geometry.start,
        geometry.direction, seen.segment, lighting.lamps, lighting.intensity, lighting.turn, lighting.single,
        lighting.diffuse, lighting.unshadowed,
    )  # fmt: skip
