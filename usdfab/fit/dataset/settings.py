"""What all samples of a data set have in common, as its manifest keeps it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.fabric import sampling_wide
from usdfab.fit.dataset.records import table_hash
from usdfab.fit.dataset.samples import CHOICES

SCHEMA = "usdfab-dataset/1"

RENDER_REVISION = 2
"""Raised whenever the same sample gives another picture."""

MAX_DEPTH = 64
"""Path vertices, as Li et al. 2024, section 7.1."""


@dataclass(frozen=True)
class Settings:
    """How a data set is made. ``size`` pixels on a side; ``shard`` samples in a file; ``denoised`` by Intel's OIDN."""

    prior: str = "both"
    seed: int = 0
    size: int = 256
    spp: int = 8
    denoised: bool = True
    shard: int = 256

    def __post_init__(self) -> None:
        if self.prior not in CHOICES:
            raise UsdfabError(f"there is no '{self.prior}'", place="--prior", remedy=f"choose {', '.join(CHOICES)}")
        for name, low, high in (("seed", 0, 2**31 - 1), ("size", 8, 2048), ("spp", 1, 2**20), ("shard", 1, 10_000)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsdfabError(f"{value} is not between {low} and {high}", place=f"--{name}")

    def rendering(self) -> dict[str, Any]:
        """How each picture was made, for its record."""
        return {
            "size": self.size,
            "spp": self.spp,
            "max_depth": MAX_DEPTH,
            "denoised": self.denoised,
            "seed": self.seed,
            "revision": RENDER_REVISION,
        }

    def manifest(self) -> dict[str, Any]:
        """What ``dataset.json`` says."""
        return {
            "schema": SCHEMA,
            "prior": self.prior,
            "seed": self.seed,
            "size": self.size,
            "spp": self.spp,
            "denoised": self.denoised,
            "shard": self.shard,
            "table": table_hash(),
            "wide_revision": sampling_wide.REVISION,
            "render_revision": RENDER_REVISION,
            "image": "half-float EXR, linear Rec. 709, a white diffuse sample is 1 in the middle",
            "usdfab": __version__,
        }


INFORMATIVE = frozenset({"usdfab", "image"})
"""Entries of the manifest that may differ between two runs on one data set."""


def settings_of(manifest: dict[str, Any], place: str) -> Settings:
    """The settings in a manifest; ``UsdfabError`` if it is none, or was made with another parameter table."""
    try:
        if manifest["schema"] != SCHEMA:
            raise UsdfabError(f"has format {manifest['schema']!r}, not {SCHEMA!r}", place=place)
        if manifest["table"] != table_hash():
            raise UsdfabError(
                f"was made with another parameter table ({manifest['table']}, this is {table_hash()})",
                place=place,
                remedy=f"use usdfab {manifest['usdfab']}, or make the data set anew",
            )
        return Settings(**{name: manifest[name] for name in ("prior", "seed", "size", "spp", "denoised", "shard")})
    except (KeyError, TypeError) as error:
        raise UsdfabError("this is no data set", place=place, remedy="give a folder with a dataset.json") from error
