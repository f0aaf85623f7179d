"""What light does in a fabric, as one vector: colours, roughnesses and index, for whoever optimises them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import SYSTEMS, Color, FabricParameters

Floats = NDArray[np.float64]

ROUGHNESSES = ("roughness_longitudinal", "roughness_azimuthal", "roughness_primary")
"""The columns of ``Optics.roughness``: gamma_M, gamma_N, gamma_M0."""


@dataclass(frozen=True, eq=False)
class Optics:
    """The optical parameters of a fabric.

    Parameters
    ----------
    albedo: (K, 3)
        The different fiber albedo coefficients C, linear Rec. 709: the warp's first, then the weft's, each in the
        order in which its yarns first show them.
    system: (K,) int
        Whose colour it is: 0 warp, 1 weft.
    roughness: (2, 3)
        Rows warp and weft, columns as ``ROUGHNESSES``.
    ior: (2,)
        Index of refraction of warp and weft.
    """

    albedo: Floats
    system: NDArray[np.int64]
    roughness: Floats
    ior: Floats

    @property
    def size(self) -> int:
        """Length of ``vector``: 3 K + 8."""
        return self.albedo.size + self.roughness.size + self.ior.size

    def vector(self) -> Floats:
        """(3 K + 8,): albedo, roughness and ior, row by row."""
        return np.concatenate([self.albedo.ravel(), self.roughness.ravel(), self.ior])

    def with_vector(self, vector: Floats) -> Optics:
        """The same layout with the numbers of ``vector`` (3 K + 8,)."""
        vector = np.asarray(vector, dtype=np.float64)
        if vector.shape != (self.size,):
            raise UsdfabError(f"expected {self.size} optical parameters, got an array of shape {vector.shape}")
        colors = self.albedo.size
        return Optics(vector[:colors].reshape(-1, 3), self.system, vector[colors:-2].reshape(2, 3), vector[-2:])

    def names(self) -> tuple[str, ...]:
        """Of the entries of ``vector``: ``warp.albedo[0].r``, ..., ``weft.roughness_primary``, ``weft.ior``."""
        first = {k: int(np.flatnonzero(self.system == k)[0]) for k in (0, 1)}
        colors = [
            f"{SYSTEMS[system]}.albedo[{row - first[int(system)]}].{channel}"
            for row, system in enumerate(self.system)
            for channel in "rgb"
        ]
        rough = [f"{system}.{name}" for system in SYSTEMS for name in ROUGHNESSES]
        return (*colors, *rough, *(f"{system}.ior" for system in SYSTEMS))


def optics_of(fabric: FabricParameters) -> Optics:
    """The optical parameters of a fabric.

    Raises
    ------
    UsdfabError
        For fibers that differ in albedo within a yarn: these numbers do not describe them.
    """
    for system in SYSTEMS:
        if fabric.system(system).albedo_variation > 0.0:
            raise UsdfabError(
                "gradients and the raster and path stages know one albedo for all fibers of a yarn",
                place=f"{system}.albedo_variation",
                remedy=f"set {system}.albedo_variation to 0",
            )
    colors = [list(dict.fromkeys(fabric.system(s).colors())) for s in SYSTEMS]
    yarns = [fabric.system(s) for s in SYSTEMS]
    return Optics(
        np.array([c for group in colors for c in group], dtype=np.float64),
        np.repeat([0, 1], [len(group) for group in colors]),
        np.array([[getattr(yarn, name) for name in ROUGHNESSES] for yarn in yarns]),
        np.array([yarn.ior for yarn in yarns]),
    )


def with_optics(fabric: FabricParameters, optics: Optics) -> FabricParameters:
    """``fabric`` with other optical parameters; colours replace those that ``optics_of(fabric)`` lists, in order.

    Raises
    ------
    UsdfabError
        If the numbers of colours differ, and for numbers outside their range.
    """
    old = optics_of(fabric)
    if not np.array_equal(old.system, optics.system):
        raise UsdfabError(f"the fabric has {len(old.system)} colours, the new optics {len(optics.system)}")
    changed: dict[str, Any] = {}
    for index, system in enumerate(SYSTEMS):
        yarn = fabric.system(system)
        rows = np.flatnonzero(old.system == index)
        new: dict[Color, Color] = {}
        for row in rows:
            red, green, blue = optics.albedo[row].tolist()
            new[tuple(old.albedo[row].tolist())] = (red, green, blue)
        values: dict = dict(zip(ROUGHNESSES, optics.roughness[index].tolist(), strict=True))
        if yarn.yarn_albedo:
            values["yarn_albedo"] = tuple(new[c] for c in yarn.yarn_albedo)
        else:
            values["albedo"] = new[yarn.albedo]
        changed[system] = replace(yarn, ior=float(optics.ior[index]), **values)
    return replace(fabric, **changed)
