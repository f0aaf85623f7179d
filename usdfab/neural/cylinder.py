"""Cloth around a standing cylinder, seen from afar: all angles of light in one picture, and the same in plain numbers.

The cylinder's axis is y, its middle the origin; the camera looks along -z. The weft runs around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.neural.surface_swatch import View
from usdfab.usd.scene import Camera, DistantLight, FabricSurface, Material, Mesh, Scene

Floats = NDArray[np.float64]

STRIPS = 180
DISTANCE = 12.0
"""Of the camera, in radii."""

LIGHT = (0.55, 0.35, 0.75)
"""Towards the light."""

SHOWN = 1.02
"""Half the picture's width in radii."""


@dataclass(frozen=True)
class Cylinder:
    """Cloth of ``cells`` warp yarns across the cylinder's width, as many high as wide."""

    fabric: FabricParameters
    cells: float = 500.0

    @property
    def radius(self) -> float:
        """Metres."""
        return 0.5 * self.cells * self.fabric.cell[0]

    @property
    def tan_half(self) -> float:
        """Of half the field of view: ``SHOWN`` radii wide at the axis."""
        return SHOWN / DISTANCE

    @property
    def to_light(self) -> Floats:
        """Unit vector towards the light."""
        return np.asarray(LIGHT) / np.linalg.norm(LIGHT)

    def scene(self) -> Scene:
        """For the tracer. A white diffuse surface that faces the light has pixel value 1."""
        r = self.radius
        angle = np.linspace(-math.pi, math.pi, STRIPS + 1)
        ring = np.stack([r * np.sin(angle), r * np.cos(angle)], axis=-1)
        high = 2.0 * r
        points = np.concatenate(
            [np.column_stack([ring[:, 0], np.full(STRIPS + 1, y), ring[:, 1]]) for y in (-high, high)]
        )
        k = np.arange(STRIPS)
        low, top = k, k + STRIPS + 1
        triangles = np.concatenate(
            [np.stack([low, low + 1, top + 1], axis=-1), np.stack([low, top + 1, top], axis=-1)]
        ).astype(np.int32)
        normals = np.column_stack([np.sin(angle), np.zeros(STRIPS + 1), np.cos(angle)])
        uv = np.column_stack([r * angle, np.zeros(STRIPS + 1)])
        lift = np.array([0.0, high])
        uvs = np.concatenate([uv - lift, uv + lift])
        look = Material("/Cylinder/Look", 0, np.full(3, 0.5), 0.5, 0.0, 1.0)
        mesh = Mesh(
            "/Cylinder", points, triangles, np.concatenate([normals, normals])[triangles], uvs[triangles],
            np.zeros(len(triangles), dtype=np.int32), True,
        )  # fmt: skip
        to_world = np.eye(4)
        to_world[2, 3] = DISTANCE * r
        camera = Camera("/Camera", to_world, np.full(2, self.tan_half), np.zeros(2), 0.0)
        sun = DistantLight("/Sun", -self.to_light, np.full(3, math.pi), 0.0)
        surface = FabricSurface(look.path, self.fabric, 1.0, None)
        return Scene("cylinder", (mesh,), (look,), (surface,), (camera,), (sun,), (), "Y")

    def view(self, pixels: int) -> View:
        """What each pixel of a square picture sees of it."""
        r = self.radius
        s = ((np.arange(pixels) + 0.5) / pixels * 2.0 - 1.0) * self.tan_half
        x, y = np.meshgrid(s, -s)
        ray = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        # Meet x^2 + z^2 = r^2 from (0, 0, DISTANCE r).
        a = ray[:, 0] ** 2 + ray[:, 2] ** 2
        b = DISTANCE * r * ray[:, 2]
        root = b * b - a * (DISTANCE**2 - 1.0) * r * r
        hit = root > 0.0
        ray, reach = ray[hit], (-b[hit] - np.sqrt(root[hit])) / a[hit]
        place = np.array([0.0, 0.0, DISTANCE * r]) + reach[:, None] * ray
        turn = np.arctan2(place[:, 0], place[:, 2])
        normal = np.column_stack([np.sin(turn), np.zeros(len(turn)), np.cos(turn)])
        around = np.column_stack([np.cos(turn), np.zeros(len(turn)), -np.sin(turn)])
        frame = np.stack([around, np.broadcast_to([0.0, 1.0, 0.0], normal.shape), normal], axis=1)
        wo = -np.einsum("nij,nj->ni", frame, ray)
        wi = frame @ self.to_light
        tile = np.array([self.fabric.weave.ends, self.fabric.weave.picks]) * self.fabric.cell
        uv = np.column_stack([r * turn, place[:, 1]]) / tile
        # A pixel's area on the cloth grows with the slant.
        side = 2.0 * self.tan_half / pixels * reach
        size = side / np.sqrt(np.maximum(wo[:, 2], 1e-3)) / math.sqrt(tile[0] * tile[1])
        queries = np.column_stack([np.mod(uv, 1.0), size, wi, wo[:, :2]])
        return View((pixels, pixels), hit, queries, np.full(len(wi), math.pi))
