"""The optics of a fabric as the few numbers that its fiber BSDF reads, and the chain rule back.

All that follows from the parameters alone is computed here, once a call and in double precision; the kernels in
`usdfab.mi.fiber_paths` get constants, and hand back derivatives with respect to these.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from usdfab.scattering.fiber_drjit import PackedFiber, absorption_from_albedo, pack_fiber

Floats = NDArray[np.float64]

LEAF_COUNT = 10
"""Numbers of a system that the value of the BSDF depends on besides its absorption: see ``leaf_values``."""


class Tables(NamedTuple):
    """``systems``: warp and weft, packed without a colour (arrays of size 1); ``sigma``: absorptions, (3 K)."""

    systems: tuple[PackedFiber, PackedFiber]
    sigma: Any


def leaf_values(packed: PackedFiber) -> list[Any]:
    """The ``LEAF_COUNT`` arrays of a material that ``eval_fiber`` reads besides sigma."""
    return [packed.eta, packed.eta2_minus_1, packed.inv_s, packed.d_scale, *packed.inv_v, *packed.m_scale]


def with_leaves(packed: PackedFiber, leaves: list[Any]) -> PackedFiber:
    """``packed`` with the arrays that ``leaf_values`` gives replaced."""
    eta, eta2, inv_s, d_scale = leaves[:4]
    return packed._replace(
        eta=eta, eta2_minus_1=eta2, inv_s=inv_s, d_scale=d_scale, inv_v=tuple(leaves[4:7]), m_scale=tuple(leaves[7:])
    )


class OpticsTables:
    """The map from ``Optics.vector`` (3 K + 8,) to ``Tables``, with its derivative.

    Parameters
    ----------
    system: (K,) int
        Of each colour: 0 warp, 1 weft.
    tilt:
        Cuticle tilt of all fibers, rad.
    """

    def __init__(self, system: NDArray[np.int64], tilt: float) -> None:
        self.system = np.asarray(system, dtype=np.uint32)
        self.tilt = tilt

    def tables(self, vector: Floats) -> Tables:
        """Constants for the kernels: opaque, so that other numbers mean no other kernel."""
        packs, absorption = self._packed(_double()(vector))
        sigma = dr.ravel(mi.Color3f(*absorption))
        systems = [_single(pack) for pack in packs]
        dr.make_opaque(sigma, *(array for pack in systems for array in pack.arrays()[1:]))
        return Tables((systems[0], systems[1]), sigma)

    def chain(self, vector: Floats, leaves: Floats, sigma: Floats) -> Floats:
        """(3 K + 8,) derivatives of what has derivatives ``leaves`` (2, LEAF_COUNT) and ``sigma`` (K, 3)."""
        parameters = _double()(vector)
        dr.enable_grad(parameters)
        packs, absorption = self._packed(parameters)
        # Opaque, as in ``tables``: one kernel for all calls.
        outer = _double()(np.r_[leaves.ravel(), sigma.T.ravel()])
        dr.make_opaque(outer)
        total = _double()(0.0)
        for k, leaf in enumerate(leaf for pack in packs for leaf in leaf_values(pack)):
            total += leaf * _entry(outer, k)
        rows, first = dr.arange(mi.UInt32, len(sigma)), leaves.size
        for channel in range(3):
            total += dr.sum(absorption[channel] * dr.gather(_double(), outer, rows + (first + channel * len(sigma))))
        dr.backward(total)
        return np.array(dr.grad(parameters))

    def _packed(self, parameters: Any) -> tuple[list[PackedFiber], list[Any]]:
        """Both systems' constants, and absorptions: three arrays of size K."""
        dr.make_opaque(parameters)
        colors = 3 * len(self.system)
        packs = []
        for k in range(2):
            gamma_m, gamma_n, gamma_m0 = (_entry(parameters, colors + 3 * k + j) for j in range(3))
            ior = _entry(parameters, colors + 6 + k)
            packs.append(pack_fiber(mi.Color3d(1.0), gamma_m, gamma_n, gamma_m0, ior, self.tilt))
        rows = dr.arange(mi.UInt32, len(self.system))
        gamma_n = dr.gather(_double(), parameters, colors + 3 * mi.UInt32(self.system) + 1)
        albedo = [dr.gather(_double(), parameters, 3 * rows + channel) for channel in range(3)]
        return packs, [absorption_from_albedo(a, gamma_n) for a in albedo]


def _double() -> Any:
    """Differentiable float64 of the variant's backend."""
    return dr.float64_array_t(mi.Float)


def _entry(array: Any, index: int) -> Any:
    return dr.gather(type(array), array, mi.UInt32(index))


def _single(pack: PackedFiber) -> PackedFiber:
    """In float32, without derivatives."""

    def cast(value: Any) -> Any:
        return tuple(mi.Float(x) for x in value) if isinstance(value, tuple) else mi.Float(value)

    fields = {name: cast(value) for name, value in pack._asdict().items() if name not in ("sigma", "tilt")}
    return pack._replace(sigma=mi.Color3f(0.0), **fields)
