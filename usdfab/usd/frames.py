"""Time: which time codes to read a stage at, and how long the shutter is open there."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from pxr import Usd

from usdfab.errors import UsdfabError
from usdfab.usd.stage import stage_name

MAX_FRAMES = 1_000_000
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)"
_RANGE = re.compile(rf"\s*({_NUMBER})\s*(?:[-:]\s*({_NUMBER})\s*(?:x\s*({_NUMBER})\s*)?)?")
_REMEDY = "write 5, 1-10, 1-10x2 (every second one), or several with commas: 1,3,10-20"


def time_code(stage: Usd.Stage, time: float | None) -> Usd.TimeCode:
    """The time code that ``read_scene`` reads at: ``time``, or the stage's start, or the earliest sample."""
    if time is not None:
        if not math.isfinite(time):
            raise UsdfabError(f"{time} is not a time code", place="time")
        return Usd.TimeCode(time)
    return Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()


def frame_times(stage: Usd.Stage, frames: str) -> list[float]:
    """The time codes that a text such as ``5``, ``1-10``, ``1-10x2``, ``1,3,10-20`` or ``all`` asks for, in its order.

    ``A-B`` (or ``A:B``, as ``usdrecord`` writes it) runs from A up, or down, to B, B included if the steps meet it;
    ``xS`` sets the length of the step, 1 without it. ``all`` is the stage's own range. A time code is listed once.

    Raises
    ------
    UsdfabError
        For anything else, a step that is not above 0, more than ``MAX_FRAMES`` frames, and ``all`` on a stage that
        has no range.
    """
    if frames.strip() == "all":
        if not stage.HasAuthoredTimeCodeRange():
            raise UsdfabError("the stage has no start and end", place=stage_name(stage), remedy="name the frames: 1-10")
        first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        if last < first:
            raise UsdfabError(f"the stage ends ({last:g}) before it starts ({first:g})", place=stage_name(stage))
        return _steps(first, last, 1.0, frames)
    times: list[float] = []
    for part in frames.split(","):
        match = _RANGE.fullmatch(part)
        if not match:
            raise UsdfabError(f"'{part.strip()}' is not a frame or a range", place=f"frames {frames}", remedy=_REMEDY)
        start, end, step = match.groups()
        first = float(start)
        times += _steps(first, first if end is None else float(end), 1.0 if step is None else float(step), frames)
    return list(dict.fromkeys(times))


def _steps(first: float, last: float, step: float, frames: str) -> list[float]:
    if not step > 0:
        raise UsdfabError(f"a step of {step:g} is not above 0", place=f"frames {frames}", remedy=_REMEDY)
    # A little slack: 0-1x0.1 has eleven frames, though 0.1 is not exactly a tenth.
    number = math.floor(abs(last - first) / step * (1.0 + 1e-12) + 1e-9) + 1
    if number > MAX_FRAMES:
        raise UsdfabError(f"{number} frames are more than {MAX_FRAMES}", place=f"frames {frames}")
    sign = 1.0 if last >= first else -1.0
    return [first + sign * k * step for k in range(number)]


@dataclass(frozen=True)
class Shutter:
    """The frame's own time code, and where what moves is evaluated; ``close`` is None where nothing is to blur."""

    frame: Usd.TimeCode
    open: Usd.TimeCode
    close: Usd.TimeCode | None

    @staticmethod
    def still(time: Usd.TimeCode) -> Shutter:
        """No blur: everything at ``time``."""
        return Shutter(time, time, None)


def shutter(time: Usd.TimeCode, opening: float, closing: float) -> Shutter:
    """The shutter at the frame ``time`` of a camera with ``shutter:open`` and ``shutter:close``, relative to the frame.

    Without a numbered time (a stage that has no range, and none asked for) there is nothing to be relative to: still.
    """
    numbered = time.IsNumeric() and not time.IsEarliestTime()
    if not (numbered and math.isfinite(opening) and math.isfinite(closing) and opening < closing):
        return Shutter.still(time)
    return Shutter(time, Usd.TimeCode(time.GetValue() + opening), Usd.TimeCode(time.GetValue() + closing))
