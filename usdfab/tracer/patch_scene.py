"""A fiber patch as an Embree scene: everything that overlaps one tile, so that the tile can repeat for ever.

Curves are the cubic B-splines that the expanded USD asset and Mitsuba draw. Embree gets them as round linear segments
between some of the spline's knots (``knots.py``), with its tangent at each vertex, so that the shading frame is smooth.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.fabric import SYSTEMS
from usdfab.fibers import FiberSystem, OpenCurves, Patch, generate_patch, patch_variants
from usdfab.fibers.shades import LEVELS, shaded_albedo
from usdfab.fibers.tiles import tile_copies
from usdfab.scattering.fiber_numba import pack_fiber
from usdfab.scattering.roughness import absorption_from_albedo
from usdfab.tracer.embree import NEIGHBOR_LEFT, NEIGHBOR_RIGHT, EmbreeScene, curve_scene
from usdfab.tracer.knots import knots_of, polylines
from usdfab.tracer.tangents import pack_tangents

FIBER_RADIUS_UNITS = 0.1
"""Radius of the thinnest fiber in patch space. Embree's curve intersector has thresholds that are not relative: in
metres, with fibers of 1e-5, it returns wrong places along the segment."""

DARKEST = 1e-4
"""Least fiber albedo coefficient: 0 would be infinitely absorbing."""


@dataclass(frozen=True)
class PatchScene:
    """One tile, ready for the kernels. Lengths in units of which ``units_per_meter`` make a metre.

    ``tangents`` (V,) of the spline at the vertices, by ``pack_tangents``; ``curves`` (curves, 2) 1 + yarn, warp first,
    then weft, and row of ``materials``; ``materials`` (M, N) packed by ``pack_fiber``; ``albedo`` (M, 4) fiber albedo
    coefficients and 1 / q(gamma_N); ``systems`` (M,) whose they are: 0 warp, 1 weft.
    """

    size: tuple[float, float]
    z_range: tuple[float, float]
    scene: EmbreeScene
    tangents: NDArray[np.uint32]
    materials: NDArray[np.float64]
    albedo: NDArray[np.float64]
    curves: NDArray[np.int32]
    systems: NDArray[np.int32]
    units_per_meter: float
    epsilon: float
    """Shortest ray: hits nearer than this are the surface the ray starts on."""

    @property
    def vertices(self) -> NDArray[np.float32]:
        """(V, 4) x, y, z, radius: Embree's buffer."""
        return self.scene.buffers[0]

    @property
    def segments(self) -> NDArray[np.uint32]:
        """(S, 2) first of a segment's two vertices, and number of its curve: Embree's buffer."""
        return self.scene.buffers[1]

    @property
    def nbytes(self) -> int:
        """Bytes of vertices, segments, tangents and tables; Embree's hierarchy comes on top."""
        tables = self.tangents.nbytes + self.materials.nbytes + self.albedo.nbytes + self.curves.nbytes
        return self.scene.nbytes + tables


def build_tiles(fabric: FabricParameters) -> list[PatchScene]:
    """The tiles of a fabric: its variants, any of which can stand anywhere. The first is that of ``variants`` = 1."""
    patches = patch_variants(fabric, copies=tile_copies(fabric))
    with ThreadPoolExecutor(min(len(patches), os.cpu_count() or 1)) as pool:
        return list(pool.map(partial(build_patch_scene, fabric), patches))


def redyed(tiles: Sequence[PatchScene], before: FabricParameters, after: FabricParameters) -> list[PatchScene] | None:
    """The ``tiles`` of one fabric as those of another that differs in optics only, without building fibers again.

    None where that cannot be: fibers of one colour would get several, or the fabrics differ in more than colours,
    ``albedo_variation`` (if both vary), roughnesses, index and tilt of the cuticle.
    """
    if _undyed(before) != _undyed(after):
        return None
    colors: dict[tuple[int, tuple[float, ...]], tuple[float, ...]] = {}
    for index, system in enumerate(SYSTEMS):
        old, new = (_shades(fabric.system(system)) for fabric in (before, after))
        for a, b in zip(old, new, strict=True):
            if colors.setdefault((index, a), b) != b:
                return None
    result = []
    for tile in tiles:
        own = [
            pack_material(after.system(SYSTEMS[system]), colors[system, _as_key(color)])
            for system, color in zip(tile.systems.tolist(), tile.albedo[:, :3], strict=True)
        ]
        result.append(
            replace(tile, materials=np.stack([m for m, _ in own]), albedo=np.asarray([a for _, a in own]))
        )  # fmt: skip
    return result


_OPTICS: dict[str, Any] = {
    "roughness_longitudinal": 0.5,
    "roughness_azimuthal": 0.5,
    "roughness_primary": 0.5,
    "cuticle_tilt": 0.0,
}


def _undyed(fabric: FabricParameters) -> FabricParameters:
    """The fabric without what ``redyed`` changes."""
    for system in SYSTEMS:
        yarn = fabric.system(system)
        plain = replace(
            yarn, **_OPTICS, ior=1.5, albedo=(0.5, 0.5, 0.5), yarn_albedo=((0.5, 0.5, 0.5),) * len(yarn.yarn_albedo),
            albedo_variation=0.5 if yarn.albedo_variation > 0.0 else 0.0,
        )  # fmt: skip
        fabric = replace(fabric, **{system: plain})  # type: ignore[arg-type]
    return fabric


def _shades(yarn: YarnParameters) -> list[tuple[float, ...]]:
    """Albedos of all fibers of a yarn system."""
    colors = np.asarray(yarn.colors(), dtype=float)
    if yarn.albedo_variation > 0.0:
        levels = np.arange(len(LEVELS))
        colors = np.concatenate([
            shaded_albedo(np.tile(color, (len(LEVELS), 1)), yarn.albedo_variation, levels) for color in colors
        ])  # fmt: skip
    return [_as_key(color) for color in colors]


def _as_key(color: NDArray[np.float64]) -> tuple[float, ...]:
    """A colour without its last digits, which depend on how many were computed at once."""
    return tuple(np.round(color, 12).tolist())


def build_patch_scene(fabric: FabricParameters, patch: Patch | None = None) -> PatchScene:
    """The patch of a fabric (or the given one) as an Embree scene with packed fiber materials."""
    if patch is None:
        patch = generate_patch(fabric, copies=tile_copies(fabric))
    radius = min(s.radius for s in patch.systems)
    units = FIBER_RADIUS_UNITS / radius
    vertices, tangents, segments, flags = [], [], [], []
    curves: list[NDArray] = []
    materials: list[NDArray] = []
    systems: list[int] = []
    albedo: list[tuple[float, ...]] = []
    base = 0
    with ThreadPoolExecutor(len(patch.curves)) as pool:
        pieces = list(pool.map(partial(_tile_segments, size=patch.size), patch.curves))
    for system, (v, t, f, g, curve) in zip(patch.curves, pieces, strict=True):
        yarn = fabric.system(system.system)
        colors, color_of_curve = np.unique(system.albedo, axis=0, return_inverse=True)
        vertices.append(units * np.c_[v, np.full(len(v), system.radius)])
        tangents.append(pack_tangents(t))
        segments.append(np.c_[f + base, curve + sum(len(c) for c in curves)])
        flags.append(g)
        first_yarn = 1 if system.system == "warp" else 2 + int(patch.warp.yarn.max())
        curves.append(np.c_[system.yarn + first_yarn, color_of_curve.reshape(-1) + len(materials)])
        base += len(v)
        for color in colors:
            own = pack_material(yarn, tuple(color))
            materials.append(own[0])
            albedo.append(own[1])
            systems.append(SYSTEMS.index(system.system))
    scene = curve_scene(np.concatenate(vertices), np.concatenate(segments), np.concatenate(flags))
    low, high = patch.z_range
    return PatchScene(
        size=(units * patch.size[0], units * patch.size[1]),
        z_range=(units * (low - 1e-3 * radius), units * (high + 1e-3 * radius)),
        scene=scene,
        tangents=np.concatenate(tangents),
        materials=np.stack(materials),
        albedo=np.asarray(albedo),
        curves=np.concatenate(curves).astype(np.int32),
        systems=np.asarray(systems, dtype=np.int32),
        units_per_meter=units,
        epsilon=5e-3 * FIBER_RADIUS_UNITS,
    )


def pack_material(yarn: YarnParameters, color: tuple[float, ...]) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Rows of ``PatchScene.materials`` and ``PatchScene.albedo`` for the yarn's fibers of one colour."""
    packed = pack_fiber(*fiber_parameters(yarn, color))
    # What turns ln C into the root of the absorption.
    inverse_q = float(np.sqrt(absorption_from_albedo(np.exp(-1.0), yarn.roughness_azimuthal)))
    return packed, (*color, inverse_q)


def fiber_parameters(
    yarn: YarnParameters, color: tuple[float, ...]
) -> tuple[NDArray[np.float64], float, float, float, float, float]:
    """The arguments of ``pack_fiber``."""
    return (
        np.maximum(np.asarray(color, dtype=float), DARKEST),
        yarn.roughness_longitudinal,
        yarn.roughness_azimuthal,
        yarn.roughness_primary,
        yarn.ior,
        yarn.cuticle_tilt,
    )


def _tile_segments(
    system: FiberSystem | OpenCurves, size: tuple[float, float]
) -> tuple[NDArray, NDArray, NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64]]:
    """All segments that overlap the tile [0, size], copies from the neighbouring tiles included.

    Segments know the one before and after them only where that one overlaps the tile too, else their joint, a sphere
    about their common vertex, does not. Those that follow one another, be it from a curve to its successor, share their
    vertex.

    Returns vertices (V, 3), tangents (V, 3), first vertex (S,), neighbour flags (S,) and curve (S,).
    """
    points, tangents, offsets = knots_of(*system.pinned()) if isinstance(system, OpenCurves) else polylines(system)
    curve_of_vertex = np.repeat(np.arange(system.curves), np.diff(offsets))
    place = np.arange(len(points)) - offsets[:-1][curve_of_vertex]
    lengths = np.diff(offsets)[curve_of_vertex]
    # The vertex from which the next segment starts, and how many patches on; -1: none.
    following, onward = np.arange(1, len(points) + 1), np.zeros(len(points), dtype=bool)
    if isinstance(system, OpenCurves):
        starts = np.flatnonzero(place <= lengths - 2)
        following[place == lengths - 2] = -1
    else:
        # A curve's own segments: from vertex 1 up to the first vertex of its successor, one vertex spare each side.
        starts = np.flatnonzero((place >= 1) & (place <= lengths - 4))
        onward = place == lengths - 4
        following[onward] = offsets[:-1][system.successor[curve_of_vertex[onward]]] + 1
    low = np.minimum(points[starts], points[starts + 1])[:, :2] - system.radius
    high = np.maximum(points[starts], points[starts + 1])[:, :2] + system.radius

    # Fibers reach the tiles beside their own; flyaways may reach farther.
    nearest = np.floor(-high.max(axis=0, initial=0.0) / size).astype(int) + 1
    farthest = np.ceil(1.0 - low.min(axis=0, initial=0.0) / size).astype(int) - 1
    vertex_parts, copy_parts = [], []
    for i in range(nearest[0], farthest[0] + 1):
        for j in range(nearest[1], farthest[1] + 1):
            shift = np.array([i * size[0], j * size[1]])
            chosen = starts[np.all((high + shift > 0.0) & (low + shift < np.asarray(size)), axis=1)]
            vertex_parts.append(chosen)
            copy_parts.append(np.broadcast_to([i, j], (len(chosen), 2)))
    vertex, copy = np.concatenate(vertex_parts), np.concatenate(copy_parts)
    step = np.zeros(2, dtype=int) if isinstance(system, OpenCurves) else np.rint(system.period[:2] / size).astype(int)
    order, joined = _in_a_row(vertex, copy, following[vertex], copy + onward[vertex, None] * step, len(points))
    vertex, copy = vertex[order], copy[order]

    # A vertex for the start of each segment, and one for the end where none follows.
    ends = ~np.r_[joined[1:], False]
    source = np.repeat(vertex, 1 + ends)
    first = np.arange(len(vertex)) + np.cumsum(ends) - ends
    source[first[ends] + 1] += 1
    shift = np.c_[np.repeat(copy, 1 + ends, axis=0) * size, np.zeros(len(source))]
    flags = (NEIGHBOR_LEFT * joined + NEIGHBOR_RIGHT * ~ends).astype(np.uint8)
    return points[source] + shift, tangents[source], first, flags, curve_of_vertex[vertex]


def _in_a_row(
    vertex: NDArray[np.int64],
    copy: NDArray[np.int64],
    next_vertex: NDArray[np.int64],
    next_copy: NDArray[np.int64],
    vertices: int,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Order of segments (S,) in which those that follow one another do so, and which ones follow the one before them.

    A segment is known by the vertex (S,) that it starts from and its copy (S, 2); the next one's likewise, where there
    is one. Nothing follows itself, however far one goes.
    """
    low, count = copy.min(axis=0), np.ptp(copy, axis=0) + 3

    def key(v: NDArray[np.int64], c: NDArray[np.int64]) -> NDArray[np.int64]:
        return ((c[:, 0] - low[0] + 1) * count[1] + c[:, 1] - low[1] + 1) * (vertices + 1) + v

    keys = key(vertex, copy)
    sort = np.argsort(keys, kind="stable")
    wanted = key(next_vertex, next_copy)
    found = sort[np.minimum(np.searchsorted(keys, wanted, sorter=sort), len(keys) - 1)]
    follows = np.where((next_vertex >= 0) & (keys[found] == wanted), found, -1)
    chained = follows >= 0
    head = np.ones(len(vertex), dtype=bool)
    head[follows[chained]] = False
    # Rows of segments, all at once: who is k-th in which row.
    row, rank = np.zeros(len(vertex), dtype=np.int64), np.zeros(len(vertex), dtype=np.int64)
    here = np.flatnonzero(head)
    number, k = np.arange(len(here)), 0
    while len(here):
        row[here], rank[here] = number, k
        on = chained[here]
        here, number, k = follows[here[on]], number[on], k + 1
    order = np.lexsort((rank, row))
    return order, ~head[order]
