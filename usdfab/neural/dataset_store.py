"""A data set of surface materials on disk, written by any number of processes at once and never in a broken state.

The layout is ``dataset_reader``'s. Files appear whole: a process that dies loses the file that it was making and
nothing else. A file's bytes depend on the settings and its number only. ``claims`` holds locks of those at work.
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.neural.dataset_draws import INFORMATIVE, DatasetSettings, make_targets, settings_of
from usdfab.neural.dataset_reader import MANIFEST, SCHEMA, Kind, material_metadata, material_path, read_manifest
from usdfab.production import (
    Produced,
    Progress,
    claimed,
    disk_refused,
    name_first,
    produce_all,
    submitted,
    write_whole,
)

CLAIMS = "claims"

STALE_SECONDS = 3600.0
"""Temporary files older than this were left by a process that died."""


class MaterialStore:
    """A data set that files are added to. Job ``n`` is one file: kinds of a material follow one another."""

    def __init__(self, root: str | Path, settings: DatasetSettings, materials: int) -> None:
        """Open a data set, or begin one.

        Raises
        ------
        UsdfabError
            If the folder cannot be used, holds other things, or a data set with other settings.
        """
        self.root, self.settings = Path(root), settings
        self._prepare()
        self._check_manifest(settings.manifest(materials))

    def job(self, index: int) -> tuple[int, Kind]:
        """(material, kind) of a job."""
        kinds = self.settings.kinds
        return index // len(kinds), kinds[index % len(kinds)]

    def path(self, index: int) -> Path:
        """The file of a job."""
        material, kind = self.job(index)
        return material_path(self.root, kind, material)

    def missing(self, indices: Iterable[int]) -> list[int]:
        """Those of ``indices`` that are not finished, in order."""
        there = {path.name for path in self.root.glob("*.safetensors")}
        return [index for index in indices if self.path(index).name not in there]

    def is_finished(self, index: int) -> bool:
        """Whether a file is there."""
        return self.path(index).exists()

    def claim(self, index: int) -> AbstractContextManager[bool]:
        """Whether this process may make a file; until the block ends no other process may."""
        return claimed(self.root / CLAIMS / self.path(index).stem, lambda: self.is_finished(index))

    def commit(self, index: int, content: bytes) -> None:
        """Keep a finished file; ``UsdfabError`` if the disk refuses."""
        try:
            write_whole(self.path(index), content)
        except OSError as error:
            raise disk_refused(error, self.path(index)) from error

    def _prepare(self) -> None:
        try:
            if self.root.exists() and not self.root.is_dir():
                raise UsdfabError("a file is in the folder's place", place=str(self.root), remedy="choose another name")
            if self.root.is_dir() and not (self.root / MANIFEST).exists():
                other = [p.name for p in self.root.iterdir() if p.name != CLAIMS and not p.name.startswith(".dataset.")]
                if other and not (self.root / MANIFEST).exists():
                    raise UsdfabError(
                        f"the folder holds other things ({other[0]})", place=str(self.root), remedy="give an empty one"
                    )
            (self.root / CLAIMS).mkdir(parents=True, exist_ok=True)
            old = time.time() - STALE_SECONDS
            for path in self.root.glob(".*.safetensors"):
                if path.stat().st_mtime < old:
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise disk_refused(error, self.root) from error

    def _check_manifest(self, wanted: dict) -> None:
        path = self.root / MANIFEST
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
        names = [name for name in dict.fromkeys((*wanted, *found)) if name not in INFORMATIVE]
        differ = [name for name in names if found.get(name) != wanted.get(name)]
        if differ:
            said = ", ".join(f"{name} {found.get(name)}, not {wanted.get(name)}" for name in differ)
            raise UsdfabError(
                f"the data set here is another one ({said})", place=str(self.root),
                remedy="give the same options or another folder",
            )  # fmt: skip
        if found.get("materials", 0) < wanted["materials"]:
            # A longer set is the same set with more of it.
            try:
                write_whole(path, (json.dumps(found | {"materials": wanted["materials"]}, indent=2) + "\n").encode())
            except OSError as error:
                raise disk_refused(error, path) from error


@dataclass(frozen=True)
class MadeMaterial:
    """A finished file: its job, its bytes, and the CPU seconds that it took."""

    index: int
    content: bytes
    seconds: float


def make_material(settings: DatasetSettings, index: int, material: int, kind: Kind) -> MadeMaterial:
    """One file, on one thread: what runs in workers."""
    begun = time.process_time()
    drawn, queries, targets = make_targets(settings, material, kind, threads=1)
    about = material_metadata(drawn) | {
        "schema": SCHEMA,
        "kind": kind,
        "index": str(material),
        "samples": str(settings.samples),
        "seed": str(settings.seed),
    }
    content = encode({"queries": queries, "targets": targets}, about)
    return MadeMaterial(index, content, time.process_time() - begun)


def encode(tensors: dict[str, NDArray[np.float32]], about: dict[str, str]) -> bytes:
    """A safetensors file (8 bytes length, header, data), always the same bytes: the library's own order varies."""
    header: dict[str, object] = {"__metadata__": dict(sorted(about.items()))}
    parts, offset = [], 0
    for name, tensor in tensors.items():
        data = np.ascontiguousarray(tensor, dtype="<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": [offset, offset + len(data)]}
        parts.append(data)
        offset += len(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # data begin at a multiple of 8
    return len(text).to_bytes(8, "little") + text + b"".join(parts)


def produce_materials(
    store: MaterialStore, materials: int, executor: Executor | None = None, slots: int = 1,
    progress: Progress | None = None,
) -> Produced:  # fmt: skip
    """Make the files of materials 0 to ``materials`` that are missing and that no other process is making.

    Raises
    ------
    UsdfabError
        If the disk refuses or a worker dies. Finished files are kept; the same call goes on.
    """

    def keep(made: MadeMaterial) -> float:
        store.commit(made.index, made.content)
        return made.seconds

    jobs = range(materials * len(store.settings.kinds))
    return produce_all(
        store, jobs, lambda job: submitted(executor, make_material, store.settings, job, *store.job(job)), keep,
        slots, progress,
    )  # fmt: skip
