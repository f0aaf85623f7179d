"""The results of ``usdfab evaluate table2`` as text and as JSON, in the layout of Table 2 of Li et al. 2024."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from usdfab.fit.table2 import PAPER_ERRORS, PAPER_FABRICS, PAPER_MEANS, SYMBOLS
from usdfab.fit.table2_evaluation import Table2Row

PRIOR = "~"
"""Follows an error that is the prior's."""

FIRST, CELL = 10, 9


def mean_errors(rows: Sequence[Table2Row], stage: str) -> dict[str, float]:
    """Percent of the range by parameter after a stage, over the fabrics that were fitted; empty where none was."""
    found = [row.errors[stage] for row in rows if stage in row.errors]
    return {name: 100.0 * float(np.mean([errors[name] for errors in found])) for name in SYMBOLS} if found else {}


def stages_of(rows: Sequence[Table2Row]) -> list[str]:
    """Names of the stages in order."""
    return list(dict.fromkeys(stage for row in rows for stage in row.errors))


def summary(rows: Sequence[Table2Row]) -> dict[str, Any]:
    """For ``--json``: each fabric, means after each stage and the paper's numbers. All errors in percent."""
    fabrics = [
        vars(row)
        | {"errors": {s: {n: 100.0 * e for n, e in errors.items()} for s, errors in row.errors.items()}}
        for row in rows
    ]  # fmt: skip
    return {
        "fabrics": fabrics,
        "means": {stage: mean_errors(rows, stage) for stage in stages_of(rows)},
        "weaves_right": {stage: sum(row.right.get(stage, False) for row in rows) for stage in stages_of(rows)},
        "symbols": dict(SYMBOLS),
        "paper": {
            name: {"fabrics": dict(zip(PAPER_FABRICS, PAPER_ERRORS[name], strict=True)), "mean": PAPER_MEANS[name]}
            for name in SYMBOLS
        },
    }


def format_table2(rows: Sequence[Table2Row]) -> str:
    """A table for each stage beside the paper's means, then the paper's own table."""
    lines = []
    for stage in stages_of(rows):
        lines += [*_stage_table(rows, stage), ""]
    lines += [f"{row.name} was refused: {row.problem}" for row in rows if row.problem]
    lines += ["", "Li et al. 2024, Table 2: error in % of the range, after all stages, other fabrics"]
    lines.append(_line("", [f"{name} " for name in (*PAPER_FABRICS, "mean")]))
    lines.append(_line("weave", ["right "] * len(PAPER_FABRICS)))
    for name, symbol in SYMBOLS.items():
        lines.append(_line(symbol, [f"{value:.2f} " for value in (*PAPER_ERRORS[name], PAPER_MEANS[name])]))
    return "\n".join(lines).replace("\n\n\n", "\n\n")


def _stage_table(rows: Sequence[Table2Row], stage: str) -> list[str]:
    means = mean_errors(rows, stage)
    lines = [
        f"after {stage}: error in % of the range ({PRIOR} estimated by no stage so far: the prior's error)",
        _line("", [f"{name} " for name in (*(row.name for row in rows), "mean", "paper")]),
        _line("weave", [_weave(row, stage) for row in rows]),
    ]
    for name, symbol in SYMBOLS.items():
        fitted = [row for row in rows if stage in row.errors]
        cells = [_cell(100.0 * row.errors[stage][name], name in row.priors[stage]) if row in fitted else "- "
                 for row in rows]  # fmt: skip
        cells.append(_cell(means[name], all(name in row.priors[stage] for row in fitted)))
        lines.append(_line(symbol, [*cells, _cell(PAPER_MEANS[name], False)]))
    lines.append(_line("distance", [_number(row.distances.get(stage), ".3f") for row in rows]))
    lines.append(_line("seconds", [_number(row.seconds.get(stage), ".0f") for row in rows]))
    right, better = sum(row.right.get(stage, False) for row in rows), sum(means[n] <= PAPER_MEANS[n] for n in means)
    lines.append(
        f"weaves right: {right} of {len(rows)}; mean error at or under the paper's: {better} of {len(means)} rows"
    )
    return lines


def _line(first: str, cells: Sequence[str]) -> str:
    return (f"{first:<{FIRST}}" + "".join(f"{cell:>{CELL}}" for cell in cells)).rstrip()


def _cell(percent: float, prior: bool) -> str:
    return f"{percent:.2f}{PRIOR if prior else ' '}"


def _number(value: float | None, form: str) -> str:
    return "- " if value is None else f"{value:{form}} "


def _weave(row: Table2Row, stage: str) -> str:
    return "- " if stage not in row.right else "right " if row.right[stage] else "wrong "
