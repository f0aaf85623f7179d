"""The rasterizer's pictures against the path tracer's, and its switches."""

import numpy as np
import pytest
import torch
from raster_scenes import coarse_fabric, coarse_renderer

from usdfab.errors import UsdfabError
from usdfab.fit.raster.renderer import RasterSettings, raster_renderer
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import Rig, swatch_scene


def picture(renderer, diffuse: float = 0.0) -> np.ndarray:
    with torch.no_grad():
        return renderer.image(renderer.model.shapes(), renderer.look_of(diffuse)).numpy()


def test_single_scattering_is_the_path_tracers():
    """Depth 2 of the tracer is direct light: the same fibers, lamp and shadows, by another way."""
    fabric = coarse_fabric(fiber_count=20, roughness_azimuthal=0.15)
    scene = swatch_scene(fabric, Rig((2e-3, 2e-3)))
    traced = Tracer(scene).render(scene.cameras[0], RenderSettings((24, 24), spp=256, max_depth=2, threads=2))
    # As many cells as the tracer's tile has, so that the draws are the same.
    settings = RasterSettings((24, 24), supersampling=6, vertices_per_segment=40, cells=4, diffuse=False)
    raster = picture(raster_renderer(scene, settings))
    np.testing.assert_allclose(raster.mean(axis=(0, 1)), traced.pixels.mean(axis=(0, 1)), rtol=0.02)
    noise = np.sqrt(traced.variance.mean())
    apart = np.sqrt(np.mean((raster - traced.pixels) ** 2))
    assert apart < 3.0 * noise + 0.05 * traced.pixels.mean()
    assert np.corrcoef(raster.ravel(), traced.pixels.ravel())[0, 1] > 0.9


def test_a_white_diffuse_picture_is_bounded_by_its_lamp():
    # f_d times the cosine is at most 1 / pi: no pixel is brighter than the white card that the rig is set to.
    pixels = picture(coarse_renderer(16, single=False, shadows=False, edges=False), diffuse=1.0)
    assert 0.5 < pixels.mean() < 1.0
    assert pixels.max() < 1.1


def test_shadows_only_darken():
    lit, dark = (picture(coarse_renderer(16, shadows=s, edges=False), 0.3) for s in (False, True))
    assert (dark <= lit + 1e-12).all()
    assert dark.mean() < 0.995 * lit.mean()
    # What of the diffuse term is not shadowed is there as without shadows, and single scattering is not touched.
    part = {"edges": False, "single": False}
    lit, dark, floor = (
        picture(coarse_renderer(16, **part, **more), 0.3) for more in ({"shadows": False}, {}, {"unshadowed": 0.4})
    )
    np.testing.assert_allclose(floor, 0.4 * lit + 0.6 * dark, rtol=1e-9, atol=1e-15)
    single = {"edges": False, "diffuse": False}
    alike = [picture(coarse_renderer(16, **single, unshadowed=u), 0.3) for u in (0.0, 0.4)]
    np.testing.assert_array_equal(*alike)


def test_edges_move_no_light():
    # Blending jumps changes where light is seen, hardly how much.
    plain, smooth = (picture(coarse_renderer(32, edges=e), 0.3) for e in (False, True))
    assert smooth.mean() == pytest.approx(plain.mean(), rel=0.01)
    # It is antialiasing: nearer to the same picture with many more pixels.
    truth = picture(coarse_renderer(32, edges=False, supersampling=8), 0.3)
    assert np.mean((smooth - truth) ** 2) < 0.6 * np.mean((plain - truth) ** 2)


def test_the_same_bits_every_time():
    renderer = coarse_renderer(16, float64=False)
    assert np.array_equal(picture(renderer, 0.3), picture(renderer, 0.3))


def test_gain_and_exposure_are_factors():
    renderer = coarse_renderer(8)
    look = renderer.look_of(0.3)
    with torch.no_grad():
        once = renderer.image(renderer.model.shapes(), look)
        look.gain.fill_(2.0)
        twice = renderer.image(renderer.model.shapes(), look)
    np.testing.assert_allclose(twice.numpy(), 2.0 * once.numpy(), rtol=1e-12)


def test_pictures_that_cannot_be():
    with pytest.raises(UsdfabError, match="cannot rasterize"):
        coarse_renderer(1)
