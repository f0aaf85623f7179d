"""Writing USD files whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf

from usdfab.errors import UsdfabError
from usdfab.files import checked_output as checked_file, whole_file

USD_SUFFIXES = (".usda", ".usdc", ".usd")


def checked_output(path: str | Path, *, overwrite: bool = False) -> Path:
    """``path`` if a USD file may be written there; ``UsdfabError`` as ``usdfab.files.checked_output``."""
    return checked_file(path, USD_SUFFIXES, overwrite=overwrite)


@contextmanager
def atomic_path(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file name in the target's folder; what was written there becomes ``path`` when the block ends well.

    If USD holds the old file open in this process, its layer is reloaded.

    Raises
    ------
    UsdfabError
        As ``checked_output``, and when the disk or USD refuses.
    """
    target = checked_output(path, overwrite=overwrite)
    try:
        with whole_file(target) as temporary:
            yield temporary
    except (OSError, Tf.ErrorException) as error:
        raise UsdfabError(f"cannot write the file ({_reason(error)})", place=str(target)) from error
    stale = Sdf.Layer.Find(str(target))
    if stale:
        stale.Reload(force=True)


def export_layer(layer: Sdf.Layer, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write an Sdf layer to ``path`` atomically, in the format of its suffix. Returns the path."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        if not layer.Export(str(temporary)):
            raise OSError("USD could not export the layer")
    return Path(path)


def _reason(error: Exception) -> str:
    lines = str(getattr(error, "strerror", None) or error).strip().splitlines()
    return lines[-1].strip() if lines else type(error).__name__
