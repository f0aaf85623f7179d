"""Small fabrics of few, thick fibers, so that a picture of some pixels shows each of them."""

import numpy as np
import torch

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fit.raster.renderer import RasterRenderer, RasterSettings, raster_renderer
from usdfab.usd.rig import Rig, swatch_scene

YARN = {
    "fiber_count": 3, "radius": 0.4e-3, "count": 5, "inclination": 0.8, "crimp": 0.9, "twist": 0.03,
    "irregularity": 0.15, "migration": 0.5, "migration_rate": 0.2, "packing": 0.5, "roughness_longitudinal": 0.5,
    "roughness_azimuthal": 0.5, "roughness_primary": 0.5,
}  # fmt: skip


def coarse_fabric(**changes) -> FabricParameters:
    yarn = YARN | changes
    warp = YarnParameters(albedo=(0.6, 0.3, 0.2), flattening=1.2, **yarn)
    weft = YarnParameters(albedo=(0.2, 0.5, 0.7), flattening=1.1, **yarn)
    return FabricParameters(size=(4e-3, 4e-3), warp=warp, weft=weft, variants=1)


def coarse_renderer(pixels: int = 24, view: float = 2e-3, fabric: FabricParameters | None = None, **settings):
    scene = swatch_scene(fabric or coarse_fabric(), Rig((view, view)))
    defaults = {"size": (pixels, pixels), "cells": 2, "float64": True}
    return raster_renderer(scene, RasterSettings(**(defaults | settings)))


def leaves(renderer: RasterRenderer, diffuse: float = 0.3):
    """Shapes and look with gradients switched on, and all their tensors by name."""
    shapes, look = renderer.model.shapes(), renderer.look_of(diffuse)
    named = {}
    for system, shape in zip(("warp", "weft"), shapes, strict=True):
        named |= {f"{system}.{k}": v for k, v in vars(shape).items() if k not in ("ply_twist", "migration_rate")}
    named |= vars(look)
    for tensor in named.values():
        tensor.requires_grad_(True)
    return shapes, look, named


def slope(function, tensor: torch.Tensor, entry: tuple, step: float, points: int = 7) -> tuple[float, float]:
    """Derivative of ``function()`` by an entry of ``tensor`` from a cubic through several points, and its error."""
    offsets = np.linspace(-1.0, 1.0, points)
    with torch.no_grad():
        start = tensor[entry].clone()
        values = []
        for offset in offsets:
            tensor[entry] = start + offset * step
            values.append(float(function()))
        tensor[entry] = start
    matrix = np.vander(offsets, 4)
    fit = np.linalg.lstsq(matrix, np.array(values), rcond=None)[0]
    rest = np.array(values) - matrix @ fit
    spread = np.linalg.inv(matrix.T @ matrix)[2, 2] * (rest @ rest) / (points - 4)
    return fit[2] / step, float(np.sqrt(spread)) / step
