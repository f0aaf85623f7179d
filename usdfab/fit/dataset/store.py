"""A data set on disk, written by any number of processes at once and never in a broken state.

    dataset.json             the manifest: settings that all samples share
    loose/000123.exr, .json  finished samples whose shard is not full yet; the record is written last
    shards/shard-00000.tar   full shards: 000000.exr, 000000.json, 000001.exr, ... (WebDataset's layout)
    claims/000123            locked by the process that is making the sample; a dead process holds no lock

Files appear whole: they are written beside their place and renamed. A process that dies, however, loses the samples
that it was rendering and nothing else.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tarfile
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from usdfab.errors import UsdfabError
from usdfab.files import whole_file
from usdfab.fit.dataset.settings import INFORMATIVE, Settings, settings_of
from usdfab.production import claimed, disk_refused, name_first, write_whole

MANIFEST, LOOSE, SHARDS, CLAIMS = "dataset.json", "loose", "shards", "claims"

STALE_SECONDS = 3600.0
"""Temporary files older than this were left by a process that died."""


def sample_name(index: int) -> str:
    """``000123``."""
    return f"{index:06d}"


def shard_name(shard: int) -> str:
    """``shard-00012.tar``."""
    return f"shard-{shard:05d}.tar"


def read_manifest(root: Path) -> dict[str, Any]:
    """The manifest of a data set.

    Raises
    ------
    UsdfabError
        If there is none, or it cannot be read.
    """
    path = root / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsdfabError("there is no data set here", place=str(root), remedy=f"no {MANIFEST} was found") from error
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
    except ValueError as error:
        raise UsdfabError("the manifest is damaged", place=str(path), remedy="restore it from a copy") from error
    if not isinstance(manifest, dict):
        raise UsdfabError("the manifest is damaged", place=str(path), remedy="restore it from a copy")
    return manifest


def encode_record(record: dict[str, Any]) -> bytes:
    """A record as the bytes of its file, always the same."""
    return (json.dumps(record, sort_keys=True, allow_nan=False, indent=1) + "\n").encode()


class Store:
    """A data set that samples are added to."""

    def __init__(self, root: str | Path, settings: Settings) -> None:
        """Open a data set, or begin one.

        Raises
        ------
        UsdfabError
            If the folder cannot be used, holds other things, or a data set with other settings; if a shard is damaged.
        """
        self.root, self.settings = Path(root), settings
        self._prepare()
        self._check_manifest()
        self._full = set(self._shards())
        self._remove_stale()

    def missing(self, indices: Iterable[int]) -> list[int]:
        """Those of ``indices`` that are not finished, in order."""
        self._full = {int(p.stem.removeprefix("shard-")) for p in (self.root / SHARDS).glob("shard-*.tar")}
        loose = {p.stem for p in (self.root / LOOSE).glob("*.json")}
        return [i for i in indices if i // self.settings.shard not in self._full and sample_name(i) not in loose]

    def is_finished(self, index: int) -> bool:
        """Whether a sample is there, loose or in a shard."""
        return self._record_path(index).exists() or self._shard_path(index // self.settings.shard).exists()

    @contextmanager
    def claim(self, index: int) -> Iterator[bool]:
        """Whether this process may make a sample; until the block ends no other process may.

        Where the system knows no file locks every claim is granted: two processes may then make a sample twice, which
        costs time and nothing else.
        """
        with claimed(self.root / CLAIMS / sample_name(index), lambda: self.is_finished(index)) as mine:
            yield mine

    def commit(self, index: int, record: dict[str, Any], image: bytes) -> None:
        """Keep a finished sample; packs its shard if that is full now.

        Raises
        ------
        UsdfabError
            If the disk refuses: what was there before is still there.
        """
        target = self._record_path(index)
        try:
            write_whole(target.with_suffix(".exr"), image)
            write_whole(target, encode_record(record))
        except OSError as error:
            raise disk_refused(error, target) from error
        self.pack(index // self.settings.shard)

    def pack(self, shard: int) -> bool:
        """Make a shard of its loose samples if all are there. Returns whether the shard is there now.

        Any number of processes may try at once: they write the same bytes, and one wins.
        """
        target = self._shard_path(shard)
        first = shard * self.settings.shard
        records = [self._record_path(i) for i in range(first, first + self.settings.shard)]
        if not target.exists():
            if not all(path.exists() for path in records):
                return target.exists()
            try:
                self._write_shard(target, records)
            except FileNotFoundError:
                # Another process has packed it in the meantime and is removing the loose files.
                if not target.exists():
                    raise
            except OSError as error:
                raise disk_refused(error, target) from error
        for path in records:
            path.unlink(missing_ok=True)
            path.with_suffix(".exr").unlink(missing_ok=True)
        return True

    def _write_shard(self, target: Path, records: list[Path]) -> None:
        with whole_file(target) as temporary, temporary.open("wb") as file:
            with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
                for path in records:
                    record, image = path.read_bytes(), path.with_suffix(".exr").read_bytes()
                    check_image(record, image, str(path))
                    for name, content in ((f"{path.stem}.exr", image), (f"{path.stem}.json", record)):
                        member = tarfile.TarInfo(name)
                        member.size = len(content)
                        tar.addfile(member, io.BytesIO(content))
            file.flush()
            os.fsync(file.fileno())

    def _prepare(self) -> None:
        manifest = self.root / MANIFEST
        try:
            if self.root.exists() and not self.root.is_dir():
                raise UsdfabError("a file is in the folder's place", place=str(self.root), remedy="choose another name")
            if self.root.is_dir() and not manifest.exists():
                other = [p.name for p in self.root.iterdir() if p.name not in (LOOSE, SHARDS, CLAIMS, MANIFEST)]
                other = [name for name in other if not name.startswith(".dataset.")]
                if other and not manifest.exists():
                    raise UsdfabError(
                        f"the folder holds other things ({other[0]})", place=str(self.root), remedy="give an empty one"
                    )
            for name in (LOOSE, SHARDS, CLAIMS):
                (self.root / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_refused(error, self.root) from error

    def _check_manifest(self) -> None:
        path, wanted = self.root / MANIFEST, self.settings.manifest()
        if not path.exists():
            temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.json")
            try:
                temporary.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
                name_first(temporary, path)
            except OSError as error:
                raise disk_refused(error, path) from error
            finally:
                temporary.unlink(missing_ok=True)
        found = read_manifest(self.root)
        settings_of(found, str(path))
        names = [name for name in (*wanted, *found) if name not in INFORMATIVE]
        differ = [name for name in dict.fromkeys(names) if found.get(name) != wanted.get(name)]
        if differ:
            said = ", ".join(f"{name} {found.get(name)}, not {wanted.get(name)}" for name in differ)
            raise UsdfabError(
                f"the data set here is another one ({said})", place=str(self.root),
                remedy="give the same options or another folder",
            )  # fmt: skip

    def _shards(self) -> list[int]:
        """Numbers of the shards, after a look at whether they are whole."""
        from usdfab.fit.dataset.shards import check_shard

        paths = sorted((self.root / SHARDS).glob("shard-*.tar"))
        for path in paths:
            check_shard(path, self.settings.shard)
        return [int(path.stem.removeprefix("shard-")) for path in paths]

    def _remove_stale(self) -> None:
        """Temporary files of processes that died, and loose copies of samples that are in shards."""
        old = time.time() - STALE_SECONDS
        for folder in (LOOSE, SHARDS):
            for path in (self.root / folder).glob(".*"):
                try:
                    if path.stat().st_mtime < old:
                        path.unlink(missing_ok=True)
                except FileNotFoundError:
                    continue
        for path in (self.root / LOOSE).glob("*.json"):
            if path.stem.isdigit() and int(path.stem) // self.settings.shard in self._full:
                path.with_suffix(".exr").unlink(missing_ok=True)
                path.unlink(missing_ok=True)

    def _record_path(self, index: int) -> Path:
        return self.root / LOOSE / f"{sample_name(index)}.json"

    def _shard_path(self, shard: int) -> Path:
        return self.root / SHARDS / shard_name(shard)


def check_image(record: bytes, image: bytes, place: str) -> dict[str, Any]:
    """The record, parsed, after checking that ``image`` is the one it was written for.

    Raises
    ------
    UsdfabError
        If either is damaged.
    """
    try:
        parsed = json.loads(record)
        known = parsed["image_sha256"]
    except (ValueError, KeyError, TypeError) as error:
        raise UsdfabError("the record is damaged", place=place, remedy=_AGAIN) from error
    if hashlib.sha256(image).hexdigest() != known:
        raise UsdfabError("the image is damaged or cut off", place=place, remedy=_AGAIN)
    return parsed


_AGAIN = "remove it and run `usdfab dataset` again"
