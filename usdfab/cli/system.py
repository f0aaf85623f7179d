"""What usdfab finds on this machine, for ``usdfab info --system``. Nothing that is missing or broken ends it."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from typing import Any

from usdfab._version import __version__
from usdfab.errors import UsdfabError

LIBRARIES = (
    "numpy", "scipy", "numba", "usd-core", "embreex", "openimageio", "xatlas", "cyclopts", "mitsuba", "drjit",
    "karellen-llvm-core", "mitsuba-oidn", "pyvista", "distributed", "torch",
    "safetensors",
)  # fmt: skip
"""Packages whose versions matter, by their names on PyPI."""

Facts = dict[str, Any]


def system_facts() -> Facts:
    """What ``--json`` prints; absent things are None, broken ones have a ``reason``."""
    from usdfab.memory import available_memory

    versions = {name: _version(name) for name in LIBRARIES}
    return {
        "usdfab": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory": {"total_bytes": _total_memory(), "available_bytes": available_memory()},
        "mitsuba": _mitsuba(versions),
        "llvm": _llvm(versions),
        "cuda": _cuda(versions),
        "embree": _embree(),
        "denoiser": {"installed": versions["mitsuba-oidn"] is not None, "version": versions["mitsuba-oidn"]},
        "usd": _usd(),
        "libraries": versions,
    }


def system_lines(facts: Facts) -> list[str]:
    """The facts for people."""
    memory, embree, usd, llvm, cuda = (facts[name] for name in ("memory", "embree", "usd", "llvm", "cuda"))
    gib = [f"{bytes / 2**30:.1f} GiB" if bytes else "unknown" for bytes in memory.values()]
    abilities = [name for name, there in embree.get("features", {}).items() if there]
    denoiser = facts["denoiser"]["version"]
    lines = [
        ("usdfab", f"{facts['usdfab']}, Python {facts['python']}, {facts['platform']}"),
        ("processor", f"{facts['processor']}, {facts['threads']} threads"),
        ("memory", f"{gib[0]}, {gib[1]} free"),
        ("Embree", f"{embree['version']}: {', '.join(abilities)}" if embree["version"] else embree["reason"]),
        ("Mitsuba", facts["mitsuba"]["device"] or facts["mitsuba"]["reason"]),
        ("LLVM", f"{llvm['version']}, {llvm['path']} ({llvm['origin']})" if llvm["path"] else llvm["reason"]),
        *(("", f"refused: {r['path']} ({r['origin']}): {r['reason']}") for r in llvm["refused"]),
        ("CUDA, OptiX", "usable" if cuda["usable"] else cuda["reason"]),
        ("denoiser", f"mitsuba-oidn {denoiser}" if denoiser else "not installed; pip install 'usdfab[denoise]'"),
        ("USD", f"{usd['version']}, schema {'registered' if usd['schema_registered'] else usd['reason']}"),
        ("schema", usd["schema_folder"]),
        *(("libraries" if k == 0 else "", f"{n} {v or 'not installed'}") for k, (n, v) in _numbered(facts)),
    ]
    return [f"{name:12} {text}".rstrip() for name, text in lines]


def _numbered(facts: Facts) -> list[tuple[int, tuple[str, str | None]]]:
    return list(enumerate(facts["libraries"].items()))


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as lines:  # noqa: PTH123
            return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _total_memory() -> int | None:
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _mitsuba(versions: dict[str, str | None]) -> Facts:
    """Which device ``--backend mitsuba`` would use."""
    from usdfab.mi.variant import resolve_device

    facts: Facts = {"version": versions["mitsuba"], "device": None, "reason": ""}
    try:
        facts["device"] = resolve_device("auto")
    except UsdfabError as error:
        facts["reason"] = f"{error.problem}; {error.remedy}"
    return facts


def _llvm(versions: dict[str, str | None]) -> Facts:
    """The library that Dr.Jit would compile with, and why those before it were refused."""
    facts: Facts = {"path": None, "version": None, "origin": None, "refused": [], "reason": ""}
    if versions["drjit"] is None:
        return facts | {"reason": "not tried, drjit is not installed"}
    from usdfab.mi.llvm import choose

    choice = choose()
    for tried in choice.tried:
        found = {"path": tried.library.path, "version": tried.verdict.version, "origin": tried.library.origin}
        if tried.verdict.fit:
            facts |= found
        else:
            facts["refused"].append(found | {"reason": tried.verdict.reason})
    if choice.library is None:
        facts["reason"] = "none that works"
    return facts


def _cuda(versions: dict[str, str | None]) -> Facts:
    if versions["drjit"] is None or versions["mitsuba"] is None:
        return {"usable": False, "reason": "not tried, mitsuba is not installed"}
    from usdfab.mi.variant import cuda_verdict

    verdict = cuda_verdict()
    return {"usable": verdict.fit, "reason": verdict.reason}


def _embree() -> Facts:
    try:
        from usdfab.tracer import embree

        return {"version": embree.version(), "features": embree.features(), "reason": ""}
    except (UsdfabError, OSError, ImportError) as error:
        return {"version": None, "features": {}, "reason": str(error)}


def _usd() -> Facts:
    import usdfab

    facts: Facts = {"version": None, "schema_folder": str(usdfab.schema_dir()), "schema_registered": False}
    try:
        from usdfab.usd.registration import require_schema, usd_version

        facts["version"] = usd_version()
        require_schema()
    except (UsdfabError, ImportError) as error:
        return facts | {"reason": str(error)}
    return facts | {"schema_registered": True, "reason": ""}
