"""A square metre of twill on a draped mesh beside a square centimetre of it: samples per second and peak memory.

    python tests/benchmarks/bench_cloth.py [--smoke] [--spp 2] [--threads N]

Both fill the picture alike: the same folds, triangles, lights and settings, a hundred times smaller. Each runs in a
process of its own, after one that only sees to it that kernels are compiled, so that peak memory (``getrusage``) is
what rendering takes. ``explicit_vertices`` is how many vertices the fibers would have if they were all stored. One line
of JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))
sys.path.insert(0, str(Path(__file__).parent))

import scenes
from bench_patch import sample

from usdfab.fibers import PATH_TRACING_VERTICES
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import Camera, DistantLight, Scene

QUADS = 100
"""Quads on each side of the mesh."""
SIDES_M = {"cloth": 1.0, "sample": 0.01}
MEGABYTE = 2**20


def draped(side: float, fibers: int) -> tuple[Scene, Camera]:
    """Twill of ``side`` metres with folds, seen from above at a slant; texture coordinates in metres."""

    def point(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        folds = 0.03 * np.sin(7.0 * a + 2.0 * b) + 0.02 * np.sin(11.0 * b - 4.0 * a + 1.0)
        return side * np.stack([a - 0.5, b - 0.5, folds - 0.3 * ((a - 0.5) ** 2 + (b - 0.5) ** 2)], axis=-1)

    mesh = scenes.sheet(point, lambda a, b: side * np.stack([a, b], axis=-1), QUADS, QUADS)
    sun = DistantLight("/Sun", np.array([0.36, 0.48, -0.8]), np.full(3, 2.0), math.radians(1.0))
    cloth = sample("twill", fibers)
    camera = scenes.look(side * np.array([0.0, -0.8, 1.1]), (0.0, 0.0, 0.0), (0.42, 0.42 * 720 / 1280))
    return scenes.scene([mesh], [scenes.cloth_material()], [scenes.dome(0.5), sun], [cloth]), camera


def explicit_vertices(side: float, fibers: int) -> float:
    """Vertices of the fibers on a square of ``side`` metres, as Li et al. 2024 store them."""
    fabric = sample("twill", fibers)
    total = 0.0
    for system, cell in (("warp", fabric.cell[1]), ("weft", fabric.cell[0])):
        yarn = fabric.system(system)
        face = fabric.weave.matrix if system == "weft" else 1 - fabric.weave.matrix.T
        segments_per_cell = float(np.mean(face != np.roll(face, 1, axis=1)))
        yarns = side * yarn.count / fabric.size[0 if system == "warp" else 1]
        total += yarns * fibers * side / cell * segments_per_cell * PATH_TRACING_VERTICES
    return total


def peak_mb() -> float:
    """Peak memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (MEGABYTE if sys.platform == "darwin" else 1024)


def render(side: float, fibers: int, size: tuple[int, int], spp: int, threads: int | None) -> dict:
    """One render, in this process."""
    scene, camera = draped(side, fibers)
    tracer = Tracer(scene)
    tracer.render(camera, RenderSettings((8, 8), 1))
    before = peak_mb()
    picture = tracer.render(camera, RenderSettings(size, spp, threads=threads))
    samples = float(picture.samples.sum())
    return {
        "side_m": side, "samples_per_s": samples / picture.seconds, "rays_per_s": picture.rays / picture.seconds,
        "s": picture.seconds, "covered": float(picture.alpha.mean()), "peak_mb": peak_mb(), "peak_before_mb": before,
        "triangles": len(scene.meshes[0].triangles), "segments": tracer.segments,
        "explicit_vertices": explicit_vertices(side, fibers),
    }  # fmt: skip


def in_a_process(*arguments: object) -> dict:
    """``render`` in a fresh interpreter, so that its peak memory is its own."""
    command = [sys.executable, __file__, "--child", json.dumps(arguments)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=3600).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--spp", type=int, default=2)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(render(*json.loads(arguments.child))))
        return
    size, fibers = ((64, 36), 8) if arguments.smoke else ((1280, 720), 200)
    in_a_process(SIDES_M["sample"], 8, (8, 8), 1, 1)
    row: dict = {"bench": "cloth", "size": size, "spp": arguments.spp, "load": os.getloadavg()[0]}
    for name, side in SIDES_M.items():
        row[name] = in_a_process(side, fibers, size, arguments.spp, arguments.threads)
    row["memory_ratio"] = row["cloth"]["peak_mb"] / row["sample"]["peak_mb"]
    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
