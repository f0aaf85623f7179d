"""Seconds from starting ``usdfab render`` to the first progressive pass in a file, warm and cold.

    python tests/benchmarks/bench_first_image.py [--smoke] [--runs 5] [--stage samples/drape.usda] [--fabric F]

``--time 0`` ends the render after its first pass, one sample for each pixel, and writes the picture: seconds are those
of the whole process. Cold means that no compiled kernel is on disk (an empty NUMBA_CACHE_DIR). Medians. One line of
JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]


def first_image(arguments: list[str], folder: Path, cache: Path | None) -> float:
    """Seconds of a process that renders one pass; ``cache`` None: kernels where they always are."""
    command = [sys.executable, "-m", "usdfab.cli.main", "render", *arguments, "--time", "0", "--quiet", "--overwrite"]
    environment = {**os.environ, **({"NUMBA_CACHE_DIR": str(cache)} if cache else {})}
    start = time.perf_counter()
    subprocess.run([*command, "-o", str(folder / "first.png")], check=True, env=environment, timeout=1800)
    return time.perf_counter() - start


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
            row["cold_s"] = first_image(render, folder, cache)
        row["warm_s"] = statistics.median(first_image(render, folder, cache) for _ in range(runs))
    row["goals"] = {"cold_s": 5.0, "warm_s": 2.0}
    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
