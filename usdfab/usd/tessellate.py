"""Cages to triangles: subdivision surfaces are refined, polygons are cut.

How far a subdivision surface is refined (``levels``): two steps, less where that makes more than ``MAX_TRIANGLES``
triangles, none for a cage of more than ``DENSE_FACES`` faces: such a mesh (simulated cloth, as a rule) is smooth
enough, and moving its points to the limit surface would shrink what the simulation made. Whoever asks for a number of
steps gets it, up to ``HARD_LIMIT`` triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.primvars import Values, at_corners
from usdfab.usd.read_mesh import Cage
from usdfab.usd.scene import Array
from usdfab.usd.subdivide import Scheme, Topology, face_varying, normal_groups, parent_faces, refined
from usdfab.usd.triangulate import triangulate

MAX_LEVELS = 2
DENSE_FACES = 20_000
MAX_TRIANGLES = 500_000
HARD_LIMIT = 20_000_000
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles of a mesh in its local space, counter-clockwise as the stage's ``orientation`` asks, metres.

    ``points``, ``points_close``, ``rest`` (V, 3) as in :class:`~usdfab.usd.read_mesh.Cage`; ``triangles`` (T, 3);
    ``face`` (T,) authored number of the face; ``normals`` (T, 3, 3) or None, not of length 1; ``groups`` (T, 3) or
    None: corners that share a smooth normal, where there are no ``normals``; ``uv`` (T, 3, 2) or None; ``albedo``
    (T, 3, 3) or None.
    """

    points: Array
    points_close: Array | None
    rest: Array
    triangles: Ints
    face: Ints
    normals: Array | None
    groups: Ints | None
    uv: Array | None
    albedo: Array | None


def levels(cage: Cage, wanted: int | None) -> tuple[int, str]:
    """Steps of refinement for a cage, and a warning (or an empty text). ``wanted`` None: the rule in the module's text.

    Loop's scheme refines triangles only: a cage with other faces is not refined.
    """
    place = str(cage.prim.GetPath())
    if cage.scheme not in ("catmullClark", "loop") or wanted == 0:
        return 0, ""
    counts = cage.topology.counts
    if cage.scheme == "loop" and (counts != 3).any():
        return 0, f"{place}: Loop subdivision of faces that are no triangles, the mesh is not refined"
    if wanted is None and len(counts) > DENSE_FACES:
        return 0, ""
    # The first step makes four triangles of a triangle, or two of each corner; each further one four of each.
    first = 4 * len(counts) if cage.scheme == "loop" else 2 * len(cage.topology.indices)
    limit, level = (MAX_TRIANGLES, MAX_LEVELS) if wanted is None else (HARD_LIMIT, wanted)
    allowed = sum(first * 4**step <= limit for step in range(level))
    if wanted is not None and allowed < wanted:
        return allowed, f"{place}: {wanted} subdivisions make more than {limit} triangles, {allowed} are made"
    return allowed, ""


def tessellate(cage: Cage, level: int) -> Triangles | None:
    """The triangles of a cage after ``level`` steps of refinement; None where all faces are holes.

    Subdivision surfaces have smooth normals, parted at creases (authored normals do not count once they are refined);
    with ``bilinear`` or ``none``, the authored ones or none.
    """
    mesh, smooth = cage.topology, cage.scheme in ("catmullClark", "loop")
    points, points_close, rest = cage.points, cage.points_close, cage.rest
    face, hole = cage.number, cage.hole
    channels: dict[str, Array | None] = {"uv": None, "albedo": None}
    if level:
        scheme: Scheme = "loop" if cage.scheme == "loop" else "catmullClark"
        if cage.boundary == "none":
            hole = hole | _at_boundary(mesh)
        fine, matrix = refined(mesh, level, scheme)
        parent = parent_faces(mesh.counts, level, scheme)
        refiner = _Refiner(cage, level, scheme, fine, matrix, parent)
        channels = {name: refiner.corners(getattr(cage, name)) for name in channels}
        points, rest = matrix @ points, matrix @ rest
        points_close = None if points_close is None else matrix @ points_close
        mesh, face, hole = fine, face[parent], hole[parent]
    else:
        channels = {name: _corners(getattr(cage, name), mesh) for name in channels}
    normals = None if level else _corners(cage.normals, mesh)
    corners, owner = triangulate(mesh.counts, mesh.indices, points)
    drawn = ~hole[owner]
    corners, owner = corners[drawn], owner[drawn]
    if len(corners) == 0:
        return None
    if cage.left_handed:
        corners = corners[:, [0, 2, 1]]
    groups = normal_groups(mesh)[corners] if smooth and normals is None else None
    picked = {name: None if v is None else v[corners] for name, v in channels.items()}
    return Triangles(
        points, points_close, rest, mesh.indices[corners], face[owner],
        None if normals is None else normals[corners], groups, **picked,
    )  # fmt: skip


def _corners(values: Values | None, mesh: Topology) -> Array | None:
    return None if values is None else at_corners(values, mesh.indices, mesh.face)


def _at_boundary(mesh: Topology) -> NDArray[np.bool_]:
    """(F,) faces that have a point on a boundary."""
    touched = np.zeros(mesh.points, dtype=bool)
    touched[mesh.edges[~mesh.regular].ravel()] = True
    face = np.zeros(len(mesh.counts), dtype=bool)
    face[mesh.face[touched[mesh.indices]]] = True
    return face


@dataclass(frozen=True, eq=False)
class _Refiner:
    """Brings primvars of a cage to the corners of its refined mesh."""

    cage: Cage
    level: int
    scheme: Scheme
    fine: Topology
    matrix: NDArray
    parent: Ints

    def corners(self, values: Values | None) -> Array | None:
        """(C', width) values at the corners of the refined faces, by the rule of their interpolation."""
        if values is None:
            return None
        coarse, v = self.cage.topology, values.values
        if values.interpolation == "vertex":
            return (self.matrix @ v)[self.fine.indices]
        if values.interpolation == "varying":
            _, linear = refined(coarse, self.level, self.scheme, linear=True)
            return (linear @ v)[self.fine.indices]
        if values.interpolation == "faceVarying":
            return self._face_varying(v)
        return at_corners(values, self.fine.indices, self.parent[self.fine.face])

    def _face_varying(self, v: Array) -> Array:
        coarse, rule = self.cage.topology, self.cage.seams
        own, unique = face_varying(coarse, v, rule)
        alike = np.array_equal(own.indices, coarse.indices) and np.array_equal(
            own.corner_sharpness, coarse.corner_sharpness
        )
        if alike and rule != "all":
            # No seams: the points' own matrix, which is there already.
            return (self.matrix @ unique)[self.fine.indices]
        fine, matrix = refined(own, self.level, self.scheme, linear=rule == "all")
        return (matrix @ unique)[fine.indices]
