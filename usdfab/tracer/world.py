"""What kernels read: all arrays of a scene, packed, without Python objects."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.tracer.intrinsics import KERNEL, borrow
from usdfab.tracer.lights import Lights
from usdfab.tracer.textures import Materials, Textures

# Columns of ``Patches.table``. Lengths in patch units.
WIDTH, HEIGHT, LOW, HIGH, EPSILON, UNITS, FIRST_CURVE = 0, 1, 2, 3, 4, 5, 6
PATCH_COLUMNS = 7

# Columns of ``Patches.curves``.
YARN, MATERIAL = 0, 1

# Columns of ``Macro.fabrics``.
FIRST_PATCH, VARIANTS, UV_SCALE, ALBEDO_MAP = 0, 1, 2, 3
FABRIC_COLUMNS = 4


class Patches(NamedTuple):
    """All tiles of a scene; the variants of one fabric lie side by side.

    Parameters
    ----------
    table: (P, PATCH_COLUMNS)
        Size and lowest and highest place of the tile, shortest ray, patch units per metre, first of its curves in
        ``curves``.
    handles: (P,)
        Embree scenes.
    records: (P, 2)
        Addresses of the tiles' tangents and segments (``PatchScene``), which kernels read where they are.
    materials: (M, FIBER_SIZE)
        Packed by ``pack_fiber``.
    albedo: (M, 4)
        Fiber albedo coefficient C (3) and 1 / q(gamma_N), with which C becomes absorption.
    curves: (C, 2) int32
        1 + yarn, warp first, and row of ``materials`` of each curve; all patches, one after the other.
    later: int
        From a row of ``materials`` to the one that later bounces see; 0: the same.
    """

    table: NDArray[np.float64]
    handles: NDArray[np.uint64]
    records: NDArray[np.uint64]
    materials: NDArray[np.float64]
    albedo: NDArray[np.float64]
    curves: NDArray[np.int32]
    later: int = 0


class Macro(NamedTuple):
    """Triangles of all meshes (T) and placed copies of meshes (I). Metres; world space, or a copy's own space.

    K is 2 where anything moves while the shutter is open (opening, closing), else 1.

    Parameters
    ----------
    corners: (K, T, 3, 9) float32
        Shading normal, and the gradients of the cloth's x and y over the surface (metres of cloth per metre).
    faces: (K, T, 3) float32
        Unit normals of the triangles, counter-clockwise side.
    uv: (T, 3, 2)
        Texture coordinates.
    tint: (N, 3, 3) float32
        Factors of the fiber albedo at the corners; triangle t has row ``t`` where ``tinted`` is 1.
    tinted: (T,) int32
        Row of ``tint`` or -1.
    material, mesh: (T,) int32
        Index into ``fabrics`` and the scene's materials; number of the mesh.
    fabrics: (materials, FABRIC_COLUMNS)
        First patch (-1: a surface), number of variants, metres of cloth per unit of uv, texture of the albedo or -1.
    placements: (K, I, 3, 4)
        Copies: own space to world.
    first: (I,) int32
        First triangle of the mesh that a copy shows.
    bounds: (2, 3)
        Of everything, at all times.
    """

    corners: NDArray[np.float32]
    faces: NDArray[np.float32]
    uv: NDArray[np.float64]
    tint: NDArray[np.float32]
    tinted: NDArray[np.int32]
    material: NDArray[np.int32]
    mesh: NDArray[np.int32]
    fabrics: NDArray[np.float64]
    placements: NDArray[np.float64]
    first: NDArray[np.int32]
    bounds: NDArray[np.float64]
    meshes: int


class World(NamedTuple):
    """Everything the kernel reads. ``embree`` holds addresses: rtcIntersect1, rtcOccluded1, filter, macro scene."""

    macro: Macro
    patches: Patches
    materials: Materials
    textures: Textures
    lights: Lights
    embree: tuple[np.uint64, np.uint64, np.uint64, np.uint64]


class View(NamedTuple):
    """A camera for kernels.

    Parameters
    ----------
    to_world: (2, 3, 4)
        Camera space to world at the shutter's opening and closing.
    film: (4,)
        Tangents of the half angles and film offset.
    lens: (2,)
        Radius of the lens, distance of the plane in focus; metres.
    width, height:
        Of the image in pixels.
    moves:
        Whether rays have different times.
    """

    to_world: NDArray[np.float64]
    film: NDArray[np.float64]
    lens: NDArray[np.float64]
    width: int
    height: int
    moves: bool


@njit(**KERNEL)
def borrowed(world):
    """The world with arrays that are not reference-counted (see ``intrinsics.borrow``)."""
    m, p, s, t, li = world.macro, world.patches, world.materials, world.textures, world.lights
    macro = Macro(
        borrow(m.corners), borrow(m.faces), borrow(m.uv), borrow(m.tint), borrow(m.tinted), borrow(m.material),
        borrow(m.mesh), borrow(m.fabrics), borrow(m.placements), borrow(m.first), borrow(m.bounds), m.meshes,
    )  # fmt: skip
    patches = Patches(
        borrow(p.table), borrow(p.handles), borrow(p.records), borrow(p.materials), borrow(p.albedo), borrow(p.curves),
        p.later,
    )  # fmt: skip
    return World(
        macro,
        patches,
        Materials(borrow(s.rows), borrow(s.textures)),
        Textures(borrow(t.texels), borrow(t.table)),
        Lights(borrow(li.table), borrow(li.image), borrow(li.rows), borrow(li.columns), li.deltas),
        world.embree,
    )
