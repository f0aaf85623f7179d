"""Speed of the surface model's aggregation: samples a second on one thread, and the time to tabulate a tile's horizons.

    python tests/benchmarks/bench_aggregation.py [--smoke] [--queries 2000] [--samples 512]

Queries as in ``usdfab dataset neural``, the middle of Table 2 of Chen et al. 2024 as the material. CPU seconds of this
process, so that other load matters little; kernels are compiled before. One line of JSON for each weave and kind.
"""

from __future__ import annotations

import argparse
import json
import math
import time

from usdfab.fabric.weave import weave_from_name
from usdfab.neural.aggregation import aggregate
from usdfab.neural.dataset_draws import PAPER_WEAVES, DatasetSettings, draw_queries
from usdfab.neural.surface_material import SurfaceMaterial, weave_of


def material(weave: str, inclination: float) -> SurfaceMaterial:
    """Inclination in degrees; another one needs horizons of its own."""
    u = math.radians(inclination)
    return SurfaceMaterial(weave_of(weave_from_name(weave)), (0.5, 0.0), (u, u), 0.5, 1.0, name=weave)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--smoke", action="store_true", help="one small weave, to see that it runs")
    parser.add_argument("--queries", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=512)
    arguments = parser.parse_args()
    queries, samples = (20, 16) if arguments.smoke else (arguments.queries, arguments.samples)
    settings = DatasetSettings("both", queries=queries, samples=samples)
    aggregate(material("plain", 29.0), draw_queries(settings, 0, "reflection")[:2], samples=1)
    for weave in PAPER_WEAVES[:1] if arguments.smoke else PAPER_WEAVES:
        begun = time.process_time()
        aggregate(material(weave, 30.0), draw_queries(settings, 0, "reflection")[:1], samples=1, threads=1)
        horizons = time.process_time() - begun
        for kind in settings.kinds:
            rows = draw_queries(settings, 0, kind)
            begun = time.process_time()
            aggregate(material(weave, 30.0), rows, transmission=kind == "transmission", samples=samples, threads=1)
            seconds = time.process_time() - begun
            print(
                json.dumps(
                    {
                        "weave": weave, "kind": kind, "samples_per_cpu_second": round(queries * samples / seconds),
                        "horizons_cpu_seconds": round(horizons, 3), "queries": queries, "samples": samples,
                    }
                )
            )  # fmt: skip


if __name__ == "__main__":
    main()
