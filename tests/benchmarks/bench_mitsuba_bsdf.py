"""The fiber plugin beside Mitsuba's own `hair`: the same curves, camera, lamp and depth, in one run, in turn.

    python tests/benchmarks/bench_mitsuba_bsdf.py [--smoke]

Each renderer has its own process, since a second large scene in one process is known to crash Mitsuba. Prints one line
of JSON: for each BSDF the seconds to the first picture (which compiles), the least and the mean seconds of later
pictures, the least and the mean seconds of a picture with its gradient (`prb`, all parameters of the one material), the
brightness; then the ratios plugin / hair.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))

import mitsuba_scene
import scenes
from bench_tracer import AROUND, DEPTH, find_llvm

from usdfab.fibers import generate_patch
from usdfab.tracer.patch_scene import tile_copies

PARAMETERS = {
    "hair": ("sigma_a.value", "longitudinal_roughness", "azimuthal_roughness", "eta"),
    "usdfab_fiber": ("albedo", "gamma_m", "gamma_n", "gamma_m0", "eta"),
}
"""What is differentiated, of each BSDF."""


def description(mi, cloth, side: int, plugin: str, folder: Path) -> dict:
    """Scene dictionary of the swatch with the one BSDF or the other."""
    scene, camera = scenes.swatch(cloth, zoom=0.2)
    patch = generate_patch(cloth, copies=tile_copies(cloth))
    center = np.mod(np.asarray(cloth.size) / 2, patch.size)
    files = mitsuba_scene.curves_text(patch, AROUND, center, folder)
    result = mitsuba_scene.mitsuba_dict(mi, cloth, files, camera, list(scene.lights), (side, side), DEPTH)
    if plugin == "hair":
        return result
    from usdfab.mi.fiber_bsdf import register_fiber_bsdf

    register_fiber_bsdf()
    for name in files:
        yarn = cloth.system(name)
        result[name]["bsdf"] = {
            "type": plugin,
            "albedo": {"type": "rgb", "value": list(yarn.albedo)},
            "gamma_m": yarn.roughness_longitudinal,
            "gamma_n": yarn.roughness_azimuthal,
            "gamma_m0": yarn.roughness_primary,
            "eta": yarn.ior,
        }
    return result


def measure(plugin: str, side: int, spp: int, runs: int, fibers: int, variant: str) -> dict[str, float]:
    """Times of one BSDF, in this process."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    dr.set_log_level(dr.LogLevel.Error)
    cloth = scenes.fabric(fibers=fibers)
    with tempfile.TemporaryDirectory() as folder:
        scene = mi.load_dict(description(mi, cloth, side, plugin, Path(folder)), parallel=False)
    dr.sync_thread()

    def timed(function) -> list[float]:
        seconds = []
        for k in range(runs + 1):
            start = time.perf_counter()
            function(k)
            dr.sync_thread()
            seconds.append(time.perf_counter() - start)
        return seconds

    means = []
    primal = timed(lambda k: means.append(float(np.mean(np.array(mi.render(scene, spp=spp, seed=k))))))

    prb = mi.load_dict({"type": "prb", "max_depth": DEPTH, "rr_depth": 5})
    params = mi.traverse(scene)
    # Warp and weft are alike here, and Mitsuba makes one object of equal ones, found under the first name.
    keys = [f"warp.bsdf.{name}" for name in PARAMETERS[plugin]]

    def gradient(k: int) -> None:
        for key in keys:
            params[key] = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=prb, spp=spp, seed=k), axis=None))
        dr.eval([dr.grad(params[key]) for key in keys])

    both = timed(gradient)
    return {
        "first_s": primal[0],
        "least_s": min(primal[1:]),
        "mean_s": float(np.mean(primal[1:])),
        "gradient_first_s": both[0],
        "gradient_least_s": min(both[1:]),
        "gradient_mean_s": float(np.mean(both[1:])),
        "brightness": float(np.mean(means)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba's variant")
    parser.add_argument("--only", choices=PARAMETERS, help="one BSDF, in this process")
    arguments = parser.parse_args()
    side, spp, runs, fibers = (16, 1, 1, 4) if arguments.smoke else (128, 16, 3, 100)
    if arguments.only:
        print(json.dumps(measure(arguments.only, side, spp, runs, fibers, arguments.variant)))
        return

    llvm = find_llvm()
    if arguments.variant.startswith("llvm") and not llvm:
        sys.exit("no LLVM library: pip install karellen-llvm-core, or set DRJIT_LIBLLVM_PATH")
    results: dict = {"side": side, "spp": spp, "depth": DEPTH, "variant": arguments.variant}
    results["load"], results["cores"] = round(os.getloadavg()[0], 1), os.cpu_count()
    for plugin in PARAMETERS:
        command = [sys.executable, __file__, "--only", plugin, "--variant", arguments.variant]
        command += ["--smoke"] * arguments.smoke
        with tempfile.TemporaryDirectory() as home:  # where Dr.Jit keeps compiled kernels
            environment = os.environ | {"HOME": home} | ({"DRJIT_LIBLLVM_PATH": llvm} if llvm else {})
            done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        results[plugin] = json.loads(done.stdout.splitlines()[-1])
    ours, hair = results["usdfab_fiber"], results["hair"]
    results["ratio"] = {key: ours[key] / hair[key] for key in hair}
    print(json.dumps(results))


if __name__ == "__main__":
    main()
