"""One count of progress over all stages of a fit, in proportion to the time that they take."""

from __future__ import annotations

from collections.abc import Callable, Mapping

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, steps done, steps to do)."""

TICKS = 1000
"""Steps of the whole course."""


class Course:
    """Stages one after another, each a share of one course of ``TICKS`` steps.

    What an earlier run has done takes no time now: finished stages are left out of ``costs``, and a stage that goes on
    from its middle counts from there.
    """

    def __init__(self, progress: Progress | None, costs: Mapping[str, float]) -> None:
        """``costs``: seconds, or anything in proportion, that each stage is expected to take, in order."""
        self._say = progress or (lambda *_: None)
        total = sum(costs.values()) or 1.0
        self._share = {name: cost / total for name, cost in costs.items()}
        self._done = 0.0

    def stage(self, name: str) -> Progress:
        """What the stage calls with its own steps."""
        before, share = self._done, self._share.get(name, 0.0)
        first: list[int] = []

        def within(text: str, done: int, total: int) -> None:
            if not first:
                first.append(max(0, done - 1))
            part = min(max((done - first[0]) / max(total - first[0], 1), 0.0), 1.0)
            self._done = max(self._done, before + share * part)
            self._say(text, round(TICKS * self._done), TICKS)

        return within

    def finish(self, name: str) -> None:
        """The stage is over, however many of its steps it told."""
        names = list(self._share)
        if name in names:
            self._done = max(self._done, sum(self._share[n] for n in names[: names.index(name) + 1]))
