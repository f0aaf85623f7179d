"""USD's own validators and diagnostics as issues, without false alarms."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from pxr import Pcp, Tf, Usd, UsdUtils, UsdValidation

from usdfab.usd.issue import Issue, Severity
from usdfab.usd.stage import site, stage_name

COMPOSITION = "usdfab:composition"
_SHADERS = ("'ND_", "'UsdPreviewSurface'", "'UsdUVTexture'", "'UsdPrimvarReader_", "'UsdTransform2d'")
_SESSION = re.compile(r",@anon:[^@]*@")
_REMEDIES = {
    "MissingDefaultPrim": "author defaultPrim in the root layer",
    "MissingMetersPerUnitMetadata": "author metersPerUnit in the root layer",
    "MissingUpAxisMetadata": "author upAxis in the root layer",
    "MissingMaterialBindingAPI": "apply MaterialBindingAPI to the prim",
    "UnresolvableDependency": "put the file there, or correct the path",
}


@contextmanager
def quiet_usd() -> Iterator[None]:
    """Keep USD's warnings off stderr: what they say comes as issues."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def validator_issues(stage: Usd.Stage, ours: Sequence[Issue]) -> Iterator[Issue]:
    """What UsdValidation's validators find, without what ``ours``, the rules' own issues, say already."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    kinds = UsdValidation.ValidationErrorType
    severities: dict[object, Severity] = {kinds.Error: "error", kinds.Warn: "warning", kinds.Info: "info"}
    context = UsdValidation.ValidationContext(validators)
    try:
        errors = context.Validate(stage)
    except Tf.ErrorException:
        # usd-core 25.11 ships no definitions of USD's own shaders and says so, once, by an exception.
        errors = context.Validate(stage)
    for error in errors:
        if error.HasNoError() or _false_alarm(error) or _told(error, ours):
            continue
        message = plain(error.GetMessage())
        severity = severities.get(error.GetType(), "info")
        remedy = _REMEDIES.get(error.GetName(), "")
        yield Issue(severity, _first_site(stage, error), str(error.GetIdentifier()), message, remedy)


def composition_issues(stage: Usd.Stage) -> Iterator[Issue]:
    """``usdfab:composition``: sublayers, references and payloads that cannot be composed, cycles among them."""
    for error in stage.GetCompositionErrors():
        path = error.rootSite.path
        place = stage_name(stage) if path.isEmpty or path.IsAbsoluteRootPath() else site(stage, path)
        cycle = isinstance(error, (Pcp.ErrorArcCycle, Pcp.ErrorSublayerCycle))
        remedy = "take one of the arcs out" if cycle else "put the file there, or correct the path"
        yield Issue("error", place, COMPOSITION, plain(str(error)), remedy)


def plain(text: str) -> str:
    """USD's message in one line, without its session layers and full stop."""
    return " ".join(_SESSION.sub("", text).split()).removesuffix(".")


def _false_alarm(error: UsdValidation.ValidationError) -> bool:
    return error.GetName() == "MissingShaderIdInRegistry" and any(name in error.GetMessage() for name in _SHADERS)


def _told(error: UsdValidation.ValidationError, ours: Sequence[Issue]) -> bool:
    """Whether an issue of a rule says the same, with more of a place: files, bindings, types, composition errors."""
    name, message = error.GetName(), error.GetMessage()
    if name == "CompositionError":
        return True
    if name == "UnresolvableDependency":
        files = re.findall(r"'([^']+)'", message)
        told = [issue.message for issue in ours if issue.rule in (COMPOSITION, "usdfab:asset")]
        return any(f"@{file}@" in text or f"({file})" in text for file in files for text in told)
    rule = {"InvalidResourcePath": "usdfab:binding", "AttributeTypeMismatch": "usdfab:type"}.get(name)
    places = {issue.site.rpartition("<")[2] for issue in ours if issue.rule == rule}
    return any(f"<{place}" in message for place in places)


def _first_site(stage: Usd.Stage, error: UsdValidation.ValidationError) -> str:
    for found in error.GetSites():
        if found.IsProperty():
            return site(stage, found.GetProperty())
        if found.IsPrim() and not found.GetPrim().IsPseudoRoot():
            return site(stage, found.GetPrim())
    return stage_name(stage)
