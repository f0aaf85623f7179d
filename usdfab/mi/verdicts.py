"""What probes found, remembered on disk: a library is tried once, not at every start."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path

from usdfab.files import whole_file

TIME_LIMIT = 120.0
"""Seconds after which a probe is given up."""


@dataclass(frozen=True)
class Verdict:
    """Whether a library serves: ``reason`` is empty where ``fit``, else a clause such as "cannot be loaded (...)"."""

    fit: bool
    version: str = ""
    reason: str = ""
    lasting: bool = True
    """Whether it would be the same the next time."""


def remembered_probe(arguments: Sequence[str], identity: Sequence[object]) -> Verdict:
    """The verdict of ``usdfab.mi.probe`` with ``arguments``, from disk where ``identity`` and this machine are known.

    A folder that cannot be read or written, and a damaged file, only cost the probe.
    """
    key = hashlib.sha256(repr((*arguments, *identity, *_machine())).encode()).hexdigest()[:32]
    file = cache_folder() / f"{key}.json"
    with suppress(OSError, ValueError, TypeError, KeyError):
        kept = json.loads(file.read_text())
        return Verdict(bool(kept["fit"]), str(kept["version"]), str(kept["reason"]))
    verdict = probe(arguments)
    if verdict.lasting:
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(file) as temporary:
                facts = {"fit": verdict.fit, "version": verdict.version, "reason": verdict.reason}
                temporary.write_text(json.dumps(facts | {"probe": list(arguments)}))
    return verdict


def probe(arguments: Sequence[str]) -> Verdict:
    """Run ``usdfab.mi.probe`` in a process of its own and judge by what it said before it ended."""
    # The probe is to find what this process would import.
    environment = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}
    package = str(Path(__file__).resolve().parents[2])
    environment["PYTHONPATH"] = os.pathsep.join([package, *(p for p in sys.path if p)])
    command = [sys.executable, "-m", "usdfab.mi.probe", *arguments]
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, errors="replace", timeout=TIME_LIMIT, check=False
        )
    except subprocess.TimeoutExpired:
        return Verdict(False, reason=f"gave no answer in {TIME_LIMIT:.0f} s", lasting=False)
    except OSError as error:
        return Verdict(False, reason=f"could not be tried ({error})", lasting=False)
    return judged(done.stdout, done.stderr, done.returncode)


def judged(stdout: str, stderr: str, code: int) -> Verdict:
    """The verdict from a probe's output and exit code, negative for the signal that ended it."""
    facts: dict = {}
    for line in stdout.splitlines():
        with suppress(ValueError):
            said = json.loads(line)
            facts |= said if isinstance(said, dict) else {}
    version = str(facts.get("version", ""))
    if facts.get("fit") and code == 0:
        return Verdict(True, version)
    if "refused" in facts:
        return Verdict(False, version, str(facts["refused"]))
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    if code < 0:
        told = next((line for line in lines if "LLVM ERROR" in line or "Critical" in line), lines[0] if lines else "")
        try:
            how = signal.Signals(-code).name
        except ValueError:
            how = f"signal {-code}"
        # Killed from outside (out of memory, an impatient user) says nothing about the library.
        lasting = how not in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
        return Verdict(False, version, f"ends the process with {how}" + (f" ({told[:120]})" if told else ""), lasting)
    # An exception: usually Dr.Jit that cannot be imported.
    return Verdict(False, version, f"fails ({lines[-1][:160] if lines else f'exit code {code}'})", lasting=False)


def cache_folder() -> Path:
    """Where usdfab keeps what it found out about this machine."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or _home() / ".cache"
    return Path(base) / "usdfab" / "probes"


def _home() -> Path:
    try:
        return Path.home()
    except RuntimeError:  # a user without a home
        return Path(os.devnull)


@lru_cache(maxsize=1)
def _machine() -> tuple[str, ...]:
    """What a verdict holds for: home folders are shared by machines, and a library may fail on one processor only."""
    processor = platform.processor()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    return (platform.machine(), processor, platform.python_version(), _version("drjit"), _version("mitsuba"))


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
