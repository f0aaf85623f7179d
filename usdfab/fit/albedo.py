"""From the colour that cloth shows to the albedo coefficient of its fibers.

Light scatters many times between fibers, so cloth of fibers with C = 0.5 is not half as bright as cloth with C = 1. How
bright it is depends on the weave, the yarns and the rig, and is measured here: the fabric is rendered under the capture
rig with a ladder of grey albedos (three at a time, one in each colour channel), which gives a monotone curve from C to
brightness for each yarn system, and the curve is read backwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, Color, FabricParameters, System
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene

LADDER = ((0.02, 0.3, 0.8), (0.1, 0.55, 0.93), (0.97, 0.99, 0.999))
"""Albedos rendered, three channels at a time."""

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
    fabric: FabricParameters, spp: int = 16, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> dict[System, BrightnessCurve]:
    """Measure both systems' curves by rendering ``fabric`` with the ladder of grey albedos."""
    albedo: list[float] = []
    seen: dict[System, list[float]] = {"warp": [], "weft": []}
    for step, rung in enumerate(LADDER):
        grey = replace(
            fabric,
            warp=replace(fabric.warp, albedo=rung, yarn_albedo=()),
            weft=replace(fabric.weft, albedo=rung, yarn_albedo=()),
        )
        means = visible_means(grey, spp, seed)
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


def visible_means(fabric: FabricParameters, spp: int = 16, seed: int = 0) -> dict[System, NDArray[np.float64]]:
    """Mean colour (3,) of each system in the rendered swatch, over the middles of the crossings where it is on top."""
    cells = np.array([fabric.size[0], fabric.size[1]]) / fabric.cell
    width = int(np.clip(PIXELS_PER_CELL * cells[0], 32, MAX_PIXELS))
    scene = swatch_scene(fabric)
    render = Tracer(scene).render(scene.cameras[0], RenderSettings((width, 0), spp=spp, seed=seed))
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
    fabric: FabricParameters, curves: dict[System, BrightnessCurve]
) -> tuple[FabricParameters, tuple[str, ...]]:
    """``fabric`` with albedos such that it shows the colours its albedos held before; notes on what is too bright."""
    notes = []
    for system in SYSTEMS:
        curve, yarn = curves[system], fabric.system(system)

        def inverted(color: Color, curve: BrightnessCurve = curve) -> Color:
            red, green, blue = (min(curve.albedo_of(c), 0.995) for c in color)
            return red, green, blue

        if max(max(c) for c in yarn.colors()) > curve.brightness[-1]:
            notes.append(
                f"the {system} is brighter in the photo than white fibers under the rig: albedo is at its limit"
            )
        changed = replace(yarn, albedo=inverted(yarn.albedo), yarn_albedo=tuple(inverted(c) for c in yarn.yarn_albedo))
        fabric = replace(fabric, **{system: changed})  # type: ignore[arg-type]
    return fabric, tuple(notes)
