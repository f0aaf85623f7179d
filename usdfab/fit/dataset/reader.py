"""Reading a data set back: every sample that is there, in order, or an error that names what is wrong with it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fit.dataset.records import sample_of
from usdfab.fit.dataset.samples import Sample
from usdfab.fit.dataset.settings import settings_of
from usdfab.fit.dataset.shards import read_shard
from usdfab.fit.dataset.store import LOOSE, MANIFEST, SHARDS, check_image, read_manifest
from usdfab.imaging import read_image


@dataclass(frozen=True)
class Stored:
    """A stored sample. ``record`` is its JSON; ``image_file`` the bytes of its EXR file; ``place`` says where it is."""

    record: dict[str, Any]
    image_file: bytes
    place: str

    @property
    def index(self) -> int:
        """The sample's number."""
        return int(self.record["index"])

    @property
    def image(self) -> NDArray[np.float32]:
        """(H, W, 3) linear Rec. 709, decoded each time."""
        return decode_image(self.image_file, self.place)

    @cached_property
    def sample(self) -> Sample:
        """Fabric, view and class; raises ``UsdfabError`` where the record is not valid."""
        return sample_of(self.record, self.place)


def read_dataset(root: str | Path) -> Iterator[Stored]:
    """All samples of a data set by number: those in shards, and loose ones.

    May be read while it is being made: what is finished at the start is what is read.

    Raises
    ------
    UsdfabError
        If there is no data set, it was made with another parameter table, or a shard or file is damaged or cut off.
        Nothing is skipped.
    """
    root = Path(root)
    settings = settings_of(read_manifest(root), str(root / MANIFEST))
    shards = {int(p.stem.removeprefix("shard-")): p for p in (root / SHARDS).glob("shard-*.tar")}
    loose = {int(p.stem): p for p in (root / LOOSE).glob("*.json") if p.stem.isdigit()}
    steps = sorted(
        [(n * settings.shard, path) for n, path in shards.items()]
        + [(i, path) for i, path in loose.items() if i // settings.shard not in shards]
    )
    for first, path in steps:
        if path.suffix == ".tar":
            found = read_shard(path, settings.shard)
        else:
            found = _read_loose(root, path, first // settings.shard, first % settings.shard, settings.shard)
        for place, record, image in found:
            yield Stored(check_image(record, image, place), image, place)


def _read_loose(root: Path, path: Path, shard: int, place: int, count: int) -> Iterator[tuple[str, bytes, bytes]]:
    try:
        yield str(path), path.read_bytes(), path.with_suffix(".exr").read_bytes()
    except FileNotFoundError as error:
        # It may have been packed since the folder was listed.
        packed = root / SHARDS / f"shard-{shard:05d}.tar"
        if not packed.exists():
            raise UsdfabError("the sample has no image or was removed", place=str(path)) from error
        yield list(read_shard(packed, count))[place]
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error


def decode_image(content: bytes, place: str = "") -> NDArray[np.float32]:
    """The picture (H, W, 3) in the bytes of an EXR file; ``UsdfabError`` naming ``place`` if it is damaged."""
    with tempfile.TemporaryDirectory(prefix="usdfab-") as folder:
        path = Path(folder) / "image.exr"
        path.write_bytes(content)
        try:
            return read_image(path).pixels
        except UsdfabError as error:
            raise UsdfabError(error.problem, place=place, remedy=error.remedy) from error
