"""The optional packages of the neural material, asked for before they are imported."""

from __future__ import annotations

from importlib.util import find_spec

from usdfab.errors import UsdfabError

PACKAGES = ("torch", "safetensors")


def require_neural_extra(what: str) -> None:
    """Raise one clear line where one of ``PACKAGES`` is not installed; ``what`` needs them. Imports none."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise UsdfabError(f"{what} needs {' and '.join(missing)}", remedy="pip install 'usdfab[fit]'")
