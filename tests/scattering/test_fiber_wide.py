"""The fiber BSDF averaged over a range of h: value and derivatives against torch with gradients by autograd."""

import math

import numpy as np
import torch
from hypothesis import assume, given, settings, strategies as st
from numba import njit

from usdfab.scattering import fiber_numba_wide as wide, fiber_torch

ANGLE = st.floats(-1.4, 1.4)
ROUGH = st.floats(0.03, 0.95)


@njit
def _value(m, turn, low, high, sin_to, cos_to, sin_ti, cos_ti, phi):
    return wide.wide_value(m, wide.wide_lobes(m, turn, sin_to, cos_to, sin_ti, cos_ti), low, high, cos_to, phi)


@njit
def _slopes(m, turn, low, high, sin_to, cos_to, sin_ti, cos_ti, phi, weights, row):
    """Value, and derivatives by (low, high, sin_to, cos_to, sin_ti, cos_ti, phi)."""
    lobes = wide.wide_lobes(m, turn, sin_to, cos_to, sin_ti, cos_ti)
    value, by_lobes, rest = wide.wide_slopes(m, lobes, low, high, cos_to, phi, weights, row)
    more = wide.wide_lobes_slopes(m, turn, sin_to, cos_to, sin_ti, cos_ti, lobes, by_lobes, row)
    return value, (rest[0], rest[1], more[0], rest[2] + more[1], more[2], more[3], rest[3])


@settings(max_examples=300, deadline=None)
@given(
    st.tuples(*[st.floats(0.05, 1.0)] * 3), ROUGH, ROUGH, ROUGH, st.floats(1.3, 1.8), st.sampled_from([0.0, 0.1]),
    st.floats(-0.99, 0.99), st.sampled_from([1e-7, 1e-3, 0.1, 0.6]), ANGLE, ANGLE, st.floats(-math.pi, math.pi),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
)  # fmt: skip
def test_value_and_derivatives_are_those_of_torch(
    albedo, gamma_m, gamma_n, gamma_m0, eta, tilt, h, spread, to, ti, phi, weights
):
    low, high = max(h - spread / 2, -0.995), min(h + spread / 2, 0.995)
    # D has a kink at half a turn, where it is trimmed; either end may be there, too.
    at = np.array([low, h, high])
    inner = 2.0 * np.arcsin(at * math.cos(to) / math.sqrt(eta**2 - math.sin(to) ** 2))
    centers = np.array([0.0 * inner, inner + math.pi, 2.0 * inner]) - 2.0 * np.arcsin(at)
    assume((np.cos(phi - centers) > -1.0 + 1e-6).all())
    parameters = torch.tensor([*albedo, gamma_m, gamma_n, gamma_m0, eta], dtype=torch.float64)
    packed = fiber_torch.pack_fiber(parameters[:3], *parameters[3:], tilt=tilt)
    constants = torch.stack([*packed.sigma, packed.eta, packed.inv_s, packed.d_scale, *packed.inv_v, *packed.m_scale])
    constants = constants.detach().requires_grad_(True)
    geometry = torch.tensor([low, high, to, ti, phi], dtype=torch.float64, requires_grad=True)
    sines = [torch.sin(geometry[2]), torch.cos(geometry[2]), torch.sin(geometry[3]), torch.cos(geometry[3])]
    m = constants
    value = fiber_torch.eval_fiber(
        fiber_torch.PackedFiber(m[:3], m[3], m[4], m[5], tuple(m[6:9]), tuple(m[9:12]), tilt),
        0.5 * (geometry[0] + geometry[1]), *sines, geometry[4], geometry[1] - geometry[0],
    )  # fmt: skip
    weighted = (torch.tensor(weights, dtype=torch.float64) * value).sum()
    weighted.backward()

    row, turn = np.zeros(wide.WIDE_SIZE), wide.tilts(tilt)
    angles = [float(s.detach()) for s in sines]
    mine = constants.detach().numpy()
    assert np.allclose(_value(mine, turn, low, high, *angles, phi), value.detach().numpy(), rtol=1e-6, atol=1e-9)
    found, slopes = _slopes(mine, turn, low, high, *angles, phi, weights, row)
    assert np.allclose(found, value.detach().numpy(), rtol=1e-6, atol=1e-9)
    by_to = slopes[2] * angles[1] - slopes[3] * angles[0]
    by_ti = slopes[4] * angles[3] - slopes[5] * angles[2]
    mine_geometry = np.array([slopes[0], slopes[1], by_to, by_ti, slopes[6]])
    size = 1e-5 + float(value.detach().abs().max())
    for expected, got in ((geometry.grad.numpy(), mine_geometry), (constants.grad.numpy(), row)):
        assert np.allclose(got, expected, rtol=1e-4, atol=1e-6 * size + 1e-7 * np.abs(expected).max())
