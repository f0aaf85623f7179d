"""How much memory a render may take."""

from __future__ import annotations

import os
from pathlib import Path

from usdfab.errors import UsdfabError

BYTES_PER_PIXEL = 400
"""Sums in double precision, the finished picture, and what its making needs for a moment."""


def available_memory(root: Path = Path("/")) -> int | None:
    """Bytes that can be had, by the kernel's estimate and the control group's limit; None where nobody knows.

    ``root`` is where ``proc`` and ``sys`` are.
    """
    found = []
    try:
        for line in (root / "proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024 * int(line.split()[1]))
    except (OSError, ValueError):  # not Linux
        if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
            found.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    group = root / "sys/fs/cgroup"
    for limit, used in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        try:
            found.append(int((group / limit).read_text()) - int((group / used).read_text()))
        except (OSError, ValueError):  # no such group, or "max"
            continue
    return max(0, min(found)) if found else None


def check_memory(width: int, height: int) -> None:
    """``UsdfabError`` if a picture of this size cannot be held."""
    need, have = BYTES_PER_PIXEL * width * height, available_memory()
    if have is not None and need > have:
        raise UsdfabError(
            f"{width} x {height} pixels need about {need / 2**30:.1f} GiB of memory and {have / 2**30:.1f} are free",
            remedy="render a smaller picture, or --region or --tile of it",
        )
