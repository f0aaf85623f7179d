"""The neural material's speed: answers, frames and their parts, and the surface model at equal error. One JSON line.

    python tests/benchmarks/bench_neural.py [--smoke] [--threads N] [--stage samples/drape.usda] [--fabric F]
        [--reflection-weights W] [--transmission-weights W]

Times are of the processor (all threads together), so that other programs on the machine count little; frames a second
are also given by the clock. ``cores``: frames a second if all threads had a core of their own.

Equal error: for each of some materials of Table 2 (Chen et al. 2024) that no data set holds, the mean absolute error of
the network against the surface model with many samples; then the fewest samples (a power of two) with which the surface
model itself is as near, and how long both take for the same queries, in the same run. Footprints are of both halves of
Table 2. ``paper`` is the paper's decoder, untrained: its speed only.
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


def best_of(runs: int, call: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Seconds of the fastest of some calls, after one that compiles."""
    call()
    seconds = []
    for _ in range(runs):
        start = clock()
        call()
        seconds.append(clock() - start)
    return min(seconds)


def decoding(networks: dict, smoke: bool) -> dict:
    """Milliseconds per million answers of each decoder on one thread."""
    from usdfab.neural.dataset_draws import DatasetSettings, draw_material, draw_queries
    from usdfab.neural.decoder import plans_of
    from usdfab.neural.training import new_network

    count = 2**14 if smoke else 2**18
    settings = DatasetSettings(queries=count, seed=UNKNOWN_SEED)
    material, queries = draw_material(settings, 0), draw_queries(settings, 0, "reflection")
    columns, order = np.asarray(queries, dtype=np.float32).T.ravel(), np.arange(count, dtype=np.int32)
    out, found = np.empty((count, 4), dtype=np.float32), {}
    for name, network in (("lean", networks["reflection"].network), ("paper", new_network("paper", "reflection"))):
        plan = plans_of(network.eval(), [material])[0]
        seconds = best_of(1 if smoke else 7, lambda plan=plan: plan.decode_columns(columns, count, order, out))
        found[name] = {
            "multiplications": plan.multiplications, "ms_per_million": round(1e9 * seconds / count, 1),
        }  # fmt: skip
    encoder = networks["reflection"].network
    found["encoder_ms"] = round(1e3 * best_of(1 if smoke else 5, lambda: plans_of(encoder, [material])), 2)
    return found


def equal_error(networks: dict, smoke: bool) -> dict:
    """How many times faster than the surface model that is as near to the truth."""
    from usdfab.neural.aggregation import aggregate
    from usdfab.neural.dataset_draws import DatasetSettings, draw_material, draw_queries
    from usdfab.neural.decoder import plans_of

    count, materials, truth = (200, 1, 256) if smoke else (4000, 7, 8192)
    settings = DatasetSettings(queries=count, seed=UNKNOWN_SEED)
    told = {}
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
        told[kind] = {
            "faster": round(statistics.median(ratios), 1), "faster_each": [round(r, 1) for r in ratios],
            "samples": needed, "error": [round(e, 4) for e in errors],
        }  # fmt: skip
    return told


def frames(networks: dict, arguments: argparse.Namespace, threads: int) -> dict:
    """Frames a second of cloth that fills the picture and of a stage, and where their time goes."""
    from usdfab.fabric import preset
    from usdfab.neural.stage_scene import build
    from usdfab.usd.fabric_io import read_fabric
    from usdfab.usd.read_scene import read_scene
    from usdfab.usd.rig import swatch_scene
    from usdfab.usd.scene import DistantLight

    cloth = read_fabric(arguments.fabric) if arguments.fabric else preset("denim")
    size = (64, 36) if arguments.smoke else (1280, 720)
    swatch = swatch_scene(cloth)
    sun = DistantLight("/Sun", np.array([0.3, 0.2, -0.93]), np.full(3, 3.0), 0.0)
    other = DistantLight("/Other", np.array([-0.5, 0.2, -0.8]), np.full(3, 1.0), 0.0)
    camera = replace(swatch.cameras[0], tan_half=swatch.cameras[0].tan_half * np.array([1.0, 0.5625]))
    stage = read_scene(arguments.stage, fabric_override=cloth)
    worlds = {
        "filled_one_light": (replace(swatch, lights=(sun,)), camera),
        "filled_two_lights": (replace(swatch, lights=(sun, other)), camera),
        "stage_one_light": (replace(stage, lights=(sun,)), stage.cameras[0]),
        "stage": (stage, stage.cameras[0]),
    }
    return {
        name: _frame(build(scene, networks, {}), seen_by, size, threads, 1 if arguments.smoke else 5)
        for name, (scene, seen_by) in worlds.items()
    }


def _frame(ready, camera, size: tuple[int, int], threads: int, runs: int) -> dict:  # type: ignore[no-untyped-def]
    """One scene: milliseconds of the processor for a whole frame, for one whose pixels are known, for its parts."""
    from usdfab.neural.render import Buffer, render

    whole, kept = (ready, camera, size, (0, 0, *size), 1, threads), Buffer()
    found = render(*whole, buffer=kept)
    busy = best_of(runs, lambda: render(*whole))
    again = best_of(runs, lambda: render(*whole, buffer=kept))
    dark = replace(ready, lights=[])
    seen = best_of(runs, lambda: render(dark, *whole[1:]))
    wall = best_of(runs, lambda: render(*whole), time.perf_counter)
    cores = min(threads, os.cpu_count() or 1)
    return {
        "answers": found.decodes, "ms": round(1e3 * busy, 1), "ms_camera_rays": round(1e3 * seen, 1),
        "ms_light_and_answers": round(1e3 * again, 1), "fps_clock": round(1.0 / wall, 2),
        "fps_cores": round(cores / busy, 2), "fps_cores_known_pixels": round(cores / again, 2),
    }  # fmt: skip


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
    told = {
        "bench": "neural", "threads": threads, "decoder": decoding(networks, arguments.smoke),
        "equal_error": equal_error(networks, arguments.smoke), "frames": frames(networks, arguments, threads),
        "goals": {"fps": 10, "faster": 10}, "load": os.getloadavg()[0],
    }  # fmt: skip
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
