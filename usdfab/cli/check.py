"""``usdfab check``: is this USD file right?"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, print_json


def run(
    file: Path,
    /,
    *,
    strict: Annotated[bool, Parameter(negative="", help="Count warnings as errors.")] = False,
    json: Json = False,
) -> int:
    """Check a USD file against USD's own validators and usdfab's rules.

    Ends with exit code 1 if there is an error, or with --strict a warning.

    Usage examples:

        usdfab check fabric.usda
        usdfab check cloth.usda --strict --json

    Parameters
    ----------
    file:
        A USD file.
    """
    from usdfab.usd.check import check

    issues = check(file)
    if json:
        print_json({"issues": [asdict(issue) for issue in issues]})
    else:
        for issue in issues:
            print(issue)
        if not issues:
            print(f"{file}: no findings")
    bad = ("error", "warning") if strict else ("error",)
    return int(any(issue.severity in bad for issue in issues))
