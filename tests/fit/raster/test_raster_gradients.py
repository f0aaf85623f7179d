"""Gradients of a rendered loss against finite differences.

A picture of pixels is not smooth: where two or more jumps fall into one pixel it jumps itself, and its gradient varies
from place to place. So the mean of gradients along a way is held against the loss's difference over it, which it is the
integral of; how much they differ from one stretch of the way to the next tells whether the difference is resolved.
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


def along(loss, named, name: str, part: float = 0.06, stretches: int = 12):
    """(mean gradient, finite difference, its standard error) over ``part`` of the value each way."""
    tensor = named[name]
    start = tensor.detach().clone()
    value = abs(float(start))
    step = part * (value if name.endswith("radius") else max(value, 0.05))
    borders = np.linspace(-step, step, stretches + 1)
    losses, gradients = [], []
    for offset in borders:
        with torch.no_grad():
            tensor.copy_(start + offset)
            losses.append(float(loss()))
    for offset in 0.5 * (borders[1:] + borders[:-1]):
        with torch.no_grad():
            tensor.copy_(start + offset)
        tensor.grad = None
        loss().backward()
        gradients.append(float(tensor.grad))
    with torch.no_grad():
        tensor.copy_(start)
    differences = np.diff(losses) / np.diff(borders)
    error = np.std(np.array(gradients) - differences, ddof=1) / np.sqrt(stretches)
    return float(np.mean(gradients)), float(differences.mean()), float(error)


def test_gradients_of_the_shape():
    loss, named = setting(32, supersampling=4, shadows=False)
    resolved = []
    for name in ("weft.radius", "weft.inclination", "warp.crimp", "weft.flattening"):
        gradient, difference, error = along(loss, named, name, stretches=8)
        if error < RESOLVED * abs(difference):
            resolved.append(name)
            assert gradient == pytest.approx(difference, rel=0.1), name
    assert len(resolved) >= 3, resolved


def compared(loss, named, name: str, entry: tuple) -> tuple[float, float]:
    """Gradient and finite difference of what the picture is smooth in."""
    tensor = named[name]
    return float(tensor.grad[entry]), slope(loss, tensor, entry, 0.02 * max(abs(float(tensor.detach()[entry])), 0.05))


def test_gradients_of_the_optics():
    loss, named = setting(16)
    loss().backward()
    for name, entry in OPTICS.items():
        gradient, difference = compared(loss, named, name, entry)
        assert gradient == pytest.approx(difference, rel=2e-3), name
    for column in (1, 2):
        gradient, difference = compared(loss, named, "roughness", (1, column))
        assert gradient == pytest.approx(difference, rel=2e-3), column


def test_without_edges_the_gradient_is_wrong():
    loss, named = setting(32, supersampling=4, single=False, shadows=False)
    gradient, difference, error = along(loss, named, "weft.radius")
    assert error < RESOLVED * abs(difference)
    assert gradient == pytest.approx(difference, rel=0.1)
    loss, named = setting(32, supersampling=4, single=False, shadows=False, edges=False)
    assert abs(along(loss, named, "weft.radius", stretches=3)[0] - difference) > 0.5 * abs(difference)


SHAPE = tuple(
    f"{system}.{k}"
    for system in ("warp", "weft")
    for k in ("radius", "flattening", "inclination", "crimp", "twist", "irregularity")
)
THICKNESS = ("weft.radius", "weft.flattening")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shadows", "names"),
    [
        (False, SHAPE),
        (True, tuple(name for name in SHAPE if name not in THICKNESS)),
        pytest.param(
            True,
            THICKNESS,
            marks=pytest.mark.xfail(
                reason="12 to 15 % too small: light that comes out between a shadow and the fiber's own silhouette",
                strict=True,
            ),
        ),
    ],
)
def test_gradients_of_everything(shadows, names):
    loss, named = setting(48, supersampling=4, shadows=shadows)
    report, wrong, resolved = {}, [], []
    for name in names:
        gradient, difference, error = report[name] = along(loss, named, name)
        if abs(difference) > 3.0 * error and gradient * difference <= 0.0:
            wrong.append(name)
        if error < RESOLVED * abs(difference):
            resolved.append(name)
            if abs(gradient - difference) > 0.1 * abs(difference):
                wrong.append(name)
    print("\n".join(f"{k}: {g:.4g} against {d:.4g} +- {e:.2g}" for k, (g, d, e) in report.items()))
    assert not wrong
    assert len(resolved) >= len(names) // 3, resolved
