"""``--set NAME=VALUE`` of ``usdfab new`` and ``usdfab edit``."""

from __future__ import annotations

from collections.abc import Sequence

from usdfab.errors import UsdfabError


def parse_settings(texts: Sequence[str] | None) -> dict[str, str]:
    """``{"warp.albedo": ".1,.2,.5"}`` from ``["warp.albedo=.1,.2,.5"]``."""
    settings = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise UsdfabError(f"'{text}' is not NAME=VALUE", place="--set", remedy="e.g. --set warp.albedo=.1,.2,.5")
        settings[name.strip()] = value.strip()
    return settings
