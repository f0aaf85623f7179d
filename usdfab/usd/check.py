"""Is this USD file right? USD's own validators plus usdfab's rules, each with a stable name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from pxr import Sdf, Tf, Usd

from usdfab.errors import UsdfabError
from usdfab.fabric.plausible import doubts, unusual
from usdfab.usd.check_assets import bindings, missing_files
from usdfab.usd.check_rules import applied, cloth, curves, preview, values
from usdfab.usd.check_schema import names, primvars, tokens, types
from usdfab.usd.check_usd import composition_issues, plain, quiet_usd, validator_issues
from usdfab.usd.fabric_io import fabric_from_prim, is_fabric
from usdfab.usd.issue import SEVERITIES, Issue, Severity, info, warning
from usdfab.usd.schema_source import camel, yarn_attribute_name
from usdfab.usd.stage import open_stage, site, stage_name

__all__ = ["RULES", "Issue", "Severity", "check", "exit_code"]

MAX_ISSUES = 10_000
"""After so many findings a last one says that the rest of the stage is not checked."""
# What USD's bindings raise for stages that are not as they should be.
_UNREADABLE = (
    Tf.ErrorException, TypeError, ValueError, ArithmeticError, LookupError, AttributeError, RuntimeError, OSError,
    MemoryError, AssertionError,
)  # fmt: skip


def plausible(prim: Usd.Prim) -> Iterator[Issue]:
    """``usdfab:cover``, ``interpenetration``, ``packing``, ``fiberRadius``, ``crimp``: cloth that cannot exist.

    ``usdfab:unusual`` for values that few fabrics have.
    """
    if not is_fabric(prim) or prim.GetTypeName() != "Material":
        return
    try:
        fabric = fabric_from_prim(prim)
    except UsdfabError:
        # Values that are out of range have issues of their own.
        return
    for doubt in doubts(fabric):
        place = prim.GetPath().AppendProperty(yarn_attribute_name(doubt.system, camel(doubt.parameter)))
        yield warning(place, prim, doubt.rule, doubt.message, doubt.remedy)
    for doubt in unusual(fabric):
        place = prim.GetPath().AppendProperty(yarn_attribute_name(doubt.system, camel(doubt.parameter)))
        yield info(place, prim, doubt.rule, doubt.message)


RULES: tuple[Callable[[Usd.Prim], Iterator[Issue]], ...] = (
    applied, values, preview, curves, cloth, names, types, tokens, primvars, plausible, missing_files, bindings,
)  # fmt: skip
"""usdfab's own rules: a prim to its issues."""


def check(source: str | Path | Usd.Stage) -> list[Issue]:
    """Everything that is wrong with a USD file, errors first; empty if nothing is.

    Runs all of UsdValidation's validators, without the false alarms about shaders that usd-core does not know
    (MaterialX's ``ND_*``, in older versions even USD's own), and the rules in ``RULES``. Prims inside instances are
    checked once for each prototype. What cannot even be read is an issue too (``usdfab:unreadable``).

    Raises
    ------
    UsdfabError
        If the file is missing or USD cannot read it; nothing else.
    """
    with quiet_usd():
        stage = open_stage(source)
        issues = _guarded(lambda: composition_issues(stage), stage_name(stage))
        for prim in prims(stage):
            place = site(stage, prim)
            for rule in RULES:
                issues += _guarded(lambda prim=prim, rule=rule: rule(prim), place)  # type: ignore[misc]
            if len(issues) > MAX_ISSUES:
                text = f"more than {MAX_ISSUES} findings, the rest of the stage is not checked"
                issues.append(Issue("warning", stage_name(stage), "usdfab:many", text))
                break
        issues += _guarded(lambda: validator_issues(stage, issues), stage_name(stage))
    return sorted(dict.fromkeys(issues), key=lambda i: (SEVERITIES.index(i.severity), i.site, i.rule))


def exit_code(issues: list[Issue], *, strict: bool = False) -> int:
    """2 with an error, 1 with a warning if ``strict``, else 0."""
    severities = {issue.severity for issue in issues}
    if "error" in severities:
        return 2
    return int(strict and "warning" in severities)


def prims(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """Every prim of a stage, overs and classes too; of several instances of one prototype the first one's."""
    seen: set[Sdf.Path] = set()
    walk = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)))
    for prim in walk:
        yield prim
        if prim.IsInstance():
            prototype = prim.GetPrototype().GetPath()
            if prototype in seen:
                walk.PruneChildren()
            seen.add(prototype)


def _guarded(rule: Callable[[], Iterator[Issue]], place: str) -> list[Issue]:
    """The issues of a rule; what it stumbles over is one more."""
    found: list[Issue] = []
    try:
        for issue in rule():
            found.append(issue)
    except UsdfabError as error:
        found.append(Issue("error", error.place or place, "usdfab:unreadable", error.problem, error.remedy))
    except _UNREADABLE as error:
        reason = plain(str(error)) or type(error).__name__
        found.append(Issue("error", place, "usdfab:unreadable", f"a value here is not what it should be ({reason})"))
    return found
