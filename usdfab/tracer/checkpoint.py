"""Unfinished renders and parts of renders as files: saved whole or not at all, loaded without running anything.

A file is an uncompressed ``.npz`` of three arrays: ``sums``, ``stops`` (see ``schedule.Work``) and ``about``, JSON text
that says which render it belongs to. It is read with ``allow_pickle=False``.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.files import whole_file
from usdfab.tracer.render import RenderSettings, Shot, resolve_region
from usdfab.tracer.schedule import LAYERS, Window, Work, bounds, plan_tiles

FORMAT = "usdfab-sums/1"
SAVE_SECONDS = 30.0
"""A checkpoint is due this long after the last one was written."""
SAVE_SHARE = 0.05
"""And not before the last one's writing took less than this part of the time since."""

_NOT_SEEN = frozenset({"path", "warnings"})
"""Fields that say where a thing comes from and change no pixel."""


def fingerprint(*things: Any) -> str:
    """A hash of everything in a scene (or other dataclasses, arrays, mappings, sequences) that pixels depend on.

    Equal for equal values, wherever files and prims are: fields called ``path`` and ``warnings`` are left out.
    """
    digest = hashlib.sha256()
    for thing in things:
        _feed(digest, thing)
    return digest.hexdigest()


def _feed(digest: Any, thing: Any) -> None:
    # Every value starts with its kind and length, so that different nestings cannot read the same.
    if is_dataclass(thing) and not isinstance(thing, type):
        _feed(digest, {f.name: getattr(thing, f.name) for f in fields(thing) if f.name not in _NOT_SEEN})
        return
    if isinstance(thing, Enum):
        thing = thing.name
    if isinstance(thing, np.generic):
        thing = thing.item()
    if isinstance(thing, np.ndarray):
        digest.update(f"array {thing.dtype.str} {thing.shape}".encode())
        digest.update(np.ascontiguousarray(thing).data)
    elif isinstance(thing, Mapping):
        digest.update(f"mapping {len(thing)}".encode())
        for key in sorted(thing):
            _feed(digest, key)
            _feed(digest, thing[key])
    elif isinstance(thing, Sequence) and not isinstance(thing, str | bytes):
        digest.update(f"sequence {len(thing)}".encode())
        for item in thing:
            _feed(digest, item)
    elif isinstance(thing, bool | int | None | str | bytes | Path):
        data = thing if isinstance(thing, bytes) else str(thing).encode()
        digest.update(f"{type(thing).__name__} {len(data)} ".encode() + data)
    elif isinstance(thing, float):
        digest.update(b"float" + struct.pack("<d", thing))
    else:
        raise TypeError(f"{type(thing).__name__} has no fingerprint")


@dataclass(frozen=True)
class Identity:
    """Which render sums belong to: two renders with equal identities have equal pixels at equal sample counts."""

    scene: str
    width: int
    height: int
    region: Window
    part: tuple[int, int]
    seed: int
    max_depth: int
    noise: float | None
    exposure: float
    segments: int
    version: str = __version__

    @classmethod
    def of(cls, scene: str, shot: Shot, settings: RenderSettings, segments: int) -> Identity:
        """The identity of a render of a scene with this fingerprint."""
        region = resolve_region(settings.region, shot.width, shot.height)
        return cls(
            scene, shot.width, shot.height, region, settings.part, shot.seed, shot.max_depth, settings.noise,
            float(shot.camera.exposure), segments,
        )  # fmt: skip

    def differences(self, other: Identity, but: Sequence[str] = ()) -> list[str]:
        """Names of what is not the same."""
        names = [f.name for f in fields(self) if f.name not in but]
        return [name for name in names if getattr(self, name) != getattr(other, name)]


@dataclass(frozen=True)
class Saved:
    """What a file holds. ``spp`` is what was asked for, ``seconds`` what it took."""

    identity: Identity
    work: Work
    spp: int
    seconds: float


def save_work(path: Path, identity: Identity, work: Work, spp: int, seconds: float = 0.0) -> None:
    """Write sums. After an error, a full disk above all, an older file is still there and nothing else is.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    about = {"format": FORMAT, "spp": spp, "seconds": seconds} | {
        f.name: getattr(identity, f.name) for f in fields(identity)
    }
    try:
        with whole_file(path) as temporary, temporary.open("wb") as file:
            np.savez(file, sums=work.sums, stops=work.stops, about=np.array(json.dumps(about)))
    except OSError as error:
        raise UsdfabError(
            f"cannot be written ({error.strerror or error})", place=str(path), remedy="make room or choose another disk"
        ) from error


def load_work(path: Path) -> Saved:
    """Read what ``save_work`` wrote.

    Raises
    ------
    UsdfabError
        If the file is missing, damaged or something else.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            about = json.loads(str(data["about"]))
            sums, stops = data["sums"], data["stops"]
        if about.pop("format") != FORMAT:
            raise ValueError
        spp, seconds = int(about.pop("spp")), float(about.pop("seconds"))
        about["region"], about["part"] = tuple(map(int, about["region"])), tuple(map(int, about["part"]))
        identity = Identity(**about)
        tiles = plan_tiles(identity.width, identity.height, identity.region, identity.part, identity.noise is not None)
        x0, y0, x1, y1 = bounds(tiles)
        if sums.shape != (y1 - y0, x1 - x0, LAYERS) or stops.shape != (len(tiles),):
            raise ValueError
    except FileNotFoundError as error:
        raise UsdfabError("there is no such file", place=str(path)) from error
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
    except (ValueError, KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise UsdfabError(
            "this is no unfinished render of this version, or it is damaged",
            place=str(path),
            remedy="remove it and start again",
        ) from error
    return Saved(identity, Work(tiles, sums, stops), spp, seconds)


def resume_work(path: Path, identity: Identity) -> Saved:
    """Read an unfinished render and make sure that it is the wanted one; else ``UsdfabError`` says what differs."""
    saved = load_work(path)
    differences = saved.identity.differences(identity)
    if differences:
        raise UsdfabError(
            f"the unfinished render is another one (it differs in: {', '.join(differences)})",
            place=str(path),
            remedy="give the same options, or start anew with --overwrite",
        )
    return saved


def merge_work(parts: Sequence[Saved], names: Sequence[str]) -> Saved:
    """The whole render from all of its parts (``RenderSettings.part``), in any order.

    Raises
    ------
    UsdfabError
        If parts are missing, twice, unfinished or of different renders; ``names`` are theirs.
    """
    first = parts[0].identity
    n = first.part[1]
    found: dict[int, str] = {}
    for part, name in zip(parts, names, strict=True):
        differences = part.identity.differences(first, but=["part"])
        if part.identity.part[1] != n:
            differences.append(f"number of tiles ({part.identity.part[1]} and {n})")
        if part.spp != parts[0].spp:
            differences.append(f"spp ({part.spp} and {parts[0].spp})")
        if differences:
            raise UsdfabError(f"belongs to another render than {names[0]} ({', '.join(differences)})", place=name)
        i = part.identity.part[0]
        if i in found:
            raise UsdfabError(f"holds tile {i}/{n}, and so does {found[i]}", place=name, remedy="give each tile once")
        found[i] = name
        wanted = [tile.wanted for tile in part.work.tiles]
        if any(wanted) and part.work.counts()[wanted].min() == 0:
            raise UsdfabError("is not finished", place=name, remedy="render it to its end, e.g. with --resume")
    missing = [f"{i}/{n}" for i in range(1, n + 1) if i not in found]
    if missing:
        raise UsdfabError(f"tiles {', '.join(missing[:8])} of the picture are missing", remedy="give all of its parts")
    identity = Identity(**{f.name: getattr(first, f.name) for f in fields(first)} | {"part": (1, 1)})
    tiles = plan_tiles(first.width, first.height, first.region)
    whole = Work(tiles)
    for part in parts:
        for tile in part.work.tiles:
            window = _common(tile.window, whole.window)
            if tile.wanted and window is not None:
                whole.part(window)[...] = part.work.part(window)
    return Saved(identity, whole, parts[0].spp, math.fsum(part.seconds for part in parts))


def _common(a: Window, b: Window) -> Window | None:
    x0, y0, x1, y1 = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


class Autosave:
    """Saves every now and then (``accumulate.Save``). A disk that refuses does not end the render: it is said once."""

    def __init__(
        self,
        path: Path,
        identity: Identity,
        spp: int,
        warn: Callable[[str], None],
        before: float = 0.0,
        every: float = SAVE_SECONDS,
    ) -> None:
        """``before`` are the seconds that went into the sums in earlier runs, ``every`` those between two saves."""
        self._path, self._identity, self._spp, self._warn, self._every = path, identity, spp, warn, every
        self._start = self._last = time.perf_counter()
        self._before, self._cost = before, 0.0
        self._complained = False
        self.saved = False
        """Whether the file holds what was last given."""

    def __call__(self, work: Work, must: bool) -> None:
        begun = time.perf_counter()
        self.saved = False
        if not must and begun - self._last < max(self._every, self._cost / SAVE_SHARE):
            return
        if not work.counts().any():
            return
        try:
            save_work(self._path, self._identity, work, self._spp, self._before + begun - self._start)
            self.saved = True
        except UsdfabError as error:
            if not self._complained or must:
                self._warn(f"the unfinished render is not saved: {error}")
            self._complained = True
        self._last = time.perf_counter()
        self._cost = self._last - begun

    def remove(self) -> None:
        """The render is done: nothing is left to resume."""
        self._path.unlink(missing_ok=True)
