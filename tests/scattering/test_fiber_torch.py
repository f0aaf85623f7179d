"""The torch target of the fiber BSDF against the Numba target, and its gradients against finite differences."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numba import njit

from usdfab.scattering import fiber_numba, fiber_torch

ANGLE = st.floats(-1.5, 1.5)
ROUGH = st.floats(0.02, 0.95)


@njit
def _numba_value(p, h, sin_to, cos_to, sin_ti, cos_ti, phi):
    prep = fiber_numba.prepare_fiber(p, h, sin_to, cos_to)
    return fiber_numba.eval_fiber(p, prep, sin_ti, cos_ti, phi)


def _torch_value(parameters: torch.Tensor, geometry: torch.Tensor, tilt: float = 0.0) -> torch.Tensor:
    """``parameters`` (7,) C, gamma_M, gamma_N, gamma_M0, eta; ``geometry`` (N, 4) h, theta_o, theta_i, phi."""
    p = fiber_torch.pack_fiber(parameters[:3], *parameters[3:], tilt=tilt)
    h, to, ti, phi = geometry.unbind(-1)
    return fiber_torch.eval_fiber(p, h, torch.sin(to), torch.cos(to), torch.sin(ti), torch.cos(ti), phi)


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(*[st.floats(0.01, 1.0)] * 3), ROUGH, ROUGH, ROUGH, st.floats(1.3, 1.8), st.sampled_from([0.0, 0.1]),
    st.floats(-0.999, 0.999), ANGLE, ANGLE, st.floats(-math.pi, math.pi),
)  # fmt: skip
def test_both_targets_agree(albedo, gamma_m, gamma_n, gamma_m0, eta, tilt, h, to, ti, phi):
    numba = _numba_value(
        fiber_numba.pack_fiber(albedo, gamma_m, gamma_n, gamma_m0, eta, tilt),
        h, math.sin(to), math.cos(to), math.sin(ti), math.cos(ti), phi,
    )  # fmt: skip
    parameters = torch.tensor([*albedo, gamma_m, gamma_n, gamma_m0, eta], dtype=torch.float64)
    value = _torch_value(parameters, torch.tensor([[h, to, ti, phi]], dtype=torch.float64), tilt)[0]
    np.testing.assert_allclose(value.numpy(), numba[:3], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("gamma_n", [0.03, 0.15, 0.6])
@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_gradients_are_those_of_finite_differences(gamma_n, tilt):
    rng = np.random.default_rng(3)
    geometry = torch.tensor(
        np.c_[rng.uniform(-0.95, 0.95, 6), rng.uniform(-1, 1, (6, 2)), rng.uniform(-3, 3, 6)], requires_grad=True
    )
    parameters = torch.tensor([0.3, 0.6, 0.9, 0.4, gamma_n, 0.12, 1.55], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: _torch_value(a, b, tilt), (parameters, geometry), rtol=1e-4, atol=1e-7)


def test_a_white_fiber_scatters_all_light():
    # Integral over directions of S cos(theta_i), C = 1: midpoint rule in sin(theta_i) and phi.
    n = 400
    sin_ti = (torch.arange(n, dtype=torch.float64) + 0.5) * 2 / n - 1
    phi = (torch.arange(n, dtype=torch.float64) + 0.5) * 2 * math.pi / n
    parameters = torch.tensor([1.0, 1.0, 1.0, 0.4, 0.2, 0.2, 1.55], dtype=torch.float64)
    p = fiber_torch.pack_fiber(parameters[:3], *parameters[3:])
    for h, theta_o in ((0.0, 0.0), (0.7, 0.5), (-0.9, -1.0)):
        one = torch.ones(n, n, dtype=torch.float64)
        grid = sin_ti[:, None] * one
        value = fiber_torch.eval_fiber(
            p, h * one, math.sin(theta_o) * one, math.cos(theta_o) * one, grid, torch.sqrt(1 - grid**2), phi * one
        )
        total = value.sum(dim=(0, 1)) * (2 / n) * (2 * math.pi / n)
        np.testing.assert_allclose(total.numpy(), 1.0, rtol=2e-3)


def test_gradients_stay_finite_at_the_edge_of_the_fiber_and_in_single_precision():
    geometry = torch.tensor([[1.0, 0.0, 0.0, 0.0], [-1.0, 1.57, -1.57, 3.1], [0.0, 0.3, -0.3, 0.0]], requires_grad=True)
    parameters = torch.tensor([1e-4, 0.5, 1.0, 0.02, 0.02, 0.02, 1.55], requires_grad=True)
    _torch_value(parameters, geometry).sum().backward()
    assert torch.isfinite(geometry.grad).all()
    assert torch.isfinite(parameters.grad).all()


@pytest.mark.parametrize("gamma_n", [0.05, 0.3])
@pytest.mark.parametrize("phi", [-2.9, -0.4, 0.3, 1.5, 3.1])
def test_a_spread_is_the_mean_over_offsets(gamma_n, phi):
    # Narrow enough for attenuation to hardly change, much wider than D.
    parameters = torch.tensor([0.3, 0.6, 0.9, 0.4, gamma_n, 0.12, 1.55], dtype=torch.float64)
    p = fiber_torch.pack_fiber(parameters[:3], *parameters[3:])
    one = torch.ones(4000, dtype=torch.float64)
    # At the caustic of TRT (h = 0.6, phi = 0.3) Phi turns around within the spread: there it is about right only.
    for h, tolerance in ((-0.5, 0.02), (0.0, 0.02), (0.6, 0.15)):
        fine = h + 0.1 * ((torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 - 0.5)
        angles = (0.3 * one).sin(), (0.3 * one).cos(), (-0.2 * one).sin(), (-0.2 * one).cos(), phi * one
        mean = fiber_torch.eval_fiber(p, fine, *angles).mean(dim=0)
        spread = fiber_torch.eval_fiber(p, h * one[:1], *(a[:1] for a in angles), spread=0.1 * one[:1])[0]
        np.testing.assert_allclose(spread.numpy(), mean.numpy(), rtol=tolerance, atol=1e-4)


def test_gradients_of_a_spread_are_those_of_finite_differences():
    geometry = torch.tensor([[0.1, 0.2, -0.3, 0.2], [-0.7, 0.4, 0.1, 2.9]], dtype=torch.float64, requires_grad=True)
    parameters = torch.tensor([0.3, 0.6, 0.9, 0.4, 0.06, 0.12, 1.55], dtype=torch.float64, requires_grad=True)

    def value(a, b):
        p = fiber_torch.pack_fiber(a[:3], *a[3:])
        h, to, ti, phi = b.unbind(-1)
        spread = torch.full_like(h, 0.3)
        return fiber_torch.eval_fiber(p, h, to.sin(), to.cos(), ti.sin(), ti.cos(), phi, spread)

    assert torch.autograd.gradcheck(value, (parameters, geometry), rtol=1e-4, atol=1e-7)
