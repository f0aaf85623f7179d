"""Albedos of the surface model measured from the fibers: a small render of each side, and a linear fit to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.neural.aggregation import aggregate
from usdfab.neural.surface_from_fabric import SurfaceAlbedos, surface_from_fabric
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.neural.surface_swatch import swatch_view
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import rig_for, swatch_scene
from usdfab.usd.scene import PointLight

Floats = NDArray[np.float64]

PIXELS_PER_CELL, MAX_PIXELS, SAMPLES = 4, 96, 256
PATHS = 150_000
"""Paths of each render: a mean colour is then good to about 2 %."""


def measured_albedos(
    fabric: FabricParameters, material: SurfaceMaterial | None = None, *, paths: int = PATHS, seed: int = 0,
    threads: int | None = None,
) -> SurfaceAlbedos:  # fmt: skip
    """Diffuse albedos with which the surface shows the same mean colours of warp and weft as the fibers do.

    The swatch is rendered under the capture rig, lit from the front and from behind (a few seconds each). The surface
    model's components at the same pixels are fitted to it by least squares, for each channel; specular albedos are
    those of ``surface_from_fabric``, since from one direction of light gloss and colour cannot be told apart.

    Parameters
    ----------
    material:
        The surface; that of ``surface_from_fabric`` by default.
    """
    found, first = surface_from_fabric(fabric)
    material = material or found
    both = []
    for behind, start in ((False, first.reflection), (True, first.transmission)):
        pixels, resolution = _rendered(fabric, behind, paths, seed, threads)
        view = swatch_view(fabric, rig_for(fabric.size), resolution, behind=behind)
        parts = aggregate(material, view.queries, transmission=behind, samples=SAMPLES, threads=threads)
        seen = pixels.reshape(-1, 3) / view.light[:, None]
        albedo = start.copy()
        albedo[:2] = fitted(parts.astype(np.float64), seen, start[2:])
        both.append(albedo)
    return SurfaceAlbedos(both[0], both[1])


def fitted(parts: Floats, seen: Floats, specular: Floats) -> Floats:
    """kd (2, 3) >= 0 with parts[:, :2] @ kd + parts[:, 2:] @ specular nearest to ``seen`` (N, 3)."""
    rest = seen - parts[:, 2:] @ specular
    kd, *_ = np.linalg.lstsq(parts[:, :2], rest, rcond=None)
    for channel in range(3):
        # With one of the two below 0, the best in range has it at 0 and the other fitted alone.
        for bad, good in ((0, 1), (1, 0)):
            if kd[bad, channel] < 0.0:
                one = parts[:, good]
                kd[bad, channel] = 0.0
                kd[good, channel] = max(float(one @ rest[:, channel]) / max(float(one @ one), 1e-12), 0.0)
    return np.maximum(kd, 0.0)


def _rendered(
    fabric: FabricParameters, behind: bool, paths: int, seed: int, threads: int | None
) -> tuple[Floats, tuple[int, int]]:
    """Pixels of the swatch (H, W, 3) and (width, height)."""
    cells = np.asarray(fabric.size) / fabric.cell
    width = int(np.clip(PIXELS_PER_CELL * cells[0], 16, MAX_PIXELS))
    height = int(np.clip(round(width * fabric.size[1] / fabric.size[0]), 1, 4 * MAX_PIXELS))
    scene = swatch_scene(replace(fabric, variants=1))
    if behind:
        lamp = scene.lights[0]
        assert isinstance(lamp, PointLight)
        scene = replace(scene, lights=(replace(lamp, position=lamp.position * [1, 1, -1]),))
    settings = RenderSettings((width, height), spp=max(1, paths // (width * height)), seed=seed, threads=threads)
    render = Tracer(scene).render(scene.cameras[0], settings)
    return render.pixels.astype(np.float64), (width, height)
