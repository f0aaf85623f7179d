"""How a mesh stretches the cloth that lies on it: yarns per centimetre, stretch, shear, what is mirrored. NumPy only.

The cloth is flat, in metres: x along the weft, y along the warp, ``q = uv * meters_per_uv``. On each triangle the
surface is a linear map of it, J (3, 2) with the singular values s1 >= s2; 1 and 1 are a surface that fits its texture
coordinates. *Stretch* is max(s1, 1 / s2): how many times yarns are drawn out or pushed together, whichever is worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.usd.scene import Array, Mesh, Scene

PERCENTILES = (5.0, 50.0, 95.0)
MAX_COPIES = 64
"""So many differently deformed placements of one mesh are measured, evenly chosen from those there are."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Of triangles, T each; infinite or nan where a triangle with area has none in uv.

    ``area`` square metres on the surface; ``s1`` >= ``s2`` singular values; ``ends`` and ``picks`` gradients on the
    surface of the cloth's x and y, the factors by which the yarns' density grows; ``shear`` degrees by which the angle
    between the yarns differs from a right one, ``mirrored``: the cloth's back is in front.
    """

    area: Array
    s1: Array
    s2: Array
    ends: Array
    picks: Array
    shear: Array
    mirrored: NDArray[np.bool_]

    @property
    def stretch(self) -> Array:
        """(T,) max(s1, 1 / s2)."""
        with np.errstate(divide="ignore"):
            return np.maximum(self.s1, 1.0 / self.s2)


def measure(points: Array, uv: Array, meters_per_uv: float) -> Stretch:
    """The stretch of triangles.

    Parameters
    ----------
    points: (T, 3, 3) metres, uv: (T, 3, 2)
        At the corners, counter-clockwise seen from the front. Triangles without area on the surface are to be left out.
    """
    edge = points[:, 1:] - points[:, :1]
    cloth = (uv[:, 1:] - uv[:, :1]) * meters_per_uv
    normal = np.cross(edge[:, 0], edge[:, 1])
    twice = np.linalg.norm(normal, axis=1)
    determinant = cloth[:, 0, 0] * cloth[:, 1, 1] - cloth[:, 0, 1] * cloth[:, 1, 0]
    # Far below any triangle's size in float32 coordinates this is none.
    flat = np.abs(determinant) <= 1e-12 * np.maximum((cloth**2).sum(axis=(1, 2)), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.where(flat, np.nan, determinant)
        jx = (edge[:, 0] * cloth[:, 1, 1:] - edge[:, 1] * cloth[:, 0, 1:]) * inverse[:, None]
        jy = (edge[:, 1] * cloth[:, 0, :1] - edge[:, 0] * cloth[:, 1, :1]) * inverse[:, None]
        e, f, g = (jx**2).sum(axis=1), (jx * jy).sum(axis=1), (jy**2).sum(axis=1)
        middle, radius = 0.5 * (e + g), np.sqrt((0.5 * (e - g)) ** 2 + f**2)
        ratio = twice * np.abs(inverse)
        s1 = np.sqrt(middle + radius)
        # The product is known exactly; the difference of two squares would lose the smaller value.
        s2 = ratio / s1
        shear = 90.0 - np.degrees(np.arccos(np.clip(f / np.sqrt(e * g), -1.0, 1.0)))
        ends, picks = np.sqrt(g) / ratio, np.sqrt(e) / ratio
    return Stretch(
        0.5 * twice, np.where(flat, np.inf, s1), np.where(flat, 0.0, s2), ends, picks, np.abs(shear), determinant < 0
    )


@dataclass(frozen=True)
class Spread:
    """A quantity over a surface: its extremes, its mean and percentiles by area."""

    min: float
    p5: float
    median: float
    mean: float
    p95: float
    max: float


def spread(values: Array, area: Array) -> Spread | None:
    """The spread of ``values`` (T,) weighted by ``area`` (T,), without those that are not finite; None if none is."""
    good = np.isfinite(values) & (area > 0)
    if not good.any():
        return None
    values, area = values[good], area[good]
    order = np.argsort(values, kind="stable")
    values, area = values[order], area[order]
    # The value below which so much of the area lies: each value stands in the middle of its own area.
    share = (np.cumsum(area) - 0.5 * area) / area.sum()
    p5, median, p95 = (float(np.interp(p / 100.0, share, values)) for p in PERCENTILES)
    return Spread(
        float(values[0]), p5, median, float(np.average(values, weights=area)), p95, float(values[-1])
    )  # fmt: skip


@dataclass(frozen=True)
class SurfaceReport:
    """What a fabric looks like on one mesh.

    ``area`` square metres; ``nominal_*`` yarns per centimetre of the flat cloth, ``*_per_cm`` on the surface, counted
    across the yarns. ``stretch_max`` and ``stretch_min`` are the singular values, ``area_ratio`` their product.
    ``above`` is the share of the area whose stretch is above ``limit``, ``mirrored`` the share that shows the cloth's
    back, ``degenerate`` that without area in uv.
    """

    mesh: str
    material: str
    meters_per_uv: float
    triangles: int
    area: float
    nominal_ends_per_cm: float
    nominal_picks_per_cm: float
    ends_per_cm: Spread | None
    picks_per_cm: Spread | None
    stretch_max: Spread | None
    stretch_min: Spread | None
    area_ratio: Spread | None
    shear_degrees: Spread | None
    limit: float
    above: float
    mirrored: float
    degenerate: float

    def as_table(self) -> dict[str, Any]:
        """Plain JSON data."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Surface:
    """A fabric on one mesh with its measurements: ``points`` (T, 3, 3), ``cloth`` (T, 3, 2) metres, T triangles."""

    points: Array
    cloth: Array
    stretch: Stretch
    report: SurfaceReport


def surfaces(scene: Scene, limit: float, materials: Sequence[str] = (), scale: float = 1.0) -> list[Surface]:
    """Every fabric on every mesh of a scene, or those of the given materials' paths only.

    ``scale`` is how many times larger than life the yarns are meant to be: stretch is what comes on top of that.
    Placements of one mesh count as often as they are placed; see ``MAX_COPIES``.
    """
    found = []
    for mesh in scene.meshes:
        if mesh.uv is None:
            continue
        fabric_of = np.array([scene.materials[m].fabric for m in mesh.face_material], dtype=np.int64)
        for number in sorted(set(fabric_of.tolist()) - {-1}):
            surface = scene.fabrics[number]
            if materials and surface.path not in materials:
                continue
            faces = fabric_of == number
            points, uv = _placed(mesh, faces)
            meters = surface.meters_per_uv * scale
            measured = measure(points, uv, meters)
            density = (0.01 / (scale * surface.fabric.cell[0]), 0.01 / (scale * surface.fabric.cell[1]))
            report = _report(mesh.path, surface.path, surface.meters_per_uv, density, measured, limit)
            found.append(Surface(points, uv * meters, measured, report))
    return found


def _placed(mesh: Mesh, faces: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Corners (T, 3, 3) and uv (T, 3, 2) of faces, for all placements, without those that have no area."""
    points, uv = mesh.points[mesh.triangles][faces], mesh.uv[faces] if mesh.uv is not None else np.zeros((0, 3, 2))
    if mesh.placements is not None:
        step = max(1, -(-len(mesh.placements) // MAX_COPIES))
        chosen = mesh.placements[::step]
        points = np.concatenate([points @ m[:, :3].T + m[:, 3] for m in chosen])
        uv = np.tile(uv, (len(chosen), 1, 1))
    area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
    return points[area > 0], uv[area > 0]


def _report(
    mesh: str, material: str, meters: float, density: tuple[float, float], found: Stretch, limit: float
) -> SurfaceReport:
    area, total = found.area, float(found.area.sum())
    degenerate = ~np.isfinite(found.s1)

    def share(chosen: NDArray[np.bool_]) -> float:
        return float(area[chosen].sum()) / total if total else 0.0

    finite = np.where(degenerate, np.nan, found.s2)
    return SurfaceReport(
        mesh, material, meters, len(area), total, *density,
        spread(found.ends * density[0], area), spread(found.picks * density[1], area),
        spread(found.s1, area), spread(finite, area), spread(found.s1 * finite, area), spread(found.shear, area),
        limit, share(found.stretch > limit), share(found.mirrored & ~degenerate), share(degenerate),
    )  # fmt: skip


def warnings(report: SurfaceReport) -> list[str]:
    """What people should know of a surface before they render it, one sentence each."""
    found = []
    if report.above > 0 and report.stretch_max and report.stretch_min:
        worst = f"{report.stretch_min.min:.3g} to {report.stretch_max.max:.3g} times"
        area = f"{_percent(report.above)} of the area ({report.above * report.area * 1e4:.3g} cm^2)"
        found.append(
            f"{report.mesh}: {area} is drawn out or pushed together by more than {report.limit:g} "
            f"(yarns are {worst} as long as they should be)"
        )
    if report.mirrored > 0:
        found.append(
            f"{report.mesh}: {_percent(report.mirrored)} of the area has mirrored texture coordinates: its weave runs "
            "the other way round"
        )
    if report.degenerate > 0:
        found.append(
            f"{report.mesh}: {_percent(report.degenerate)} of the area has no area in its texture coordinates, there "
            "are no yarns to be seen"
        )
    return found


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"
