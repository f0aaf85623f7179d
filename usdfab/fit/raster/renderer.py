"""The differentiable picture of a fabric under the capture rig: all parts joined."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import optics_of
from usdfab.fibers.patch import RASTERIZATION_VERTICES
from usdfab.fit.raster.curves import CurveModel, Polylines, Shapes, as_numpy, raster_copies
from usdfab.fit.raster.edges import Ints, Jumps, blended, inside, outside, pixel_pairs
from usdfab.fit.raster.hits import Meeting, meet
from usdfab.fit.raster.jumps import visible_edges
from usdfab.fit.raster.rims import light_beyond, places_of, rims_at_ends
from usdfab.fit.raster.segments import geometry_of
from usdfab.fit.raster.shade import Lighting, Look, cuticle_turns, materials, shaded
from usdfab.fit.raster.shadows import shadow_edges
from usdfab.fit.raster.view import View, view_of
from usdfab.fit.raster.visibility import NOTHING, PatchIndex, Seen, index_patch, look, shadows_at, taken
from usdfab.usd.scene import Camera, Scene

PATCH_CELLS = 6
"""Cells that the patch has each way at least, each with random draws of its own."""


@dataclass(frozen=True)
class RasterSettings:
    """How to rasterize.

    ``size`` (width, height) of the picture; ``supersampling`` squared pixels make one of them (the paper: 2 x 2).
    ``single``, ``diffuse``, ``shadows``, ``edges`` switch off parts, for ablations. ``rims`` looks with own rays
    at shadows where fibers end, which gradients need and pictures hardly show. ``unshadowed`` of the diffuse term
    is there in shadows, too; none in the paper, see ``shade_kernel.UNSHADOWED``. ``float64`` gives it in double
    precision, in which it is computed, for gradient checks.
    """

    size: tuple[int, int]
    supersampling: int = 2
    vertices_per_segment: int = RASTERIZATION_VERTICES
    cells: int = PATCH_CELLS
    single: bool = True
    diffuse: bool = True
    shadows: bool = True
    edges: bool = True
    rims: bool = True
    unshadowed: float = 0.0
    float64: bool = False


class RasterRenderer:
    """A fabric under a rig, with its random draws fixed: ``image(shapes, look)`` has gradients of both."""

    def __init__(self, scene: Scene, camera: Camera, fabric: FabricParameters, settings: RasterSettings) -> None:
        """Lay out fibers and rays.

        Raises
        ------
        UsdfabError
            As ``view_of`` and ``CurveModel``; for pictures of less than 2 x 2 pixels.
        """
        if min(settings.size) < 2 or settings.supersampling < 1:
            raise UsdfabError(f"cannot rasterize {settings.size[0]} x {settings.size[1]} pixels")
        self.settings = settings
        self.fabric = fabric
        self.model = CurveModel(fabric, raster_copies(fabric, settings.cells), settings.vertices_per_segment)
        n = settings.supersampling
        self._shape = settings.size[1] * n, settings.size[0] * n
        self._view: View = view_of(scene, camera, (self._shape[1], self._shape[0]))
        directions = self._view.directions.reshape(-1, 3)
        start = self._view.eye - (self._view.eye[2] / directions[:, 2:]) * directions
        self._pairs = pixel_pairs(*self._shape)
        scale = min(s.radius for s in self.model._systems)
        self._geometry = geometry_of(self.model, start, directions, scale)
        # Width of a pixel on the cloth's plane, across the ray.
        steps = np.linalg.norm(np.diff(start.reshape(*self._shape, 3), axis=1), axis=-1)
        self._pixel = float(np.median(steps)) / scale
        self._color_system = optics_of(fabric).system
        self._lighting = Lighting(
            self._view.lamps / scale, self._view.intensity / scale**2,
            cuticle_turns((fabric.warp.cuticle_tilt, fabric.weft.cuticle_tilt), self._color_system),
            settings.single, settings.diffuse, settings.unshadowed,
        )  # fmt: skip

    def look_of(self, diffuse: float | np.ndarray = 0.3) -> Look:
        """The optical parameters of the fabric itself as float64 tensors, with k_d ``diffuse`` ((K, 3) or one)."""
        optics = optics_of(self.fabric)
        every = np.broadcast_to(np.asarray(diffuse, dtype=np.float64), optics.albedo.shape).copy()
        numbers = (optics.albedo, every, optics.roughness, optics.ior, np.ones(()))
        return Look(*(torch.from_numpy(np.array(n, dtype=np.float64)) for n in numbers))

    def image(self, shapes: Shapes, look_: Look) -> Tensor:
        """The picture (H, W, 3), linear Rec. 709, rows from the top, in ``float32`` or ``float64``."""
        lines = self.model(shapes)
        pixels = self.pixels(lines, look_)
        height, width = self._shape
        n = self.settings.supersampling
        small = pixels.reshape(height // n, n, width // n, n, 3).mean(dim=(1, 3))
        return small.to(torch.float64 if self.settings.float64 else torch.float32)

    def pixels(self, lines: Polylines, look_: Look) -> Tensor:
        """The picture before it is filtered down, (H n * W n, 3) float64."""
        index = index_patch(self.model, as_numpy(lines.points), as_numpy(lines.radius))
        lamps = self._view.lamps if self.settings.shadows else self._view.lamps[:0]
        geometry = self._geometry
        seen, shadows = look(index, self._view.eye, geometry.direction, lamps)
        met = meet(geometry, lines, seen)
        bare, rims = self._lit(index, lines, met, seen, shadows)
        lit = _held(bare + rims[0] + rims[1])
        spread = self._pixel * geometry.scale / lines.radius
        material = materials(look_, self._color_system)
        flat = shaded(geometry, seen, met, lit, spread, material, self._lighting)
        if not self.settings.edges:
            return self._view.gain * look_.gain * flat

        def light(at: Ints, what: Seen, lit: Tensor) -> Tensor:
            """Of what would be seen in pixels ``at``."""
            here = replace(geometry, start=geometry.start[at], direction=geometry.direction[at])
            met = meet(here, lines, what)
            return shaded(here, what, met, _held(lit), spread, material, self._lighting)

        parts = []
        for pairs, along_row in zip(self._pairs, (True, False), strict=True):
            # Rims beside a jump lie before it or behind it; those that run across it are there on both sides.
            across = rims[1 if along_row else 0]
            for ends in visible_edges(geometry, lines, index, self._view.eye, seen, pairs, along_row):
                at = inside(ends.pairs, ends.t)
                near, far = torch.from_numpy(at), torch.from_numpy(outside(ends.pairs, ends.t))
                lit_here, lit_there = bare[near] + across[near], bare[far] + across[far]
                if len(lamps) and self.settings.rims:
                    lit_there = light_beyond(geometry, lines, index, ends, seen, lamps, along_row) + across[far]
                    if ends.here is not None:
                        lit_here = self._lit_there(index, at, lines, ends.here)
                own = light(at, taken(seen, at) if ends.here is None else ends.here, lit_here)
                parts.append(Jumps(ends.pairs, ends.t, light(at, ends.beyond, lit_there) - own))
        return self._view.gain * look_.gain * blended(flat, parts)

    def _bare(self, shadows: list[Seen], count: int) -> Tensor:
        """(N, lamps): 1 where a lamp shines, else 0."""
        if not shadows:
            return torch.ones(count, len(self._view.lamps), dtype=torch.float64)
        return torch.from_numpy(np.stack([s.segment == NOTHING for s in shadows], axis=1).astype(np.float64))

    def _lit_there(self, index: PatchIndex, at: Ints, lines: Polylines, what: Seen) -> Tensor:
        """(M, lamps): 1 where a lamp shines on what would be seen in pixels ``at``, else 0."""
        here = replace(self._geometry, start=self._geometry.start[at], direction=self._geometry.direction[at])
        places = places_of(here, meet(here, lines, what).distance)
        return self._bare(shadows_at(index, places, what, what, self._view.lamps), len(at))

    def _lit(
        self, index: PatchIndex, lines: Polylines, met: Meeting, seen: Seen, shadows: list[Seen]
    ) -> tuple[Tensor, list[Tensor]]:
        """(N, lamps): 1 where a lamp shines on the middle of pixels, else 0; and what rims along rows and along columns
        add to it."""
        bare = self._bare(shadows, len(met.h))
        none = torch.zeros_like(bare)
        if not (shadows and self.settings.edges):
            return bare, [none, none]
        lamps, geometry = self._view.lamps, self._geometry
        rims = []
        for pairs, along_row in zip(self._pairs, (True, False), strict=True):
            at_ends = (
                rims_at_ends(geometry, lines, index, met.distance, seen, shadows, lamps, pairs, along_row)
                if self.settings.rims else [[] for _ in lamps]
            )  # fmt: skip
            columns = []
            for k, (shadow, lamp) in enumerate(zip(shadows, lamps, strict=True)):
                shines = bare[:, k : k + 1]
                parts = shadow_edges(
                    geometry, lines, met.distance, shines, seen, shadow, lamp, pairs, along_row
                )  # fmt: skip
                column = blended(shines, parts) - shines
                for pixels, light in at_ends[k]:
                    column = column.index_add(0, pixels, light[:, None])
                columns.append(column)
            rims.append(torch.cat(columns, dim=1))
        return bare, rims


def _held(lit: Tensor) -> Tensor:
    """Light held in [0, 1]; without slope at 0, as in the kernels."""
    return torch.relu(lit) - torch.relu(lit - 1.0)


def raster_renderer(scene: Scene, settings: RasterSettings) -> RasterRenderer:
    """The renderer of a rig scene's first camera and only fabric."""
    if len(scene.fabrics) != 1 or not scene.cameras:
        raise UsdfabError(f"a rig has one fabric and a camera, not {len(scene.fabrics)} and {len(scene.cameras)}",
                          place=scene.path)  # fmt: skip
    return RasterRenderer(scene, scene.cameras[0], scene.fabrics[0].fabric, settings)


__all__ = ["Look", "RasterRenderer", "RasterSettings", "raster_renderer", "view_of"]
