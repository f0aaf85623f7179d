"""The exceptions that users see: where, what was wrong, what to do."""

from __future__ import annotations


class UsdfabError(ValueError):
    """Bad input or an impossible request, told to a person.

    The command line prints it as one line and ends with ``exit_code``. Our own bugs are asserts, never this.

    Parameters
    ----------
    problem:
        What was wrong, one clause without a full stop.
    place:
        The file, prim path, option or parameter it concerns; empty where there is none.
    remedy:
        What to do about it; empty where the problem says it all.
    """

    exit_code = 2

    def __init__(self, problem: str, *, place: str = "", remedy: str = "") -> None:
        self.problem = problem
        self.place = place
        self.remedy = remedy
        text = f"{place}: {problem}" if place else problem
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(text)


class NoFabricError(UsdfabError):
    """A photo that can be read but shows no woven fabric that could be measured."""

    exit_code = 3
