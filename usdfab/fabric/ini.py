"""Reading the INI dialect of weaving files: tolerant of how real programs write it, bounded in what it takes.

The rules are those of the WIF 1.1 specification (Ravi Nielsen, 1997): ``[SECTION]`` lines, ``key=value`` lines,
comments after ``;``, names in any case and any order, and private sections that no one else reads. Python's
``configparser`` is not used since it refuses duplicate keys, lines without ``=`` and stray text, all of which real
files hold.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from usdfab.errors import UsdfabError

MAX_BYTES = 8 * 1024 * 1024
"""Largest file that is read; drafts are some ten kilobytes."""


@dataclass(frozen=True)
class IniFile:
    """Sections by upper-case name, each a mapping of lower-case keys to raw values; and what was passed over."""

    sections: dict[str, dict[str, str]]
    private: tuple[str, ...]
    notes: tuple[str, ...]

    def section(self, name: str) -> dict[str, str]:
        """The section called ``name``, empty where there is none."""
        return self.sections.get(name, {})


def read_ini(path: str | Path) -> IniFile:
    """The sections of a file.

    UTF-8, UTF-8 or UTF-16 with a byte order mark, and Latin-1 are read, with any line ends.

    Raises
    ------
    UsdfabError
        If the file is missing, a folder, too large, empty, binary, or holds no section at all.
    """
    file, place = Path(path), str(path)
    if not file.exists():
        raise UsdfabError("the file does not exist", place=place)
    if file.is_dir():
        raise UsdfabError("this is a folder, not a file", place=place)
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror})", place=place) from error
    if len(data) > MAX_BYTES:
        raise UsdfabError(f"the file is larger than {MAX_BYTES // 1024 // 1024} MB", place=place)
    return parse_ini(decode(data, place), place)


def decode(data: bytes, place: str = "") -> str:
    """Text of a file's bytes; ``UsdfabError`` if they are empty or binary."""
    if not data.strip():
        raise UsdfabError("the file is empty", place=place)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    if b"\0" in data:
        raise UsdfabError("this is a binary file, not text", place=place)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def parse_ini(text: str, place: str = "") -> IniFile:
    """The sections of a text. Of keys and sections that come twice the first value counts, as on Windows."""
    sections: dict[str, dict[str, str]] = {}
    private: list[str] = []
    current: dict[str, str] | None = None
    stray = repeated = 0
    # Not splitlines(), which also breaks at form feeds and the like that may stand within a title.
    for line in re.split(r"\r\n|\r|\n", text):
        line = line.strip()
        if not line or line.startswith(";"):
            continue
        header = re.match(r"\[([^\]]*)\]", line)
        if header:
            name = " ".join(header[1].upper().split())
            if name.startswith("PRIVATE"):
                private.append(name)
                current = {}
            else:
                current = sections.setdefault(name, {})
            continue
        key, equals, value = line.partition("=")
        if not equals or current is None:
            stray += 1
            continue
        key = " ".join(key.lower().split())
        if key in current:
            repeated += 1
        else:
            current[key] = value.strip()
    if not sections:
        raise UsdfabError("no [SECTION] in this file", place=place, remedy="a WIF file begins with [WIF]")
    notes = []
    if stray:
        notes.append(f"{stray} lines are neither sections nor key=value and were ignored")
    if repeated:
        notes.append(f"{repeated} keys come more than once; the first of each counts")
    return IniFile(sections, tuple(private), tuple(notes))
