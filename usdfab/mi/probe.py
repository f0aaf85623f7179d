"""What runs in a process of its own to see whether a library serves Dr.Jit, because an unfit one ends the process.

    python -m usdfab.mi.probe llvm LIBRARY [PRELOAD ...]
    python -m usdfab.mi.probe cuda

One JSON object per step on stdout, so that whoever started this knows how far it came.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import sys
from collections.abc import Sequence
from typing import Any


def say(**facts: Any) -> None:
    """One step done."""
    print(json.dumps(facts), flush=True)


def llvm_version(library: ctypes.CDLL) -> str | None:
    """``"19.1.7"``; "15 or older" for those that cannot tell; None for a library that is no LLVM."""
    if not hasattr(library, "LLVMContextCreate"):
        return None
    if not hasattr(library, "LLVMGetVersion"):  # new in LLVM 16
        return "15 or older"
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*(ctypes.byref(n) for n in numbers))
    return ".".join(str(n.value) for n in numbers)


def kernel_error(floats: Any) -> float:
    """Greatest error of a kernel with the operations of fiber scattering, in the arrays of a Dr.Jit backend.

    ``floats`` is the backend's Float. Minima and maxima are what LLVM 15 cannot translate on some processors.
    """
    import drjit as dr

    count = 33
    x = dr.linspace(floats, -1.5, 1.5, count)
    y = dr.exp(-dr.square(dr.maximum(x, -1.0))) + dr.log(2.0 + dr.minimum(x, 0.5)) + dr.atan2(x, 2.0)
    y = dr.select(y > 0.5, dr.sqrt(dr.abs(y)), dr.fma(x, y, dr.sin(x) * dr.cos(x)))
    error = 0.0
    for k, found in enumerate(y):
        u = -1.5 + 3.0 * k / (count - 1)
        v = math.exp(-(max(u, -1.0) ** 2)) + math.log(2.0 + min(u, 0.5)) + math.atan2(u, 2.0)
        v = math.sqrt(abs(v)) if v > 0.5 else u * v + math.sin(u) * math.cos(u)
        error = max(error, abs(float(found) - v))
    return error


def probe_llvm(path: str, preload: Sequence[str]) -> None:
    """Load the library as Dr.Jit would, then run a kernel with it."""
    for needed in preload:
        ctypes.CDLL(needed, mode=ctypes.RTLD_GLOBAL)
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        say(refused=f"cannot be loaded ({error})")
        return
    version = llvm_version(library)
    if version is None:
        say(refused="is no LLVM library")
        return
    say(version=version)
    if not version[0].isdigit() or version.startswith("15") or int(version.split(".")[0]) < 16:
        say(refused="LLVM 16 or newer is needed")
        return
    os.environ["DRJIT_LIBLLVM_PATH"] = path
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        say(refused="Dr.Jit does not take it")
        return
    from drjit.llvm.ad import Float

    _judge(kernel_error(Float))


def probe_cuda() -> None:
    """A kernel on the GPU, then one ray, for which Mitsuba needs OptiX."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.CUDA):
        say(refused="Dr.Jit finds no usable CUDA driver")
        return
    say(version="cuda")
    from drjit.cuda.ad import Float

    error = kernel_error(Float)
    if not error < 1e-5:
        _judge(error)
        return
    say(step="optix")
    import mitsuba as mi

    mi.set_variant("cuda_ad_rgb")
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 3), mi.Vector3f(0, 0, -1)))
    _judge(abs(float(hit.t[0]) - 2.0))


def _judge(error: float) -> None:
    if error < 1e-5:
        say(fit=True)
    else:
        say(refused=f"computes wrong values (error {error:.2g})")


def main(arguments: Sequence[str]) -> None:
    """Probe what the arguments name."""
    if os.name == "posix":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # what fails here is expected to
    if arguments[0] == "cuda":
        probe_cuda()
    else:
        probe_llvm(arguments[1], arguments[2:])


if __name__ == "__main__":
    main(sys.argv[1:])
