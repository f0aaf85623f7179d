"""The fitted parameters as rows of text: value, unit, where it comes from and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from usdfab.fabric import SYSTEMS, YARN_PARAMETERS, FabricParameters, Parameter, System, YarnParameters
from usdfab.fabric.parameters import PARAMETER_BY_NAME
from usdfab.fit.analysis import PhotoAnalysis, YarnSystem
from usdfab.fit.doubts import Doubt
from usdfab.fit.priors import MIN_CONFIDENCE
from usdfab.fit.stages import StageOutcome

UNITS = {"m": ("µm", 1e6), "rad": ("°", 57.29577951308232), "1/m": ("1/mm", 1e-3)}
"""How lengths, angles and densities are shown: unit and factor."""


@dataclass(frozen=True)
class Row:
    """One parameter of both systems: ``values`` and ``known`` (where from, how sure) for warp and weft."""

    name: str
    symbol: str
    unit: str
    values: tuple[str, str]
    known: tuple[str, str]


def parameter_rows(
    fabric: FabricParameters, analysis: PhotoAnalysis, stages: Sequence[StageOutcome], doubts: Sequence[Doubt] = ()
) -> list[Row]:
    """All rows of the parameter table for a fit; ``doubts`` are named at the parameters that they concern."""
    rows = []
    for parameter in YARN_PARAMETERS:
        unit, factor = UNITS.get(parameter.unit, (parameter.unit, 1.0))
        warp, weft = (_value(_shown(fabric.system(s), parameter.name), factor) for s in SYSTEMS)
        known_warp, known_weft = (
            _known(parameter, s, analysis, stages, factor) + _doubted(parameter.name, s, doubts) for s in SYSTEMS
        )
        shown = "" if unit == "1" else unit
        rows.append(Row(parameter.name, parameter.symbol, shown, (warp, weft), (known_warp, known_weft)))
    return rows


def _shown(yarn: YarnParameters, name: str) -> Any:
    return yarn.effective_fiber_radius if name == "fiber_radius" else getattr(yarn, name)


def _value(value: Any, factor: float) -> str:
    if isinstance(value, tuple):
        if value and isinstance(value[0], tuple):
            return f"{len(value)} colours"
        return " ".join(f"{v:.3f}" for v in value) if value else "–"
    return str(value) if isinstance(value, int) else f"{value * factor:.4g}"


def _known(
    parameter: Parameter, system: System, analysis: PhotoAnalysis, stages: Sequence[StageOutcome], factor: float
) -> str:
    """The last stage that changed it, with what that stage knows of its accuracy; else the analysis, or a prior."""
    for earlier, stage in reversed(list(pairwise(stages))):
        names = ("albedo", "yarn_albedo") if parameter.name in ("albedo", "yarn_albedo") else (parameter.name,)
        if all(getattr(earlier.fabric.system(system), n) == getattr(stage.fabric.system(system), n) for n in names):
            continue
        spread = [v for k, v in stage.uncertainty.items() if k.split("[")[0] == f"{system}.{parameter.name}"]
        return f"{stage.name} stage" + (f", ± {max(spread) * factor:.2g}" if spread else "")
    yarn = stages[-1].fabric.system(system)
    if parameter.name == "fiber_radius" and not yarn.fiber_radius:
        return "from fiber_count and packing"
    if parameter.name == "yarn_albedo":
        return "photo" if yarn.yarn_albedo else "one colour"
    sure = _confidence(parameter.name, getattr(analysis, system))
    if sure is None:
        return "prior" if PARAMETER_BY_NAME[parameter.name].stages else "default"
    if sure < MIN_CONFIDENCE and parameter.name in ("twist", "radius"):
        return f"prior (photo: confidence {sure:.2f})"
    return f"photo, confidence {sure:.2f}"


def _doubted(name: str, system: System, doubts: Sequence[Doubt]) -> str:
    causes = dict.fromkeys(d.cause for d in doubts if name in d.parameters or f"{system}.{name}" in d.parameters)
    return f"; doubtful: {', '.join(causes)}" if causes else ""


def _confidence(name: str, seen: YarnSystem) -> float | None:
    """Of what the analysis reads from the photo."""
    return {
        "count": seen.count_confidence,
        "radius": seen.width_confidence,
        "albedo": seen.colour_confidence,
        "twist": seen.twist_confidence,
    }.get(name)
