"""The differentiable picture of a fabric under the capture rig: all parts joined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import optics_of
from usdfab.fibers.patch import RASTERIZATION_VERTICES
from usdfab.fit.raster.curves import CurveModel, Polylines, Shapes, as_numpy, raster_copies
from usdfab.fit.raster.edges import blended, pixel_pairs
from usdfab.fit.raster.hits import Gatherer, Meeting, dot, meet
from usdfab.fit.raster.jumps import Rays, shadow_edges, visible_edges
from usdfab.fit.raster.shade import Look, Surface, piece_count, pieces, radiance
from usdfab.fit.raster.view import View, view_of
from usdfab.fit.raster.visibility import NOTHING, Seen, index_patch, look
from usdfab.scattering.fiber_torch import pack_fiber
from usdfab.usd.scene import Camera, Scene

PATCH_CELLS = 6
"""Cells that the patch has each way at least, each with random draws of its own."""


@dataclass(frozen=True)
class RasterSettings:
    """How to rasterize.

    ``size`` (width, height) of the picture; ``supersampling`` squared pixels make one of them (the paper: 2 x 2).
    ``single``, ``diffuse``, ``shadows``, ``edges`` switch off parts, for ablations. ``float64`` computes pixels in
    double precision, for gradient checks.
    """

    size: tuple[int, int]
    supersampling: int = 2
    vertices_per_segment: int = RASTERIZATION_VERTICES
    cells: int = PATCH_CELLS
    single: bool = True
    diffuse: bool = True
    shadows: bool = True
    edges: bool = True
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
        self._dtype = torch.float64 if settings.float64 else torch.float32
        directions = self._view.directions.reshape(-1, 3)
        start = self._view.eye - (self._view.eye[2] / directions[:, 2:]) * directions
        self._directions = directions
        self._rays = Rays(start, torch.from_numpy(directions).to(self._dtype))
        self._pairs = pixel_pairs(*self._shape)
        self._scale = min(s.radius for s in self.model._systems)
        # Width of a pixel on the cloth's plane, across the ray.
        steps = np.linalg.norm(np.diff(start.reshape(*self._shape, 3), axis=1), axis=-1)
        self._pixel = float(np.median(steps)) / self._scale

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
        return pixels.reshape(height // n, n, width // n, n, 3).mean(dim=(1, 3))

    def pixels(self, lines: Polylines, look_: Look) -> Tensor:
        """The picture before it is filtered down, (H n * W n, 3)."""
        index = index_patch(self.model, as_numpy(lines.points), as_numpy(lines.radius))
        lamps = self._view.lamps if self.settings.shadows else self._view.lamps[:0]
        seen, shadows = look(index, self._view.eye, self._directions, lamps)
        hit = np.flatnonzero(seen.segment != NOTHING)
        gather = Gatherer(self.model, lines, self._scale, self._dtype)
        segments = gather(seen, self._rays.start[hit], hit)
        direction = self._rays.direction[torch.from_numpy(hit)]
        met = meet(segments, direction)
        lit = self._lit(gather, seen, shadows, hit, met)
        spread = self._pixel / segments.radius
        colors = self._shaded(seen, hit, Surface(met.tangent, met.h, direction, spread), met, lit, look_)
        flat = torch.zeros(len(self._directions), 3, dtype=self._dtype).index_copy(0, torch.from_numpy(hit), colors)
        if self.settings.edges:
            parts = []
            for pairs, along_row in zip(self._pairs, (True, False), strict=True):
                parts += visible_edges(gather, seen, shadows, self._rays, pairs, along_row)
            flat = blended(flat, parts)
        return (self._view.gain * look_.gain).to(self._dtype) * flat

    def _lit(self, gather: Gatherer, seen: Seen, shadows: list[Seen], hit: np.ndarray, met: Meeting) -> Tensor:
        """(hits, lamps): how much of each lamp shines there."""
        if not shadows:
            return torch.ones(len(hit), len(self._view.lamps), dtype=self._dtype)
        rows = torch.from_numpy(hit)
        places = torch.zeros(len(self._directions), 3, dtype=self._dtype).index_copy(
            0, rows, met.distance[:, None] * self._rays.direction[rows]
        )
        columns = []
        for shadow, lamp in zip(shadows, self._view.lamps, strict=True):
            shines = torch.from_numpy(shadow.segment == NOTHING).to(self._dtype)[:, None]
            if self.settings.edges:
                parts = []
                for pairs, along_row in zip(self._pairs, (True, False), strict=True):
                    parts += shadow_edges(gather, seen, shadow, self._rays, places, lamp, pairs, along_row)
                shines = blended(shines, parts)
            columns.append(shines[rows, 0])
        return torch.stack(columns, dim=1)

    def _shaded(self, seen: Seen, hit: np.ndarray, surface: Surface, met: Meeting, lit: Tensor, look_: Look) -> Tensor:
        """(hits, 3) radiance."""
        segment = seen.segment[hit]
        system, color = self.model.system[segment], self.model.color[segment]
        total = torch.zeros(len(hit), 3, dtype=self._dtype)
        starts = self._rays.start[hit]
        place = met.distance[:, None] * surface.ray
        for row in range(len(look_.albedo)):
            mine = np.flatnonzero(color == row)
            if not len(mine):
                continue
            k = int(system[mine[0]])
            rough = look_.roughness[k].to(self._dtype)
            material = pack_fiber(
                look_.albedo[row].to(self._dtype), rough[0], rough[1], rough[2], look_.ior[k].to(self._dtype),
                self.fabric.system("weft" if k else "warp").cuticle_tilt,
            )  # fmt: skip
            diffuse = look_.diffuse[row].to(self._dtype)
            for lamp, position in enumerate(self._view.lamps):
                bright = mine[as_numpy(lit[:, lamp])[mine] > 0.0]
                number = piece_count(surface.only(torch.from_numpy(bright))).numpy()
                for count in np.unique(number):
                    some = bright[number == count]
                    rows = torch.from_numpy(some)
                    offset = torch.from_numpy((position - starts[some]) / self._scale).to(self._dtype) - place[rows]
                    squared = dot(offset, offset)
                    to_lamp = offset / torch.sqrt(squared)[:, None]
                    light = torch.zeros(len(some), 3, dtype=self._dtype)
                    for piece, share in pieces(surface.only(rows), int(count)):
                        light = light + share[:, None] * radiance(
                            material if self.settings.single else None, diffuse if self.settings.diffuse else None,
                            piece, to_lamp, lit[rows, lamp],
                        )  # fmt: skip
                    intensity = torch.from_numpy(self._view.intensity[lamp] / self._scale**2).to(self._dtype)
                    total = total.index_add(0, rows, light * intensity / squared[:, None])
        return total


def raster_renderer(scene: Scene, settings: RasterSettings) -> RasterRenderer:
    """The renderer of a rig scene's first camera and only fabric."""
    if len(scene.fabrics) != 1 or not scene.cameras:
        raise UsdfabError(f"a rig has one fabric and a camera, not {len(scene.fabrics)} and {len(scene.cameras)}",
                          place=scene.path)  # fmt: skip
    return RasterRenderer(scene, scene.cameras[0], scene.fabrics[0].fabric, settings)


__all__ = ["Look", "RasterRenderer", "RasterSettings", "raster_renderer", "view_of"]
