"""Gradients of a rendered loss against finite differences.

A picture of pixels is not smooth: where two or more jumps fall into one pixel it jumps itself, and finite differences
are noisy. So they are fitted through several points; the noise of the fit tells whether they are resolved.
"""

import numpy as np
import pytest
import torch
from raster_scenes import coarse_renderer, leaves, slope
from scipy.ndimage import gaussian_filter

RESOLVED = 0.04
"""Standard error of a finite difference, relative to it, up to which it can tell 10 %."""

OPTICS = {"albedo": (1, 1), "diffuse": (0, 0), "roughness": (0, 0), "ior": (0,), "gain": ()}


def setting(pixels: int, **settings):
    """A renderer, its leaves, and a loss of the whole picture with weights that vary over it."""
    renderer = coarse_renderer(pixels, **settings)
    shapes, look, named = leaves(renderer)
    noise = np.random.default_rng(0).normal(size=(pixels, pixels, 3))
    weights = gaussian_filter(noise, (pixels / 16, pixels / 16, 0))
    weights = torch.from_numpy(1.0 + weights / weights.std())

    def loss() -> torch.Tensor:
        return (weights * renderer.image(shapes, look)).mean()

    return loss, named


def compared(loss, named, name: str, entry: tuple = (), part: float = 0.02, points: int = 7):
    """(gradient, finite difference over ``part`` of the value each way from ``points``, its standard error)."""
    tensor = named[name]
    value = abs(float(tensor.detach()[entry]))
    step = part * (value if name.endswith("radius") else max(value, 0.05))
    difference, error = slope(loss, tensor, entry, step, points)
    assert tensor.grad is not None
    return float(tensor.grad[entry]), difference, error


def test_gradients_of_the_shape():
    loss, named = setting(32, supersampling=4, single=False, shadows=False)
    loss().backward()
    resolved = []
    for name in ("warp.radius", "weft.inclination", "warp.crimp", "weft.flattening", "warp.irregularity", "warp.twist"):
        gradient, difference, error = compared(loss, named, name)
        if error < RESOLVED * abs(difference):
            resolved.append(name)
            assert gradient == pytest.approx(difference, rel=0.1), name
    assert len(resolved) >= 3, resolved


def test_gradients_of_the_optics():
    loss, named = setting(16)
    loss().backward()
    for name, entry in OPTICS.items():
        gradient, difference, _ = compared(loss, named, name, entry)
        assert gradient == pytest.approx(difference, rel=2e-3), name
    for column in (1, 2):
        gradient, difference, _ = compared(loss, named, "roughness", (1, column))
        assert gradient == pytest.approx(difference, rel=2e-3), column


def test_without_edges_the_gradient_is_wrong():
    with_edges, named = setting(32, supersampling=4, single=False, shadows=False)
    without, other = setting(32, supersampling=4, single=False, shadows=False, edges=False)
    with_edges().backward()
    without().backward()
    gradient, difference, error = compared(with_edges, named, "weft.radius")
    assert error < RESOLVED * abs(difference)
    assert gradient == pytest.approx(difference, rel=0.1)
    assert abs(float(other["weft.radius"].grad) - difference) > 0.5 * abs(difference)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shadows", "part", "points"),
    [
        (False, 0.02, 7),
        (True, 0.06, 13),
        (True, 0.02, 7),
        (False, 0.06, 13),
    ],
)  # fmt: skip
def test_gradients_of_everything(shadows, part, points):
    loss, named = setting(48, supersampling=4, shadows=shadows)
    loss().backward()
    report, wrong = {}, []
    shape = ("radius", "flattening", "inclination", "crimp", "twist", "irregularity")
    for name in [f"{system}.{k}" for system in ("warp", "weft") for k in shape]:
        gradient, difference, error = compared(loss, named, name, part=part, points=points)
        report[name] = (gradient, difference, error)
        if abs(difference) > 3.0 * error and gradient * difference <= 0.0:
            wrong.append(name)
        if error < RESOLVED * abs(difference) and abs(gradient - difference) > 0.1 * abs(difference):
            wrong.append(name)
    print("\n".join(f"{k}: {g:.4g} against {d:.4g} +- {e:.2g}" for k, (g, d, e) in report.items()))
    resolved = [k for k, (_, d, e) in report.items() if e < RESOLVED * abs(d)]
    assert not wrong
    assert len(resolved) >= 5, resolved
