"""What to say where a disk does not take a file."""

from __future__ import annotations

import errno
from pathlib import Path

from usdfab.errors import UsdfabError


def refused(error: Exception, path: Path) -> UsdfabError:
    """The error to raise where a disk refuses to take a file."""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    if full or "No space left" in str(error):
        return UsdfabError(
            "the disk is full", place=str(path), remedy="make room and run the same command again; nothing is lost"
        )
    reason = (error.strerror or "no reason given") if isinstance(error, OSError) else str(error)
    return UsdfabError(f"cannot be written ({reason})", place=str(path))
