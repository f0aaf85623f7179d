"""Differentiable path tracing of a fabric's fibers: pictures as a function of its optics, and gradients back.

    renderer = DifferentiableRenderer(scene, camera, (128, 128))
    image = renderer.render(renderer.optics, spp=1024, seed=0)
    gradient = renderer.gradient(renderer.optics, adjoint, spp=256, seed=1)

The geometry is frozen. Both are unbiased; a gradient of a loss is as well where its adjoint, dJ/dimage, was computed
from a picture of another seed. How light takes its way: `usdfab.mi.fiber_paths`. Light gain and exposure are linear,
and left to the caller. For torch: `usdfab.fit.torch_image`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.optics import Optics, optics_of
from usdfab.mi.fibers import MAX_POINTS
from usdfab.mi.variant import load
from usdfab.mi.visible import MARGIN_CELLS
from usdfab.usd.scene import Camera, Scene

Floats = NDArray[np.float64]

PATHS_AT_ONCE = 2**20
"""Most paths in a pass; a path takes about 0.1 kB between kernels, and 12 bytes more for each colour."""

FEW_COLORS = 8
"""Fabrics of more colours have passes of fewer paths."""

MAX_DEPTH = 256
"""Longest path whose vertices fit on a thread's stack with room to spare."""


class DifferentiableRenderer:
    """A picture of a fabric under its rig as a function of the fabric's optics.

    Parameters
    ----------
    scene:
        One fabric, as `usdfab.usd.rig.swatch_scene` gives it, and lights.
    camera:
        What to see; its exposure counts.
    size:
        (width, height) in pixels.
    max_depth:
        Longest path in vertices, the light's counted and the camera's not: 2 is direct light. Up to ``MAX_DEPTH``.
    device:
        ``auto``, ``llvm`` or ``cuda``.
    margin:
        Cells of the weave around the picture that are made of fibers; None: all of the cloth within ``budget``. With 2
        the mean of a picture and its gradients were those of 8 within their noise of 0.3 %, with 0.5 a picture was 9 %
        too dark.
    budget:
        Most control points.

    Attributes
    ----------
    optics:
        Those of the scene's fabric; they give the layout of all vectors.
    points:
        Control points of all fibers.
    warnings:
        What was approximated.

    Raises
    ------
    UsdfabError
        If Mitsuba or the device cannot be used, the scene is not one fabric and lights, or nothing of it is seen.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        size: tuple[int, int],
        *,
        max_depth: int = 64,
        device: str = "auto",
        margin: float | None = MARGIN_CELLS,
        budget: int = MAX_POINTS,
    ) -> None:
        if device == "scalar":
            raise UsdfabError("Mitsuba's scalar variant has no gradients", place="--device", remedy="use llvm or cuda")
        if min(size) < 1 or not 2 <= max_depth <= MAX_DEPTH:
            raise UsdfabError(f"size {size} must be a pixel or more and depth {max_depth} between 2 and {MAX_DEPTH}")
        load(device)
        from usdfab.mi.fiber_stage import build_stage, fabric_surface, seen_fibers
        from usdfab.mi.fiber_tables import OpticsTables

        fabric = fabric_surface(scene).fabric
        cloth = seen_fibers(scene, camera, margin, budget)
        self.optics = optics_of(fabric)
        self.size = size
        self.points = cloth.points
        self._stage, said = build_stage(scene, camera, size, cloth, max_depth - 1)
        self.warnings = (*cloth.warnings, *said)
        self._tables = OpticsTables(self.optics.system, fabric.warp.cuticle_tilt)
        self._gain = 2.0**camera.exposure

    def render(self, optics: Optics | ArrayLike, spp: int, seed: int) -> Floats:
        """(H, W, 3) linear Rec. 709, rows from the top. The same seed gives the same picture on the same device.

        Parameters
        ----------
        optics:
            Laid out as ``self.optics``, or its vector (3 K + 8,).

        Raises
        ------
        UsdfabError
            For a vector of another length, numbers that are not finite, and less than one sample.
        """
        from usdfab.mi.fiber_film import camera_rays, pixel_sums
        from usdfab.mi.fiber_paths import trace

        tables = self._tables.tables(self._vector(optics))
        total = np.zeros((self.size[0] * self.size[1], 3))
        for number, count in self._passes(spp):
            rays, seeds = camera_rays(self._stage.scene, self.size, count, _pass_seed(seed, number))
            radiance, _, _, _ = trace(self._stage, tables, rays, seeds, None, None, False)
            total += pixel_sums(radiance, count)
        return (self._gain / spp * total).reshape(self.size[1], self.size[0], 3)

    def gradient(self, optics: Optics | ArrayLike, adjoint: ArrayLike, spp: int, seed: int) -> Floats:
        """(3 K + 8,) derivatives of <adjoint, image> with respect to ``Optics.vector``.

        Parameters
        ----------
        optics:
            As for ``render``.
        adjoint: (H, W, 3)
            dJ/dimage for a loss J. Where it follows from a picture, that should have another ``seed``: else the two
            are correlated, and the gradient is biased.

        Raises
        ------
        UsdfabError
            As ``render``, and for an adjoint of another shape.
        """
        from usdfab.mi.fiber_film import camera_rays, pixel_values, sums
        from usdfab.mi.fiber_paths import empty_memory, trace, walk_back

        vector = self._vector(optics)
        weights = np.asarray(adjoint, dtype=np.float64)
        width, height = self.size
        if weights.shape != (height, width, 3) or not np.all(np.isfinite(weights)):
            raise UsdfabError(
                f"expected finite numbers of shape {(height, width, 3)}, got {weights.shape}", place="adjoint"
            )
        weights = (self._gain / spp * weights).reshape(-1, 3)
        # Of order 1 in float32, whatever a mean over the picture did to it.
        unit = float(np.abs(weights).max()) or 1.0
        tables = self._tables.tables(vector)
        total: Any = 0.0
        for number, count in self._passes(spp):
            rays, seeds = camera_rays(self._stage.scene, self.size, count, _pass_seed(seed, number))
            _, vertices, memory, glow = trace(self._stage, tables, rays, seeds, *empty_memory(self._stage), True)
            image = pixel_values(weights / unit, count)
            total = total + sums(*walk_back(self._stage, tables, image, vertices, memory, glow))
        leaves, sigma = np.split(unit * total, [-3 * len(self.optics.albedo)])
        return self._tables.chain(vector, leaves.reshape(2, -1), sigma.reshape(-1, 3))

    def _vector(self, optics: Optics | ArrayLike) -> Floats:
        if isinstance(optics, Optics) and not np.array_equal(optics.system, self.optics.system):
            raise UsdfabError("the colours are not those of the scene's fabric, in number or system", place="optics")
        vector = optics.vector() if isinstance(optics, Optics) else np.asarray(optics, dtype=np.float64)
        if vector.shape != (self.optics.size,):
            raise UsdfabError(
                f"expected {self.optics.size} optical parameters, got an array of shape {vector.shape}", place="optics"
            )
        if not np.all(np.isfinite(vector)):
            wrong = ", ".join(n for n, v in zip(self.optics.names(), vector, strict=True) if not np.isfinite(v))
            raise UsdfabError(f"not a finite number: {wrong}", place="optics")
        return vector

    def _passes(self, spp: int) -> list[tuple[int, int]]:
        """(number, samples per pixel) of each pass."""
        if spp < 1:
            raise UsdfabError(f"{spp} samples per pixel are less than 1", place="spp")
        paths = PATHS_AT_ONCE * FEW_COLORS // max(FEW_COLORS, len(self.optics.albedo))
        most = max(1, paths // (self.size[0] * self.size[1]))
        number = -(-spp // most)
        return [(k, spp * (k + 1) // number - spp * k // number) for k in range(number)]


def _pass_seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
