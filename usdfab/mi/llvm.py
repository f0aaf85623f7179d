"""Choosing the LLVM library with which Dr.Jit compiles, before Dr.Jit is imported.

Dr.Jit loads the first ``libLLVM`` that it finds when it is imported, and an unfit one ends the process: LLVM 15 with
"Cannot select" on some processors, none at all with a division by zero at the first array. So each candidate is tried
in a process of its own (``probe.py``), in this order: DRJIT_LIBLLVM_PATH, the package ``karellen-llvm-core``, the
system's libraries.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path

from usdfab.mi.verdicts import Verdict, remembered_probe

PACKAGE = "karellen-llvm-core"
VARIABLE = "DRJIT_LIBLLVM_PATH"

_NAMES = ("libLLVM*.so*", "libLLVM*.dylib", "LLVM-C.dll")
_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib*",
    "/usr/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm/lib",
    "/usr/local/opt/llvm/lib",
    "C:/Program Files/LLVM/bin",
)


@dataclass(frozen=True)
class Library:
    """A library that may be LLVM. ``origin``: who named it. ``preload``: what has to be loaded before it."""

    path: str
    origin: str
    preload: tuple[str, ...] = ()


@dataclass(frozen=True)
class Tried:
    """A candidate and what the probe found."""

    library: Library
    verdict: Verdict


@dataclass(frozen=True)
class Choice:
    """The library to use, None where no candidate is fit, and all that were tried, in order."""

    library: Library | None
    tried: tuple[Tried, ...]

    @property
    def refusals(self) -> str:
        """Why candidates were refused, one clause; empty where none was."""
        return "; ".join(f"{t.library.path} {t.verdict.reason}" for t in self.tried if not t.verdict.fit)


@lru_cache(maxsize=1)
def choose() -> Choice:
    """The first candidate that works. Tried once per process; the probes' results are kept on disk."""
    return first_fit(candidates())


def first_fit(libraries: Iterator[Library]) -> Choice:
    """The first of ``libraries`` that is fit; those after it are not tried."""
    tried = []
    for library in libraries:
        tried.append(Tried(library, try_library(library)))
        if tried[-1].verdict.fit:
            return Choice(library, tuple(tried))
    return Choice(None, tuple(tried))


def try_library(library: Library) -> Verdict:
    """Whether Dr.Jit works with a library, by a probe that this process survives."""
    try:
        status = Path(library.path).stat()
    except OSError:
        return Verdict(False, reason="does not exist")
    if not Path(library.path).is_file():
        return Verdict(False, reason="is no file")
    identity = (status.st_mtime_ns, status.st_size)
    return remembered_probe(("llvm", library.path, *library.preload), identity)


def use(library: Library) -> None:
    """Make Dr.Jit, which must not have been imported yet, load this library."""
    for needed in library.preload:
        ctypes.CDLL(needed, mode=ctypes.RTLD_GLOBAL)
    os.environ[VARIABLE] = library.path


def candidates() -> Iterator[Library]:
    """Libraries to try, the same file once."""
    seen: set[str] = set()
    for library in _named():
        real = os.path.realpath(library.path)
        if real not in seen:
            seen.add(real)
            yield library


def _named() -> Iterator[Library]:
    if os.environ.get(VARIABLE):
        yield Library(os.environ[VARIABLE], VARIABLE)
    yield from _packaged()
    yield from (Library(str(path), "system") for path in _system())


def _packaged() -> Iterator[Library]:
    """The library of ``karellen-llvm-core``.

    Its symbolic links are made at the first start of an interpreter after it was installed. Until then the loader does
    not find the libc++ that it brings, which then has to be loaded first.
    """
    try:
        located = [Path(str(file.locate())).resolve() for file in metadata.files(PACKAGE) or ()]
    except metadata.PackageNotFoundError:
        return
    files = [f for f in located if ".so" in f.name and f.is_file()]
    libraries = sorted({f for f in files if re.fullmatch(r"libLLVM[-\d.]*\.so[.\d]*", f.name)})
    needed = re.compile(r"(lib(?:c\+\+|c\+\+abi|unwind))\.so\.\d.*")
    runtime = {match[1]: f for f in files if (match := needed.fullmatch(f.name))}
    linked = all((f.parent / f"{name}.so.1").exists() for name, f in runtime.items())
    order = () if linked else ("libunwind", "libc++abi", "libc++")
    preload = tuple(str(runtime[name]) for name in order if name in runtime)
    for path in libraries:
        yield Library(str(path), PACKAGE, preload)


def _system() -> list[Path]:
    """The system's libraries, newest version first, the same file once."""
    folders = [Path(sys.prefix) / "lib", Path(sys.base_prefix) / "lib"]
    folders += [Path(f) for f in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if f]
    for pattern in _FOLDERS:
        anchor = Path(pattern).anchor
        folders += sorted(Path(anchor).glob(pattern[len(anchor) :])) if anchor and Path(anchor).exists() else []
    found = {path.resolve(): None for folder in folders for name in _NAMES for path in folder.glob(name)}
    return sorted((path for path in found if path.is_file()), key=_version_in_name, reverse=True)


def _version_in_name(path: Path) -> tuple[int, ...]:
    """(19, 1) of ``libLLVM.so.19.1`` and ``libLLVM-19.1.so``; a name without a version comes last."""
    return tuple(int(n) for n in re.findall(r"\d+", path.name))
