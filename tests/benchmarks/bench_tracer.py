"""Our path tracer beside Mitsuba 3: the same fibers, camera, lamp and depth, in one run on all cores.

    python tests/benchmarks/bench_tracer.py [--smoke]

Mitsuba runs in `llvm_ad_rgb` where an LLVM library is found (DRJIT_LIBLLVM_PATH, else the karellen-llvm-core package),
in `scalar_rgb` otherwise. Scenes are built and kernels compiled before the clock runs. What counts is the time to the
same noise: time x variance of the pixels' means. Lines printed, one `name key value ...` each:

    ours, mitsuba   seconds, paths/s, rays/s, variance (mean over pixels of the mean's variance), megabytes
    ratio           ours / Mitsuba: time, time x variance (below 1: ours is faster), brightness

Mitsuba's rays are not counted; they are put at our rays per path. Memory is the peak of the process so far, so that
Mitsuba's includes ours.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))

import mitsuba_scene
import scenes

from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.patch_scene import tile_copies

DEPTH = 64
AROUND = 1
"""Copies of the patch on each side in Mitsuba."""


def find_llvm() -> str:
    """Path of an LLVM library for Dr.Jit, or an empty string."""
    if os.environ.get("DRJIT_LIBLLVM_PATH"):
        return os.environ["DRJIT_LIBLLVM_PATH"]
    found: list[Path] = []
    try:
        files = importlib.metadata.files("karellen-llvm-core") or []
        found += [Path(str(f.locate())) for f in files if f.name.startswith("libLLVM")]
    except importlib.metadata.PackageNotFoundError:
        pass
    for pattern in ("lib/libLLVM.so*", "lib/libLLVM*.dylib", "bin/LLVM-C.dll"):
        found += Path(sys.prefix).glob(pattern)
    return next((str(path.resolve()) for path in found if path.is_file()), "")


def megabytes() -> float:
    """Peak memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def line(name: str, **values: float) -> None:
    print(name, *(f"{key} {value:.4g}" for key, value in values.items()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--variant", default="", help="Mitsuba's variant")
    arguments = parser.parse_args()
    side, runs, spp, fibers = (32, 2, 4, 8) if arguments.smoke else (256, 4, 16, 100)

    cloth = scenes.fabric(fibers=fibers)
    scene, camera = scenes.swatch(cloth, zoom=0.2)
    patch = generate_patch(cloth, copies=tile_copies(cloth))
    print(f"load {os.getloadavg()[0]:.1f} cores {os.cpu_count()} image {side}x{side} spp {runs}x{spp} depth {DEPTH}")

    def spread(pictures: list) -> tuple[float, float]:
        """Brightness, and variance of one run's pixels."""
        stack = np.asarray(pictures, dtype=float)
        return float(stack.mean()), float(stack.var(axis=0, ddof=1).mean())

    tracer = Tracer(scene)
    tracer.render(camera, RenderSettings((8, 8), spp=1, max_depth=DEPTH))
    settings = [RenderSettings((side, side), spp=spp, max_depth=DEPTH, seed=k) for k in range(runs)]
    renders = [tracer.render(camera, s) for s in settings]
    seconds = sum(r.seconds for r in renders)
    mean, variance = spread([r.pixels for r in renders])
    paths = side * side * spp * runs
    rays = sum(r.rays for r in renders)
    line("ours", s=seconds, paths_per_s=paths / seconds, rays_per_s=rays / seconds, rays_per_path=rays / paths,
         variance=variance, segments=tracer.segments, MB=megabytes())  # fmt: skip

    if importlib.util.find_spec("mitsuba") is None:
        print("mitsuba is not installed; pip install mitsuba")
        return
    llvm = find_llvm()
    if llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = llvm
    import mitsuba as mi

    variant = arguments.variant or ("llvm_ad_rgb" if llvm else "scalar_rgb")
    mi.set_variant(variant)
    print(f"mitsuba variant {variant} version {mi.__version__} llvm {Path(llvm).name if llvm else 'none'}")
    with tempfile.TemporaryDirectory() as folder:
        center = np.mod(np.asarray(cloth.size) / 2, patch.size)
        files = mitsuba_scene.curves_text(patch, AROUND, center, Path(folder))
        description = mitsuba_scene.mitsuba_dict(mi, cloth, files, camera, list(scene.lights), (side, side), DEPTH)
        theirs = mi.load_dict(description)
    np.array(mi.render(theirs, spp=spp, seed=999))  # compiles
    start = time.perf_counter()
    pictures = [np.array(mi.render(theirs, spp=spp, seed=k)) for k in range(runs)]
    their_seconds = time.perf_counter() - start
    their_mean, their_variance = spread(pictures)
    line("mitsuba", s=their_seconds, paths_per_s=paths / their_seconds, rays_per_s_estimated=rays / their_seconds,
         variance=their_variance, MB=megabytes())  # fmt: skip
    line("ratio", time=seconds / their_seconds, equal_variance=seconds * variance / (their_seconds * their_variance),
         brightness=mean / their_mean)  # fmt: skip


if __name__ == "__main__":
    main()
