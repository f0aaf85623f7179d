"""From parameters to a ready patch: seconds and bytes, beside the storage that Li et al. 2024 report.

    python tests/benchmarks/bench_build.py [--smoke] [--weaves plain,twill,satin] [--runs 5]

``patch`` is one repeat of the weave, ``tiles`` all variants of the fabric's tile, as the tracer uses them. ``fibers``
are vertices, indices and records; ``hierarchy`` is what Embree asks its device for while it builds, less what it gives
back (its own memory monitor). Seconds are medians. One line of JSON for each weave.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from bench_patch import sample

from usdfab.fabric import FabricParameters
from usdfab.fibers import generate_patch
from usdfab.tracer import embree
from usdfab.tracer.patch_scene import PatchScene, build_patch_scene, build_tiles

PAPER_MB = {"plain": 0.74 + 1.0, "twill": 1.54 + 1.5, "satin": 4.26 + 2.5}
"""Fibers and hierarchy of a patch (Li et al. 2024, section 6)."""


class MemoryMonitor:
    """Counts the bytes that this process's Embree device holds, hierarchies for the most part; not shared buffers."""

    def __init__(self) -> None:
        self.held = 0
        kind = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_bool)
        self._callback = kind(self._count)
        function = embree.library().rtcSetDeviceMemoryMonitorFunction
        function.restype, function.argtypes = None, [ctypes.c_void_p, kind, ctypes.c_void_p]
        function(embree.device(), self._callback, None)

    def _count(self, _user: object, change: int, _post: bool) -> bool:
        self.held += change
        return True


def measure(build: Callable[[], list[PatchScene]], monitor: MemoryMonitor, runs: int) -> dict:
    """Seconds and bytes of what ``build`` makes."""
    seconds = []
    for _ in range(runs):
        before, start = monitor.held, time.perf_counter()
        scenes = build()
        seconds.append(time.perf_counter() - start)
        hierarchy = monitor.held - before
        fibers, segments = sum(s.nbytes for s in scenes), sum(len(s.segments) for s in scenes)
        del scenes
    return {
        "s": statistics.median(seconds), "fibers_mb": fibers / 1e6, "hierarchy_mb": hierarchy / 1e6,
        "mb": (fibers + hierarchy) / 1e6, "segments": segments,
    }  # fmt: skip


def bench(weave: str, fabric: FabricParameters, monitor: MemoryMonitor, runs: int) -> dict:
    """The line of one weave."""
    start = time.perf_counter()
    generated = generate_patch(fabric)
    generate = time.perf_counter() - start
    patch = measure(lambda: [build_patch_scene(fabric, generate_patch(fabric))], monitor, runs)
    return {
        "bench": "build", "weave": weave, "runs": runs, "load": os.getloadavg()[0],
        "control_points": sum(len(s.points) for s in generated.systems), "first_generate_s": generate, "patch": patch,
        "paper_mb": PAPER_MB[weave], "ratio": patch["mb"] / PAPER_MB[weave],
        "tiles": {"variants": fabric.variants} | measure(lambda: build_tiles(fabric), monitor, runs),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--weaves", default="plain,twill,satin")
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    fibers, runs = (8, 1) if arguments.smoke else (200, arguments.runs)
    monitor = MemoryMonitor()
    for weave in arguments.weaves.split(","):
        print(json.dumps(bench(weave, sample(weave, fibers), monitor, runs)), flush=True)


if __name__ == "__main__":
    main()
