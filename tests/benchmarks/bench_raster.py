"""Seconds of one iteration of the raster stage, and where they go; and by other ways to the same gradient.

    python tests/benchmarks/bench_raster.py [--smoke] [--width 360] [--weave plain] [--fibers 200] [--runs 3]
                                            [--peer-width 180] [--threads 2] [--cpu]

An iteration is a picture, its losses (features included) and their gradient by all that stage 2 moves. Prints one line
of JSON:

    iteration_s     the best of the runs; adam_s: 75 of them, a whole descent by Adam at 360
    seconds         where they go: least seconds of each part, forward and backward. Features are measured by
                    themselves, forward and backward; the geometry's backward is what is left
    peers           at --peer-width, single scattering and diffuse alone without the features: ours; the same picture
                    and gradient in plain torch with gradients by autograd (what the kernels replace and are held to);
                    finite differences by path tracing (one-sided, one more picture than there are parameters, direct
                    light, as many samples a pixel as the rasterizer has), each with the fibers laid out anew, which
                    have noise that ours have not, and no diffuse term

nvdiffrast (Laine et al. 2020), whose way with edges this is, needs CUDA. The machine should be quiet: both torch and
Numba wait for each other's threads.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "fit" / "raster"))

from raster_reference import Reference

from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fabric.sampling import sample_fabric
from usdfab.fit.features import fast_dtype, load_features
from usdfab.fit.raster import edges, hits, jumps, renderer as raster, shade, shadows
from usdfab.fit.raster.curves import CurveModel
from usdfab.fit.raster.renderer import RasterSettings, raster_renderer
from usdfab.fit.raster.unconstrained import parameters_of
from usdfab.fit.raster_stage import QUALITIES, render_size
from usdfab.fit.texture import Target, color_loss, texture_loss
from usdfab.torch_run import deterministic
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene

FORWARD: dict[str, tuple[Any, str]] = {
    "geometry": (CurveModel, "__call__"),
    "index": (raster, "index_patch"),
    "visibility": (raster, "look"),
    "meeting": (raster, "meet"),
    "shadow edges": (raster, "shadow_edges"),
    "edges": (raster, "visible_edges"),
    "rims": (raster, "rims_at_ends"),
    "light beyond": (raster, "light_beyond"),
    "shading": (raster, "shaded"),
    "blending": (raster, "blended"),
}
BACKWARD: dict[str, Any] = {
    "meeting": hits._Meet,
    "shadow edges": shadows._Crossing,
    "edges": jumps._Crossing,
    "shading": shade._Shaded,
    "blending": edges._Blended,
}


now = time.perf_counter


class Clock:
    """Seconds spent in functions, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def timed(self, name: str, function: Callable) -> Callable:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            start = now()
            result = function(*arguments, **options)
            self.seconds[name] += now() - start
            return result

        return wrapped

    def watch(self) -> None:
        """From now on, all parts of the renderer."""
        for name, (place, attribute) in FORWARD.items():
            setattr(place, attribute, self.timed(name, getattr(place, attribute)))
        for name, kind in BACKWARD.items():
            kind.backward = staticmethod(self.timed(f"{name}, backward", kind.backward))


def best(function: Callable[[], Any], runs: int) -> float:
    """Least seconds; once before, to compile."""
    seconds = []
    for _ in range(runs + 1):
        start = now()
        function()
        seconds.append(now() - start)
    return min(seconds[1:])


def cloth(weave: str, fibers: int) -> FabricParameters:
    fabric = sample_fabric(weave, np.random.default_rng(1))
    return replace(fabric, **{s: replace(fabric.system(s), fiber_count=fibers) for s in SYSTEMS})


def iteration(fabric: FabricParameters, width: int, runs: int) -> dict[str, Any]:
    """One iteration's seconds and where they go."""
    stage = QUALITIES["standard" if width >= 256 else "draft"]
    size = render_size(fabric, width)
    target = torch.rand(3, size[1], size[0], generator=torch.Generator().manual_seed(0))
    goal = Target.from_image(target, load_features(dtype=fast_dtype()), stage.levels, stage.kind)
    pixels = raster_renderer(swatch_scene(fabric), RasterSettings(size, stage.supersampling))
    parameters = parameters_of(fabric)

    def losses(image: torch.Tensor) -> torch.Tensor:
        return texture_loss(image, goal) + color_loss(image, goal)

    def step() -> None:
        vector = parameters.vector().requires_grad_(True)
        start = now()
        image = pixels.image(*parameters.of(parameters.natural(vector))).permute(2, 0, 1)
        middle = now()
        loss = losses(image)
        clock.seconds["features"] += now() - middle
        clock.seconds["picture"] += middle - start
        start = now()
        loss.backward()
        clock.seconds["backward"] += now() - start

    def features() -> None:
        losses(target.clone().requires_grad_(True)).backward()

    clock = Clock()
    with deterministic():
        total = best(step, runs)
        both = best(features, runs)
        clock.watch()
        rows = []
        for _ in range(runs):
            clock.seconds.clear()
            step()
            rows.append(dict(clock.seconds))
    seconds = {name: min(row[name] for row in rows) for name in rows[0]}
    seconds["features, backward"] = max(both - seconds["features"], 0.0)
    known = sum(v for k, v in seconds.items() if k.endswith(", backward"))
    seconds["geometry, backward"] = max(seconds["backward"] - known, 0.0)
    return {
        "vertices": pixels.model.vertices,
        "parameters": len(parameters.free),
        "iteration_s": total,
        "adam_s": QUALITIES["paper"].iterations * total,
        "seconds": {k: round(v, 4) for k, v in seconds.items()},
    }


def peers(fabric: FabricParameters, width: int, runs: int) -> dict[str, Any]:
    """Other ways to the gradient of one picture."""
    scene, size = swatch_scene(fabric), render_size(fabric, width)
    pixels = raster_renderer(scene, RasterSettings(size, float64=True))
    parameters = parameters_of(fabric)
    gradients = {}

    def gradient(name: str, reference: bool) -> None:
        vector = parameters.vector().requires_grad_(True)
        shapes, look = parameters.of(parameters.natural(vector))
        image = Reference(pixels, look).image(shapes) if reference else pixels.image(shapes, look)
        (image * weights).sum().backward()
        gradients[name] = vector.grad

    weights = torch.rand(size[1], size[0], 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours = best(lambda: gradient("ours", False), runs)
    autograd = best(lambda: gradient("autograd", True), 1)
    spp = pixels.settings.supersampling**2

    def picture() -> None:
        Tracer(scene).render(
            scene.cameras[0], RenderSettings(size, spp=spp, max_depth=2, threads=torch.get_num_threads())
        )

    once = best(picture, 1)
    differences = (len(parameters.free) + 1) * once
    mine, other = gradients["ours"], gradients["autograd"]
    return {
        "width": width,
        "ours_s": ours,
        "autograd_s": autograd,
        "finite_differences_s": differences,
        "autograd/ours": autograd / ours,
        "finite_differences/ours": differences / ours,
        "gradients_apart": float((mine - other).norm() / other.norm()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small, to see that it runs")
    parser.add_argument("--width", type=int, default=360)
    parser.add_argument("--weave", default="plain", choices=["plain", "twill0", "twill1", "satin"])
    parser.add_argument("--fibers", type=int, default=200)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--peer-width", type=int, default=180)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--cpu", action="store_true", help="CPU seconds on one thread: for a machine that is busy")
    a = parser.parse_args()
    if a.cpu:
        global now
        now, a.threads = time.process_time, 1
    if a.smoke:
        a.width, a.fibers, a.runs, a.peer_width = 64, 6, 1, 16
    torch.set_num_threads(a.threads)
    numba.set_num_threads(min(a.threads, numba.config.NUMBA_NUM_THREADS))
    fabric = cloth(a.weave, a.fibers)
    compared = peers(fabric, a.peer_width, a.runs)
    result = {
        "width": a.width, "weave": a.weave, "fibers": a.fibers, "threads": a.threads,
        "clock": "cpu" if a.cpu else "wall",
        "load": round(os.getloadavg()[0], 1), **iteration(fabric, a.width, a.runs), "peers": compared,
    }  # fmt: skip
    print(json.dumps(result))


if __name__ == "__main__":
    main()
