"""The maps from perceptual parameters to those of the lobes."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from usdfab.scattering import roughness

GAMMAS = st.floats(0.01, 1.0)


def test_values_by_hand():
    # 0.726 + 0.812 + 3.7 and sqrt(pi/8) (0.265 + 1.194 + 5.372), at gamma = 1 where all powers are 1.
    assert roughness.longitudinal_variance(1.0) == pytest.approx(5.238**2)
    assert roughness.azimuthal_scale(1.0) == pytest.approx(0.6266570687 * 6.831)
    # q(1) = 5.969 - 0.215 + 2.532 - 10.73 + 5.574 + 0.245; C = 1/e has ln C = -1.
    assert roughness.absorption_from_albedo(np.exp(-1.0), 1.0) == pytest.approx(3.375**-2)


def test_lobes_of_one_roughness():
    v = roughness.longitudinal_variance(0.4)
    np.testing.assert_allclose(roughness.lobe_variances(0.4, 0.4), v * np.array([1.0, 0.25, 4.0, 4.0]))
    assert roughness.lobe_variances(0.4, 0.1)[0] == roughness.longitudinal_variance(0.1)


@given(st.floats(1e-3, 1.0), GAMMAS)
def test_albedo_round_trip(albedo, gamma_n):
    sigma_a = roughness.absorption_from_albedo(albedo, gamma_n)
    assert roughness.albedo_from_absorption(sigma_a, gamma_n) == pytest.approx(albedo, rel=1e-12)


@given(GAMMAS)
def test_white_absorbs_nothing(gamma_n):
    assert roughness.absorption_from_albedo(1.0, gamma_n) == 0.0
    assert roughness.albedo_from_absorption(0.0, gamma_n) == 1.0


def test_monotone():
    gammas = np.linspace(0.01, 1.0, 500)
    assert np.all(np.diff(roughness.longitudinal_variance(gammas)) > 0)
    assert np.all(np.diff(roughness.azimuthal_scale(gammas)) > 0)
    albedo = np.linspace(0.01, 1.0, 500)[:, None]
    assert np.all(np.diff(roughness.absorption_from_albedo(albedo, gammas), axis=0) < 0)
