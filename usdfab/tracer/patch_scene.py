"""A fiber patch as an Embree scene: everything that overlaps one tile, so that the tile can repeat for ever.

Curves are the cubic B-splines that the expanded USD asset and Mitsuba draw. Embree gets them as round linear segments
between some of the spline's knots (``knots.py``), with its tangent at each vertex, so that the shading frame is smooth.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.fabric import SYSTEMS
from usdfab.fibers import FiberSystem, OpenCurves, Patch, generate_patch, patch_variants
from usdfab.fibers.tiles import tile_copies
from usdfab.scattering.fiber_numba import pack_fiber
from usdfab.scattering.roughness import absorption_from_albedo
from usdfab.tracer.embree import NEIGHBOR_LEFT, NEIGHBOR_RIGHT, EmbreeScene, curve_scene
from usdfab.tracer.knots import knots_of, polylines

FIBER_RADIUS_UNITS = 0.1
"""Radius of the thinnest fiber in patch space. Embree's curve intersector has thresholds that are not relative: in
metres, with fibers of 1e-5, it returns wrong places along the segment."""

DARKEST = 1e-4
"""Least fiber albedo coefficient: 0 would be infinitely absorbing."""


@dataclass(frozen=True)
class PatchScene:
    """One tile, ready for the kernels. Lengths in units of which ``units_per_meter`` make a metre.

    ``segments`` (S, 8) int16, packed by ``pack_segments``; ``curves`` (curves, 2) 1 + yarn, warp first, then weft, and
    row of ``materials``; ``materials`` (M, N) packed by ``pack_fiber``; ``albedo`` (M, 4) fiber albedo coefficients and
    1 / q(gamma_N); ``systems`` (M,) whose they are: 0 warp, 1 weft.
    """

    size: tuple[float, float]
    z_range: tuple[float, float]
    scene: EmbreeScene
    segments: NDArray[np.int16]
    materials: NDArray[np.float64]
    albedo: NDArray[np.float64]
    curves: NDArray[np.int32]
    systems: NDArray[np.int32]
    units_per_meter: float
    epsilon: float
    """Shortest ray: hits nearer than this are the surface the ray starts on."""

    @property
    def nbytes(self) -> int:
        """Bytes of vertices, indices and records; Embree's hierarchy comes on top."""
        return self.scene.nbytes + self.segments.nbytes + self.materials.nbytes + self.curves.nbytes


def build_tiles(fabric: FabricParameters) -> list[PatchScene]:
    """The tiles of a fabric: its variants, any of which can stand anywhere. The first is that of ``variants`` = 1."""
    patches = patch_variants(fabric, copies=tile_copies(fabric))
    with ThreadPoolExecutor(min(len(patches), os.cpu_count() or 1)) as pool:
        return list(pool.map(partial(build_patch_scene, fabric), patches))


def build_patch_scene(fabric: FabricParameters, patch: Patch | None = None) -> PatchScene:
    """The patch of a fabric (or the given one) as an Embree scene with packed fiber materials."""
    if patch is None:
        patch = generate_patch(fabric, copies=tile_copies(fabric))
    radius = min(s.radius for s in patch.systems)
    units = FIBER_RADIUS_UNITS / radius
    vertices, first, flags, segments = [], [], [], []
    curves: list[NDArray] = []
    materials: list[NDArray] = []
    systems: list[int] = []
    albedo: list[tuple[float, ...]] = []
    base = 0
    for system in patch.curves:
        yarn = fabric.system(system.system)
        colors, color_of_curve = np.unique(system.albedo, axis=0, return_inverse=True)
        v, t, f, g, curve = _tile_segments(system, patch.size)
        vertices.append(units * np.c_[v, np.full(len(v), system.radius)])
        first.append(f + base)
        flags.append(g)
        segments.append(pack_segments(t[f], t[f + 1], curve + sum(len(c) for c in curves)))
        first_yarn = 1 if system.system == "warp" else 2 + int(patch.warp.yarn.max())
        curves.append(np.c_[system.yarn + first_yarn, color_of_curve.reshape(-1) + len(materials)])
        base += len(v)
        for color in colors:
            own = pack_material(yarn, tuple(color))
            materials.append(own[0])
            albedo.append(own[1])
            systems.append(SYSTEMS.index(system.system))
    segment_vertex = np.concatenate(first).astype(np.int32)
    scene = curve_scene(np.concatenate(vertices), segment_vertex, np.concatenate(flags))
    low, high = patch.z_range
    return PatchScene(
        size=(units * patch.size[0], units * patch.size[1]),
        z_range=(units * (low - 1e-3 * radius), units * (high + 1e-3 * radius)),
        scene=scene,
        segments=np.concatenate(segments),
        materials=np.stack(materials),
        albedo=np.asarray(albedo),
        curves=np.concatenate(curves).astype(np.int32),
        systems=np.asarray(systems, dtype=np.int32),
        units_per_meter=units,
        epsilon=5e-3 * FIBER_RADIUS_UNITS,
    )


def pack_segments(start: NDArray, end: NDArray, curve: NDArray) -> NDArray[np.int16]:
    """(S, 8) what a hit needs to know of its segment, in 16 bytes.

    The spline's unit tangents at both ends (S, 3), 32767 for 1: kernels use their direction only. Then the curve's
    number, its lower 16 bits first.
    """
    tangents = np.rint(32767.0 * np.c_[start, end]).astype(np.int16)
    return np.c_[tangents, np.asarray(curve, dtype="<u4").view("<i2").reshape(-1, 2)]


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
    about their common vertex, does not.

    Returns vertices (V, 3), tangents (V, 3), first vertex (S,), neighbour flags (S,) and curve (S,).
    """
    points, tangents, offsets = knots_of(*system.pinned()) if isinstance(system, OpenCurves) else polylines(system)
    curve_of_vertex = np.repeat(np.arange(system.curves), np.diff(offsets))
    place = np.arange(len(points)) - offsets[:-1][curve_of_vertex]
    lengths = np.diff(offsets)[curve_of_vertex]
    if isinstance(system, OpenCurves):
        starts = np.flatnonzero(place <= lengths - 2)
    else:
        # A curve's own segments: from vertex 1 up to the first vertex of its successor, one vertex spare each side.
        starts = np.flatnonzero((place >= 1) & (place <= lengths - 4))
    # Which vertices have a segment before and after the one that starts there, be it a spare one.
    joined = place > 0, place < lengths - 2
    own = np.zeros(len(points) + 1, dtype=bool)
    own[starts] = True
    low = np.minimum(points[starts], points[starts + 1])[:, :2] - system.radius
    high = np.maximum(points[starts], points[starts + 1])[:, :2] + system.radius

    # Fibers reach the tiles beside their own; flyaways may reach farther.
    nearest = np.floor(-high.max(axis=0, initial=0.0) / size).astype(int) + 1
    farthest = np.ceil(1.0 - low.min(axis=0, initial=0.0) / size).astype(int) - 1
    out_v, out_t, out_f, out_g, out_c = [], [], [], [], []
    base = 0
    for i in range(nearest[0], farthest[0] + 1):
        for j in range(nearest[1], farthest[1] + 1):
            shift = np.array([i * size[0], j * size[1], 0.0])
            inside = np.all((high + shift[:2] > 0.0) & (low + shift[:2] < np.asarray(size)), axis=1)
            chosen = starts[inside]
            if not len(chosen):
                continue
            used = np.zeros(len(points), dtype=bool)
            here = np.zeros(len(points) + 1, dtype=bool)
            here[chosen] = True
            # A spare neighbour stands for a segment of another curve, of which nothing is known here.
            before, after = (
                flag[chosen] & (here[chosen + step] | ~own[chosen + step])
                for flag, step in zip(joined, (-1, 1), strict=True)
            )
            for neighbors in (chosen, chosen + 1, chosen[before] - 1, chosen[after] + 2):
                used[neighbors] = True
            new_index = np.cumsum(used) - 1
            out_v.append(points[used] + shift)
            out_t.append(tangents[used])
            out_f.append(new_index[chosen] + base)
            out_g.append((NEIGHBOR_LEFT * before + NEIGHBOR_RIGHT * after).astype(np.uint8))
            out_c.append(curve_of_vertex[chosen])
            base += int(used.sum())
    return tuple(np.concatenate(out) for out in (out_v, out_t, out_f, out_g, out_c))  # type: ignore[return-value]
