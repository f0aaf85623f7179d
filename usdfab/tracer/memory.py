"""How much memory a render may take."""

from __future__ import annotations

from usdfab.errors import UsdfabError
from usdfab.memory import available_memory

BYTES_PER_PIXEL = 400
"""Sums in double precision, the finished picture, and what its making needs for a moment."""


def check_memory(width: int, height: int) -> None:
    """``UsdfabError`` if a picture of this size cannot be held."""
    need, have = BYTES_PER_PIXEL * width * height, available_memory()
    if have is not None and need > have:
        raise UsdfabError(
            f"{width} x {height} pixels need about {need / 2**30:.1f} GiB of memory and {have / 2**30:.1f} are free",
            remedy="render a smaller picture, or --region or --tile of it",
        )
