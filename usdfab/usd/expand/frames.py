"""Frames of flat pieces on a curved surface: from their corners, so that neighbours share what lies between them.

The map from a piece to the world is taken through its four corners on the surface, in the sense of least squares. The
middles of its edges then come out the same from both sides, whatever the surface does; what is left at the corners is
the surface's twist. Tangent frames at the centre, in contrast, lean against each other like shingles where a mesh with
smooth normals has flat faces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.expand.surface import ClothSurface, Places, unit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_SHEAR = 1.5
"""Tangent of the greatest shear that prototypes have."""

SMALLEST, LARGEST = 1e-3, 1e3
"""World per metre of cloth: pieces stretched beyond this are left out."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Affine maps of N pieces: place on the cloth relative to the piece's centre, and height, to the world.

    Parameters
    ----------
    centers: (N, 3) metres
    linear: (N, 3, 3)
        Columns: world per metre of cloth along x, y and the front normal. Left-handed where uv is mirrored.
    """

    centers: Floats
    linear: Floats

    def __getitem__(self, rows: NDArray) -> Frames:
        return Frames(self.centers[rows], self.linear[rows])

    def at(self, local: Floats) -> Floats:
        """(N, ..., 3) where ``local`` (N, ..., 3) comes to lie."""
        turned = np.einsum("nij,n...j->n...i", self.linear, local)
        return turned + self.centers.reshape(-1, *(1,) * (local.ndim - 2), 3)


@dataclass(frozen=True, eq=False)
class Poses:
    """Frames in the parts that instances have: ``linear`` = rotation * scale * shear of x by y.

    Instances scale and turn but cannot shear, so prototypes come in several shears.

    ``rotations`` (N, 3, 3) proper; ``scales`` (N, 3), the second negative where uv is mirrored; ``shear`` (N,) in whole
    steps, each ``step`` (N,) of tangent.
    """

    rotations: Floats
    scales: Floats
    shear: Ints
    step: Floats

    @property
    def linear(self) -> Floats:
        """(N, 3, 3) the frames' matrices, with the shear rounded to its steps."""
        skew = np.zeros((len(self.shear), 3, 3))
        skew[:, 0, 0] = skew[:, 1, 1] = skew[:, 2, 2] = 1.0
        skew[:, 0, 1] = self.shear * self.step
        return self.rotations @ (self.scales[:, :, None] * skew)


def corner_frames(
    surface: ClothSurface, chart: Ints, triangle: Ints, center: Places, low: Floats, high: Floats
) -> tuple[Frames, Floats, Places]:
    """Frames of boxes on the cloth from ``low`` (N, 2) to ``high``.

    Parameters
    ----------
    triangle: (N,), center:
        The triangle in which the box's centre lies, and what lies there.

    Returns
    -------
    frames, corners (N, 4, 3) on the surface in the order (low, low), (high, low), (low, high), (high, high), and what
    lies at the corners (4 N). Corners beyond the border go on in the triangle's plane.
    """
    size = high - low
    signs = np.array([(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)])
    offset = (signs[None] * size[:, None]).reshape(-1, 2)
    owner = np.repeat(np.arange(len(low)), 4)
    anchor = triangle[owner]
    shift = offset[:, :1] * surface.along[anchor] + offset[:, 1:] * surface.across[anchor]
    guess = center.points[owner] + shift
    xy = 0.5 * (low + high)[owner] + offset
    found, weights = surface.locate(chart[owner], xy, guess)
    lost = found < 0
    found = np.where(lost, anchor, found)
    weights = np.where(lost[:, None], surface.weights(found, xy), weights)
    there = surface.at(found, weights)
    # A chart that covers the place elsewhere is not what lies beyond the border here.
    far = np.linalg.norm(there.points - guess, axis=1) > 2.0 * np.linalg.norm(shift, axis=1)
    corners = np.where((far | lost)[:, None], guess, there.points).reshape(-1, 4, 3)
    x = 0.5 * (corners[:, 1] - corners[:, 0] + corners[:, 3] - corners[:, 2]) / size[:, :1]
    y = 0.5 * (corners[:, 2] - corners[:, 0] + corners[:, 3] - corners[:, 1]) / size[:, 1:]
    normal = np.cross(x, y)
    area = np.linalg.norm(normal, axis=1)
    # Front is where the surface's own normal points, also where uv is mirrored.
    front = np.sign(np.einsum("nx,nx->n", normal, surface.flat[triangle]))[:, None]
    z = front * normal / np.maximum(area, 1e-300)[:, None] * np.sqrt(area)[:, None]
    return Frames(corners.mean(axis=1), np.stack([x, y, z], axis=2)), corners, there


def regular(frames: Frames) -> NDArray[np.bool_]:
    """Which frames neither collapse nor stretch beyond reason."""
    x, y = frames.linear[:, :, 0], frames.linear[:, :, 1]
    sx, sy = np.linalg.norm(x, axis=1), np.linalg.norm(y, axis=1)
    upright = np.linalg.norm(np.cross(x, y), axis=1) > 0.05 * sx * sy
    return upright & (np.minimum(sx, sy) > SMALLEST) & (np.maximum(sx, sy) < LARGEST)


def poses(frames: Frames, step: Floats) -> Poses:
    """The frames as rotation, scale and shear in steps of ``step`` (N,), tangents."""
    x, y, z = (frames.linear[:, :, k] for k in range(3))
    sx = np.linalg.norm(x, axis=1)
    first, third = unit(x), unit(z)
    second = np.cross(third, first)
    sy = np.einsum("nx,nx->n", y, second)
    skew = np.einsum("nx,nx->n", y, first) / sx
    shear = np.rint(np.clip(skew, -MAX_SHEAR, MAX_SHEAR) / step).astype(np.int64)
    # What rounding leaves is shared between warp and weft: both turn by half of it.
    half = 0.5 * np.arctan((skew - shear * step) * sx / np.where(sy == 0.0, 1.0, sy))[:, None]
    one, two = np.cos(half) * first - np.sin(half) * second, np.sin(half) * first + np.cos(half) * second
    scales = np.stack([sx, sy, np.linalg.norm(z, axis=1)], axis=1)
    return Poses(np.stack([one, two, third], axis=2), scales, shear, step)
