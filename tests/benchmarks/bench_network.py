"""Seconds of the network's guess on a photo, from a fresh start of Python. One line of JSON.

    python tests/benchmarks/bench_network.py [PHOTO] [--smoke] [--runs 3]

``first_s``: weights loaded, photo guessed at, in a process that has done neither; ``imports_s``: what Python, torch and
the rest need before that; ``next_s``: the best of ``--runs`` more guesses. The goal is 2 s for ``first_s``.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photo", nargs="?", type=Path, default=ROOT / "samples" / "microscope.png")
    parser.add_argument("--smoke", action="store_true", help="one run")
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    begun = time.perf_counter()
    from usdfab.fit.network.network_file import load_network
    from usdfab.fit.network.predict import predict
    from usdfab.fit.photo_input import load_photo

    imports = time.perf_counter() - begun
    photo = load_photo(arguments.photo).pixels
    seconds = []
    for _ in range(1 + (1 if arguments.smoke else arguments.runs)):
        begun = time.perf_counter()
        predict(photo, load_network())
        seconds.append(round(time.perf_counter() - begun, 3))
    told = {
        "bench": "network", "pixels": photo.shape[:2], "load": round(os.getloadavg()[0], 1),
        "imports_s": round(imports, 3), "first_s": seconds[0], "next_s": min(seconds[1:]),
    }  # fmt: skip
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
