"""k_d tied to C: the map's values, slopes, and that the tied picture is as bright as the path-traced one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fit.raster.multiple import DiffuseMap, crossing_part
from usdfab.fit.raster.renderer import RasterSettings, raster_renderer
from usdfab.fit.raster.shade_kernel import UNSHADOWED
from usdfab.fit.raster_multiple import measured_diffuse
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene

LADDER = np.array([0.0, 0.25, 0.5, 1.0])
CURVES = np.stack([LADDER**2, 0.5 * LADDER])
MAP = DiffuseMap(LADDER, CURVES, np.array([0.0, 0.25]), np.array([0, 0, 1]))


def test_values_lie_on_the_curves_and_cross_over() -> None:
    albedo = torch.tensor([[0.25, 0.5, 1.0], [0.5, 0.5, 0.5], [1.0, 0.5, 0.25]], dtype=torch.float64)
    k_d = MAP(albedo).numpy()
    assert k_d[0] == pytest.approx([0.0625, 0.25, 1.0])
    own, other = 0.5 * albedo[2].numpy(), np.array([np.interp(m, LADDER, CURVES[1]) for m in (0.375, 0.5, 0.75)])
    assert k_d[2] == pytest.approx(own**0.75 * other**0.25)


def test_slopes_are_those_of_differences() -> None:
    albedo = torch.tensor([[0.3, 0.6, 0.9], [0.2, 0.4, 0.1], [0.7, 0.6, 0.35]], dtype=torch.float64)
    assert torch.autograd.gradcheck(MAP, albedo.requires_grad_())
    assert MAP(torch.zeros(3, 3, dtype=torch.float64)).gt(0.0).all()


def test_the_part_that_crosses_is_found_again() -> None:
    own, other = np.array([0.1, 0.6, 0.3]), np.array([0.8, 0.05, 0.5])
    for part in (0.0, 0.3, 1.0):
        assert crossing_part(own, other, own ** (1.0 - part) * other**part) == pytest.approx(part)


def test_the_tied_picture_has_the_traced_colours() -> None:
    yarn = YarnParameters(count=4, radius=2.4e-4, fiber_count=12, roughness_azimuthal=0.2, flattening=1.2)
    cloth = FabricParameters(
        size=(2e-3, 2e-3), warp=replace(yarn, albedo=(0.8, 0.4, 0.2)), weft=replace(yarn, albedo=(0.3, 0.6, 0.9))
    )
    renderer = raster_renderer(swatch_scene(cloth), RasterSettings((32, 32), 2, unshadowed=UNSHADOWED))
    tie = measured_diffuse(cloth, renderer, paths=20_000)
    look = renderer.look_of()
    look = replace(look, diffuse=tie(look.albedo))
    with torch.no_grad():
        shown = renderer.image(renderer.model.shapes(), look).double().mean(dim=(0, 1)).numpy()
        single = renderer.image(renderer.model.shapes(), renderer.look_of(0.0)).double().mean(dim=(0, 1)).numpy()
    scene = swatch_scene(cloth)
    traced = Tracer(scene).render(scene.cameras[0], RenderSettings((32, 32), spp=24)).pixels.mean(axis=(0, 1))
    assert shown == pytest.approx(traced, rel=0.15)
    assert (single < 0.8 * traced).all()
