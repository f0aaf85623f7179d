"""Whether tests can have Mitsuba with Dr.Jit's LLVM backend, or the reason why not."""

from __future__ import annotations

import functools

from usdfab.errors import UsdfabError
from usdfab.mi.variant import load


@functools.cache
def why_not() -> str:
    """Why there is no `llvm_ad_rgb` here, or an empty string; it is the current variant then."""
    try:
        load("llvm")
    except UsdfabError as error:
        return str(error)
    return ""
