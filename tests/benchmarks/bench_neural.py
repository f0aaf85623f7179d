"""The neural material's speed: answers a second, against the surface model at equal error, and frames a second.

    python tests/benchmarks/bench_neural.py [--smoke] [--threads N] [--stage samples/drape.usda] [--fabric F]
        [--reflection-weights W] [--transmission-weights W]

Equal error: for each of some materials of Table 2 (Chen et al. 2024) that no data set holds, the mean absolute error of
the network against the surface model with many samples; then the fewest samples with which the surface model itself is
as near, and how long both take for the same queries on one thread, in the same run. Footprints are of both halves of
Table 2. ``paper`` is the paper's decoder, untrained: its speed only. One line of JSON per part.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
UNKNOWN_SEED = 4711
"""Of the materials: data sets are made with small seeds."""


def best_of(runs: int, call: Callable[[], object]) -> float:
    """Seconds of the fastest of some calls, after one that compiles."""
    call()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def tell(part: str, **row: object) -> None:
    """One line of JSON."""
    print(json.dumps({"bench": "neural", "part": part, **row, "load": os.getloadavg()[0]}), flush=True)


def decoding(networks: dict, threads: int, smoke: bool) -> None:
    """Answers a second of each decoder."""
    from usdfab.neural.dataset_draws import DatasetSettings, draw_material, draw_queries
    from usdfab.neural.decoder import plans_of
    from usdfab.neural.training import new_network

    count = 2**14 if smoke else 2**20
    settings = DatasetSettings(queries=count, seed=UNKNOWN_SEED)
    material, queries = draw_material(settings, 0), draw_queries(settings, 0, "reflection")
    for name, network in (("lean", networks["reflection"].network), ("paper", new_network("paper", "reflection"))):
        plan = plans_of(network.eval(), [material])[0]
        for used in sorted({1, threads}):
            seconds = best_of(1 if smoke else 5, lambda plan=plan, used=used: plan.decode(queries, used))
            tell(
                "decoder", decoder=name, threads=used, multiplications=plan.multiplications,
                millions_per_second=round(count / seconds / 1e6, 2),
                fps_1280x720=round(count / seconds / (1280 * 720), 2), goal_fps=10,
            )  # fmt: skip


def equal_error(networks: dict, smoke: bool) -> None:
    """How many times faster than the surface model that is as near to the truth."""
    from usdfab.neural.aggregation import aggregate
    from usdfab.neural.dataset_draws import DatasetSettings, draw_material, draw_queries
    from usdfab.neural.decoder import plans_of

    count, materials, truth = (200, 1, 256) if smoke else (4000, 7, 8192)
    settings = DatasetSettings(queries=count, seed=UNKNOWN_SEED)
    for kind, weights in networks.items():
        ratios, needed, errors = [], [], []
        for index in range(materials):
            material, queries = draw_material(settings, index), draw_queries(settings, index, kind)

            def surface(samples: int, material=material, queries=queries, kind=kind) -> np.ndarray:
                through = kind == "transmission"
                return aggregate(material, queries, transmission=through, samples=samples, seed=5, threads=1)

            true = surface(truth)
            plan = plans_of(weights.network, [material])[0]
            error = float(np.abs(plan.decode(queries) - true).mean())
            samples = 1
            while samples < truth // 4 and float(np.abs(surface(samples) - true).mean()) > error:
                samples *= 2
            # Seconds of as many queries as keep both clocks busy for a while.
            many = np.tile(queries, (1 if smoke else 50, 1))
            network_time = best_of(1 if smoke else 5, lambda plan=plan, many=many: plan.decode(many)) / len(many)
            surface_time = best_of(1 if smoke else 3, lambda: surface(samples)) / count  # noqa: B023
            ratios.append(surface_time / network_time)
            needed.append(samples)
            errors.append(error / float(true.mean()))
        tell(
            "equal error", kind=kind, materials=materials, faster=round(statistics.median(ratios), 2),
            faster_each=[round(r, 2) for r in ratios], samples=needed, error=[round(e, 4) for e in errors], goal=10,
        )  # fmt: skip


def frames(networks: dict, arguments: argparse.Namespace, threads: int) -> None:
    """Frames a second of a stage, and of cloth that fills the picture."""
    from usdfab.fabric import preset
    from usdfab.neural.render import render
    from usdfab.neural.stage_scene import build
    from usdfab.usd.fabric_io import read_fabric
    from usdfab.usd.read_scene import read_scene
    from usdfab.usd.rig import swatch_scene
    from usdfab.usd.scene import DistantLight

    cloth = read_fabric(arguments.fabric) if arguments.fabric else preset("denim")
    size = (64, 36) if arguments.smoke else (1280, 720)
    swatch = swatch_scene(cloth)
    sun = DistantLight("/Sun", np.array([0.3, 0.2, -0.93]), np.full(3, 3.0), 0.0)
    camera = replace(swatch.cameras[0], tan_half=swatch.cameras[0].tan_half * np.array([1.0, 0.5625]))
    worlds = {"cloth fills the picture, one light": (replace(swatch, lights=(sun,)), camera)}
    if not arguments.smoke:
        stage = read_scene(arguments.stage, fabric_override=cloth)
        worlds["stage"] = (stage, stage.cameras[0])
    for name, (scene, seen_by) in worlds.items():
        ready = build(scene, networks, {})
        seconds = best_of(
            1 if arguments.smoke else 3,
            lambda ready=ready, seen_by=seen_by: render(ready, seen_by, size, (0, 0, *size), 1, threads),
        )
        found = render(ready, seen_by, size, (0, 0, *size), 1, threads)
        tell(
            "frames", scene=name, width=size[0], height=size[1], threads=threads, fps=round(1.0 / seconds, 3),
            answers_per_frame=found.decodes, goal_fps=10,
        )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--threads", type=int, help="all by default")
    parser.add_argument("--stage", default=str(ROOT / "samples" / "drape.usda"))
    parser.add_argument("--fabric", help="fabric file to put on the stage's cloth")
    parser.add_argument("--reflection-weights", type=Path)
    parser.add_argument("--transmission-weights", type=Path)
    arguments = parser.parse_args()

    from usdfab.cli.render_neural import load_networks
    from usdfab.tracer.render import thread_count

    networks = load_networks(
        {"reflection": arguments.reflection_weights, "transmission": arguments.transmission_weights}
    )
    threads = thread_count(arguments.threads)
    decoding(networks, threads, arguments.smoke)
    equal_error(networks, arguments.smoke)
    frames(networks, arguments, threads)


if __name__ == "__main__":
    main()
