"""One finding of a check, and how the rules make them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pxr import Sdf, Usd

from usdfab.usd.stage import site

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class Issue:
    """One finding.

    ``site`` is ``file</prim.attribute>``, ``rule`` is stable (``usdfab:...`` for our own), ``message`` says what is
    wrong and ``remedy`` what to do about it, empty where the message says it all.
    """

    severity: Severity
    site: str
    rule: str
    message: str
    remedy: str = ""

    def __str__(self) -> str:
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.severity}: {self.site}: {self.message}{remedy} ({self.rule})"


def error(
    where: Usd.Prim | Usd.Property | Sdf.Path, prim: Usd.Prim, rule: str, message: str, remedy: str = ""
) -> Issue:
    """Something that will not work, at ``where`` in the stage of ``prim``; ``rule`` without its ``usdfab:``."""
    return Issue("error", site(prim.GetStage(), where), f"usdfab:{rule}", message, remedy)


def warning(
    where: Usd.Prim | Usd.Property | Sdf.Path, prim: Usd.Prim, rule: str, message: str, remedy: str = ""
) -> Issue:
    """Something that works, though probably not as it was meant."""
    return Issue("warning", site(prim.GetStage(), where), f"usdfab:{rule}", message, remedy)


def info(where: Usd.Prim | Usd.Property | Sdf.Path, prim: Usd.Prim, rule: str, message: str) -> Issue:
    """Something worth a look."""
    return Issue("info", site(prim.GetStage(), where), f"usdfab:{rule}", message)
