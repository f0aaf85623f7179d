"""Albedos of the surface model measured from the fibers: small renders under several lights, and a linear fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts are loaded when they are first used
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.neural.aggregation import aggregate
from usdfab.neural.surface_from_fabric import SurfaceAlbedos, surface_from_fabric
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.neural.surface_swatch import View, swatch_view
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import Rig, rig_for, swatch_scene
from usdfab.usd.scene import PointLight

Floats = NDArray[np.float64]
Components = Callable[[View], Floats]
"""The four components (N, 4) of a model at the pixels of a view."""

PIXELS_PER_CELL, MAX_PIXELS, SAMPLES = 4, 96, 256
PATHS = 100_000
"""Paths of each render: a mean colour is then good to about 2 %."""

TILTS = ((0.0, 0.0), (50.0, 0.0), (50.0, 90.0))
"""Lights besides the rig's own place: (degrees from the normal, degrees around it from +x). The first is the rig's."""


@dataclass(frozen=True, eq=False)
class Observation:
    """What a camera straight above sees of the fibers (H, W, 3) under one lamp, and what it looks at."""

    view: View
    pixels: Floats


def measured_albedos(
    fabric: FabricParameters, material: SurfaceMaterial | None = None, *, paths: int = PATHS, seed: int = 0,
    threads: int | None = None,
) -> SurfaceAlbedos:  # fmt: skip
    """Albedos with which the surface shows warp and weft as bright as the fibers are.

    A swatch is rendered under ``TILTS`` (a few seconds each) and once with the lamp behind it. Diffuse albedos for each
    channel and system and one specular albedo for each system, all at least 0, are fitted to the front by least
    squares: gloss and colour are told apart by the lights. Behind, only diffuse albedos are.

    Parameters
    ----------
    material:
        The surface; that of ``surface_from_fabric`` by default.
    """
    found, first = surface_from_fabric(fabric)
    surface = material or found

    def components(view: View, behind: bool = False) -> Floats:
        parts = aggregate(surface, view.queries, transmission=behind, samples=SAMPLES, threads=threads)
        return parts.astype(np.float64)

    front = observe(fabric, paths=paths, seed=seed, threads=threads)
    below = _observation(fabric, lamp_at(rig_for(fabric.size), 0, 0) * [1, 1, -1], paths, seed, threads)
    back = first.transmission.copy()
    back[:2] = fitted(components(below.view, True), _per_light(below), back[2:])
    return SurfaceAlbedos(fit_reflection(components, front), back)


def observe(
    fabric: FabricParameters, *, paths: int = PATHS, seed: int = 0, threads: int | None = None
) -> list[Observation]:
    """The fabric under each of ``TILTS``."""
    rig = rig_for(fabric.size)
    return [_observation(fabric, lamp_at(rig, *tilt), paths, seed, threads) for tilt in TILTS]


def lamp_at(rig: Rig, tilt: float, turn: float) -> Floats:
    """Place of a lamp as far from the sample as the rig's: the rig's own for no tilt, degrees otherwise."""
    own = np.asarray(rig.light_position)
    if tilt == 0.0:
        return own
    sine, angle = math.sin(math.radians(tilt)), math.radians(turn)
    unit = np.array([sine * math.cos(angle), sine * math.sin(angle), math.cos(math.radians(tilt))])
    return np.linalg.norm(own) * unit


def fit_reflection(components: Components, observations: Sequence[Observation]) -> Floats:
    """(4, 3) albedos, rows kd_warp, kd_weft, ks_warp, ks_weft (ks equal in all channels), nearest to what was seen."""
    # Unknowns: kd_warp, kd_weft for r, g, b, then ks_warp, ks_weft. Normal equations: pixels are many.
    matrix, target = np.zeros((8, 8)), np.zeros(8)
    for observation in observations:
        parts, seen = components(observation.view), _per_light(observation)
        for channel in range(3):
            rows = np.zeros((len(parts), 8))
            rows[:, 2 * channel : 2 * channel + 2] = parts[:, :2]
            rows[:, 6:] = parts[:, 2:]
            matrix += rows.T @ rows
            target += rows.T @ seen[:, channel]
    # What is seen of one system only leaves the other's gloss free: a trace of a wish for 0.
    root = np.linalg.cholesky(matrix + 1e-9 * np.trace(matrix) * np.eye(8))
    found, _ = scipy.optimize.nnls(root.T, np.linalg.solve(root, target))
    return np.concatenate([found[:6].reshape(3, 2).T, np.repeat(found[6:, None], 3, axis=1)])


def fitted(parts: Floats, seen: Floats, specular: Floats) -> Floats:
    """kd (2, 3) >= 0 with parts[:, :2] @ kd + parts[:, 2:] @ specular nearest to ``seen`` (N, 3)."""
    rest = seen - parts[:, 2:] @ specular
    return np.stack([scipy.optimize.nnls(parts[:, :2], rest[:, c])[0] for c in range(3)], axis=1)


def _per_light(observation: Observation) -> Floats:
    return observation.pixels.reshape(-1, 3) / observation.view.light[:, None]


def _observation(fabric: FabricParameters, lamp: Floats, paths: int, seed: int, threads: int | None) -> Observation:
    cells = np.asarray(fabric.size) / fabric.cell
    width = int(np.clip(PIXELS_PER_CELL * cells[0], 16, MAX_PIXELS))
    height = int(np.clip(round(width * fabric.size[1] / fabric.size[0]), 1, 4 * MAX_PIXELS))
    scene = swatch_scene(replace(fabric, variants=1))
    light = scene.lights[0]
    assert isinstance(light, PointLight)
    scene = replace(scene, lights=(replace(light, position=lamp),))
    settings = RenderSettings((width, height), spp=max(1, paths // (width * height)), seed=seed, threads=threads)
    render = Tracer(scene).render(scene.cameras[0], settings)
    view = swatch_view(fabric, rig_for(fabric.size), (width, height), lamp)
    return Observation(view, render.pixels.astype(np.float64))
