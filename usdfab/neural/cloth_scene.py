"""Triangles as the neural renderer's kernels read them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from usdfab.neural.gbuffer import CORNER, GLOWING, NORMAL, PASSED, PLAIN, RECORD, TILE_UV, WOVEN, Cloth
from usdfab.tracer import embree
from usdfab.tracer.lights import DISTANT, DOME, POINT
from usdfab.tracer.world import FIRST_PATCH, UV_SCALE, World
from usdfab.usd.scene import Material, Scene


def pack_cloth(repeats: NDArray[np.float64], scene: Scene, world: World, mips: NDArray[np.int32]) -> Cloth:
    """What the kernels read besides the world; ``repeats`` (fabrics, 2) metres and ``mips`` as in ``gbuffer.Cloth``."""
    macro = world.macro
    own = macro.fabrics[macro.material]
    woven = own[:, FIRST_PATCH] >= 0.0
    fabric = np.where(woven, own[:, FIRST_PATCH], 0).astype(np.int32)
    records = np.zeros((len(fabric), RECORD), dtype=np.float32)
    records[:, CORNER:NORMAL] = macro.corners[0].reshape(len(fabric), NORMAL)
    records[:, NORMAL:TILE_UV] = macro.faces[0]
    records[:, TILE_UV:] = tile_coordinates(macro.uv, own[:, UV_SCALE], repeats[fabric]).reshape(len(fabric), 6)
    records[~woven, TILE_UV:] = 0.0
    kinds = np.array([_kind(material) for material in scene.materials], dtype=np.int32)[macro.material]
    kinds[woven] = np.where(_has_axes(macro.corners[0][woven]), WOVEN, PASSED)
    addresses = np.uint64(embree.packet_address()), np.uint64(embree.packet_shadow_address())
    return Cloth(
        records.ravel(), kinds, fabric, repeats.astype(np.float32).ravel(), mips,
        bool((macro.tinted >= 0).any() or (mips >= 0).any()), bool((kinds == PASSED).any()), has_bodies(world),
        addresses,
    )  # fmt: skip


def has_bodies(world: World) -> bool:
    """Whether any light has an extent, so that a ray can meet it."""
    return bool((~np.isin(world.lights.table[:, 0], (POINT, DISTANT, DOME))).any())


def tile_coordinates(
    uv: NDArray[np.float64], scale: NDArray[np.float64], repeats: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Places of corners (T, 3, 2) in repeats, moved by whole repeats so that singles hold them well.

    Parameters
    ----------
    uv: (T, 3, 2)
        Texture coordinates.
    scale: (T,)
        Metres of cloth to a unit.
    repeats: (T, 2)
        Metres.
    """
    tiles = uv * scale[:, None, None] / repeats[:, None, :]
    return tiles - np.floor(tiles[:, :1])


def _kind(material: Material) -> int:
    """Of the triangles with a material that is no cloth."""
    if material.opacity < 1.0 or "opacity" in material.textures:
        return PASSED
    return GLOWING if np.any(material.emissive) or "emissiveColor" in material.textures else PLAIN


def _has_axes(corners: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether triangles (T, 3, 9) have texture coordinates with an area, as ``gbuffer.cloth_frame`` judges it."""
    middle = corners.mean(axis=1, dtype=float)
    x, y = middle[:, 3:6], middle[:, 6:9]
    area = np.linalg.norm(np.cross(x, y), axis=1)
    size = np.maximum((x**2).sum(axis=1), (y**2).sum(axis=1))
    return (area > 1e-6 * size) & (size > 0.0)
