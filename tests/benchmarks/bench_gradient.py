"""Seconds to equal variance of gradients by the optics: our forward mode beside path replay in Mitsuba, in turn.

    python tests/benchmarks/bench_gradient.py [--quick] [--cases narrow,rough] [--size 128] [--spp 16] [--runs 8]

The adjoint is that of a squared loss against a picture with other optics, the same for all. A gradient is taken with
several seeds; its variance times the seconds it takes is what counts: halving it halves the time to the same noise.
Parameters are made comparable by their logarithms: derivatives are multiplied by the parameter. Each renderer has its
own process, since a second large scene in one process is known to crash Mitsuba. Scenes are built and kernels compiled
before the clock runs.

One line of JSON for each case and renderer (ours; ours with a fading drift, ``keep``; Mitsuba where it is installed):

    primal_s, gradient_s    least seconds of a picture and of a gradient of the same samples
    primal_s_per_M, gradient_s_per_M, gradient_to_primal
                            the same per million paths, and their ratio
    costs                   gradient_s times variance, for each parameter
    cost                    their sums over all albedos, roughnesses and indices

then one with the ratios of costs to ours, overall (geometric mean over parameters) and by group, and how far the mean
gradients are apart in standard errors.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))

import scenes

CASES = {
    "narrow": {"roughness_longitudinal": 0.5, "roughness_azimuthal": 0.05, "roughness_primary": 0.12},
    "satin": {"roughness_longitudinal": 0.4, "roughness_azimuthal": 0.05, "roughness_primary": 0.12},
    "twill": {"roughness_longitudinal": 0.5, "roughness_azimuthal": 0.15, "roughness_primary": 0.12},
    "rough": {"roughness_longitudinal": 0.6, "roughness_azimuthal": 0.5, "roughness_primary": 0.6},
}
WEAVES = {"satin": "satin 5/2", "twill": "twill 2/2"}
DEPTH = 64
KEEP = 0.7
GROUPS = ("albedo", "roughness", "ior")
RENDERERS = ("ours", "keep", "mitsuba")


def make(name: str, scene, camera, size: tuple[int, int]):
    """A renderer with ``optics``, ``render`` and ``gradient``."""
    if name == "mitsuba":
        from usdfab.mi.differentiable import DifferentiableRenderer

        return DifferentiableRenderer(scene, camera, size, max_depth=DEPTH)
    from usdfab.tracer.differentiable import DifferentiableTracer

    return DifferentiableTracer(scene, camera, size, max_depth=DEPTH, keep=KEEP if name == "keep" else 1.0)


def measure(name: str, case: str, side: int, spp: int, runs: int, fibers: int) -> dict:
    """Times and variances of one renderer, in this process."""
    from usdfab.tracer.differentiable import DifferentiableTracer

    cloth = scenes.fabric(WEAVES.get(case, "plain"), fibers=fibers, **CASES[case])
    scene, camera = scenes.swatch(cloth)
    reference = DifferentiableTracer(scene, camera, (side, side), max_depth=DEPTH)
    vector = reference.optics.vector()
    target = reference.render(vector * np.where(np.arange(len(vector)) < len(vector) - 2, 0.85, 1.0), 16, 1001)
    adjoint = 2.0 / target.size * (reference.render(vector, 16, 1000) - target)
    renderer = make(name, scene, camera, (side, side))

    def timed(function) -> tuple[float, list]:
        function(10**6)  # compiles
        seconds, results = [], []
        for seed in range(runs):
            start = time.perf_counter()
            results.append(function(seed))
            seconds.append(time.perf_counter() - start)
        return min(seconds), results

    primal_s, _ = timed(lambda seed: renderer.render(renderer.optics, spp, seed))
    gradient_s, rows = timed(lambda seed: renderer.gradient(renderer.optics, adjoint, spp, seed))
    gradients = np.array(rows) * vector
    variance = gradients.var(axis=0, ddof=1)
    paths = 1e-6 * side * side * spp
    names = renderer.optics.names()
    return {
        "case": case, "renderer": name, "side": side, "spp": spp, "runs": runs, "depth": DEPTH,
        "load": round(os.getloadavg()[0], 1), "cores": os.cpu_count(),
        "primal_s": primal_s, "gradient_s": gradient_s,
        "primal_s_per_M": primal_s / paths, "gradient_s_per_M": gradient_s / paths,
        "gradient_to_primal": gradient_s / primal_s,
        "cost": {key: gradient_s * float(variance[[key in n for n in names]].sum()) for key in GROUPS},
        "costs": dict(zip(names, (gradient_s * variance).tolist(), strict=True)),
        "mean": gradients.mean(axis=0).tolist(),
        "error": np.sqrt(variance / runs).tolist(),
    }  # fmt: skip


def compare(case: str, results: dict[str, dict]) -> dict:
    """Ratios of costs to ours; below 1: cheaper than ours."""
    ours = results["ours"]
    line: dict = {"case": case}
    for name, other in results.items():
        if name == "ours":
            continue
        difference = np.subtract(other["mean"], ours["mean"]) / np.hypot(other["error"], ours["error"])
        line[f"{name}/ours"] = {
            "overall": float(
                np.exp(np.mean([np.log(other["costs"][key] / ours["costs"][key]) for key in ours["costs"]]))
            ),
            **{key: other["cost"][key] / ours["cost"][key] for key in GROUPS},
            "most_errors_apart": float(np.abs(difference).max()),
        }
    return line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--smoke", "--quick", dest="quick", action="store_true", help="a few seconds once compiled, to see that it runs"
    )
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--renderers", default=",".join(RENDERERS))
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--fibers", type=int, default=60)
    parser.add_argument("--only", action="store_true", help="one case and renderer, in this process")
    a = parser.parse_args()
    cases, renderers = a.cases.split(","), a.renderers.split(",")
    if a.quick:
        cases, renderers = cases[:1], [r for r in renderers if r != "mitsuba"]
        a.size, a.spp, a.runs, a.fibers = 16, 2, 3, 4
    if a.only:
        print(json.dumps(measure(renderers[0], cases[0], a.size, a.spp, a.runs, a.fibers)))
        return
    if "mitsuba" in renderers and not (
        importlib.util.find_spec("mitsuba") and importlib.util.find_spec("usdfab.mi.differentiable")
    ):
        renderers.remove("mitsuba")
    for case in cases:
        results = {}
        for name in renderers:
            command = [sys.executable, __file__, "--only", "--cases", case, "--renderers", name, "--size", str(a.size)]
            command += ["--spp", str(a.spp), "--runs", str(a.runs), "--fibers", str(a.fibers)]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            results[name] = json.loads(done.stdout.splitlines()[-1])
            print(json.dumps(results[name]), flush=True)
        if "ours" in results and len(results) > 1:
            print(json.dumps(compare(case, results)), flush=True)


if __name__ == "__main__":
    main()
