"""What is written beside each image: everything that is needed to know, and to make it again, as plain JSON."""

from __future__ import annotations

import hashlib
from dataclasses import fields
from typing import Any

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, Provenance, Weave, YarnParameters, as_table
from usdfab.fabric.parameters import YARN_PARAMETERS
from usdfab.fabric.sampling_weaves import CLASSES
from usdfab.fit.dataset.samples import Sample
from usdfab.fit.dataset.views import view_from_table

SCHEMA = "usdfab-sample/1"


def table_hash() -> str:
    """A hash of what numbers in records mean: names, units, ranges and Table 4's distributions, and the classes."""
    rows = [(p.name, p.symbol, p.unit, p.kind, p.default, p.hard, p.paper) for p in YARN_PARAMETERS]
    return hashlib.sha256(repr((rows, CLASSES)).encode()).hexdigest()[:16]


def sample_record(sample: Sample, about: dict[str, Any], image: bytes) -> dict[str, Any]:
    """The JSON beside a sample's image. ``about`` says how it was rendered (``Settings.rendering``)."""
    fabric = sample.fabric
    return {
        "schema": SCHEMA,
        "index": sample.index,
        "prior": sample.prior,
        "class": sample.label,
        "class_index": CLASSES.index(sample.label),
        "family": fabric.weave.classify(),
        "fabric": as_table(fabric),
        "view": sample.view.as_table(),
        "rendering": about,
        "table": table_hash(),
        "usdfab": __version__,
        "image_sha256": hashlib.sha256(image).hexdigest(),
    }


def sample_of(record: dict[str, Any], place: str = "") -> Sample:
    """The sample that a record describes.

    Raises
    ------
    UsdfabError
        If this is no record, or values in it are not valid.
    """
    try:
        if record["schema"] != SCHEMA:
            raise UsdfabError(f"has format {record['schema']!r}, not {SCHEMA!r}", place=place)
        fabric = fabric_from_table(record["fabric"])
        return Sample(int(record["index"]), record["prior"], record["class"], fabric, view_from_table(record["view"]))
    except UsdfabError as error:
        raise UsdfabError(error.problem, place=f"{place}: {error.place}" if error.place else place) from error
    except (KeyError, TypeError, ValueError) as error:
        raise UsdfabError("this is no record of a sample", place=place, remedy="make the data set anew") from error


def fabric_from_table(table: dict[str, Any]) -> FabricParameters:
    """The inverse of ``fabric.as_table``.

    Raises
    ------
    KeyError, TypeError, UsdfabError
        For another table, and for values out of range.
    """
    names = [f.name for f in fields(YarnParameters)]

    def yarn(values: dict[str, Any]) -> YarnParameters:
        return YarnParameters(**{name: values[name] for name in names})

    said = {f.name: table["provenance"][f.name] for f in fields(Provenance)}
    about: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in said.items()}
    return FabricParameters(
        Weave.from_rows(table["weave"]["matrix"], table["weave"]["name"]),
        (table["size_m"][0], table["size_m"][1]),
        warp=yarn(table["warp"]),
        weft=yarn(table["weft"]),
        seed=table["seed"],
        name=table["name"],
        provenance=Provenance(**about),
        variants=table["variants"],
        albedo_map=table["albedo_map"],
    )
