"""The one place where OpenImageIO is imported."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from usdfab.errors import UsdfabError


def openimageio() -> Any:
    """The OpenImageIO module, loaded on first use.

    Raises
    ------
    UsdfabError
        If it is not installed.
    """
    try:
        import OpenImageIO
    except ImportError as error:
        raise UsdfabError(f"OpenImageIO cannot be loaded ({error})", remedy="pip install openimageio") from error
    return OpenImageIO


@contextmanager
def captured_stderr() -> Iterator[list[str]]:
    """Keep what C libraries (libpng above all) print to stderr while the block runs.

    If the block ends well the text is passed on to stderr, so that nothing gets lost. If it raises, the text is
    dropped: the exception tells it better. Where stderr cannot be redirected, nothing is done.
    """
    kept: list[str] = []
    try:
        sys.stderr.flush()
        saved = os.dup(2)
    except (OSError, ValueError, AttributeError):
        yield kept
        return
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)
        try:
            yield kept
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            kept.append(sink.read().decode(errors="replace"))
    sys.stderr.write(kept[0])
