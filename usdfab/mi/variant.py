"""Loading Mitsuba in the variant that a device needs."""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

from usdfab.errors import UsdfabError
from usdfab.mi import llvm
from usdfab.mi.verdicts import Verdict, remembered_probe

Device = Literal["auto", "llvm", "cuda", "scalar"]

VARIANTS = {"llvm": "llvm_ad_rgb", "cuda": "cuda_ad_rgb", "scalar": "scalar_rgb"}
INSTALL = "run: pip install 'usdfab[mitsuba]'"
INSTALL_LLVM = (
    f"{INSTALL}, which brings one for Linux on x86-64; elsewhere install LLVM 16 or newer and set {llvm.VARIABLE}"
)


def load(device: str = "auto") -> Any:
    """The module ``mitsuba`` with its variant set.

    Parameters
    ----------
    device:
        ``"llvm"``: all cores of the processor. ``"cuda"``: an NVIDIA GPU. ``"scalar"``: the processor without
        compilation, slow and without gradients. ``"auto"``: the GPU where there is a usable one, else LLVM.

    Raises
    ------
    UsdfabError
        If Mitsuba is not installed, the device is not there, or no LLVM library works. Nothing has been loaded then.
    """
    name = resolve_device(device)
    prepare()
    try:
        import mitsuba
    except ImportError as error:
        raise UsdfabError(f"Mitsuba cannot be loaded ({error})", remedy=INSTALL) from error
    if name == "llvm":
        _require_chosen()
    if mitsuba.variant() != VARIANTS[name]:
        mitsuba.set_variant(VARIANTS[name])
    return mitsuba


def prepare() -> None:
    """Choose the LLVM library for whoever imports ``drjit`` or ``mitsuba`` after this.

    Dr.Jit loads its library when it is imported, once and for all: the first that it finds, fit or not.
    """
    if "drjit" in sys.modules or find_spec("drjit") is None:
        return
    chosen = llvm.choose().library
    if chosen is not None:
        llvm.use(chosen)


def _require_chosen() -> None:
    """``UsdfabError`` if Dr.Jit was imported by others before ``prepare``, with another library: it may be unfit."""
    import drjit

    loaded = ".".join(str(n) for n in drjit.detail.llvm_version())
    chosen = llvm.choose().library
    assert chosen is not None, "resolve_device has asked"
    if loaded != llvm.try_library(chosen).version:
        found = f"with LLVM {loaded}" if not loaded.startswith("-") else "without LLVM"
        raise UsdfabError(
            f"Dr.Jit was imported {found} before a library was chosen for it",
            remedy=f"load Mitsuba by usdfab.mi.variant.load first, or set {llvm.VARIABLE}={chosen.path}",
        )


def resolve_device(device: str) -> str:
    """``"llvm"``, ``"cuda"`` or ``"scalar"``, after checking that it works; loads nothing. Errors as ``load``."""
    if device not in get_args(Device):
        raise UsdfabError(f"there is no '{device}'", place="--device", remedy=f"choose {', '.join(get_args(Device))}")
    for package in ("drjit", "mitsuba"):
        if find_spec(package) is None:
            raise UsdfabError(f"the Mitsuba backend needs {package}, which is not installed", remedy=INSTALL)
    if device == "scalar":
        return device
    if device == "cuda" or (device == "auto" and cuda_driver()):
        verdict = cuda_verdict()
        if verdict.fit:
            return "cuda"
        if device == "cuda":
            raise UsdfabError(f"CUDA cannot be used: {verdict.reason}", place="--device cuda", remedy="use llvm")
    choice = llvm.choose()
    if choice.library is None:
        why = f" ({choice.refusals})" if choice.refusals else ""
        raise UsdfabError(f"no LLVM library for Dr.Jit was found{why}", remedy=INSTALL_LLVM)
    return "llvm"


def cuda_driver() -> str:
    """What tells the NVIDIA driver of this machine from others; empty where there is none."""
    for path in ("/proc/driver/nvidia/version", "/sys/module/nvidia/version"):
        try:
            return Path(path).read_text().strip()
        except OSError:
            continue
    for path in ("/dev/dxg", "C:/Windows/System32/nvcuda.dll"):
        if Path(path).exists():
            return f"{path} {Path(path).stat().st_mtime_ns}"
    return ""


@lru_cache(maxsize=1)
def cuda_verdict() -> Verdict:
    """Whether Dr.Jit runs on the GPU and Mitsuba traces rays there."""
    driver = cuda_driver()
    if not driver:
        return Verdict(False, reason="there is no NVIDIA driver")
    return remembered_probe(("cuda",), (driver,))
