"""A piece of a fabric that hangs over a ball, from formulas alone: how it looks as cloth, for reports.

The ball's cap is covered along great circles; outside, the cloth falls in folds, as deep as it takes to hold each of
its circles: along these, lengths are right, along the radii within a quarter. The piece is ``YARNS`` yarns wide,
whatever the yarns' size, so that the weave can be told in a small picture.
"""

from __future__ import annotations

import numpy as np

from usdfab.fabric import FabricParameters
from usdfab.usd.bake import smooth_normals
from usdfab.usd.fabric_io import preview_color, preview_roughness
from usdfab.usd.problems import Problems
from usdfab.usd.read_textures import albedo_map
from usdfab.usd.scene import Array, Camera, DomeLight, FabricSurface, IntArray, Material, Mesh, RectLight, Scene

YARNS = 100
"""Yarns along a side of the cloth, of the system with the wider spacing."""

QUADS = 160
"""Along a side; the folds are smooth at that."""

BALL = 0.2
"""Radius of the ball over the cloth's side."""

CAP = np.radians(62.0)
"""From the ball's pole to where the cloth leaves it."""

FOLDS = 7
FLOOR = -0.39
"""Height of the floor below the ball's centre, over the cloth's side: just under the corners."""

EYE, TARGET, HALF_VIEW = (0.35, -2.2, 1.15), (0.0, 0.0, -0.125), 0.15
KEY = (1.8, -1.2, 2.2)
"""Where camera and lamp are and where they look, over the cloth's side."""


def drape_scene(fabric: FabricParameters, aspect: float = 4.0 / 3.0) -> Scene:
    """The fabric over a ball on a grey floor, under a lamp and a sky, seen by one camera. z is up.

    Parameters
    ----------
    aspect:
        Width over height of the picture.
    """
    side = YARNS * max(fabric.cell)
    problems = Problems(strict=False)
    points, triangles, uv = _cloth(side)
    normals = smooth_normals(points, triangles, triangles.astype(np.int64))
    cloth = Mesh("/Drape/Cloth", points, triangles, normals, uv, np.zeros(len(triangles), dtype=np.int32), True)
    corners = 12.0 * side * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    corners[:, 2] = FLOOR * side
    two = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    floor = Mesh("/Drape/Floor", corners, two, None, None, np.ones(2, dtype=np.int32), True)
    look = Material("/Drape/Fabric", 0, np.asarray(preview_color(fabric)), preview_roughness(fabric), 0.0, 1.0)
    grey = Material("/Drape/Grey", -1, np.full(3, 0.35), 0.9, 0.0, 1.0)
    surface = FabricSurface(look.path, fabric, 1.0, albedo_map(fabric, look.path, problems))
    eye, target, key = (side * np.asarray(p) for p in (EYE, TARGET, KEY))
    camera = Camera("/Drape/Camera", look_at(eye, target), np.array([aspect, 1.0]) * HALF_VIEW, np.zeros(2), 0.0)
    towards = look_at(key, np.zeros(3))
    edge_u, edge_v = (1.4 * side * towards[:3, k] for k in (0, 1))
    lamp = RectLight(
        "/Drape/Lamp", key - 0.5 * (edge_u + edge_v), edge_u, edge_v, -towards[:3, 2], np.array([1.0, 0.96, 0.9]) * 9.0
    )
    sky = DomeLight("/Drape/Sky", np.eye(4), np.array([0.85, 0.92, 1.0]) * 0.35)
    return Scene(
        "drape", (cloth, floor), (look, grey), (surface,), (camera,), (lamp, sky), tuple(problems.warnings), "Z"
    )


def _cloth(side: float) -> tuple[Array, IntArray, Array]:
    """Points (V, 3), triangles (T, 3) and their uv (T, 3, 2) in metres on the flat cloth, weft along x."""
    along = np.linspace(-0.5, 0.5, QUADS + 1) * side
    x, y = (a.ravel() for a in np.meshgrid(along, along))
    points = draped(np.hypot(x, y) / side, np.arctan2(y, x)) * side
    first = (np.arange(QUADS)[:, None] * (QUADS + 1) + np.arange(QUADS)).ravel()
    a, b, c, d = first, first + 1, first + QUADS + 2, first + QUADS + 1
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    flat = np.stack([x, y], axis=1) + 0.5 * side
    return points, triangles, flat[triangles]


def draped(distance: Array, angle: Array) -> Array:
    """Where points of the cloth come to lie, (V, 3), for their polar coordinates on the flat cloth; its side is 1.

    The ball's centre is the origin.
    """
    inner = np.minimum(distance, BALL * CAP)
    radius, height = BALL * np.sin(inner / BALL), BALL * np.cos(inner / BALL)
    hanging = np.maximum(distance - BALL * CAP, 0.0)
    # The slope steepens from the cap's rim to nearly upright: psi(s) = steep + (CAP - steep) exp(-s / bend), summed up.
    steep, bend = np.radians(80.0), 0.05
    s = np.linspace(0.0, 1.0, 2001)
    psi = steep + (CAP - steep) * np.exp(-s / bend)
    out, down = (np.concatenate([[0.0], np.cumsum(f(psi[:-1]) * np.diff(s))]) for f in (np.cos, np.sin))
    radius = radius + np.interp(hanging, s, out)
    height = height - np.interp(hanging, s, down)
    depth, turned = _folds(distance, radius, hanging, angle)
    radius = radius * (1.0 + depth * _wave(turned))
    return np.stack([radius * np.cos(turned), radius * np.sin(turned), height], axis=1)


def _folds(distance: Array, radius: Array, hanging: Array, angle: Array) -> tuple[Array, Array]:
    """Relative depth of the folds at points (V,), and the angles at which these lie, so that circles keep their length.

    ``distance`` on the flat cloth, mean ``radius``, length ``hanging`` below the cap's rim.
    """
    order = np.argsort(distance)
    rings = np.linspace(0.0, float(distance.max()), 65)[1:]
    mean = np.interp(rings, distance[order], radius[order])
    begun = np.clip(np.interp(rings, distance[order], hanging[order]) / 0.1, 0.0, 1.0)
    phi = np.linspace(0.0, 2.0 * np.pi, 1025)
    depths = np.linspace(0.0, 0.6, 121)
    relative = 1.0 + depths[:, None] * _wave(phi)
    steps = np.hypot(np.diff(relative, axis=1), 0.5 * (relative[:, 1:] + relative[:, :-1]) * np.diff(phi))
    wanted = 2.0 * np.pi * np.maximum(rings / mean, 1.0)
    depth = begun * np.interp(wanted, steps.sum(axis=1), depths)
    # Angle on the flat cloth -> angle of the fold, ring by ring, read off between rings.
    flat = np.stack([np.concatenate([[0.0], np.cumsum(steps[k])]) for k in np.searchsorted(depths, depth)])
    flat *= 2.0 * np.pi / flat[:, -1:]
    table = np.stack([np.interp(phi, row, phi) for row in flat])
    place = np.interp(distance, rings, np.arange(len(rings)))
    low = np.minimum(place.astype(int), len(rings) - 2)
    column = (angle % (2.0 * np.pi)) / (2.0 * np.pi) * 1024.0
    left = np.minimum(column.astype(int), 1023)
    t, u = place - low, column - left
    corner = [table[low + i, left + j] for i in (0, 1) for j in (0, 1)]
    turned = (1 - t) * ((1 - u) * corner[0] + u * corner[1]) + t * ((1 - u) * corner[2] + u * corner[3])
    return np.interp(distance, rings, depth), turned


def _wave(angle: Array) -> Array:
    return np.cos(FOLDS * angle + 0.6 * np.sin(2.0 * angle + 1.0) + 0.4)


def look_at(eye: Array, target: Array) -> Array:
    """(4, 4) frame at ``eye`` whose -z points at ``target``, y up."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    frame[:3, 3] = eye
    return frame
