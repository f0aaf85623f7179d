"""What a camera sees at once, before any kernel is compiled: NumPy and Embree's packets of rays.

One ray for each pixel, to surfaces and into the fibers of cloth, lit by a lamp at the camera. No lights, no shadows, no
textures: a picture to look at for as long as compiling takes, not an estimate of anything.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from usdfab.tracer import embree
from usdfab.tracer.tangents import unpack_tangents
from usdfab.tracer.world import (
    FIRST_CURVE,
    FIRST_PATCH,
    HEIGHT,
    HIGH,
    LOW,
    MATERIAL,
    UNITS,
    UV_SCALE,
    WIDTH,
)

if TYPE_CHECKING:
    from usdfab.tracer.patch_scene import PatchScene
    from usdfab.tracer.render import Tracer
    from usdfab.usd.scene import Camera

BRIGHTNESS = 0.8
"""Of a white surface that faces the camera."""

_LANES, _ROWS = 16, 24
_ORG, _TNEAR, _DIR, _TFAR, _MASK, _NG, _U, _V, _PRIM, _GEOM, _INST = 0, 3, 4, 8, 9, 12, 15, 16, 17, 18, 19
"""Rows of an RTCRayHit16, each of 16 values (rtcore_ray.h)."""
_INVALID = 0xFFFFFFFF
_MAX_TILES = 64

Floats = NDArray[np.float64]


class Hits(NamedTuple):
    """What rays (N,) met; ``t`` is the end of the ray where ``hit`` is false."""

    hit: NDArray[np.bool_]
    t: Floats
    normal: Floats
    u: Floats
    v: Floats
    prim: NDArray[np.int64]
    copy: NDArray[np.int64]

    def of(self, rays: NDArray) -> Hits:
        """Those of some rays: a mask or numbers."""
        return Hits(
            self.hit[rays], self.t[rays], self.normal[rays], self.u[rays], self.v[rays], self.prim[rays],
            self.copy[rays],
        )  # fmt: skip


def preview(tracer: Tracer, camera: Camera, width: int, height: int) -> NDArray[np.float32]:
    """A picture (height, width, 3), linear: what is there, lit from the camera."""
    world = tracer.world
    origins, directions = _camera_rays(camera, width, height)
    hits = trace(int(world.embree[3]), origins, directions, np.full(len(origins), np.inf))
    color = np.zeros((len(origins), 3))
    seen = np.flatnonzero(hits.hit)
    if len(seen):
        color[seen] = _shade(tracer, directions[seen], hits.of(seen))
    return (BRIGHTNESS * color).reshape(height, width, 3).astype(np.float32)


def _camera_rays(camera: Camera, width: int, height: int) -> tuple[Floats, Floats]:
    """(H W, 3) origins and unit directions through places in the pixels, when the shutter opens; no lens.

    Any places, the same each time: through the middles, cloth would show moire.
    """
    jitter = np.random.default_rng(0).random((2, height, width))
    s = 2.0 * (np.arange(width) + jitter[0]) / width - 1.0
    t = 1.0 - 2.0 * (np.arange(height)[:, None] + jitter[1]) / height
    x, y = camera.tan_half[0] * (s + camera.offset[0]), camera.tan_half[1] * (t + camera.offset[1])
    local = np.stack([x, y, np.full(x.shape, -1.0)], axis=-1).reshape(-1, 3)
    matrix = np.asarray(camera.to_world, dtype=float)
    directions = local @ matrix[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to(matrix[:3, 3], directions.shape), directions


def trace(scene: int, origins: Floats, directions: Floats, ends: Floats, near: float = 0.0) -> Hits:
    """Nearest hits of rays (N, 3) in an Embree scene, given by its handle.

    The calls keep Python's lock: to give it away 20,000 times, while another thread compiles, would take minutes.
    """
    count = len(origins)
    packets = -(-count // _LANES)
    memory = np.zeros(packets * _ROWS * _LANES + 16, dtype=np.float32)
    shift = (-memory.ctypes.data // 4) % 16  # aligned to 64 bytes
    floats = memory[shift : shift + packets * _ROWS * _LANES].reshape(packets, _ROWS, _LANES)
    words = floats.view(np.uint32)

    def put(row: int, values: NDArray | float) -> None:
        lane = np.full(packets * _LANES, -1.0, dtype=np.float32)  # spare rays end before they begin
        lane[:count] = values
        floats[:, row] = lane.reshape(packets, _LANES)

    for axis in range(3):
        put(_ORG + axis, origins[:, axis])
        put(_DIR + axis, directions[:, axis])
    put(_TNEAR, near)
    put(_TFAR, ends)
    words[:, _MASK] = words[:, _GEOM] = words[:, _INST] = _INVALID
    valid = np.full(_LANES + 16, -1, dtype=np.int32)
    lanes = valid.ctypes.data + (-valid.ctypes.data % 64)
    call = ctypes.PYFUNCTYPE(None, *4 * [ctypes.c_void_p])(embree.packet_address())
    start, step = floats.ctypes.data, 4 * _ROWS * _LANES
    for k in range(packets):
        call(lanes, scene, start + k * step, None)

    def get(of: NDArray, row: int) -> NDArray:
        return of[:, row].reshape(-1)[:count]

    copy = get(words, _INST).astype(np.int64)
    return Hits(
        get(words, _GEOM) != _INVALID,
        get(floats, _TFAR).astype(float),
        np.stack([get(floats, _NG + axis) for axis in range(3)], axis=1).astype(float),
        get(floats, _U).astype(float),
        get(floats, _V).astype(float),
        get(words, _PRIM).astype(np.int64),
        np.where(copy == _INVALID, -1, copy),
    )


def _shade(tracer: Tracer, directions: Floats, hits: Hits) -> Floats:
    """(N, 3) colours of hits on meshes."""
    world, macro = tracer.world, tracer.world.macro
    placed = hits.copy >= 0
    prim = hits.prim.copy()
    prim[placed] += macro.first[hits.copy[placed]]
    material = macro.material[prim]
    # A hit's normal is in the space of the copy that was hit: normals go by the inverse transpose.
    normal = np.array(macro.faces[0, prim], dtype=float)
    turned = np.linalg.inv(macro.placements[0, hits.copy[placed], :, :3]).transpose(0, 2, 1)
    normal[placed] = np.einsum("kij,kj->ki", turned, normal[placed])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    facing = abs(np.einsum("kx,kx->k", normal, directions))
    fabric = macro.fabrics[material, FIRST_PATCH] >= 0.0
    color = np.where(fabric[:, None], 0.5, world.materials.rows[material, :3]) * facing[:, None]
    for first in np.unique(macro.fabrics[material[fabric], FIRST_PATCH]).astype(int):
        albedo = world.patches.albedo[world.patches.curves[int(world.patches.table[first, FIRST_CURVE]), MATERIAL], :3]
        own = fabric & (macro.fabrics[material, FIRST_PATCH] == first)
        color[own] = albedo * facing[own, None]
        into = np.flatnonzero(own & ~placed)  # cloth on placed copies is shown without its fibers
        color[into] = _cloth(tracer, first, directions[into], prim[into], hits.u[into], hits.v[into])
    return color


def _cloth(tracer: Tracer, first: int, directions: Floats, prim: NDArray[np.int64], u: Floats, v: Floats) -> Floats:
    """(N, 3) colours where rays meet cloth: of the fibers of the tile ``first``, black where they go through."""
    macro, patches = tracer.world.macro, tracer.world.patches
    table = patches.table[first]
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    corner = np.einsum("kc,kcx->kx", weights, macro.corners[0, prim].astype(float))
    texture = np.einsum("kc,kcx->kx", weights, macro.uv[prim]) * macro.fabrics[macro.material[prim], UV_SCALE][:, None]
    normal = corner[:, :3] / np.maximum(np.linalg.norm(corner[:, :3], axis=1, keepdims=True), 1e-300)
    # World to patch, as in ``slab.enter_slab``: gradients of the cloth's x and y in the plane, the normal scaled alike.
    gradients = corner[:, 3:].reshape(-1, 2, 3)
    gradients = gradients - np.einsum("kgx,kx->kg", gradients, normal)[..., None] * normal[:, None]
    area = np.abs(np.einsum("kx,kx->k", np.cross(gradients[:, 0], gradients[:, 1]), normal))
    maps = table[UNITS] * np.concatenate([gradients, (np.sqrt(area)[:, None] * normal)[:, None]], axis=1)
    flight = np.einsum("kij,kj->ki", maps, directions)
    flight /= np.maximum(np.linalg.norm(flight, axis=1, keepdims=True), 1e-300)
    color = np.zeros((len(prim), 3))
    alive = np.flatnonzero((area > 0.0) & (abs(flight[:, 2]) > 1e-3))
    d = flight[alive]
    border = np.where(d[:, 2] < 0.0, table[HIGH], table[LOW])
    place = np.c_[table[UNITS] * texture[alive], np.zeros(len(alive))] + (border / d[:, 2])[:, None] * d
    size = table[[WIDTH, HEIGHT]]
    place[:, :2] = np.mod(place[:, :2], size)
    for _ in range(_MAX_TILES):
        if not len(alive):
            break
        with np.errstate(divide="ignore"):
            to_side = np.where(d[:, :2] > 0.0, size - place[:, :2], -place[:, :2]) / np.where(
                d[:, :2] == 0.0, 1e-300, d[:, :2]
            )
        to_end = np.where(d[:, 2] > 0.0, table[HIGH] - place[:, 2], table[LOW] - place[:, 2]) / d[:, 2]
        way = np.maximum(np.c_[to_side, to_end], 0.0)
        axis = way.argmin(axis=1)
        t = way.min(axis=1)
        hits = trace(int(patches.handles[first]), place, d, t)
        color[alive[hits.hit]] = _fibers(tracer.tiles[first][1], d[hits.hit], hits.of(hits.hit))
        place = place + t[:, None] * d
        for side in range(2):
            here = axis == side
            place[here, side] = np.where(d[here, side] > 0.0, 0.0, size[side])
        on = ~hits.hit & (axis < 2)
        alive, d, place = alive[on], d[on], place[on]
    return color


def _fibers(tile: PatchScene, directions: Floats, hits: Hits) -> Floats:
    """(N, 3) colours of fibers, brighter across than along (Kajiya and Kay 1989) and where they face the camera."""
    start, curve = tile.segments[hits.prim].T
    ends = [unpack_tangents(tile.tangents[vertex]) for vertex in (start, start + 1)]
    tangent = (1.0 - hits.u)[:, None] * ends[0] + hits.u[:, None] * ends[1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    along = np.einsum("kx,kx->k", tangent, directions)
    normal = hits.normal / np.maximum(np.linalg.norm(hits.normal, axis=1, keepdims=True), 1e-300)
    facing = abs(np.einsum("kx,kx->k", normal, directions))
    return tile.albedo[tile.curves[curve, MATERIAL], :3] * (facing * np.sqrt(np.maximum(1.0 - along**2, 0.0)))[:, None]
