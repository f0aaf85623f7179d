"""One iteration of stage 3 beside Mitsuba's: a picture and the gradient of a loss of it, on the same curves.

    python tests/benchmarks/bench_differentiable.py [--quick | --smoke] [--pixels N ...] [--spp PRIMAL/GRADIENT ...]

Ours: `usdfab.mi.differentiable` with our fiber BSDF, a parameter vector of two yarn systems. Theirs: Mitsuba's `prb`
with its `hair` and its parameters, by ``mi.render`` with ``spp_grad``, in passes where a picture is too much for one
(as ours). The loss is the mean squared difference to 0.2, rebuilt from each iteration's picture; every iteration has
other seeds and other parameters. Each renderer has its own process, since a second large scene in one process is known
to crash Mitsuba.

One line of JSON for each case: for each renderer the seconds of the first iteration (which compiles), the least and
the mean seconds of later ones, the least seconds of all cores together (which other programs on the machine hardly
change), the kernels that later iterations compiled (0), and the brightness; then the ratios ours / theirs.
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

import scenes

DEPTH = 64
TARGET = 0.2
MARGIN = 4.0
PATHS = 2**20
"""Most paths in a pass of Mitsuba's."""

CASES = [(128, "16/16"), (128, "128/32"), (256, "16/16"), (256, "64/64"), (720, "16/16"), (128, "1024/256")]
QUICK = [(128, "16/16")]
SMOKE = [(8, "2/2")]


def ours(cloth, scene, camera, side: int, spp: tuple[int, int], variant: str):
    """A function iteration -> (image, gradient of the parameters shared with Mitsuba's hair)."""
    from usdfab.mi.differentiable import DifferentiableRenderer

    renderer = DifferentiableRenderer(scene, camera, (side, side), max_depth=DEPTH, device=variant, margin=MARGIN)
    start = renderer.optics.vector()

    def iterate(k: int):
        vector = start * (1.0 - 1e-3 * (k % 2))
        image = renderer.render(vector, spp[0], 2 * k)
        return image, renderer.gradient(vector, 2.0 * (image - TARGET) / image.size, spp[1], 2 * k + 1)

    return iterate


def theirs(cloth, scene, camera, side: int, spp: tuple[int, int], variant: str):
    """The same by Mitsuba's `prb` and `hair`."""
    from usdfab.mi.variant import load

    mi = load(variant)
    import drjit as dr

    from usdfab.mi.camera import sensor
    from usdfab.mi.fiber_stage import seen_fibers
    from usdfab.mi.fibers import MAX_POINTS, curve_shapes, hair_bsdf
    from usdfab.mi.lights import emitters
    from usdfab.mi.scene import FIBER_UNITS
    from usdfab.mi.space import Space

    curves = seen_fibers(scene, camera, MARGIN, MAX_POINTS)
    low, high = curves.bounds
    space = Space(FIBER_UNITS / curves.fibers[0].curves.radius, 0.5 * (low + high))
    view, _ = sensor(mi, camera, (side, side), (0, 0, side, side), space)
    with tempfile.TemporaryDirectory() as folder:
        shapes, _ = curve_shapes(curves, space, hair_bsdf, Path(folder))
        lights = emitters(mi, scene.lights, {}, space, 1.0)
        loaded = mi.load_dict({"type": "scene", "sensor": view, **lights, **shapes}, parallel=False)
    prb = mi.load_dict({"type": "prb", "max_depth": DEPTH, "rr_depth": 5})
    params = mi.traverse(loaded)
    names = ("sigma_a.value", "longitudinal_roughness", "azimuthal_roughness", "eta")
    keys = [key for key in sorted(params.keys()) if key.endswith(names)]
    start = {key: type(params[key])(params[key]) for key in keys}

    def split(count: int) -> list[int]:
        most = max(1, PATHS // side**2)
        number = -(-count // most)
        return [count * (j + 1) // number - count * j // number for j in range(number)]

    def iterate(k: int):
        for key in keys:
            params[key] = type(start[key])(dr.detach(start[key]) * (1.0 - 1e-3 * (k % 2)))
            dr.make_opaque(params[key])
        params.update()
        image = (
            sum(
                n * np.array(mi.render(loaded, integrator=prb, spp=n, seed=1000 * k + j))
                for j, n in enumerate(split(spp[0]))
            )
            / spp[0]
        )
        adjoint = mi.TensorXf((2.0 * (image - TARGET) / image.size).astype(np.float32))
        gradient = dict.fromkeys(keys, 0.0)
        for j, n in enumerate(split(spp[1])):
            for key in keys:
                params[key] = type(start[key])(dr.detach(params[key]))
                dr.enable_grad(params[key])
            params.update()
            prb.render_backward(loaded, params, adjoint, spp=n, seed=1000 * k + 500 + j)
            for key in keys:
                gradient[key] = gradient[key] + n / spp[1] * np.array(dr.grad(params[key])).ravel()
        for key in keys:
            params[key] = type(start[key])(dr.detach(params[key]))
        params.update()
        return image, np.concatenate([gradient[key] for key in keys])

    return iterate


RENDERERS = {"ours": ours, "prb_hair": theirs}


def measure(name: str, side: int, spp: tuple[int, int], runs: int, fibers: int, variant: str) -> dict[str, float]:
    """Times of one renderer, in this process."""
    from usdfab.mi.variant import load

    load(variant)
    import drjit as dr

    dr.set_log_level(dr.LogLevel.Error)
    cloth = scenes.fabric(fibers=fibers)
    scene, camera = scenes.swatch(cloth, zoom=0.4)
    iterate = RENDERERS[name](cloth, scene, camera, side, spp, variant)
    seconds, cpu, means, compiled = [], [], [], 0
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for k in range(runs + 1):
            dr.kernel_history_clear()
            start, work = time.perf_counter(), time.process_time()
            image, gradient = iterate(k)
            dr.sync_thread()
            seconds.append(time.perf_counter() - start)
            cpu.append(time.process_time() - work)
            means.append(float(image.mean()))
            assert np.all(np.isfinite(gradient)), gradient
            jit = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
            compiled += 0 if k == 0 else sum(not entry["cache_hit"] for entry in jit)
    return {
        "first_s": seconds[0],
        "least_s": min(seconds[1:]),
        "mean_s": float(np.mean(seconds[1:])),
        "cpu_s": min(cpu[1:]),
        "compiled_later": compiled,
        "brightness": float(np.mean(means)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", "--quick", dest="smoke", action="store_true", help="seconds, to see that it runs")
    parser.add_argument("--device", default="llvm", choices=("llvm", "cuda"))
    parser.add_argument("--pixels", type=int, nargs="*", help="sides of pictures, instead of the usual cases")
    parser.add_argument("--spp", nargs="*", default=["16/16"], help="samples of picture/gradient, with --pixels")
    parser.add_argument("--runs", type=int, default=3, help="iterations after the first")
    parser.add_argument("--only", choices=RENDERERS, help="one renderer and case, in this process")
    arguments = parser.parse_args()
    cases = SMOKE if arguments.smoke else CASES
    if arguments.pixels:
        cases = [(side, spp) for side in arguments.pixels for spp in arguments.spp]
    runs, fibers = (2, 4) if arguments.smoke else (arguments.runs, 100)
    for side, text in cases:
        spp = tuple(int(n) for n in text.split("/"))
        if arguments.only:
            print(json.dumps(measure(arguments.only, side, spp, runs, fibers, arguments.device)))
            continue
        results: dict = {"side": side, "spp": text, "depth": DEPTH, "device": arguments.device}
        results["load"], results["cores"] = round(os.getloadavg()[0], 1), os.cpu_count()
        for name in RENDERERS:
            command = [sys.executable, __file__, "--only", name, "--device", arguments.device, "--runs", str(runs)]
            command += ["--smoke"] if arguments.smoke else ["--pixels", str(side), "--spp", text]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            results[name] = json.loads(done.stdout.splitlines()[-1])
        mine, peer = results["ours"], results["prb_hair"]
        results["ratio"] = {
            key: mine[key] / peer[key] for key in ("first_s", "least_s", "mean_s", "cpu_s", "brightness")
        }
        print(json.dumps(results), flush=True)


if __name__ == "__main__":
    main()
