"""Random fabrics as microscope photos of real cloth show them: the second distribution beside Table 4.

Table 4 of Li et al. 2024 knows round, unplied, evenly closed yarns of two random colours in seven weaves. Photos show
plied and strongly twisted yarns, fuzz, flattened and uneven yarns, open cloth, few colours, all weaves, 5 to 40 yarns
across and cells that are not square. Yarns are built by kind (spun, plied, filament), geometry by what must hold
between the systems: crossing yarns touch, the cover says how open the cloth is. Lengths are metres, angles radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import FabricParameters, System, YarnParameters
from usdfab.fabric.plausible import doubts
from usdfab.fabric.sampling_colors import colored
from usdfab.fabric.sampling_weaves import CLASSES, OTHER, OTHER_SHARE, sample_weave
from usdfab.fabric.weave import PAPER_WEAVES

REVISION = 1
"""Raised whenever the same random numbers give another fabric."""

COUNT_RANGE = (4.5, 42.0)
"""Fewest and most yarns of a system across the picture."""

SIDE_RANGE = (1.5e-3, 8e-3)
COVER_RANGE = (0.5, 1.2)
"""Width over spacing of each yarn system: cheesecloth to yarns that are squeezed together."""

FLATTENING_RANGE = (1.0, 3.0)

ANGLE_RANGES = {"spun": (6.0, 28.0), "plied": (15.0, 30.0), "filament": (0.0, 4.0)}
"""Angle in degrees between the fibers (plies, of a plied yarn) on top of the yarn and its axis."""

ACCEPTED = frozenset({"cover"})
"""Rules of ``plausible`` that may be broken: squeezed yarns share a little space, and Table 4's do too."""

_TRIES = 1000


@dataclass(frozen=True)
class _Shape:
    """The cloth's geometry before its yarns have fibers: spacing of both systems, and which leave gaps."""

    count: dict[System, float]
    spacing: dict[System, float]
    open: dict[System, bool]
    side: float


def sample_class(rng: np.random.Generator) -> str:
    """A weave class for a fabric of the wide prior: ``other`` with ``OTHER_SHARE``, the seven equally likely."""
    return OTHER if rng.random() < OTHER_SHARE else PAPER_WEAVES[rng.integers(len(PAPER_WEAVES))]


def sample_wide(label: str, rng: np.random.Generator) -> FabricParameters:
    """A random fabric of a class (``sampling_weaves.CLASSES``) with ``variants`` 1.

    It could exist: ``plausible.doubts`` finds nothing but ``ACCEPTED`` rules.

    Raises
    ------
    UsdfabError
        For an unknown class.
    """
    if label not in CLASSES:
        raise UsdfabError(f"there is no class '{label}'", remedy=f"use one of {', '.join(CLASSES)}")
    for _ in range(_TRIES):
        fabric = _draw(label, rng)
        if all(doubt.rule in ACCEPTED for doubt in doubts(fabric)):
            return colored(fabric, rng)
    raise AssertionError(f"no plausible fabric of class {label} in {_TRIES} draws")


def _draw(label: str, rng: np.random.Generator) -> FabricParameters:
    weave = sample_weave(label, rng)
    floats = FabricParameters(weave).float_cells()
    shape = _shape(floats, rng)
    kind = _kind(rng)
    other_kind = kind if rng.random() < 0.75 else _kind(rng)
    base = {"warp": _yarn(shape, "warp", kind, floats, rng)}
    if kind == other_kind and rng.random() < 0.6:
        # The same yarn in both directions, as thick; it is pressed flat by how closely it is set.
        cover = min(COVER_RANGE[1], base["warp"].radius * 2 * base["warp"].flattening / shape.spacing["weft"])
        flattening = base["warp"].flattening * max(1.0, COVER_RANGE[0] / cover)
        base["weft"] = replace(
            base["warp"], count=shape.count["weft"], flattening=flattening,
            radius=0.5 * max(cover, COVER_RANGE[0]) * shape.spacing["weft"] / flattening,
        )  # fmt: skip
    else:
        base["weft"] = _yarn(shape, "weft", other_kind, floats, rng)
    radii = {s: yarn.radius for s, yarn in base.items()}
    # Crossing yarns touch, more or less: of the distance of their centres each system bends through its share.
    apart = rng.uniform(0.75, 1.15) * sum(radii.values())
    share = rng.uniform(0.2, 0.8)
    crimp = {"warp": apart * share / radii["warp"], "weft": apart * (1.0 - share) / radii["weft"]}
    warp, weft = (replace(base[s], crimp=float(np.clip(crimp[s], 0.1, 1.9))) for s in ("warp", "weft"))
    size = (shape.side, shape.side)
    return FabricParameters(weave, size, warp, weft, int(rng.integers(2**31)), "Sampled", variants=1)


def _shape(floats: int, rng: np.random.Generator) -> _Shape:
    side = _log_uniform(rng, *SIDE_RANGE)
    # Long floats would slip in open cloth: nobody weaves that.
    gaps = rng.random() < (0.35 if floats < 4 else 0.1)
    both = rng.random() < 0.6
    one = rng.random() < 0.5
    while True:
        mean = _log_uniform(rng, 5.5, 30.0)
        aspect = math.exp(np.clip(rng.normal(0.0, 0.3), -0.7, 0.7) / 2.0)
        ends, picks = mean * aspect, mean / aspect
        if all(COUNT_RANGE[0] <= n <= COUNT_RANGE[1] for n in (ends, picks)):
            break
    return _Shape(
        count={"warp": ends, "weft": picks},
        spacing={"warp": side / ends, "weft": side / picks},
        open={"warp": gaps and (both or one), "weft": gaps and (both or not one)},
        side=side,
    )


def _kind(rng: np.random.Generator) -> str:
    return str(rng.choice(["spun", "plied", "filament"], p=[0.5, 0.3, 0.2]))


def _yarn(shape: _Shape, system: System, kind: str, floats: int, rng: np.random.Generator) -> YarnParameters:
    spacing = shape.spacing[system]
    along = shape.spacing["weft" if system == "warp" else "warp"]
    cover = rng.uniform(COVER_RANGE[0], 0.85) if shape.open[system] else rng.uniform(0.85, COVER_RANGE[1])
    # Long floats and untwisted filaments spread; open cloth keeps its yarns rounder.
    spread = 0.25 + 0.35 * (kind == "filament") + 0.2 * (floats >= 4)
    flattening = float(np.clip(1.0 + abs(rng.normal(0.0, spread)) + 0.2 * (not shape.open[system]), *FLATTENING_RANGE))
    half_width = 0.5 * cover * spacing
    low, high = ANGLE_RANGES[kind]
    # On top of the yarn a fiber moves across by 2 pi alpha f e per cell, and the cell is the other spacing long.
    turns = math.tan(math.radians(rng.uniform(low, high))) * along / (2.0 * math.pi * half_width)
    hand = -1.0 if rng.random() < 0.3 else 1.0
    plies = int(rng.choice([2, 3, 4], p=[0.75, 0.17, 0.08])) if kind == "plied" else 1
    values: dict = {
        "count": shape.count[system],
        "radius": half_width / flattening,
        "flattening": flattening,
        "fiber_count": round(_log_uniform(rng, 25, 120) if kind == "filament" else _log_uniform(rng, 50, 260)),
        "packing": rng.uniform(0.3, 0.6),
        "inclination": rng.uniform(0.25, 1.3),
        "twist": float(np.clip(hand * turns, -1.5, 1.5)),
        "ply_count": plies,
        "irregularity": rng.uniform(0.02, 0.15) if kind == "filament" else rng.uniform(0.1, 0.55),
        "migration": float(np.clip(rng.normal(0.75, 0.05), 0.5, 0.95)),
        "migration_rate": float(np.clip(rng.normal(0.2, 0.06), 0.02, 0.5)),
    }
    if plies > 1:
        # Between plies whose fibers lie along the yarn (-twist) and plies that are hardly twisted.
        values["ply_twist"] = -values["twist"] * rng.uniform(0.2, 1.2)
    return YarnParameters(**values | _fuzz(kind, spacing, rng) | _optics(kind, rng) | _uneven(kind, rng))


def _uneven(kind: str, rng: np.random.Generator) -> dict:
    """How thickness and place vary along the yarn: spun yarns do by 10 to 20 %, filament yarns hardly."""
    most = 0.2 if kind == "filament" else 1.0
    return {"unevenness": most * rng.uniform(0.03, 0.22), "waviness": most * rng.uniform(0.05, 0.4)}


def _fuzz(kind: str, spacing: float, rng: np.random.Generator) -> dict:
    """Flyaways, relative to the cloth's cells as photos show them."""
    if rng.random() > (0.1 if kind == "filament" else 0.8):
        return {}
    return {
        "flyaway_density": _log_uniform(rng, 0.2, 5.0) / spacing,
        "flyaway_length": _log_uniform(rng, 0.4, 3.0) * spacing,
        "flyaway_loop_fraction": rng.uniform(0.1, 0.6),
        "flyaway_spread": rng.uniform(0.2, 0.9),
    }


def _optics(kind: str, rng: np.random.Generator) -> dict:
    mean = 0.3 if kind == "filament" else 0.5
    return {
        "roughness_longitudinal": float(np.clip(rng.normal(mean, 0.15), 0.08, 0.95)),
        "roughness_azimuthal": _log_uniform(rng, 0.03, 0.35),
        "roughness_primary": _log_uniform(rng, 0.05, 0.2 if kind == "filament" else 0.4),
        "cuticle_tilt": 0.05 if kind != "filament" and rng.random() < 0.2 else 0.0,
    }


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
