"""From the colour that cloth shows to the albedo coefficient of its fibers.

Light scatters many times between fibers, so cloth of fibers with C = 0.5 is not half as bright as cloth with C = 1. How
bright it is depends on the weave, the yarns and the rig, and is measured here: the fabric is rendered under the capture
rig with a ladder of grey albedos (three at a time, one in each colour channel), which gives a monotone curve from C to
brightness for each yarn system, and the curve is read backwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, Color, FabricParameters, System
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import Rig, sample_scene

LADDER = ((0.02, 0.3, 0.8), (0.1, 0.55, 0.93), (0.97, 0.99, 0.999))
"""Albedos rendered, three channels at a time."""

REFINEMENTS = 3
"""Renders with the albedos found, to correct for light that crosses from one system to the other."""

OVER_RELAXATION = 1.7
"""Only about half of what a system shows comes from its own albedo's curve, so corrections are taken larger."""

MAX_ALBEDO = 0.995
BRIGHT_ALBEDO = 0.95
"""Albedo of the brightest yarns of a photo that shows more light than the rig's standard exposure can explain."""

DARK_ALBEDO = 0.03
"""Albedo, in its darkest channel, of yarns more saturated than cloth can look under the rig's standard exposure."""

LEAST_EXPOSURE = 0.1

PATHS = 300_000
"""Paths in each render; a mean brightness is then good to about 2 %."""

PIXELS_PER_CELL = 8
MAX_PIXELS = 160


@dataclass(frozen=True)
class BrightnessCurve:
    """Brightness of a yarn system where it is on top, against the albedo of all fibers; both increase."""

    albedo: NDArray[np.float64]
    brightness: NDArray[np.float64]

    def albedo_of(self, brightness: float) -> float:
        """The albedo that shows this brightness; clamped to the ends of the curve."""
        return float(np.interp(brightness, self.brightness, self.albedo))


def brightness_curves(
    fabric: FabricParameters,
    paths: int = PATHS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    rig: Rig | None = None,
) -> dict[System, BrightnessCurve]:
    """Measure both systems' curves by rendering ``fabric`` with the ladder of grey albedos, under ``rig``."""
    albedo: list[float] = []
    seen: dict[System, list[float]] = {"warp": [], "weft": []}
    for step, rung in enumerate(LADDER):
        grey = replace(
            fabric,
            warp=replace(fabric.warp, albedo=rung, yarn_albedo=()),
            weft=replace(fabric.weft, albedo=rung, yarn_albedo=()),
        )
        means = visible_means(grey, paths, seed, rig)
        albedo.extend(rung)
        for system in SYSTEMS:
            seen[system].extend(means[system])
        if progress:
            progress(step + 1, len(LADDER))
    order = np.argsort(albedo)
    return {
        system: BrightnessCurve(
            np.r_[0.0, np.asarray(albedo)[order]], np.r_[0.0, np.maximum.accumulate(np.asarray(values)[order])]
        )
        for system, values in seen.items()
    }


def photo_exposure(shown: FabricParameters, curves: dict[System, BrightnessCurve]) -> float:
    """How many times brighter than under the rig's standard light a photo is.

    Light and albedo cannot be told apart in one photo, but both ends are bounded. The rig's light is normalised so that
    a white diffuse surface is 1, and cloth of white fibers is darker than that; a camera, however, exposes white cloth
    as white. So where the photo's colours ask for more than fibers of albedo ``BRIGHT_ALBEDO`` give, the light was
    stronger. And even black fibers reflect some light off their surface, which has no colour: where a channel is darker
    than fibers of ``DARK_ALBEDO`` are, as in deep red cloth, the light was weaker; that counts half, in stops, since
    the gloss of the fibers is not known either. Between the two it is 1; of the two, the first counts.

    Parameters
    ----------
    shown:
        The fabric with the photo's linear colours as albedo.
    curves:
        From ``brightness_curves`` of the same fabric.
    """
    needed, allowed = LEAST_EXPOSURE, 1.0
    for system in SYSTEMS:
        curve, colors = curves[system], np.asarray(shown.system(system).colors())
        dark, bright = (
            max(float(np.interp(c, curve.albedo, curve.brightness)), 1e-6) for c in (DARK_ALBEDO, BRIGHT_ALBEDO)
        )
        needed = max(needed, float(colors.max()) / bright)
        allowed = min(allowed, float(colors.mean(axis=0).min()) / dark)
    return max(needed, math.sqrt(allowed))


def visible_means(
    fabric: FabricParameters, paths: int = PATHS, seed: int = 0, rig: Rig | None = None
) -> dict[System, NDArray[np.float64]]:
    """Mean colour (3,) of each system in the rendered swatch, over the middles of the crossings where it is on top."""
    cells = np.array([fabric.size[0], fabric.size[1]]) / fabric.cell
    width = int(np.clip(PIXELS_PER_CELL * cells[0], 32, MAX_PIXELS))
    height = max(1, round(width * fabric.size[1] / fabric.size[0]))
    spp = max(1, round(paths / (width * height)))
    # One variant of the repeat shows the same colours as several, which take as many times as long to build.
    scene = sample_scene(replace(fabric, variants=1), rig)
    render = Tracer(scene).render(scene.cameras[0], RenderSettings((width, height), spp=spp, seed=seed))
    return means_on_top(render.pixels, fabric)


def means_on_top(pixels: NDArray, fabric: FabricParameters) -> dict[System, NDArray[np.float64]]:
    """Mean colour of each system in a picture that shows exactly the fabric's sample, upright."""
    height, width = pixels.shape[:2]
    x = (np.arange(width) + 0.5) / width * fabric.size[0] / fabric.cell[0]
    y = (height - np.arange(height) - 0.5) / height * fabric.size[1] / fabric.cell[1]
    weft_on_top = fabric.weave.matrix[np.ix_(y.astype(int) % fabric.weave.picks, x.astype(int) % fabric.weave.ends)]
    middle = (np.abs(y % 1.0 - 0.5) < 0.3)[:, None] & (np.abs(x % 1.0 - 0.5) < 0.3)[None, :]
    means: dict[System, NDArray[np.float64]] = {}
    for system, on_top in (("warp", 0), ("weft", 1)):
        chosen = middle & (weft_on_top == on_top)
        means[system] = pixels[chosen if chosen.any() else weft_on_top == on_top].mean(axis=0).astype(float)  # type: ignore[index]
    return means


def with_inverted_albedo(
    fabric: FabricParameters,
    curves: dict[System, BrightnessCurve],
    paths: int = PATHS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    rig: Rig | None = None,
) -> tuple[FabricParameters, tuple[str, ...]]:
    """``fabric`` with albedos such that it shows the colours its albedos held before; notes on what is too bright.

    The curves dye both systems alike, but light that crosses from one to the other carries the other's colour. So the
    result is rendered ``REFINEMENTS`` times, and what it shows too much or too little of goes into the next reading.
    """
    found, _, notes = with_inverted_albedo_and_light(fabric, curves, paths, seed, progress, rig, most_light=1.0)
    return found, notes


def with_inverted_albedo_and_light(
    fabric: FabricParameters,
    curves: dict[System, BrightnessCurve],
    paths: int = PATHS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    rig: Rig | None = None,
    most_light: float = math.inf,
) -> tuple[FabricParameters, float, tuple[str, ...]]:
    """``with_inverted_albedo`` where the light is not known: (fabric, light, notes).

    Bright yarns among dark ones must be brighter than the curves say, since the dark ones take part of their light. If
    more than fibers of ``BRIGHT_ALBEDO`` is asked for, the light was stronger; else their colour would be lost, all
    channels being at the limit. ``light`` (1 to ``most_light``) is how many times brighter the fabric has to be shown.
    """
    wanted = {s: np.mean(fabric.system(s).colors(), axis=0) for s in SYSTEMS}
    factors = {s: np.ones(3) for s in SYSTEMS}
    light = 1.0
    found = _read_backwards(fabric, curves, factors)
    for step in range(REFINEMENTS):
        shown = visible_means(found, paths, seed + 1 + step, rig)
        for system in SYSTEMS:
            ratio = wanted[system] / np.maximum(light * shown[system], 1e-6)
            factors[system] = factors[system] * np.clip(ratio, 0.5, 2.0) ** OVER_RELAXATION
        more = max(1.0, *(_asked_of_bright(fabric, s, curves[s], factors[s]) for s in SYSTEMS))
        more = min(more, most_light / light)
        light *= more
        factors = {s: f / more for s, f in factors.items()}
        found = _read_backwards(fabric, curves, factors)
        if progress:
            progress(step + 1, REFINEMENTS)
    notes = tuple(
        f"the {system} is brighter in the photo than white fibers under the rig: albedo is at its limit"
        for system in SYSTEMS
        if max(max(c) for c in fabric.system(system).colors()) > curves[system].brightness[-1]
    )
    return found, light, notes


def _asked_of_bright(
    fabric: FabricParameters, system: System, curve: BrightnessCurve, factors: NDArray[np.float64]
) -> float:
    """What a system's brightest channel asks for, over what fibers of ``BRIGHT_ALBEDO`` give."""
    bright = float(np.interp(BRIGHT_ALBEDO, curve.albedo, curve.brightness))
    return float((np.asarray(fabric.system(system).colors()) * factors).max()) / max(bright, 1e-6)


def _read_backwards(
    fabric: FabricParameters, curves: dict[System, BrightnessCurve], factors: dict[System, NDArray[np.float64]]
) -> FabricParameters:
    """Each colour of ``fabric``, times its system's factors, replaced by the albedo that shows it."""

    def albedo(system: System, color: Color) -> Color:
        wanted = np.asarray(color) * factors[system]
        red, green, blue = (min(curves[system].albedo_of(float(c)), MAX_ALBEDO) for c in wanted)
        return red, green, blue

    return with_colors(fabric, albedo)


def dimmed(fabric: FabricParameters, exposure: float) -> FabricParameters:
    """``fabric`` with all its colours divided by an exposure; 1 at most."""
    return with_colors(
        fabric, lambda _, c: (min(c[0] / exposure, 1.0), min(c[1] / exposure, 1.0), min(c[2] / exposure, 1.0))
    )


def with_colors(fabric: FabricParameters, change: Callable[[System, Color], Color]) -> FabricParameters:
    """``fabric`` with every colour of each system replaced by ``change`` of it."""
    for system in SYSTEMS:
        yarn = fabric.system(system)
        colors = tuple(change(system, c) for c in yarn.yarn_albedo)
        changed = replace(yarn, albedo=change(system, yarn.albedo), yarn_albedo=colors)
        fabric = replace(fabric, **{system: changed})  # type: ignore[arg-type]
    return fabric
