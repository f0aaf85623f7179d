"""What material and query number i of a data set are: pure functions of settings and number (Table 2 of paper B)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.fabric.weave import weave_from_name
from usdfab.neural.aggregation import aggregate
from usdfab.neural.dataset_reader import KINDS, Kind
from usdfab.neural.surface_material import (
    GAP_RANGE,
    HEIGHT_SCALE_RANGE,
    INCLINATION_RANGE,
    PAPER_GAP,
    ROUGHNESS_RANGE,
    TWIST_RANGE,
    SurfaceMaterial,
    weave_of,
)

SCHEMA = "usdfab-neural-dataset/1"
REVISION = 1
"""Raised whenever the same settings give other numbers."""

PAPER_WEAVES = ("plain", "twill_3x3", "twill_5x5", "twill_8x8", "satin_5x5", "satin_8x8", "satin_5x10")
"""The seven patterns of Chen et al. 2024, 5.1."""

MAX_MATERIALS, MAX_QUERIES, MAX_SAMPLES = 100_000, 10_000_000, 2**24
EDGE = 0.9999
"""Directions are drawn within this radius of the unit disk: z stays above 0.014."""

Range = tuple[float, float]


@dataclass(frozen=True)
class DatasetSettings:
    """How a data set is made; angles in degrees. The defaults are Table 2 of Chen et al. 2024, but for the counts.

    Parameters
    ----------
    kind:
        reflection, transmission or both.
    queries, samples:
        Queries of each material and kind; samples of each (the paper: 3.2 million and 2048).
    weaves:
        Names, or matrices, which take turns: any seven materials in a row have the paper's seven.
    twist:
        One of these, drawn for warp and weft each.
    inclination, roughness, height_scale:
        Uniform; inclination for warp and weft each.
    small, large:
        Footprint sizes in tiles: uniform in either, half of the queries each.
    gap:
        Uniform; the paper's is always 0.2.
    """

    kind: str = "reflection"
    queries: int = 20_000
    samples: int = 512
    seed: int = 0
    weaves: tuple[str, ...] = PAPER_WEAVES
    twist: tuple[float, ...] = (-30.0, 0.0, 30.0)
    inclination: Range = (15.0, 45.0)
    roughness: Range = (0.1, 1.0)
    height_scale: Range = (0.0, 2.0)
    small: Range = (0.0, 1.0)
    large: Range = (1.0, 5.0)
    gap: Range = (PAPER_GAP, PAPER_GAP)

    def __post_init__(self) -> None:
        if self.kind not in (*KINDS, "both"):
            raise UsdfabError(f"there is no '{self.kind}'", place="--kind", remedy=f"choose {', '.join(KINDS)} or both")
        for name, low, high in (
            ("queries", 1, MAX_QUERIES), ("samples", 1, MAX_SAMPLES), ("seed", 0, 2**31 - 1),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise UsdfabError(f"{getattr(self, name)} is not between {low} and {high}", place=f"--{name}")
        if not self.weaves or not self.twist:
            raise UsdfabError("there is nothing to draw from", place="--weaves" if not self.weaves else "--twist")
        for weave in self.weaves:
            weave_from_name(weave)
        degrees = {name: tuple(math.degrees(v) for v in limits) for name, limits in
                   (("twist", TWIST_RANGE), ("inclination", INCLINATION_RANGE))}  # fmt: skip
        for name, values, limits in (
            ("twist", self.twist, degrees["twist"]),
            ("inclination", self.inclination, degrees["inclination"]),
            ("roughness", self.roughness, ROUGHNESS_RANGE),
            ("height-scale", self.height_scale, HEIGHT_SCALE_RANGE),
            ("gap", self.gap, GAP_RANGE),
            ("small", self.small, (0.0, 1e3)),
            ("large", self.large, (0.0, 1e3)),
        ):
            outside = [v for v in values if not limits[0] <= v <= limits[1]]
            if outside:
                told = f"{outside[0]:g} is not between {limits[0]:g} and {limits[1]:g}"
                raise UsdfabError(told, place=f"--{name}")
            if name != "twist" and (len(values) != 2 or values[0] > values[1]):
                raise UsdfabError("expected two numbers, the lower first", place=f"--{name}")

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of files."""
        return tuple(kind for kind in KINDS if self.kind in (kind, "both"))

    def manifest(self, materials: int) -> dict[str, Any]:
        """What ``dataset.json`` says of a set of ``materials`` materials."""
        settings = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}
        about = {"schema": SCHEMA, "revision": REVISION, "usdfab": __version__, "materials": materials}
        return about | settings


INFORMATIVE = frozenset({"usdfab", "materials"})
"""Entries of the manifest that may differ between two runs on one data set."""


def settings_of(manifest: dict[str, Any], place: str) -> DatasetSettings:
    """The settings in a manifest; ``UsdfabError`` where it is none of this version."""
    if (manifest.get("schema"), manifest.get("revision")) != (SCHEMA, REVISION):
        found = f"{manifest.get('schema')!r} revision {manifest.get('revision')!r}"
        raise UsdfabError(f"has format {found}, not {SCHEMA!r} revision {REVISION}", place=place)
    try:
        values = {f.name: manifest[f.name] for f in fields(DatasetSettings)}
    except KeyError as error:
        raise UsdfabError(f"the manifest has no {error.args[0]}", place=place) from error
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return DatasetSettings(**given)


def draw_material(settings: DatasetSettings, index: int) -> SurfaceMaterial:
    """Material ``index``; the same for reflection and transmission."""
    rng = np.random.default_rng([settings.seed, 0, index])
    weave = weave_from_name(settings.weaves[index % len(settings.weaves)])
    twist = np.radians(rng.choice(np.asarray(settings.twist, dtype=np.float64), 2))
    inclination = np.radians(rng.uniform(*settings.inclination, 2))
    return SurfaceMaterial(
        weave_of(weave),
        (float(twist[0]), float(twist[1])),
        (float(inclination[0]), float(inclination[1])),
        float(rng.uniform(*settings.roughness)),
        float(rng.uniform(*settings.height_scale)),
        float(rng.uniform(*settings.gap)),
        weave.name,
    )


def draw_queries(settings: DatasetSettings, index: int, kind: Kind) -> NDArray[np.float32]:
    """(queries, 8) of material ``index``: each column stratified over all rows (a Latin hypercube).

    Both directions are uniform over the disk of their x and y, which is what drawing from the square and leaving out
    what lies outside gives.
    """
    rng = np.random.default_rng([settings.seed, 1 + KINDS.index(kind), index])
    count = settings.queries
    strata = np.stack([rng.permutation(count) for _ in range(7)], axis=1)
    u = (strata + rng.random((count, 7))) / count
    half = np.where(u[:, 2] < 0.5, 2.0 * u[:, 2], 2.0 * u[:, 2] - 1.0)
    (a, b), (c, d) = settings.small, settings.large
    size = np.where(u[:, 2] < 0.5, a + (b - a) * half, c + (d - c) * half)
    (wix, wiy), (wox, woy) = _disk(u[:, 3], u[:, 4]), _disk(u[:, 5], u[:, 6])
    wiz = np.sqrt(1.0 - wix**2 - wiy**2) * (1.0 if kind == "reflection" else -1.0)
    queries = np.stack([u[:, 0], u[:, 1], size, wix, wiy, wiz, wox, woy], axis=1).astype(np.float32)
    # Rounding may have led to 1, which is 0.
    queries[:, :2] %= 1.0
    return queries


def _disk(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    radius = EDGE * np.sqrt(a)
    return radius * np.cos(2.0 * np.pi * b), radius * np.sin(2.0 * np.pi * b)


def make_targets(
    settings: DatasetSettings, index: int, kind: Kind, threads: int | None = None
) -> tuple[SurfaceMaterial, NDArray[np.float32], NDArray[np.float32]]:
    """(material, queries, targets) number ``index``: what the file holds."""
    material, queries = draw_material(settings, index), draw_queries(settings, index, kind)
    targets = aggregate(
        material, queries, transmission=kind == "transmission", samples=settings.samples,
        seed=settings.seed + 2 * index + KINDS.index(kind), threads=threads,
    )  # fmt: skip
    return material, queries, targets
