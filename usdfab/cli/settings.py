"""``--set NAME=VALUE`` and ``--wif FILE`` of ``usdfab new`` and ``usdfab edit``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from usdfab.fabric import FabricParameters


def parse_settings(texts: Sequence[str] | None) -> dict[str, str]:
    """``{"warp.albedo": ".1,.2,.5"}`` from ``["warp.albedo=.1,.2,.5"]``."""
    settings = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise UsdfabError(f"'{text}' is not NAME=VALUE", place="--set", remedy="e.g. --set warp.albedo=.1,.2,.5")
        settings[name.strip()] = value.strip()
    return settings


def woven_by(fabric: FabricParameters, wif: Path) -> tuple[FabricParameters, tuple[str, ...]]:
    """``fabric`` woven by the draft in a file, thinned where its repeat is too large; and what is to be told."""
    from usdfab._version import __version__
    from usdfab.fabric import Provenance, read_wif, with_draft
    from usdfab.fibers import thinned

    draft = read_wif(wif)
    woven, thinning = thinned(with_draft(fabric, draft))
    warnings = (*draft.warnings, *thinning)
    provenance = Provenance(wif.name, generator=f"usdfab {__version__}", stages=("wif",), notes=warnings)
    return replace(woven, provenance=provenance), warnings
