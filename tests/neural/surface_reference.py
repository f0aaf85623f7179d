"""The aggregation of Chen et al. 2024, eq. 3 to 8, written to be read: NumPy, a jittered grid, marched shadows."""

from __future__ import annotations

import math

import numpy as np

from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.scattering import surface_model as model

START, STEP, REACH = 1 / 64, 1 / 32, 5.0
"""Begin, step and length of shadow rays, in cells."""


def segment_at(material: SurfaceMaterial, row: int, column: int) -> tuple[bool, float, int]:
    """(warp on top, middle of the segment along the yarn relative to the cell's start, length in cells)."""
    warp = bool(material.weave[row, column])
    line = material.weave[:, column] if warp else ~material.weave[row]
    here, period = (row, len(line)) if warp else (column, len(line))
    first = here
    while line[(first - 1) % period]:
        first -= 1
    last = here
    while line[(last + 1) % period]:
        last += 1
    length = last - first + 1
    return warp, first + length / 2 - here, length


class Surface:
    """Frame and height at points (n, 2) in cells, tabulated by crossing."""

    def __init__(self, material: SurfaceMaterial) -> None:
        self.material = material
        self.table = [[segment_at(material, r, c) for c in range(material.columns)] for r in range(material.rows)]

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Warp on top, gap, u, v, length, inclination at each point."""
        m = self.material
        x, y = points[..., 0] % m.columns, points[..., 1] % m.rows
        column, row = np.minimum(x.astype(int), m.columns - 1), np.minimum(y.astype(int), m.rows - 1)
        table = np.array([[(w, mid, length) for w, mid, length in line] for line in self.table])[row, column]
        warp, middle, length = table[..., 0] > 0.5, table[..., 1], table[..., 2]
        across = np.where(warp, x - column - 0.5, -(y - row - 0.5))
        along = np.where(warp, y - row, x - column) - middle
        inclination = np.where(warp, m.inclination[0], m.inclination[1])
        return (
            warp,
            np.abs(across) > m.half_width,
            inclination * along / (length / 2),
            np.pi * across,
            length,
            inclination,
        )

    def frame(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """(warp, gap, normal, fiber direction)."""
        m = self.material
        warp, gap, u, v, _, _ = self.locate(points)
        psi = np.where(warp, m.twist[0], m.twist[1])
        normal = np.stack([np.sin(v), np.sin(u) * np.cos(v), np.cos(u) * np.cos(v)], axis=-1)
        t = np.stack(
            [
                -np.cos(v) * np.sin(psi),
                np.cos(u) * np.cos(psi) + np.sin(u) * np.sin(v) * np.sin(psi),
                -np.sin(u) * np.cos(psi) + np.cos(u) * np.sin(v) * np.sin(psi),
            ],
            axis=-1,
        )
        normal[..., :2] *= m.height_scale
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        t -= np.sum(t * normal, axis=-1, keepdims=True) * normal
        t /= np.linalg.norm(t, axis=-1, keepdims=True)
        # (across, along) to (x, y)
        for vector in (normal, t):
            a, b = vector[..., 0].copy(), vector[..., 1].copy()
            vector[..., 0], vector[..., 1] = np.where(warp, a, b), np.where(warp, b, -a)
        normal[gap], t[gap] = (0.0, 0.0, 1.0), 0.0
        return warp, gap, normal, t

    def height(self, points: np.ndarray) -> np.ndarray:
        """Integral of the slopes -beta tan v across and -beta tan u along, 0 on the crest's ends."""
        m = self.material
        _, gap, u, v, length, inclination = self.locate(points)
        side = np.log(np.cos(np.minimum(np.abs(v), np.pi * m.half_width))) / np.pi
        arch = length / 2 / inclination * np.log(np.cos(u) / np.cos(inclination))
        return m.height_scale * (side + np.where(gap, 0.0, arch))

    def free(self, points: np.ndarray, w: np.ndarray) -> np.ndarray:
        """V: whether a ray towards ``w`` (up) leaves the tile unhindered."""
        open_ = np.ones(len(points), dtype=bool)
        start, across = self.height(points), math.hypot(w[0], w[1])
        if across < 1e-9:
            return open_
        for reach in np.arange(START, REACH, STEP):
            there = points + reach / across * w[:2]
            open_ &= start + reach / across * w[2] >= self.height(there)
        return open_


def aggregate_slowly(
    material: SurfaceMaterial, query: np.ndarray, transmission: bool = False, side: int = 90, blend: float = 0.5
) -> np.ndarray:
    """(5,): C_warp, C_weft, S_warp, S_weft and the visible share of gaps of one query."""
    u, v, size = query[:3]
    wi = query[3:6]
    wo = np.array([query[6], query[7], math.sqrt(1 - query[6] ** 2 - query[7] ** 2)])
    # Jittered: a regular grid would meet the regular yarns at a few places only.
    corners = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    places = (corners + np.random.default_rng(0).random(corners.shape)) / side - 0.5
    points = ([u, v] + size * places) * [material.columns, material.rows]
    surface = Surface(material)
    warp, gap, normal, t = surface.frame(points)

    facing = np.maximum(normal @ wo, 0.0)
    area = facing / normal[:, 2] * surface.free(points, wo)  # eq. 4
    towards = wi * [1, 1, -1] if transmission else wi
    cosine = np.maximum((-normal if transmission else normal) @ wi, 0.0)
    lit = surface.free(points, towards) & (cosine > 0) & ~gap
    with np.errstate(divide="ignore", invalid="ignore"):
        term = model.specular_transmission if transmission else model.specular_reflection
        safe = np.where(gap[:, None], [1.0, 0.0, 0.0], t)
        specular = np.where(lit & (facing > 0), term(wi, wo, normal, safe, material.roughness) * cosine, 0.0)
    diffuse = lit * (blend * cosine + (1 - blend) * abs(wi[2])) / np.pi  # f^d <wi.n_s>
    total = area.sum()
    if total == 0:
        return np.zeros(5)
    parts = [np.sum((value * area)[system]) for value in (diffuse, specular) for system in (warp, ~warp)]
    return np.array([*parts, np.sum(area[gap])]) / total
