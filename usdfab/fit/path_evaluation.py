"""How well stage 3 finds known optics: ``usdfab evaluate path``, beside Table 2 of Li et al. 2024.

A fabric is drawn from Table 4 and rendered; that picture is the photo. The stage starts from the same geometry with
other draws of the fibers and with each of its parameters 20 % too large or too small. The paper's columns are those of
its whole pipeline, which has to find the geometry as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import optics_of, with_optics
from usdfab.fabric.sampling import sample_fabric
from usdfab.fit.path_noise import Denoised
from usdfab.fit.path_result import PathResult
from usdfab.fit.path_settings import PathSettings
from usdfab.fit.path_space import OpticsSpace
from usdfab.fit.path_stage import Progress, denoiser_installed, refine_appearance
from usdfab.fit.table2 import PAPER_MEANS, SYMBOLS, range_errors
from usdfab.imaging.denoise import denoise
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene

Floats = NDArray[np.float64]

WEAVES = ("plain", "twill0", "satin")
"""Taken in turn."""

PERTURBATION = 0.2
"""Relative error of each parameter at the start."""

GROUPS = {
    name: SYMBOLS[name] for name in ("albedo", "roughness_longitudinal", "roughness_primary", "roughness_azimuthal")
}
"""What the stage estimates, by the names of ``YarnParameters``."""

PAPER = {symbol: PAPER_MEANS[name] for name, symbol in GROUPS.items()}
"""Mean errors of Table 2 of Li et al. 2024 in percent of the parameter's range."""

PHOTO_SAMPLES = {"draft": 128, "standard": 512, "paper": 4096}
"""Per pixel of the picture that stands for the photo; it is denoised where the denoiser is installed."""


@dataclass(frozen=True, eq=False)
class Recovery:
    """One experiment; errors are in percent of the parameter's range, means over systems and channels (Table 2).

    ``before`` and ``after`` have the keys of ``PAPER``.
    """

    weave: str
    seed: int
    before: dict[str, float]
    after: dict[str, float]
    result: PathResult

    def summary(self) -> dict[str, object]:
        """For ``--json``."""
        return {"weave": self.weave, "seed": self.seed, "before": self.before, "after": self.after} | {
            "result": self.result.summary()
        }


def evaluate_path(
    count: int,
    seed: int,
    settings: PathSettings,
    photo_spp: int,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Recovery]:
    """Recover ``count`` fabrics drawn from Table 4.

    Raises
    ------
    UsdfabError
        For a count below 1, and as ``refine_appearance``.
    """
    if count < 1:
        raise UsdfabError(f"{count} fabrics are none", place="--count", remedy="give 1 or more")
    results = []
    for index in range(count):
        weave = WEAVES[index % len(WEAVES)]

        def report(done: int, of: int, loss: float, index: int = index, weave: str = weave) -> None:
            if progress:
                progress(index * of + done, count * of, f"{weave}, loss {loss:.3f}")

        fabric = sample_fabric(weave, np.random.default_rng([seed, index]))
        results.append(recover(fabric, weave, seed + index, settings, photo_spp, report))
    return results


def recover(
    truth: FabricParameters,
    weave: str,
    seed: int,
    settings: PathSettings,
    photo_spp: int,
    progress: Progress | None = None,
) -> Recovery:
    """Recover the optics of ``truth``, of one of the weaves of Table 4, from a picture of it."""
    photo = rendered_photo(truth, settings, photo_spp, seed)
    start = perturbed(truth, seed)
    result = refine_appearance(start, photo, settings=replace(settings, seed=seed), progress=progress)
    before, after = (table2_errors(fabric, truth, weave) for fabric in (start, result.fabric))
    return Recovery(weave, seed, before, after, result)


def rendered_photo(fabric: FabricParameters, settings: PathSettings, spp: int, seed: int = 0) -> Floats:
    """(H, W, 3) the fabric under the capture rig, ``settings.side`` pixels along the longer side."""
    factor = settings.side / max(fabric.size)
    size = max(1, round(fabric.size[0] * factor)), max(1, round(fabric.size[1] * factor))
    scene = swatch_scene(fabric)
    # Another stream than that of the fit's renders.
    how = RenderSettings(size, spp=spp, max_depth=settings.max_depth, seed=2**31 + seed, threads=settings.threads)
    render = Tracer(scene).render(scene.cameras[0], how)
    pixels = render.pixels.astype(np.float64)
    if not denoiser_installed():
        return pixels
    return Denoised.of(pixels, lambda image: denoise(image, render.albedo, render.normal).astype(np.float64)).image


def perturbed(fabric: FabricParameters, seed: int) -> FabricParameters:
    """The fabric with other draws of its fibers and each estimated parameter 20 % too large or too small."""
    optics = optics_of(fabric)
    rng = np.random.default_rng([seed, 1])
    vector = optics.vector()
    space = OpticsSpace.around(optics)
    signs = rng.choice([-1.0, 1.0], space.size)
    vector[space.free] *= 1.0 + PERTURBATION * signs
    inside = np.clip(vector, 0.011, 0.99)
    inside[-2:] = vector[-2:]
    return replace(with_optics(fabric, optics.with_vector(inside)), seed=int(rng.integers(2**31)))


def table2_errors(fabric: FabricParameters, truth: FabricParameters, weave: str) -> dict[str, float]:
    """Percent of each parameter's range in Table 4, means over systems, colours and channels (Table 2)."""
    found = range_errors(fabric, truth, weave, tuple(GROUPS))
    return {symbol: 100.0 * found[name] for name, symbol in GROUPS.items()}


def format_recoveries(results: Sequence[Recovery]) -> str:
    """The table as text."""
    lines = ["Errors in % of the range, before -> after", f"{'':<14}" + "".join(f"{key:>18}" for key in PAPER)]
    for r in results:
        cells = "".join(f"{r.before[key]:8.2f} -> {r.after[key]:6.2f}" for key in PAPER)
        lines.append(f"{r.weave + ' ' + str(r.seed):<14}{cells}   {r.result.seconds:6.0f} s  loss {r.result.loss:.3f}")
    if len(results) > 1:
        means = [(np.mean([r.before[k] for r in results]), np.mean([r.after[k] for r in results])) for k in PAPER]
        lines.append(f"{'mean':<14}" + "".join(f"{a:8.2f} -> {b:6.2f}" for a, b in means))
    lines.append(f"{'paper':<14}" + "".join(f"{value:18.2f}" for value in PAPER.values()))
    return "\n".join(lines)
