"""What a woven fabric is: two yarn systems, a weave, a size. Frozen, validated, plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric.parameters import PARAMETER_BY_NAME, YARN_PARAMETERS, Parameter
from usdfab.fabric.plies import ply_fill
from usdfab.fabric.weave import Weave, plain, weave_from_name

Color = tuple[float, float, float]
System = Literal["warp", "weft"]
SYSTEMS: tuple[System, System] = ("warp", "weft")
SIZE_RANGE = (1e-5, 10.0)
"""Shortest and longest side of a sample that is accepted, in metres."""

VARIANTS_RANGE = (1, 16)
"""Fewest and most variants of the tile that repeats."""


def _default(name: str) -> Any:
    return PARAMETER_BY_NAME[name].default


@dataclass(frozen=True)
class YarnParameters:
    """One yarn system (warp or weft). Fields are the rows of ``YARN_PARAMETERS``, which holds units and meanings.

    Raises
    ------
    UsdfabError
        For a value that is not a finite number or lies outside the table's hard range.
    """

    count: float = _default("count")
    radius: float = _default("radius")
    flattening: float = _default("flattening")
    fiber_count: int = _default("fiber_count")
    fiber_radius: float = _default("fiber_radius")
    packing: float = _default("packing")
    inclination: float = _default("inclination")
    crimp: float = _default("crimp")
    twist: float = _default("twist")
    ply_count: int = _default("ply_count")
    ply_twist: float = _default("ply_twist")
    irregularity: float = _default("irregularity")
    unevenness: float = _default("unevenness")
    waviness: float = _default("waviness")
    migration: float = _default("migration")
    migration_rate: float = _default("migration_rate")
    flyaway_density: float = _default("flyaway_density")
    flyaway_loop_fraction: float = _default("flyaway_loop_fraction")
    flyaway_length: float = _default("flyaway_length")
    flyaway_spread: float = _default("flyaway_spread")
    albedo: Color = _default("albedo")
    yarn_albedo: tuple[Color, ...] = _default("yarn_albedo")
    albedo_variation: float = _default("albedo_variation")
    roughness_longitudinal: float = _default("roughness_longitudinal")
    roughness_azimuthal: float = _default("roughness_azimuthal")
    roughness_primary: float = _default("roughness_primary")
    ior: float = _default("ior")
    cuticle_tilt: float = _default("cuticle_tilt")

    def __post_init__(self) -> None:
        for parameter in YARN_PARAMETERS:
            value = checked_value(parameter, getattr(self, parameter.name))
            object.__setattr__(self, parameter.name, value)

    @property
    def effective_fiber_radius(self) -> float:
        """Fiber radius in metres: the given one, or from the packing of the cross-section."""
        if self.fiber_radius > 0:
            return self.fiber_radius
        filled = self.flattening * self.packing * ply_fill(self.ply_count)
        return self.radius * math.sqrt(filled / self.fiber_count)

    def colors(self) -> tuple[Color, ...]:
        """Albedo of consecutive yarns, repeated in order."""
        return self.yarn_albedo or (self.albedo,)


@dataclass(frozen=True)
class Provenance:
    """Where the numbers come from. Everything is text, so that any USD program can show it."""

    source: str = ""
    source_sha256: str = ""
    generator: str = ""
    stages: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class FabricParameters:
    """A woven fabric.

    Parameters
    ----------
    weave:
        The weave matrix; weft runs along +x, warp along +y.
    size: (2,) metres
        Physical size of the sample: ``size[0] / warp.count`` is the distance between ends,
        ``size[1] / weft.count`` the distance between picks.
    warp, weft:
        The two yarn systems.
    seed:
        Fixes every random draw of the fibers.
    variants:
        How many variants of the repeating tile a renderer mixes, so that the eye finds no repetition; 1 is off.
    albedo_map:
        Path of an image that multiplies the fiber albedo, looked up with the texture coordinates of the cloth; empty
        for none.
    neural_weights:
        Path of the file of ``usdfab train neural --asset`` with the fabric's own network; empty for none.
    """

    weave: Weave = field(default_factory=plain)
    size: tuple[float, float] = (5e-3, 5e-3)
    warp: YarnParameters = field(default_factory=YarnParameters)
    weft: YarnParameters = field(default_factory=YarnParameters)
    seed: int = 0
    name: str = "Fabric"
    provenance: Provenance = field(default_factory=Provenance)
    variants: int = 4
    albedo_map: str = ""
    neural_weights: str = ""

    def __post_init__(self) -> None:
        if len(self.size) != 2:
            raise UsdfabError(f"size is two lengths in metres, got {self.size!r}", place="size")
        low, high = SIZE_RANGE
        for side in self.size:
            if not (math.isfinite(side) and low <= side <= high):
                raise UsdfabError(f"a side of {side} m is not between {low:g} and {high:g} m", place="size")
        object.__setattr__(self, "size", (float(self.size[0]), float(self.size[1])))
        if not 0 <= self.seed < 2**31:
            raise UsdfabError(f"{self.seed} is not between 0 and 2^31 - 1", place="seed")
        fewest, most = VARIANTS_RANGE
        if self.variants != int(self.variants) or not fewest <= self.variants <= most:
            raise UsdfabError(f"{self.variants} is not a whole number from {fewest} to {most}", place="variants")

    @property
    def cell(self) -> tuple[float, float]:
        """Size of one crossing in metres: (distance between ends along x, distance between picks along y)."""
        return self.size[0] / self.warp.count, self.size[1] / self.weft.count

    def system(self, name: System) -> YarnParameters:
        """The yarn system called ``warp`` or ``weft``."""
        return self.warp if name == "warp" else self.weft

    def with_systems(self, yarns: Mapping[System, YarnParameters]) -> FabricParameters:
        """The same fabric with other yarn systems, one or both."""
        return replace(self, warp=yarns.get("warp", self.warp), weft=yarns.get("weft", self.weft))

    def repeat(self) -> tuple[int, int]:
        """Picks and ends after which weave *and* colours repeat."""
        return (
            math.lcm(self.weave.picks, len(self.weft.colors())),
            math.lcm(self.weave.ends, len(self.warp.colors())),
        )

    def cover(self, name: System) -> float:
        """Width of the yarns over their spacing, ``2 e f n / L``: 1 is closed cloth."""
        yarn = self.system(name)
        spacing = self.cell[0] if name == "warp" else self.cell[1]
        return 2.0 * yarn.radius * yarn.flattening / spacing

    def float_cells(self) -> int:
        """Longest float of the weave, in cells."""
        return max(_longest_run(row) for m in (self.weave.matrix, self.weave.matrix.T) for row in m)


def _longest_run(row: np.ndarray) -> int:
    changes = np.flatnonzero(row != np.roll(row, 1))
    return int(np.diff(np.r_[changes, changes[0] + len(row)]).max())


def checked_value(parameter: Parameter, value: Any, place: str = "") -> Any:
    """``value`` in the parameter's type, or ``UsdfabError`` naming the parameter, the range and the unit."""
    place = place or parameter.name
    if parameter.kind == "colors":
        colors = np.asarray(value, dtype=float)
        if colors.size == 0:
            return ()
        if colors.ndim != 2 or colors.shape[1] != 3:
            raise UsdfabError("expected a list of RGB triples", place=place)
        return tuple(_checked_color(parameter, c, place) for c in colors)
    if parameter.kind == "color":
        return _checked_color(parameter, value, place)
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise UsdfabError(f"expected a number, got {value!r}", place=place) from None
    _check_range(parameter, number, place)
    if parameter.kind == "int":
        if number != int(number):
            raise UsdfabError(f"expected a whole number, got {value!r}", place=place)
        return int(number)
    return number


def _checked_color(parameter: Parameter, value: Any, place: str) -> Color:
    try:
        color = np.asarray(value, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        raise UsdfabError(f"expected three numbers (linear RGB), got {value!r}", place=place) from None
    if color.shape == (1,):
        color = np.repeat(color, 3)
    if color.shape != (3,):
        raise UsdfabError(f"expected three numbers (linear RGB), got {len(color)}", place=place)
    for channel in color:
        _check_range(parameter, float(channel), place)
    return (float(color[0]), float(color[1]), float(color[2]))


def _check_range(parameter: Parameter, number: float, place: str) -> None:
    low, high = parameter.hard
    if not (math.isfinite(number) and low <= number <= high):
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        raise UsdfabError(f"{number:g} is not between {low:g} and {high:g}{unit}", place=place)


# --- editing by name -------------------------------------------------------------------------------------------------


def edited(fabric: FabricParameters, settings: Mapping[str, str]) -> FabricParameters:
    """``fabric`` with settings such as ``{"warp.albedo": ".1,.2,.5", "weave": "twill 2/2"}`` applied.

    Names: ``weave``, ``size`` (two lengths, in metres or with a unit), ``seed``, ``variants``, ``name``, ``albedo_map``
    (a file), and
    ``warp.NAME`` or ``weft.NAME`` or ``both.NAME`` for each row of the parameter table.

    Raises
    ------
    UsdfabError
        For an unknown name or a value out of range.
    """
    for key, text in settings.items():
        fabric = _edited_once(fabric, key.strip(), text.strip())
    return fabric


def _edited_once(fabric: FabricParameters, key: str, text: str) -> FabricParameters:
    if key == "weave":
        return replace(fabric, weave=weave_from_name(text))
    if key == "size":
        return replace(fabric, size=parse_size(text))
    if key in ("seed", "variants"):
        if not text.isdigit():
            raise UsdfabError(f"expected a whole number, got '{text}'", place=key)
        return replace(fabric, **{key: int(text)})  # type: ignore[arg-type]
    if key == "name":
        return replace(fabric, name=text)
    if key == "albedo_map":
        return replace(fabric, albedo_map=text)
    system, _, name = key.partition(".")
    if system not in ("warp", "weft", "both") or name not in PARAMETER_BY_NAME:
        known = ", ".join(p.name for p in YARN_PARAMETERS)
        raise UsdfabError(
            f"unknown parameter '{key}'",
            remedy="use weave, size, seed, variants, name, albedo_map, or warp., weft. or both. followed by one of: "
            + known,
        )
    value = _parse_value(PARAMETER_BY_NAME[name], text, key)
    changes = {s: replace(fabric.system(s), **{name: value}) for s in SYSTEMS if system in (s, "both")}
    return replace(fabric, **changes)  # type: ignore[arg-type]


def _parse_value(parameter: Parameter, text: str, place: str) -> Any:
    try:
        if parameter.kind == "colors":
            value: Any = [[float(v) for v in part.split(",")] for part in text.split(";") if part.strip()]
        elif parameter.kind == "color":
            value = [float(v) for v in text.split(",")]
        elif parameter.unit == "m":
            value = parse_length(text)
        else:
            value = float(text)
    except ValueError as error:
        if isinstance(error, UsdfabError):
            raise
        raise UsdfabError(f"'{text}' is not a number", place=place) from None
    return checked_value(parameter, value, place)


_UNITS = {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9, "in": 0.0254}


def parse_length(text: str) -> float:
    """Metres from ``"3.6mm"``, ``"200um"``, ``"1in"`` or a bare number of metres."""
    stripped = text.strip().lower()
    split = len(stripped.rstrip("abcdefghijklmnopqrstuvwxyzµμ "))
    number, unit = stripped[:split], stripped[split:].strip()
    try:
        value = float(number) * _UNITS[unit]
    except (ValueError, KeyError):
        raise UsdfabError(f"'{text}' is not a length", remedy="write for example 3.6mm, 200um, 1in or 0.0036") from None
    if not math.isfinite(value):
        raise UsdfabError(f"'{text}' is not a finite length")
    return value


def parse_size(text: str) -> tuple[float, float]:
    """Two lengths in metres from ``"3.6mm"``, ``"3.6mm,2mm"`` or ``"3.6x2mm"``."""
    parts = [p for p in text.lower().replace("x", ",").split(",") if p.strip()]
    if not 1 <= len(parts) <= 2:
        raise UsdfabError(f"'{text}' is not a size", remedy="write for example 3.6mm or 3.6mm,2.4mm")
    unit = parts[-1].lstrip("0123456789.eE+- ")
    lengths = [parse_length(p if p.strip()[-1].isalpha() or p.strip()[-1] in "µμ" else p + unit) for p in parts]
    return lengths[0], lengths[-1]


def as_table(fabric: FabricParameters) -> dict[str, Any]:
    """The fabric as plain JSON data: what ``usdfab info --json`` prints."""

    def yarn(parameters: YarnParameters) -> dict[str, Any]:
        values = {f.name: getattr(parameters, f.name) for f in fields(parameters)}
        values["yarn_albedo"] = [list(c) for c in parameters.yarn_albedo]
        return values | {"albedo": list(parameters.albedo)}

    return {
        "name": fabric.name,
        "weave": {
            "name": fabric.weave.name,
            "class": fabric.weave.classify(),
            "matrix": fabric.weave.matrix.astype(int).tolist(),
        },
        "size_m": list(fabric.size),
        "seed": fabric.seed,
        "variants": fabric.variants,
        "albedo_map": fabric.albedo_map,
        "neural_weights": fabric.neural_weights,
        "warp": yarn(fabric.warp),
        "weft": yarn(fabric.weft),
        "provenance": {
            f.name: list(v) if isinstance(v := getattr(fabric.provenance, f.name), tuple) else v
            for f in fields(fabric.provenance)
        },
    }
