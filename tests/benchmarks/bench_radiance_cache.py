"""Pictures whose paths end at a radiance cache beside whole paths, as the match stage makes them. One JSON line.

    python tests/benchmarks/bench_radiance_cache.py [--smoke] [--fabrics linen denim silk-satin]

For each preset under the capture rig: ``seconds`` of a picture by whole paths and with the cache, what it learns
included; ``relmse`` of both against a picture of many whole paths (mean over pixels of the squared error over the
squared reference + 0.01), so that noise and what the cache gets wrong both count; ``ratio`` of relMSE times seconds,
cache over whole: below 1 the cache pays; ``brightness`` of the cached picture, means over draws, over the reference.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--fabrics", nargs="+", default=["linen", "denim", "silk-satin"], help="presets")
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()

    from usdfab.fabric import preset
    from usdfab.tracer import RenderSettings, Tracer
    from usdfab.tracer.cached_tracer import CachedTracer
    from usdfab.tracer.render import thread_count
    from usdfab.usd.rig import swatch_scene

    threads = thread_count(arguments.threads)
    side, many, draws = (16, 4, 1) if arguments.smoke else (96, 512, 4)
    names = arguments.fabrics[:1] if arguments.smoke else arguments.fabrics
    rows = []
    for name in names:
        scene = swatch_scene(preset(name))
        camera = replace(scene.cameras[0], tan_half=0.5 * scene.cameras[0].tan_half)
        tracer = Tracer(scene)
        truth = tracer.render(camera, RenderSettings((side, side), spp=many, seed=9, threads=threads)).pixels
        seconds: dict[str, list[float]] = {"whole": [], "cached": []}
        found: dict[str, list[np.ndarray]] = {"whole": [], "cached": []}
        for seed in range(draws + 1):
            small = RenderSettings((side // 2, side // 2), spp=4, seed=1000 + seed, threads=threads)
            for kind, spp in (("whole", 4), ("cached", 8)):
                begun = time.perf_counter()
                by = tracer if kind == "whole" else CachedTracer(tracer, camera, small)
                picture = by.render(camera, RenderSettings((side, side), spp=spp, seed=seed, threads=threads)).pixels
                if seed:  # the first compiles
                    seconds[kind].append(time.perf_counter() - begun)
                    found[kind].append(picture)
        error = {
            kind: float(np.mean([((p - truth) ** 2 / (truth**2 + 0.01)).mean() for p in pictures]))
            for kind, pictures in found.items()
        }
        mean = {kind: float(np.mean(s)) for kind, s in seconds.items()}
        rows.append({
            "fabric": name,
            "seconds": [round(mean[k], 3) for k in ("whole", "cached")],
            "relmse": [round(error[k], 4) for k in ("whole", "cached")],
            "ratio": round(error["cached"] * mean["cached"] / (error["whole"] * mean["whole"]), 3),
            "brightness": round(float(np.mean(found["cached"]) / truth.mean()), 4),
        })  # fmt: skip
    print(json.dumps({"threads": threads, "side": side, "draws": draws, "fabrics": rows}))


if __name__ == "__main__":
    main()
