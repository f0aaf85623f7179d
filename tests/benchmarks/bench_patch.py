"""Time to equal noise: our path tracer and Mitsuba 3 on the same flat samples, in one run on all cores.

    python tests/benchmarks/bench_patch.py [--smoke] [--weaves plain,twill,satin] [--ours] [--side 400] [--window 40]
                                           [--bsdf hair|plugin]

Samples follow the medians of Table 4 (Li et al. 2024) under the capture rig; depth 32; Mitsuba's `path` on the same
B-spline curves with its `hair` BSDF (`llvm_ad_rgb` where an LLVM library is found, else `scalar_rgb`); with `--bsdf
plugin` and LLVM with our own, since `hair` is 2 % too bright for satin. The noise is

    relMSE = mean over pixels and channels of variance / (mean^2 + (0.1 x picture's mean)^2)

with variance and mean from independent runs, so that each program is its own reference. Few paths carry much of the
light: with few samples the mean of a bright pixel hides its own noise. So a window in the middle of the picture is
rendered with thousands of samples, instead of the whole with a few. Seconds to relMSE 0.01 are those of the whole
picture, `seconds of a run x pixels / pixels of the window x relMSE of a run / 0.01`. Kernels are compiled before the
clock runs. Mitsuba renders each weave in a process of its own. One line of JSON for each weave.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))
sys.path.insert(0, str(Path(__file__).parent))

import mitsuba_scene
from bench_tracer import find_llvm

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.patch_scene import tile_copies
from usdfab.usd.rig import swatch_scene

DEPTH = 32
TARGET = 0.01
SIDE_M = 5e-3


def sample(weave: str, fibers: int = 200, variants: int = 1) -> FabricParameters:
    """The medians of Table 4; Mitsuba has one longitudinal roughness for all lobes, so gamma_M0 = gamma_M.

    One variant of the tile, since Mitsuba gets copies of one.
    """
    common = {
        "fiber_count": fibers, "irregularity": 0.15, "migration": 0.75, "twist": 0.03, "inclination": 0.8,
        "roughness_longitudinal": 0.45, "roughness_primary": 0.45, "roughness_azimuthal": 0.1,
        "albedo": (0.7, 0.5, 0.3),
    }  # fmt: skip
    counts, radii, crimps, flattening = {
        "plain": ((6, 8), (0.075, 0.075), (0.9, 0.9), (1.0, 1.0)),
        "twill": ((10, 12), (0.056, 0.047), (0.9, 0.9), (1.0, 1.0)),
        "satin": ((10, 12), (0.029, 0.02), (0.3, 1.0), (1.7, 2.0)),
    }[weave]
    warp, weft = (
        YarnParameters(count=n, radius=r * SIDE_M, crimp=c, flattening=f, **common)
        for n, r, c, f in zip(counts, radii, crimps, flattening, strict=True)
    )
    name = {"plain": "plain", "twill": "twill_1_3", "satin": "satin"}[weave]
    return FabricParameters(weave_from_name(name), (SIDE_M, SIDE_M), warp, weft, name=weave, variants=variants)


def noise(pictures: list) -> tuple[float, float]:
    """Brightness and relMSE of one run, from independent runs."""
    stack = np.asarray(pictures, dtype=float)
    mean = stack.mean(axis=0)
    floor = (0.1 * mean.mean()) ** 2
    return float(mean.mean()), float((stack.var(axis=0, ddof=1) / (mean**2 + floor)).mean())


def middle_window(side: int, window: int) -> tuple[int, int, int, int]:
    """(x0, y0, x1, y1) of a square in the middle."""
    start = (side - window) // 2
    return start, start, start + window, start + window


def ours(weave: str, fibers: int, side: int, window: int, spp: int, runs: int, threads: int | None = None) -> dict:
    """Seconds and noise of one run of the tracer."""
    scene = swatch_scene(sample(weave, fibers))
    start = time.perf_counter()
    tracer = Tracer(scene)
    build = time.perf_counter() - start
    camera = scene.cameras[0]
    tracer.render(camera, RenderSettings((8, 8), spp=2, max_depth=DEPTH))
    region = middle_window(side, window)
    renders = [
        tracer.render(camera, RenderSettings((side, side), spp, DEPTH, seed=k, threads=threads, region=region))
        for k in range(runs)
    ]
    mean, error = noise([r.pixels for r in renders])
    seconds = sum(r.seconds for r in renders) / runs
    paths = window * window * spp
    return {
        "to_target_s": seconds * (side / window) ** 2 * error / TARGET, "s": seconds, "relmse": error, "mean": mean,
        "us_per_path": 1e6 * seconds / paths, "rays_per_path": renders[0].rays / paths, "segments": tracer.segments,
        "build_s": build,
    }  # fmt: skip


def mitsuba(weave: str, fibers: int, side: int, window: int, spp: int, runs: int, bsdf: str = "hair") -> dict:
    """The same of Mitsuba; in a process of its own."""
    llvm = find_llvm()
    if llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = llvm
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb" if llvm else "scalar_rgb")
    cloth = sample(weave, fibers)
    scene = swatch_scene(cloth)
    # The same tile, and copies on all sides: enough to cover the sample and as far around it as light wanders.
    patch = generate_patch(cloth, copies=tile_copies(cloth))
    center = np.asarray(cloth.size) / 2
    middle = np.mod(center, patch.size)
    around = int(
        np.ceil(max(center[k] + max(middle[k], patch.size[k] - middle[k]) for k in range(2)) / min(patch.size))
    )
    with tempfile.TemporaryDirectory() as folder:
        files = mitsuba_scene.curves_text(patch, around, middle, Path(folder))
        light = list(scene.lights)
        description = mitsuba_scene.mitsuba_dict(mi, cloth, files, scene.cameras[0], light, (side, side), DEPTH)
        x0, y0, _x1, _y1 = middle_window(side, window)
        description["sensor"]["film"] |= {
            "crop_offset_x": x0, "crop_offset_y": y0, "crop_width": window, "crop_height": window,
        }  # fmt: skip
        if bsdf == "plugin":
            from usdfab.mi.fiber_bsdf import register_fiber_bsdf

            register_fiber_bsdf()
            for name in files:
                description[name]["bsdf"] = mitsuba_scene.plugin_dict(cloth.system(name))
        loaded = mi.load_dict(description, parallel=bsdf == "hair")
    np.array(mi.render(loaded, spp=spp, seed=999))
    start = time.perf_counter()
    pictures = [np.array(mi.render(loaded, spp=spp, seed=k)) for k in range(runs)]
    seconds = (time.perf_counter() - start) / runs
    mean, error = noise(pictures)
    return {
        "to_target_s": seconds * (side / window) ** 2 * error / TARGET, "s": seconds, "relmse": error, "mean": mean,
        "us_per_path": 1e6 * seconds / (window * window * spp), "variant": mi.variant(),
    }  # fmt: skip


def _child(queue, arguments: tuple) -> None:
    queue.put(mitsuba(*arguments))


def in_a_process(*arguments) -> dict:
    """``mitsuba`` in a fresh process, which must end well."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_child, args=(queue, arguments))
    process.start()
    result = queue.get(timeout=1800)
    process.join()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--weaves", default="plain,twill,satin")
    parser.add_argument("--ours", action="store_true", help="leave Mitsuba out")
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--window", type=int, default=40)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--bsdf", choices=("hair", "plugin"), default="hair", help="what Mitsuba's fibers scatter with")
    arguments = parser.parse_args()
    side, window, spp, runs, fibers = arguments.side, arguments.window, arguments.spp, arguments.runs, 200
    if arguments.smoke:
        side, window, spp, runs, fibers = 24, 12, 16, 2, 8
    for weave in arguments.weaves.split(","):
        row = {
            "bench": "patch", "weave": weave, "side": side, "window": window, "spp": spp, "runs": runs,
            "bsdf": arguments.bsdf, "load": os.getloadavg()[0],
        }  # fmt: skip
        row["ours"] = ours(weave, fibers, side, window, spp, runs, arguments.threads)
        if not arguments.ours:
            row["mitsuba"] = in_a_process(weave, fibers, side, window, spp, runs, arguments.bsdf)
            row["ratio"] = row["ours"]["to_target_s"] / row["mitsuba"]["to_target_s"]
            row["brightness"] = row["ours"]["mean"] / row["mitsuba"]["mean"]
        print(json.dumps(row, default=float), flush=True)


if __name__ == "__main__":
    main()
