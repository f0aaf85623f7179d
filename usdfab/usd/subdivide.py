"""Subdivision surfaces: Catmull-Clark and Loop as sparse matrices over control points. NumPy and SciPy only.

One refinement step takes a mesh's topology and gives the finer topology and a matrix S with ``points' = S @ points``;
rows of S sum to 1. The same matrix serves positions at any time, and every other vertex primvar. Face-varying values
(uv) have a topology of their own over the same faces (``face_varying``), with seams as its boundaries.

Rules are OpenSubdiv's, of which this is a small part: boundaries are cubic B-splines through their ends, edges that
more than two faces share count as boundaries, creases and corners may be semi-sharp (DeRose et al. 1998, "Subdivision
Surfaces in Character Animation": a sharpness of s acts in full for s steps; between 0 and 1 the rules are blended).
Limit masks after Halstead et al. 1993 and Loop 1987.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy  # its parts are loaded when they are first used: most stages have nothing to refine
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Scheme = Literal["catmullClark", "loop"]
INFINITE = 10.0
"""Sharpness from which on an edge or corner stays sharp for ever (UsdGeomMesh's SHARPNESS_INFINITE)."""


@dataclass(frozen=True, eq=False)
class Topology:
    """Faces and what is sharp about them.

    Parameters
    ----------
    counts: (F,)
        Corners of each face, 3 or more.
    indices: (C,)
        Point of each corner, C = sum of counts.
    points: int
        Number of points V.
    creases: (n, 2)
        Points at the ends of creased edges; edges that no face has are ignored.
    crease_sharpness: (n,)
    corner_sharpness: (V,)
        0 where a point is no corner.
    """

    counts: Ints
    indices: Ints
    points: int
    creases: Ints
    crease_sharpness: Floats
    corner_sharpness: Floats

    @cached_property
    def face(self) -> Ints:
        """(C,) face of each corner."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @cached_property
    def following(self) -> Ints:
        """(C,) the next corner of the same face."""
        following = np.arange(1, len(self.indices) + 1)
        ends = np.cumsum(self.counts)
        following[ends - 1] = ends - self.counts
        return following

    @cached_property
    def preceding(self) -> Ints:
        """(C,) the corner before, of the same face."""
        preceding = np.zeros_like(self.following)
        preceding[self.following] = np.arange(len(self.following))
        return preceding

    @cached_property
    def _edges(self) -> tuple[Ints, Ints]:
        keys = _keys(self.indices, self.indices[self.following], self.points)
        unique, edge = np.unique(keys, return_inverse=True)
        return np.stack([unique // self.points, unique % self.points], axis=1), edge.ravel()

    @property
    def edges(self) -> Ints:
        """(E, 2) points of each edge, the smaller first."""
        return self._edges[0]

    @property
    def edge(self) -> Ints:
        """(C,) the edge from each corner to the next."""
        return self._edges[1]

    @cached_property
    def regular(self) -> NDArray[np.bool_]:
        """(E,) whether exactly two faces meet at the edge."""
        return np.bincount(self.edge, minlength=len(self.edges)) == 2

    @cached_property
    def sharpness(self) -> Floats:
        """(E,) sharpness of the edges; boundaries are infinitely sharp."""
        sharp = np.zeros(len(self.edges))
        if len(self.creases):
            keys = _keys(self.edges[:, 0], self.edges[:, 1], self.points)
            wanted = _keys(self.creases[:, 0], self.creases[:, 1], self.points)
            place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
            known = keys[place] == wanted
            np.maximum.at(sharp, place[known], self.crease_sharpness[known])
        return np.where(self.regular, np.where(sharp >= INFINITE, np.inf, sharp), np.inf)


def _keys(a: Ints, b: Ints, points: int) -> Ints:
    return np.minimum(a, b) * points + np.maximum(a, b)


def topology(
    counts: Ints,
    indices: Ints,
    points: int,
    creases: Ints | None = None,
    crease_sharpness: Floats | None = None,
    corners: Ints | None = None,
    corner_sharpness: Floats | None = None,
    *,
    sharp_boundary_corners: bool = True,
) -> Topology:
    """A :class:`Topology` from UsdGeomMesh's attributes.

    Parameters
    ----------
    corners, corner_sharpness: (n,)
    sharp_boundary_corners:
        Points on a boundary that belong to one face only stay where they are (``interpolateBoundary`` ==
        "edgeAndCorner", the default); without it boundaries round them off ("edgeOnly").
    """
    sharp = np.zeros(points)
    if corners is not None and corner_sharpness is not None:
        np.maximum.at(sharp, corners, np.where(corner_sharpness >= INFINITE, np.inf, corner_sharpness))
    pairs = np.zeros((0, 2), dtype=np.int64) if creases is None else np.asarray(creases, dtype=np.int64).reshape(-1, 2)
    values = np.zeros(len(pairs)) if crease_sharpness is None else np.asarray(crease_sharpness, dtype=np.float64)
    plain = Topology(
        np.asarray(counts, dtype=np.int64), np.asarray(indices, dtype=np.int64), points, pairs, values, sharp
    )
    if sharp_boundary_corners:
        open_points = np.zeros(points, dtype=bool)
        open_points[plain.edges[~plain.regular].ravel()] = True
        sharp[open_points & (np.bincount(plain.indices, minlength=points) == 1)] = np.inf
    return plain


def refined(
    mesh: Topology, levels: int, scheme: Scheme, *, linear: bool = False, limit: bool = True
) -> tuple[Topology, csr_array]:
    """The topology after ``levels`` steps and the (V', V) matrix from the control points to its points.

    Each step makes a quad of every corner of every face (Catmull-Clark), or four triangles of every triangle (Loop), in
    the order of the corners, so that topologies over the same faces stay alike.

    Parameters
    ----------
    scheme:
        ``"loop"`` takes triangles only.
    linear:
        Points of edges and faces are means, old points stay: what ``varying`` primvars do.
    limit:
        Move the points to where they would be after infinitely many steps (only after one step at least).
    """
    matrix = scipy.sparse.csr_array(_identity(mesh.points))
    for _ in range(levels):
        mesh, step = _step(mesh, scheme, linear)
        matrix = scipy.sparse.csr_array(step @ matrix)
    if limit and levels and not linear:
        matrix = scipy.sparse.csr_array(_limit(mesh, scheme) @ matrix)
    return mesh, matrix


def parent_faces(counts: Ints, levels: int, scheme: Scheme) -> Ints:
    """(F',) the face of the control mesh that each face of the refined one comes from."""
    if levels == 0:
        return np.arange(len(counts))
    if scheme == "loop":
        return np.repeat(np.arange(len(counts)), 4**levels)
    return np.repeat(np.arange(len(counts)), np.asarray(counts) * 4 ** (levels - 1))


def face_varying(
    mesh: Topology, values: Floats, rule: str = "cornersPlus1"
) -> tuple[Topology, Floats]:  # fmt: skip
    """Face-varying values as points of a topology of their own: ``(topology, (W, width) values)``.

    Corners at one point that have equal values are one point of it. Its edges are as sharp as the mesh's own.

    Parameters
    ----------
    values: (C, width)
    rule:
        UsdGeomMesh's ``faceVaryingLinearInterpolation``. "boundaries" keeps all points on seams where they are;
        "cornersOnly" and "cornersPlus1/2" those that one face alone has, and the latter also those at points where
        three or more values meet; "none" keeps none. "all" is linear altogether: refine with ``linear``.
    """
    rows = np.column_stack([mesh.indices.astype(np.float64), values])
    unique, first, indices = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    indices = indices.ravel()
    owner = mesh.indices[first]
    number = len(unique)
    bare = topology(mesh.counts, indices, number, sharp_boundary_corners=rule != "none")
    inherited = mesh.corner_sharpness[owner]
    if rule == "none":
        inherited = np.where(np.isinf(inherited), 0.0, inherited)
    corner = np.maximum(bare.corner_sharpness, inherited)
    if rule == "boundaries":
        corner[bare.edges[~bare.regular].ravel()] = np.inf
    elif rule in ("cornersPlus1", "cornersPlus2"):
        corner[np.bincount(owner, minlength=mesh.points)[owner] >= 3] = np.inf
    # Creases of the mesh are creases of its values.
    keys = _keys(mesh.edges[:, 0], mesh.edges[:, 1], mesh.points)
    own = _keys(owner[bare.edges[:, 0]], owner[bare.edges[:, 1]], mesh.points)
    sharp = np.where(mesh.regular, mesh.sharpness, 0.0)[np.searchsorted(keys, own)]
    creased = sharp > 0
    result = Topology(mesh.counts, indices, number, bare.edges[creased], sharp[creased], corner)
    return result, values[first]


def normal_groups(mesh: Topology) -> Ints:
    """(C,) corners with the same number share one smooth normal: those at a point, parted by sharp edges."""
    smooth = mesh.regular & (mesh.sharpness == 0)
    if not (mesh.regular & ~smooth).any():
        return mesh.indices
    # The two corners at either end of a smooth edge, one in each of its faces, belong together.
    order = np.argsort(mesh.edge, kind="stable")
    one, two = order[smooth[mesh.edge[order]]].reshape(-1, 2).T
    after_one, after_two = mesh.following[one], mesh.following[two]
    same_way = mesh.indices[one] == mesh.indices[two]
    start = np.where(same_way, two, after_two)
    end = np.where(same_way, after_two, two)
    rows, columns = np.concatenate([one, after_one]), np.concatenate([start, end])
    number = len(mesh.indices)
    graph = scipy.sparse.coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(number, number))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


# --- one step --------------------------------------------------------------------------------------------------------


def _step(mesh: Topology, scheme: Scheme, linear: bool) -> tuple[Topology, csr_array]:
    middle = _matrix(np.repeat(np.arange(len(mesh.edges)), 2), mesh.edges.ravel(), 0.5, (len(mesh.edges), mesh.points))
    if scheme == "loop":
        edge_points, old_points = (middle, _identity(mesh.points)) if linear else _loop(mesh, middle)
        stacked = [old_points, edge_points]
    else:
        share = 1.0 / mesh.counts[mesh.face]
        face_points = _matrix(mesh.face, mesh.indices, share, (len(mesh.counts), mesh.points))
        pair = (middle, _identity(mesh.points))
        edge_points, old_points = pair if linear else _catmull_clark(mesh, middle, face_points)
        stacked = [old_points, edge_points, face_points]
    return _split(mesh, scheme), scipy.sparse.csr_array(scipy.sparse.vstack(stacked))


def _split(mesh: Topology, scheme: Scheme) -> Topology:
    """The finer faces, and what is left of creases and corners."""
    number, edges = mesh.points, len(mesh.edges)
    forward, back = number + mesh.edge, number + mesh.edge[mesh.preceding]
    if scheme == "loop":
        own = np.stack([mesh.indices, forward, back], axis=1).reshape(-1, 9)
        inner = forward.reshape(-1, 3)
        indices = np.concatenate([own, inner], axis=1).ravel()
        counts = np.full(4 * len(mesh.counts), 3)
        points = number + edges
    else:
        indices = np.stack([mesh.indices, forward, number + edges + mesh.face, back], axis=1).ravel()
        counts = np.full(len(mesh.indices), 4)
        points = number + edges + len(mesh.counts)
    sharp = mesh.regular & (mesh.sharpness > 1)
    halves = number + np.flatnonzero(sharp)
    pairs = np.concatenate([np.stack([mesh.edges[sharp, k], halves], axis=1) for k in (0, 1)])
    creases = np.tile(mesh.sharpness[sharp] - 1.0, 2)
    corners = np.zeros(points)
    corners[:number] = np.maximum(mesh.corner_sharpness - 1.0, 0.0)
    return Topology(counts, indices, points, pairs, creases, corners)


def _catmull_clark(mesh: Topology, middle: csr_array, face_points: csr_array) -> tuple[csr_array, csr_array]:
    """Matrices of the edge points and of the old points' new places."""
    shape = (len(mesh.edges), len(mesh.counts))
    beside = _matrix(mesh.edge, mesh.face, 0.25, shape) @ face_points
    edge_points = _blend(np.clip(mesh.sharpness, 0.0, 1.0), 0.5 * middle + beside, middle)
    valence = np.maximum(np.bincount(mesh.edges.ravel(), minlength=mesh.points), 1)
    faces = np.maximum(np.bincount(mesh.indices, minlength=mesh.points), 1)
    mean_face = _matrix(mesh.indices, mesh.face, 1.0 / faces[mesh.indices], (mesh.points, len(mesh.counts)))
    ends = mesh.edges.ravel()
    mean_edge = _matrix(ends, np.repeat(np.arange(len(mesh.edges)), 2), 1.0 / valence[ends], middle.T.shape)
    smooth = (
        scipy.sparse.diags_array(1.0 / valence) @ (mean_face @ face_points + 2.0 * mean_edge @ middle)
        + scipy.sparse.diags_array((valence - 3.0) / valence)
    )  # fmt: skip
    return edge_points, _old_points(mesh, smooth, 1.0 / 8.0)


def _loop(mesh: Topology, middle: csr_array) -> tuple[csr_array, csr_array]:
    """The same for Loop's scheme."""
    opposite = mesh.indices[mesh.preceding]
    across = _matrix(mesh.edge, opposite, 1.0 / 8.0, (len(mesh.edges), mesh.points))
    edge_points = _blend(np.clip(mesh.sharpness, 0.0, 1.0), 0.75 * middle + across, middle)
    valence = np.maximum(np.bincount(mesh.edges.ravel(), minlength=mesh.points), 1)
    beta = _loop_weight(valence)
    smooth = scipy.sparse.diags_array(1.0 - valence * beta) + scipy.sparse.diags_array(beta) @ _neighbours(
        mesh, np.ones(len(mesh.edges), bool)
    )
    return edge_points, _old_points(mesh, smooth, 1.0 / 8.0)


def _loop_weight(valence: Ints) -> Floats:
    return (5.0 / 8.0 - (3.0 / 8.0 + np.cos(2.0 * np.pi / valence) / 4.0) ** 2) / valence


def _old_points(mesh: Topology, smooth: csr_array, side: float, *, limit: bool = False) -> csr_array:
    """``smooth`` where nothing is sharp; on creases the curve's mask (``side``, rest, ``side``), at corners the point.

    ``limit``: what is sharp at all counts in full, since no step is left that could round it.
    """
    sharp = mesh.sharpness > 0
    ends = mesh.edges[sharp].ravel()
    number = np.bincount(ends, minlength=mesh.points)
    # Infinite sharpness would make the mean infinite, which is meant: clipped below.
    mean = np.bincount(ends, np.repeat(mesh.sharpness[sharp], 2), mesh.points) / np.maximum(number, 1)
    weight = np.where(mean > 0, 1.0, 0.0) if limit else np.clip(mean, 0.0, 1.0)
    unused = np.bincount(mesh.indices, minlength=mesh.points) == 0
    identity = _identity(mesh.points)
    crease = (1.0 - 2.0 * side) * identity + side * _neighbours(mesh, sharp)
    result = _blend(np.where(number == 2, weight, 0.0), smooth, crease)
    corner = np.maximum(np.where(number > 2, weight, 0.0), np.clip(mesh.corner_sharpness, 0.0, 1.0))
    if limit:
        corner = np.where(mesh.corner_sharpness > 0, 1.0, corner)
    return _blend(np.where(unused, 1.0, corner), result, identity)


def _limit(mesh: Topology, scheme: Scheme) -> csr_array:
    """(V, V) matrix to the limit surface; Catmull-Clark needs a mesh of quads."""
    valence = np.maximum(np.bincount(mesh.edges.ravel(), minlength=mesh.points), 1)
    around = _neighbours(mesh, np.ones(len(mesh.edges), dtype=bool))
    if scheme == "loop":
        weight = 1.0 / (valence + 3.0 / (8.0 * _loop_weight(valence)))
        smooth = scipy.sparse.diags_array(1.0 - valence * weight) + scipy.sparse.diags_array(weight) @ around
    else:
        diagonal = mesh.indices[mesh.following[mesh.following]]
        across = _matrix(mesh.indices, diagonal, 1.0, (mesh.points, mesh.points))
        total = scipy.sparse.diags_array(valence.astype(np.float64) ** 2) + 4.0 * around + across
        # n (n + 5) wherever the surface is smooth; elsewhere the row is not used, but stays finite.
        smooth = scipy.sparse.diags_array(1.0 / np.asarray(total.sum(axis=1)).ravel()) @ total
    return _old_points(mesh, scipy.sparse.csr_array(smooth), 1.0 / 6.0, limit=True)


def _neighbours(mesh: Topology, chosen: NDArray[np.bool_]) -> csr_array:
    """(V, V) with 1 where a chosen edge joins two points."""
    a, b = mesh.edges[chosen].T
    return _matrix(np.concatenate([a, b]), np.concatenate([b, a]), 1.0, (mesh.points, mesh.points))


def _blend(weight: Floats, zero: csr_array, one: csr_array) -> csr_array:
    """Rows of ``zero`` where ``weight`` is 0, of ``one`` where it is 1."""
    blended = scipy.sparse.csr_array(
        scipy.sparse.diags_array(1.0 - weight) @ zero + scipy.sparse.diags_array(weight) @ one
    )
    blended.eliminate_zeros()
    return blended


def _identity(number: int) -> csr_array:
    return scipy.sparse.csr_array(scipy.sparse.diags_array(np.ones(number)))


def _matrix(rows: Ints, columns: Ints, values: Floats | float, shape: tuple[int, int]) -> csr_array:
    data = np.broadcast_to(np.asarray(values, dtype=np.float64), rows.shape)
    return scipy.sparse.csr_array(scipy.sparse.coo_array((data, (rows, columns)), shape=shape))
