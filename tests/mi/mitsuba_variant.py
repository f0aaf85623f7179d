"""Mitsuba with Dr.Jit's LLVM backend for tests, or the reason why not."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

# Asked in another process: with no LLVM, or an old one, Dr.Jit ends the process that asks.
_PROBE = """
import drjit as dr
assert dr.has_backend(dr.JitBackend.LLVM)
from drjit.llvm import Float
assert dr.minimum(Float(1, 2), Float(2, 1))[1] == 1
"""


def find_llvm() -> str:
    """Path of an LLVM library for Dr.Jit, or an empty string."""
    if os.environ.get("DRJIT_LIBLLVM_PATH"):
        return os.environ["DRJIT_LIBLLVM_PATH"]
    try:
        files = importlib.metadata.files("karellen-llvm-core") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    found = [Path(str(f.locate())) for f in files if f.name.startswith("libLLVM")]
    found += Path(sys.prefix).glob("lib/libLLVM.so*")
    return next((str(path.resolve()) for path in found if path.is_file()), "")


@functools.cache
def why_not() -> str:
    """Why there is no `llvm_ad_rgb` here, or an empty string; else the library is chosen for this process."""
    if importlib.util.find_spec("mitsuba") is None:
        return "mitsuba is not installed"
    llvm = find_llvm()
    environment = os.environ | ({"DRJIT_LIBLLVM_PATH": llvm} if llvm else {})
    if subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True).returncode:
        return f"Dr.Jit has no use for the LLVM library {llvm or '(none found)'}"
    # Before Dr.Jit is imported.
    os.environ.update(environment)
    return ""
