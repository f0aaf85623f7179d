"""The kernels of the rasterizer against the same picture in plain torch with gradients by autograd."""

import numba
import numpy as np
import pytest
import torch
from raster_reference import Reference
from raster_scenes import coarse_fabric, coarse_renderer, leaves

from usdfab.fit.raster.hits import in_units
from usdfab.fit.raster.jumps import ALONG_COLUMN, ALONG_ROW, GAP_P, GAP_Q, P_ENDS, Q_ENDS, classified
from usdfab.fit.raster.visibility import index_patch, look

TILTED = coarse_fabric(fiber_count=20, roughness_azimuthal=0.15, cuticle_tilt=0.05)
SETTINGS = {
    "all": {"pixels": 16},
    "tilted": {"pixels": 16, "fabric": TILTED, "unshadowed": 0.4},
    "small": {"pixels": 12, "supersampling": 1, "view": 3.5e-3, "fabric": TILTED},
    "no single": {"pixels": 12, "single": False},
    "no diffuse": {"pixels": 12, "diffuse": False},
    "no edges": {"pixels": 12, "edges": False},
    "no shadows": {"pixels": 16, "shadows": False},
    "no rims": {"pixels": 12, "rims": False},
}
"""``small`` has pixels wider than fibers."""


@pytest.mark.parametrize("name", SETTINGS)
def test_picture_and_gradients_are_those_of_autograd(name):
    renderer = coarse_renderer(**SETTINGS[name])
    size = renderer.settings.size
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(size[1], size[0], 3)))
    pictures, gradients = [], []
    for reference in (False, True):
        shapes, look, named = leaves(renderer)
        image = Reference(renderer, look).image(shapes) if reference else renderer.image(shapes, look)
        (weights * image).sum().backward()
        pictures.append(image.detach().numpy())
        gradients.append({k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in named.items()})
    assert pictures[1].std() > 0.01
    np.testing.assert_allclose(pictures[0], pictures[1], rtol=1e-6, atol=1e-8)
    for key, expected in gradients[1].items():
        # The fits of the BSDF's kernel (arc sine, exponential, Bessel) are good to 3e-8.
        bound = 1e-6 * float(expected.abs().max()) + 1e-12
        np.testing.assert_allclose(gradients[0][key].numpy(), expected.numpy(), rtol=1e-5, atol=bound, err_msg=key)


@pytest.mark.parametrize("name", ["all", "tilted", "small"])
def test_jumps_are_classified_as_in_torch(name):
    renderer = coarse_renderer(**SETTINGS[name] | {"pixels": 32})
    reference = Reference(renderer, renderer.look_of())
    lines = reference._lines = renderer.model(renderer.model.shapes())
    geometry = renderer._geometry
    points, radius = in_units(geometry, lines.points, lines.radius)
    index = index_patch(renderer.model, lines.points.numpy(), lines.radius.numpy())
    seen, _ = look(index, renderer._view.eye, geometry.direction, np.zeros((0, 3)))
    for pairs, along_row in zip(renderer._pairs, (True, False), strict=True):
        kinds = classified(geometry, points, radius, seen, pairs, along_row)
        expected = reference.kinds_of(geometry, seen, pairs, ALONG_ROW if along_row else ALONG_COLUMN)
        assert {P_ENDS, Q_ENDS} <= set(kinds.tolist())
        assert name != "small" or all((kinds & bit).any() for bit in (GAP_P, GAP_Q))
        # Where two numbers are equal but for rounding, either may be the larger.
        assert (kinds != expected).sum() <= 1e-3 * (expected != 0).sum()


def test_gradients_are_the_same_bits_with_any_number_of_threads():
    found = []
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            renderer = coarse_renderer(24)
            shapes, look, named = leaves(renderer)
            renderer.image(shapes, look).square().sum().backward()
            found.append([v.grad.numpy().copy() for v in named.values() if v.grad is not None])
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))
