"""Reading weavers' drafts in the Weaving Information File format, WIF 1.1 (Ravi Nielsen and others, 1997).

What real programs write is taken as it is meant: colour ranges other than 0-255, threads without lines, lift plans
beside treadlings, several shafts or treadles in a line, missing table entries, private sections. What is ignored is
told in ``Draft.warnings``. Colours are sRGB in the file and linear Rec. 709 here. ``wif_write`` writes such files.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric.draft import Bools, Draft, DraftYarns, compose, draft_of_drawdown, drawdown
from usdfab.fabric.fabric import Color
from usdfab.fabric.ini import IniFile, read_ini
from usdfab.srgb import srgb_to_linear

WIF_SUFFIXES = (".wif",)

MAX_THREADS = 4096
"""Most ends, picks, shafts and treadles that are read."""

METERS = {"centimeters": 0.01, "inches": 0.0254, "decipoints": 0.0254 / 720}
"""Metres of WIF's units. A decipoint is a tenth of a point."""

SPACING_RANGE = (1e-6, 0.1)
"""Distances and widths of yarns that are believed, metres."""

MAX_COVER = 2.0
"""A yarn thicker than so many spacings is not believed."""

_GREY: Color = (0.2, 0.2, 0.2)
_KNOWN = {
    "WIF", "CONTENTS", "TEXT", "NOTES", "WEAVING", "WARP", "WEFT", "COLOR PALETTE", "COLOR TABLE", "THREADING", "TIEUP",
    "TREADLING", "LIFTPLAN", *(f"{s} {what}" for s in ("WARP", "WEFT") for what in ("COLORS", "SPACING", "THICKNESS")),
}  # fmt: skip


def read_wif(path: str | Path) -> Draft:
    """The draft in a WIF file: one repeat of weave and colours, spacing, thickness, and what was ignored.

    Raises
    ------
    UsdfabError
        If the file cannot be read or is no WIF, a value is not a number or out of bounds, the draft has more than
        ``MAX_THREADS`` ends, picks, shafts or treadles or a repeat above ``MAX_REPEAT``, or a yarn never interlaces.
    """
    return _Reader(read_ini(path), str(path), Path(path).stem).draft()


@dataclass(frozen=True)
class _Threads:
    """The ends or picks of a file: how many, the colour of each (or none), metres between and across (0 unknown)."""

    number: int
    colors: tuple[Color, ...]
    spacing: NDArray[np.float64]
    thickness: NDArray[np.float64]

    def kept(self, keep: Bools) -> _Threads:
        colors = tuple(c for c, k in zip(self.colors, keep, strict=True) if k) if self.colors else ()
        return _Threads(int(keep.sum()), colors, self.spacing[keep], self.thickness[keep])


class _Reader:
    """One file while it is read; ``warnings`` grow on the way."""

    def __init__(self, ini: IniFile, place: str, stem: str) -> None:
        self.ini, self.place, self.stem = ini, place, stem
        self.warnings = list(ini.notes)

    def draft(self) -> Draft:
        """The draft (see ``read_wif``)."""
        if not {"THREADING", "TREADLING", "LIFTPLAN", "WEAVING"} & set(self.ini.sections):
            raise UsdfabError(
                "no draft in this file",
                place=self.place,
                remedy="a WIF needs [THREADING] and [TREADLING] or [LIFTPLAN]",
            )
        if not self.ini.section("THREADING"):
            raise UsdfabError("the draft has no threading", place=f"{self.place} [THREADING]")
        shafts, treadles = self._count("WEAVING", "shafts"), self._count("WEAVING", "treadles")
        threading = self._lists("THREADING", "end", self._count("WARP", "threads"), shafts, "shaft").T
        lift = self._lift(self._count("WEFT", "threads"), shafts, treadles)
        for section, entries in (("THREADING", threading), ("TREADLING] or [LIFTPLAN", lift)):
            if entries.size == 0:
                raise UsdfabError("no thread has an entry", place=f"{self.place} [{section}]")
        shafts = max(len(threading), lift.shape[1])
        threading, lift = _padded(threading, (shafts, threading.shape[1])), _padded(lift, (len(lift), shafts))
        warp, weft = self._threads("WARP", threading.shape[1]), self._threads("WEFT", len(lift))
        threading, warp = self._used(threading, 1, warp, "end", "are on no shaft")
        lift, weft = self._used(lift, 0, weft, "pick", "lift no shaft")
        matrix = drawdown(threading, lift, self._rising())
        draft, (picks, ends) = draft_of_drawdown(matrix, warp.colors, weft.colors, self._title(), self.place)
        self._tell_repeat(matrix.shape, (picks, ends))
        warp_yarns = DraftYarns(draft.warp.colors, *self._lengths("warp", warp, ends))
        weft_yarns = DraftYarns(draft.weft.colors, *self._lengths("weft", weft, picks))
        self._tell_ignored()
        return replace(draft, warp=warp_yarns, weft=weft_yarns, warnings=tuple(self.warnings))

    # --- the loom ----------------------------------------------------------------------------------------------------

    def _rising(self) -> bool:
        text = _bare(self.ini.section("WEAVING").get("rising shed", ""))
        if text.lower() in ("false", "off", "no", "0"):
            return False
        if text.lower() not in ("true", "on", "yes", "1"):
            self.warnings.append("the draft does not say whether its shed rises; a rising shed is assumed")
        return True

    def _lift(self, picks: int, shafts: int, treadles: int) -> Bools:
        """(picks, shafts) by treadling and tie-up where there are both, else by the lift plan."""
        plan = self._lists("LIFTPLAN", "pick", picks, shafts, "shaft") if self.ini.section("LIFTPLAN") else None
        if not (self.ini.section("TREADLING") and self.ini.section("TIEUP")):
            if plan is None:
                raise UsdfabError("no lift plan, and no treadling with a tie-up", place=self.place)
            return plan
        treadling = self._lists("TREADLING", "pick", picks, treadles, "treadle")
        tieup = self._lists("TIEUP", "treadle", treadles, shafts, "shaft")
        most = max(treadling.shape[1], len(tieup))
        treadling, tieup = _padded(treadling, (len(treadling), most)), _padded(tieup, (most, tieup.shape[1]))
        lift = compose(treadling, tieup)
        if plan is not None:
            shape = (max(len(lift), len(plan)), max(lift.shape[1], plan.shape[1]))
            if not np.array_equal(_padded(lift, shape), _padded(plan, shape)):
                self.warnings.append("the lift plan differs from the treadling, which counts")
        return lift

    def _lists(self, section: str, row: str, rows: int, columns: int, column: str) -> Bools:
        """(rows, columns) which numbers a section's lines list; grows beyond ``columns`` where a line names more."""
        found: list[tuple[int, list[int]]] = []
        outside = 0
        for key, text in self.ini.section(section).items():
            number = self._row(key, rows)
            if number is None:
                outside += 1
                continue
            items = [self._whole(t, f"{section}] {key}", MAX_THREADS) for t in _bare(text).split(",") if t.strip()]
            found.append((number, [k for k in items if k > 0]))
        if outside:
            of = f" of the {rows} {row}s" if rows else ""
            self.warnings.append(f"[{section}]: {outside} lines belong to none{of} and were ignored")
        largest = max((max(items, default=0) for _, items in found), default=0)
        if columns and largest > columns:
            self.warnings.append(f"[{section}] names {column} {largest} of {columns}; it was added")
        lists = np.zeros((rows or max((n for n, _ in found), default=0), max(columns, largest)), dtype=bool)
        for number, items in found:
            lists[number - 1, np.asarray(items, dtype=int) - 1] = True
        return lists

    def _used(self, matrix: Bools, axis: int, threads: _Threads, label: str, why: str) -> tuple[Bools, _Threads]:
        """Without the ends or picks that have no entry in ``matrix``."""
        keep: Bools = np.asarray(matrix.any(axis=1 - axis))
        if not keep.any():
            raise UsdfabError(f"all {label}s {why}", place=self.place)
        if not keep.all():
            self.warnings.append(f"{int((~keep).sum())} {label}s {why} and were left out")
        return np.compress(keep, matrix, axis=axis), threads.kept(keep)

    # --- the yarns ---------------------------------------------------------------------------------------------------

    def _threads(self, system: str, number: int) -> _Threads:
        spacing, thickness = (self._metres(system, name, number) for name in ("spacing", "thickness"))
        return _Threads(number, self._colors(system, number), spacing, thickness)

    def _metres(self, system: str, name: str, number: int) -> NDArray[np.float64]:
        """(number,) metres from ``[WARP] Spacing`` and ``[WARP SPACING]``; 0 where nothing is said."""
        own, lines = self.ini.section(system), self.ini.section(f"{system} {name.upper()}")
        values = np.full(number, self._real(own[name], f"{system}] {name.title()}") if name in own else 0.0)
        for key, text in lines.items():
            row = self._row(key, number)
            if row is not None:
                values[row - 1] = self._real(text, f"{system} {name.upper()}] {key}")
        if not values.any():
            return values
        unit = _bare(own.get("units", "")).strip('"').lower()
        if unit not in METERS:
            message = f"[{system}] {name} has no known unit ('{unit[:20]}'; {', '.join(METERS)}) and was ignored"
            self.warnings.append(message)
            return np.zeros(number)
        return values * METERS[unit]

    def _lengths(self, system: str, threads: _Threads, repeat: int) -> tuple[float, float]:
        """Mean spacing and thickness over one repeat, where they can be believed."""
        lengths = {}
        for name, values in (("spacing", threads.spacing[:repeat]), ("thickness", threads.thickness[:repeat])):
            mean = float(values.mean())
            low, high = SPACING_RANGE
            if mean and not low <= mean <= high:
                self.warnings.append(f"the {system}'s {name} of {mean:.3g} m is not believed and was ignored")
                mean = 0.0
            elif mean and values.max() > values.min() * 1.001:
                spread = f"{values.min() * 1e3:.3g} to {values.max() * 1e3:.3g} mm"
                self.warnings.append(f"the {system}'s {name} varies ({spread}); its mean is used for all yarns")
            lengths[name] = mean
        if lengths["thickness"] > MAX_COVER * lengths["spacing"] > 0:
            self.warnings.append(
                f"the {system} is {MAX_COVER:g} times as thick as its spacing; its thickness was ignored"
            )
            lengths["thickness"] = 0.0
        return lengths["spacing"], lengths["thickness"]

    def _colors(self, system: str, number: int) -> tuple[Color, ...]:
        """The colour of each thread, or nothing where the file names none."""
        own, lines = self.ini.section(system), self.ini.section(f"{system} COLORS")
        table = self._table()
        default = self._color_index(own["color"], f"{system}] Color") if "color" in own else None
        if default is None and not lines:
            return ()
        given = self._own_color(own.get("color", ""))
        indices = [default] * number
        for key, text in lines.items():
            row = self._row(key, number)
            if row is not None:
                indices[row - 1] = self._color_index(text, f"{system} COLORS] {key}")
        fallback = table.get(default, given) if default is not None else given
        if not table and given is None:
            self.warnings.append(f"[{system}] names colours but there is no color table; they were ignored")
            return ()
        missing = sorted({-1 if k is None else k for k in indices} - set(table) - ({default} if given else set()))
        if missing:
            names = ", ".join(str(k) if k >= 0 else "none" for k in missing[:5])
            what = "the default colour" if fallback else "grey"
            self.warnings.append(f"[{system}] has colours that are not in the color table ({names}): {what} is used")
        return tuple(table.get(k, fallback or _GREY) if k is not None else fallback or _GREY for k in indices)

    def _table(self) -> dict[int | None, Color]:
        """Linear colours by their number."""
        low, high = self._range()
        table: dict[int | None, Color] = {}
        clipped = False
        for key, text in self.ini.section("COLOR TABLE").items():
            number = self._row(key, 0)
            if number is None:
                continue
            parts = [self._real(t, f"COLOR TABLE] {key}", signed=True) for t in _bare(text).split(",") if t.strip()]
            if len(parts) != 3:
                raise UsdfabError("expected three numbers R,G,B", place=f"{self.place} [COLOR TABLE] {key}")
            scaled = (np.asarray(parts) - low) / (high - low)
            clipped |= bool((scaled < 0).any() or (scaled > 1).any())
            table[number] = _linear(scaled)
        if clipped:
            self.warnings.append(f"[COLOR TABLE] has colours outside the range {low:g} to {high:g}; they were clipped")
        return table

    def _range(self) -> tuple[float, float]:
        text = self.ini.section("COLOR PALETTE").get("range")
        place = "COLOR PALETTE] Range"
        if text is None:
            if self.ini.section("COLOR TABLE"):
                self.warnings.append("the range of the colours is not given; 0 to 255 is assumed")
            return 0.0, 255.0
        parts = [self._real(t, place, signed=True) for t in _bare(text).split(",") if t.strip()]
        if len(parts) != 2 or parts[0] >= parts[1]:
            raise UsdfabError(f"'{text[:40]}' is no range of colours", place=f"{self.place} [{place}")
        return parts[0], parts[1]

    def _color_index(self, text: str, place: str) -> int:
        # Older files write index,R,G,B; the specification tells to read the first number only.
        return self._whole(_bare(text).split(",")[0], place, 10**9)

    def _own_color(self, text: str) -> Color | None:
        """The R,G,B after the index of ``[WARP] Color``, for two-colour drafts without a table."""
        parts = _bare(text).split(",")
        if len(parts) != 4:
            return None
        low, high = self._range()
        values = [self._real(t, "WARP] Color", signed=True) for t in parts[1:]]
        return _linear((np.asarray(values) - low) / (high - low))

    # --- values ------------------------------------------------------------------------------------------------------

    def _title(self) -> str:
        title = self.ini.section("TEXT").get("title", "")
        printable = "".join(c if c.isprintable() else " " for c in title)
        return " ".join(printable.split())[:100] or " ".join(self.stem.split())[:100] or "Draft"

    def _count(self, section: str, key: str) -> int:
        """A number of threads, shafts or treadles; 0 where it is not given."""
        text = self.ini.section(section).get(key)
        if text is None or not _bare(text):
            self.warnings.append(f"[{section}] {key.title()} is missing; it follows from the lines")
            return 0
        return self._whole(_bare(text), f"{section}] {key.title()}", MAX_THREADS)

    def _row(self, key: str, rows: int) -> int | None:
        """The number that a line is for, from 1 to ``rows`` (0: to ``MAX_THREADS``), or None."""
        if not re.fullmatch(r"[0-9]{1,9}", key):
            return None
        return int(key) if 1 <= int(key) <= (rows or MAX_THREADS) else None

    def _whole(self, text: str, place: str, most: int) -> int:
        stripped = text.strip()
        if not re.fullmatch(r"[0-9]{1,12}", stripped):
            raise UsdfabError(f"'{stripped[:40]}' is not a whole number", place=f"{self.place} [{place}")
        if int(stripped) > most:
            raise UsdfabError(f"{stripped} is above {most}, the most that is read", place=f"{self.place} [{place}")
        return int(stripped)

    def _real(self, text: str, place: str, signed: bool = False) -> float:
        stripped = _bare(text)
        if not re.fullmatch(r"[+-]?([0-9]{1,30}([.][0-9]{0,30})?|[.][0-9]{1,30})([eE][+-]?[0-9]{1,2})?", stripped):
            raise UsdfabError(f"'{stripped[:40]}' is not a number", place=f"{self.place} [{place}")
        value = float(stripped)
        if value < 0 and not signed:
            raise UsdfabError(f"{stripped[:40]} is below 0", place=f"{self.place} [{place}")
        return value

    # --- what is told ------------------------------------------------------------------------------------------------

    def _tell_repeat(self, whole: tuple[int, ...], repeat: tuple[int, int]) -> None:
        for label, count, length in zip(("picks", "ends"), whole, repeat, strict=True):
            if count % length:
                self.warnings.append(f"the {count} {label} end within a repeat of {length}, which goes on")

    def _tell_ignored(self) -> None:
        others = sorted(set(self.ini.sections) - _KNOWN)
        if others:
            self.warnings.append("sections that were ignored: " + _few(others))
        if self.ini.private:
            self.warnings.append("private sections that were ignored: " + _few(sorted(set(self.ini.private))))


def _few(names: list[str]) -> str:
    """The first names as printable text."""
    shown = ", ".join("".join(c if c.isprintable() else "?" for c in name[:40]) for name in names[:6])
    return shown + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _bare(text: str) -> str:
    """A number's text without the comment behind it. (In texts a semicolon is no comment.)"""
    return text.split(";", 1)[0].strip()


def _linear(encoded: NDArray[Any]) -> Color:
    red, green, blue = srgb_to_linear(np.clip(encoded, 0.0, 1.0))
    return float(red), float(green), float(blue)


def _padded(matrix: Bools, shape: tuple[int, int]) -> Bools:
    """``matrix`` with empty rows and columns at its end."""
    out = np.zeros(shape, dtype=bool)
    out[: matrix.shape[0], : matrix.shape[1]] = matrix
    return out
