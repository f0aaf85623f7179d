"""Seconds from starting ``usdfab render`` to the first progressive pass in a file, warm and cold.

    python tests/benchmarks/bench_first_image.py [--smoke] [--runs 5] [--stage samples/drape.usda] [--fabric F]

``--time 0`` ends the render after its first pass, one sample for each pixel, and writes the picture: seconds are those
of the whole process. Cold means that no compiled kernel is on disk (an empty NUMBA_CACHE_DIR): ``cold_preview_s`` is
when the preview is there that is shown while they are compiled, ``cold_s`` when the first pass is. ``cpu_s`` are
processor seconds, for machines that do other work too. Medians. One line of JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


class Seconds(NamedTuple):
    """Of one process: until a preview is there (None: there was none), until it ends, and of processors, both."""

    preview: float | None
    preview_cpu: float | None
    all: float
    cpu: float


def first_image(arguments: list[str], folder: Path, cache: Path | None) -> Seconds:
    """A process that renders one pass; ``cache`` None: kernels where they always are."""
    command = [sys.executable, "-m", "usdfab.cli.main", "render", *arguments, "--time", "0", "--quiet", "--overwrite"]
    environment = {**os.environ, **({"NUMBA_CACHE_DIR": str(cache)} if cache else {})}
    preview = preview_cpu = None
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    with subprocess.Popen([*command, "-o", str(folder / "first.png")], env=environment) as process:
        while process.poll() is None:
            if preview is None and (folder / "first.preview.png").exists():
                preview, preview_cpu = time.perf_counter() - start, cpu_of(process.pid)
            time.sleep(0.005)
    seconds = time.perf_counter() - start
    if process.returncode:
        raise SystemExit(f"the render ended with {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Seconds(preview, preview_cpu, seconds, cpu)


def cpu_of(process: int) -> float | None:
    """Processor seconds of a running process, where /proc tells."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="kernels stay in the usual cache, and a small picture")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--stage", default=str(ROOT / "samples" / "drape.usda"))
    parser.add_argument("--fabric", help="fabric file to put on the stage's cloth")
    arguments = parser.parse_args()
    render = [arguments.stage, *(["--fabric", arguments.fabric] if arguments.fabric else [])]
    row: dict = {"bench": "first_image", "load": os.getloadavg()[0], "cores": os.cpu_count()}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        cache: Path | None = folder / "kernels"
        runs = arguments.runs
        if arguments.smoke:
            cache, runs, render = None, 1, [*render, "--resolution", "32"]
        else:
            cold = first_image(render, folder, cache)
            row |= {"cold_preview_s": cold.preview, "cold_preview_cpu_s": cold.preview_cpu}
            row |= {"cold_s": cold.all, "cold_cpu_s": cold.cpu}
        warm = [first_image(render, folder, cache) for _ in range(runs)]
        row["warm_s"] = statistics.median(w.all for w in warm)
        row["warm_cpu_s"] = statistics.median(w.cpu for w in warm)
    row["goals"] = {"cold_s": 5.0, "warm_s": 2.0}
    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
