"""The evaluation as text and as JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from usdfab.fit.network.evaluation import (
    WAYS,
    Judged,
    Report,
    counts_within,
    mean_errors,
    surprise,
    weave_accuracy,
    within_one_sigma,
)
from usdfab.fit.network.paper import PAPER_MEANS


def summary(report: Report) -> dict[str, Any]:
    """Everything that the tables say, as plain JSON data; errors are fractions."""
    result: dict[str, Any] = {"training_samples": report.training_samples, "network": report.about}
    for name, samples in _groups(report):
        ways = _ways(samples)
        result[name] = {
            "samples": len(samples),
            "refused_by_analysis": sum(one.refused for one in samples) if "analysis" in ways else None,
            "weave_accuracy": {way: weave_accuracy(samples, way) for way in ways[1:]},
            "family_accuracy": {way: weave_accuracy(samples, way, family=True) for way in ways[1:]},
            "counts_within_5_percent": {way: counts_within(samples, way, 0.05) for way in ways[1:]},
            "counts_within_10_percent": {way: counts_within(samples, way, 0.10) for way in ways[1:]},
            "errors": {way: mean_errors(samples, way) for way in ways},
        }
        if not np.isnan(samples[0].deviations).all():
            result[name]["within_one_sigma"] = within_one_sigma(samples)
            result[name]["surprise_less_prior_nats"] = surprise(samples, report.scale)
    return result


def format_report(report: Report) -> str:
    """The tables as text."""
    said = summary(report)
    lines: list[str] = []
    for name, samples in _groups(report):
        part, ways = said[name], _ways(samples)
        kind = "Table 4, as rendered; error in % of the range" if name == "table4" else (
            "wide prior, as cameras show it; error in % of 6 standard deviations of the prior"
        )  # fmt: skip
        lines.append(f"{len(samples)} samples of {kind}")
        lines.append(
            f"{'':<24}" + "".join(f"{way:>10}" for way in ways) + (f"{'paper':>10}" if name == "table4" else "")
        )
        for title, key in (
            ("weave right, %", "weave_accuracy"), ("family right, %", "family_accuracy"),
            ("counts within 5 %, %", "counts_within_5_percent"), ("counts within 10 %, %", "counts_within_10_percent"),
        ):  # fmt: skip
            cells = "".join(f"{100 * part[key][way]:10.1f}" for way in ways[1:])
            lines.append(f"{title:<24}{'':>10}{cells}")
        for row in part["errors"]["prior"]:
            cells = "".join(f"{100 * part['errors'][way][row]:10.2f}" if row in part["errors"][way] else f"{'-':>10}"
                            for way in ways)  # fmt: skip
            paper = f"{PAPER_MEANS[row]:10.2f}" if name == "table4" else ""
            lines.append(f"{row:<24}{cells}{paper}")
        if "within_one_sigma" in part:
            lines.append(f"{'':<24}{'in 1 sigma, %':>14}{'nats less than prior':>22}")
            for row, share in part["within_one_sigma"].items():
                lines.append(f"{row:<24}{100 * share:14.0f}{-part['surprise_less_prior_nats'][row]:22.2f}")
        lines.append("")
    return "\n".join(lines[:-1])


def _groups(report: Report) -> list[tuple[str, tuple[Judged, ...]]]:
    groups = [(name, tuple(one for one in report.samples if one.table4 == (name == "table4")))
              for name in ("table4", "wide")]  # fmt: skip
    return [(name, samples) for name, samples in groups if samples]


def _ways(samples: tuple[Judged, ...]) -> list[str]:
    return [way for way in WAYS if any(way in one.labels for one in samples)]
