"""Measures how much diffuse light stands for multiple scattering in a cloth: path-traced brightness minus the first
scattering, for a ladder of albedos, see ``raster.multiple``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.fabric import SYSTEMS, Color, FabricParameters
from usdfab.fabric.optics import optics_of
from usdfab.fit.albedo import brightness_curves, means_on_top, visible_means
from usdfab.fit.raster.multiple import DiffuseMap, crossing_part
from usdfab.fit.raster.renderer import RasterRenderer
from usdfab.usd.rig import Rig

Floats = NDArray[np.float64]

PATHS = 60_000
"""Paths of each of the four pictures: their mean brightness is then good to about 2 %."""

MIXED: tuple[Color, Color] = ((0.05, 0.9, 0.3), (0.9, 0.05, 0.8))
"""Albedos of warp and weft in the picture that tells how much light crosses over."""

GREY = 0.5
LARGEST = 2.0
"""Of k_d: white fibers in deep cloth may show more light than a white diffuse surface of their own area."""


def measured_diffuse(
    fabric: FabricParameters, renderer: RasterRenderer, rig: Rig | None = None, paths: int = PATHS, seed: int = 0
) -> DiffuseMap:
    """k_d as a function of C for ``fabric``.

    Parameters
    ----------
    renderer:
        Of this fabric under ``rig``: its pictures without a diffuse term are taken from what the tracer shows.
    paths:
        Of each path-traced picture; four are made.
    """
    curves = brightness_curves(fabric, paths, seed=seed, rig=rig)
    ladder = np.r_[curves["warp"].albedo, 1.0]
    traced = np.array([np.r_[curves[s].brightness, _end(curves[s].albedo, curves[s].brightness)] for s in SYSTEMS])
    unit = _raster(renderer, np.full((2, 3), GREY), 1.0) - _raster(renderer, np.full((2, 3), GREY), 0.0)
    unit = np.maximum(unit.mean(axis=1), 1e-9)

    def single(warp: Floats, weft: Floats) -> Floats:
        """(2, N) brightness of one scattering for albedos (N,), three at a time."""
        parts = [_raster(renderer, np.stack([warp[k : k + 3], weft[k : k + 3]]), 0.0) for k in range(0, len(warp), 3)]
        return np.concatenate(parts, axis=1)

    spare = -len(ladder) % 3
    padded = np.r_[ladder, np.ones(spare)]
    once = single(padded, padded)[:, : len(ladder)]
    diffuse = np.clip((traced - once) / unit[:, None], 0.0, LARGEST)
    diffuse = np.maximum.accumulate(diffuse, axis=1)

    warp, weft = np.array(MIXED[0]), np.array(MIXED[1])
    mixed = replace(
        fabric,
        warp=replace(fabric.warp, albedo=MIXED[0], yarn_albedo=()),
        weft=replace(fabric.weft, albedo=MIXED[1], yarn_albedo=()),
    )
    means = visible_means(mixed, paths, seed, rig)
    once = single(warp, weft)
    crossing = np.empty(2)
    for k, (system, own, other) in enumerate(zip(SYSTEMS, (warp, weft), (weft, warp), strict=True)):
        seen = (means[system] - once[k]) / unit[k]
        crossing[k] = crossing_part(np.interp(own, ladder, diffuse[k]), np.interp(other, ladder, diffuse[k]), seen)
    return DiffuseMap(ladder, diffuse, crossing, np.asarray(optics_of(fabric).system, dtype=np.int64))


def _end(albedo: Floats, brightness: Floats) -> float:
    """Brightness at albedo 1, straight on from the last two points."""
    slope = (brightness[-1] - brightness[-2]) / (albedo[-1] - albedo[-2])
    return float(brightness[-1] + slope * (1.0 - albedo[-1]))


def _raster(renderer: RasterRenderer, albedo: Floats, diffuse: float) -> Floats:
    """(2, 3) mean colours of warp and weft where they are on top, in the raster picture with these albedos (2, 3)."""
    system = np.asarray(optics_of(renderer.fabric).system, dtype=np.int64)
    look = replace(renderer.look_of(diffuse), albedo=torch.from_numpy(np.ascontiguousarray(albedo[system])))
    with torch.no_grad():
        picture = renderer.image(renderer.model.shapes(), look).double().numpy()
    means = means_on_top(picture, renderer.fabric)
    return np.array([means[s] for s in SYSTEMS])
