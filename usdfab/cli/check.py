"""``usdfab check``: is this USD file right?"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, print_json, say


def run(
    file: Path,
    /,
    *,
    strict: Annotated[bool, Parameter(negative="", help="End with exit code 1 if there are warnings.")] = False,
    json: Json = False,
) -> int:
    """Check a USD file against USD's own validators and usdfab's rules.

    Finds what USD's validators find, attributes that are misspelt, of the wrong type or out of range, cloth that cannot
    exist (yarns that interpenetrate, fibers that do not fit), missing files and bindings that lead nowhere. Ends with
    exit code 0 if there is nothing worse than warnings, 1 if there are warnings and --strict is given, 2 with errors.

    --json prints {"schema", "file", "counts": {"error", "warning", "info"}, "exit_code", "issues": [{"severity",
    "site", "rule", "message", "remedy"}]}; site is file</prim.attribute>, rules keep their names.

    Usage examples:

        usdfab check fabric.usda
        usdfab check cloth.usda --strict --json

    Parameters
    ----------
    file:
        A USD file.
    """
    from usdfab.usd.check import check, exit_code
    from usdfab.usd.issue import SEVERITIES

    issues = check(file)
    code = exit_code(issues, strict=strict)
    counts = {severity: sum(issue.severity == severity for issue in issues) for severity in SEVERITIES}
    if json:
        found = [asdict(issue) for issue in issues]
        print_json({"file": file, "counts": counts, "exit_code": code, "issues": found})
        return code
    for issue in issues:
        print(issue)
    if not issues:
        print(f"{file}: no findings")
    else:
        said = [f"{count} {severity}{'s' if count != 1 and severity != 'info' else ''}"
                for severity, count in counts.items() if count]  # fmt: skip
        say(f"{file}: {', '.join(said)}")
    return code
