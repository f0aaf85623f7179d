"""How well stage 2 recovers random fabrics (Li et al. 2024, Table 2 and figures 15, 17, 18).

Fabrics are drawn from the paper's Table 4 and rendered by path tracing. The fit starts from the truth with every
number moved by ``PERTURBATION`` of its range up or down, and with other random draws of the fibers. Errors are
|estimate - truth| over the width of the parameter's range, averaged over the yarn systems and the colour channels.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fabric.optics import ROUGHNESSES
from usdfab.fabric.sampling import sample_fabric
from usdfab.fit.features import FeatureNet, fast_dtype, load_features
from usdfab.fit.path_stage import start_from_joint
from usdfab.fit.raster.unconstrained import soft_range
from usdfab.fit.raster_stage import StageResult, StageSettings, refine_by_raster, render_size
from usdfab.fit.table2 import PAPER_MEANS, SYMBOLS, range_errors, range_width
from usdfab.imaging.denoise import denoise
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene

WEAVES = ("plain", "twill0", "twill1", "satin")
PERTURBATION = 0.2
TARGET_SPP = 64
"""Paths per pixel of the target, which is denoised: in the statistics of a picture of 64 paths, noise outweighs all."""

JUDGED = ("albedo", *ROUGHNESSES, "twist", "crimp", "inclination", "radius", "irregularity")
"""Rows of Table 2 that stage 2 moves."""

ABLATIONS: dict[str, dict[str, object]] = {
    "full": {},
    "single": {"diffuse": False},
    "diffuse": {"single": False},
    "texture only": {"color": 0.0},
    "colour only": {"texture": 0.0},
    "no prior": {"prior": 0.0},
}
"""What is left out: of the shading (figure 15), of the losses (figure 17), the prior (figure 18)."""


@dataclass(frozen=True)
class Recovery:
    """One fabric fitted in one way.

    ``before``, ``after`` map the names of ``JUDGED`` to errors, fractions of the range; ``first_loss``, ``best_loss``
    are those of the fit. ``seconds`` of the clock, ``cpu_seconds`` of all threads of this process.
    """

    weave: str
    number: int
    ablation: str
    before: dict[str, float]
    after: dict[str, float]
    first_loss: float
    best_loss: float
    iterations: int
    seconds: float
    cpu_seconds: float = 0.0


Progress = Callable[[int, int, str], None]
Watch = Callable[[Recovery, NDArray, StageResult], None]
"""Called with each fit's recovery, its target (H, W, 3) and its result."""


def evaluate_raster(
    count: int = 1,
    seed: int = 0,
    settings: StageSettings | None = None,
    *,
    weaves: Sequence[str] = WEAVES,
    ablations: Sequence[str] = ("full",),
    fibers: int | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
    net: FeatureNet | None = None,
) -> list[Recovery]:
    """Fit ``count`` fabrics of each weave in every way of ``ablations``.

    Parameters
    ----------
    settings:
        Of stage 2; what moves is ``JUDGED`` and k_d (flattening and exposure are known here, as in the paper).
    fibers:
        Fibers in each yarn instead of Table 4's 200, to save time.
    """
    if count < 1 or (fibers is not None and fibers < 1):
        raise UsdfabError("there is nothing to fit", place="--count", remedy="use 1 or more fabrics and fibers")
    net = net or load_features(dtype=fast_dtype())  # before minutes of tracing, if it is missing
    settings = replace(settings or StageSettings(), free=(*JUDGED, "diffuse"))
    jobs = [(weave, number) for weave in weaves for number in range(count)]
    steps, done = len(jobs) * len(ablations) * settings.iterations, 0
    results: list[Recovery] = []
    for weave, number in jobs:
        rng = np.random.default_rng((seed, WEAVES.index(weave), number))
        truth = sample_fabric(weave, rng)
        if fibers:
            truth = replace(truth, **{s: replace(truth.system(s), fiber_count=fibers) for s in SYSTEMS})  # type: ignore[arg-type]
        start = perturbed(truth, weave, rng)
        target = _target(truth, settings.width, seed)
        for name in ablations:
            chosen = replace(settings, **ABLATIONS[name])  # type: ignore[arg-type]
            begun, begun_cpu, base = time.perf_counter(), time.process_time(), done

            def say(
                k: int, _: int, loss: float, label: str = f"{weave} {number + 1}, {name}", base: int = base
            ) -> None:
                if progress:
                    progress(base + k, steps, f"{label}: {loss:.3f}")

            found = refine_by_raster(start, target, chosen, net=net, progress=say)
            done += settings.iterations
            if found.interrupted:
                return results
            # Without a diffuse term, or with one that follows from C, C itself is what path tracing starts from.
            halfway = chosen.diffuse and not (chosen.tied and chosen.single)
            fabric = start_from_joint(found.fabric, found.diffuse) if halfway else found.fabric
            results.append(
                Recovery(
                    weave,
                    number,
                    name,
                    errors(start, truth, weave),
                    errors(fabric, truth, weave),
                    found.losses[0],
                    found.best_loss,
                    len(found.losses),
                    time.perf_counter() - begun,
                    time.process_time() - begun_cpu,
                )
            )
            if watch:
                watch(results[-1], target, found)
    return results


def perturbed(truth: FabricParameters, weave: str, rng: np.random.Generator) -> FabricParameters:
    """``truth`` with every number of ``JUDGED`` moved by ``PERTURBATION`` of its range, and another seed.

    Up or down by chance; the other way where that would leave the soft range, and to its border where both would.
    """
    changed = {}
    for system in SYSTEMS:
        yarn = truth.system(system)
        values: dict[str, float | tuple[float, ...]] = {}
        for name in JUDGED:
            step = PERTURBATION * range_width(name, weave, system)
            # Table 4's lengths are relative to the sample's side.
            step *= truth.size[0] if name == "radius" else 1.0
            old = np.atleast_1d(getattr(yarn, name))
            moved = [_moved(float(v), step, soft_range(name), rng) for v in old]
            values[name] = tuple(moved) if name == "albedo" else moved[0]
        changed[system] = replace(yarn, **values)  # type: ignore[arg-type]
    return replace(truth, seed=(truth.seed + 1) % 2**31, **changed)  # type: ignore[arg-type]


def _moved(value: float, step: float, limits: tuple[float, float], rng: np.random.Generator) -> float:
    low, high = limits
    sign = 1.0 if rng.random() < 0.5 else -1.0
    for candidate in (value + sign * step, value - sign * step):
        if low <= candidate <= high:
            return candidate
    return min(max(value + sign * step, low), high)


def errors(fabric: FabricParameters, truth: FabricParameters, weave: str) -> dict[str, float]:
    """|estimate - truth| over the width of the range, by name."""
    return range_errors(fabric, truth, weave, JUDGED)


def _target(truth: FabricParameters, width: int, seed: int) -> np.ndarray:
    scene = swatch_scene(truth)
    size = render_size(truth, width)
    render = Tracer(scene).render(scene.cameras[0], RenderSettings(size, spp=TARGET_SPP, seed=seed))
    return denoise(render.pixels, render.albedo, render.normal)


def format_recoveries(results: Sequence[Recovery]) -> str:
    """The tables as text: errors in percent of the range, before and after, beside the paper's means; losses; seconds
    by the clock and of all processors."""
    lines = []
    for ablation in dict.fromkeys(r.ablation for r in results):
        mine = [r for r in results if r.ablation == ablation]
        names = [f"{r.weave} {r.number + 1}" for r in mine]
        lines.append(f"{ablation}: error in % of the range, before > after")
        lines.append(f"{'':<10}" + "".join(f"{n:>16}" for n in names) + f"{'mean':>16}{'paper':>8}")
        for row in JUDGED:
            pairs = [(100 * r.before[row], 100 * r.after[row]) for r in mine]
            means = (np.mean([p[0] for p in pairs]), np.mean([p[1] for p in pairs]))
            cells = "".join(f"{f'{b:.1f} > {a:.1f}':>16}" for b, a in (*pairs, means))
            lines.append(f"{SYMBOLS[row]:<10}{cells}{PAPER_MEANS[row]:8.2f}")
        cells = "".join(f"{f'{r.first_loss:.2f} > {r.best_loss:.2f}':>16}" for r in mine)
        lines.append(f"{'loss':<10}{cells}")
        lines.append(f"{'seconds':<10}" + "".join(f"{r.seconds:16.0f}" for r in mine))
        lines.append(f"{'cpu':<10}" + "".join(f"{r.cpu_seconds:16.0f}" for r in mine))
        lines.append("")
    return "\n".join(lines[:-1])
