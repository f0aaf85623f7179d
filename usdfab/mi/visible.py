"""Which parts of a cloth a camera sees, in the cloth's own plane, so that only these are made of fibers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from usdfab.fabric import FabricParameters
from usdfab.usd.expand.place import Box
from usdfab.usd.expand.surface import ClothSurface
from usdfab.usd.scene import Camera

Floats = NDArray[np.float64]
Window = tuple[float, float, float, float]
"""(left, bottom, right, top) of a part of the film, whose borders are at -1 and 1."""

MARGIN_CELLS = 4
"""Cells of the weave around what the camera sees that count as seen: what light from there adds can be seen."""

FINE_MESH = 500
"""Where more triangles than this are in view, all that they cover is taken; else rays find out which part of them."""

_RAYS = 48
"""Rays on each side of the picture."""


def visible_boxes(
    place: ClothSurface, camera: Camera, fabric: FabricParameters, window: Window, margin: float = MARGIN_CELLS
) -> list[Box]:
    """Boxes of cloth (x0, y0, x1, y1), metres, that do not overlap and hold all that is in view and ``margin`` cells.

    Cloth behind other cloth counts as seen: light comes through.
    """
    near = np.flatnonzero(_in_window(place, camera, window))
    if len(near) > FINE_MESH:
        xy = place.xy[near].reshape(-1, 2)
    else:
        s = np.linspace(window[0], window[2], _RAYS) + camera.offset[0]
        t = np.linspace(window[1], window[3], _RAYS) + camera.offset[1]
        x, y = np.meshgrid(camera.tan_half[0] * s, camera.tan_half[1] * t)
        directions = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)], axis=1) @ camera.to_world[:3, :3].T
        xy = np.concatenate([_met(place, near, camera.to_world[:3, 3], d) for d in directions])
    return boxes_around(xy, margin * max(fabric.cell))


def boxes_around(places: Floats, margin: float) -> list[Box]:
    """Boxes that hold all places (N, 2) and ``margin`` around them; one for each group, joined where they overlap."""
    if len(places) == 0:
        return []
    cell = np.unique(np.floor(places / margin).astype(np.int64), axis=0, return_inverse=True)
    squares, owner = cell[0], cell[1].ravel()
    pairs = cKDTree(squares).query_pairs(2.5, p=np.inf, output_type="ndarray").reshape(-1, 2)
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(squares),) * 2)
    count, label = connected_components(links, directed=False)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, label[owner], places - margin)
    np.maximum.at(high, label[owner], places + margin)
    boxes = np.concatenate([low, high], axis=1)
    k = 0
    while k < len(boxes):
        over = ((boxes[:, :2] < boxes[k, 2:]) & (boxes[:, 2:] > boxes[k, :2])).all(axis=1)
        if over.sum() == 1:
            k += 1
            continue
        joined = np.r_[boxes[over, :2].min(axis=0), boxes[over, 2:].max(axis=0)]
        # The larger box may overlap those that were settled.
        boxes, k = np.concatenate([joined[None], boxes[~over]]), 0
    return [(float(a), float(b), float(c), float(d)) for a, b, c, d in boxes]


def _in_window(place: ClothSurface, camera: Camera, window: Window) -> NDArray[np.bool_]:
    """(T,) triangles that may be in a window: the boxes of their pictures overlap it, or they reach beside the eye."""
    local = (place.points - camera.to_world[:3, 3]) @ camera.to_world[:3, :3]
    depth = -local[..., 2]
    film = local[..., :2] / np.where(depth > 0.0, depth, 1.0)[..., None] / camera.tan_half - camera.offset
    low, high = film.min(axis=1), film.max(axis=1)
    overlap = ((low <= window[2:]) & (high >= window[:2])).all(axis=1)
    return np.where((depth > 0.0).all(axis=1), overlap, (depth > 0.0).any(axis=1))


def _met(place: ClothSurface, triangles: NDArray[np.int64], origin: Floats, direction: Floats) -> Floats:
    """(N, 2) places of the cloth, metres, at which a ray meets triangles, all layers (Moeller and Trumbore)."""
    corners = place.points[triangles]
    a = corners[:, 0]
    e1, e2 = corners[:, 1] - a, corners[:, 2] - a
    p = np.cross(direction, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.einsum("tx,tx->t", e1, p)
        q = origin - a
        u = np.einsum("tx,tx->t", q, p) * inverse
        r = np.cross(q, e1)
        v = r @ direction * inverse
        t = np.einsum("tx,tx->t", e2, r) * inverse
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    weights = np.stack([1.0 - u - v, u, v], axis=1)[hit]
    return np.einsum("tc,tcx->tx", weights, place.xy[triangles[hit]])
