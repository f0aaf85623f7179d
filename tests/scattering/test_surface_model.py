"""The point model of woven surfaces against integrals, limits and symmetries that do not come from its own code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numba import njit

from usdfab.scattering import surface_model as model
from usdfab.scattering.surface_model_numba import flake_reflection, flake_transmission

ALPHAS = (0.1, 0.3, 0.7, 1.0)
UP = np.array([0.0, 0.0, 1.0])


def sphere(polar: int = 160, around: int = 320) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and weights (n,): Gauss in each half of z, equal steps around it."""
    x, w = np.polynomial.legendre.leggauss(polar // 2)
    z, wz = np.concatenate([0.5 * x + 0.5, -0.5 * x - 0.5]), np.concatenate([w, w]) * 0.5
    phi = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    r = np.sqrt(1.0 - z**2)
    grid = np.stack(np.broadcast_arrays(r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), z[:, None]), axis=-1)
    weights = np.broadcast_to(wz[:, None] * 2.0 * np.pi / around, grid.shape[:2])
    return grid.reshape(-1, 3), weights.reshape(-1)


DIRECTIONS, WEIGHTS = sphere()


def direction(theta: float, phi: float) -> np.ndarray:
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


VIEWS = [direction(*angles) for angles in ((0.0, 0.0), (0.6, 0.4), (1.2, 2.0), (1.45, -0.7))]
TANGENT = direction(math.pi / 2, 0.3)
angle = st.floats(0.0, 1.5)
turn = st.floats(-math.pi, math.pi)
alphas = st.floats(0.05, 1.0)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_the_flakes_project_to_sigma_and_lambda(alpha: float) -> None:
    """The integral of the flakes' projected area is sqrt(w S w), and over the cosine Lambda (two faces each)."""
    for w in VIEWS:
        seen = np.sum(np.abs(DIRECTIONS @ w) * model.flake_density(DIRECTIONS, TANGENT, alpha) * WEIGHTS) / 2.0
        assert seen == pytest.approx(model.projected_area(w, TANGENT, alpha), rel=2e-3)
        assert seen / w[2] == pytest.approx(model.smith_lambda(w, UP, TANGENT, alpha), rel=2e-3)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_sigma_is_that_of_the_turned_matrix(alpha: float) -> None:
    across = np.cross(UP, TANGENT)
    turn = np.stack([across, np.cross(TANGENT, across), TANGENT])
    matrix = turn.T @ np.diag([1.0, 1.0, alpha**2]) @ turn
    for w in VIEWS:
        assert model.projected_area(w, TANGENT, alpha) == pytest.approx(math.sqrt(w @ matrix @ w), rel=1e-12)
        q = w @ np.linalg.inv(matrix) @ w
        assert model.flake_density(w, TANGENT, alpha) == pytest.approx(1 / (math.pi * alpha * q**2), rel=1e-12)


def scattered(wo: np.ndarray, alpha: float, depth: float = model.OPTICAL_DEPTH) -> tuple[float, float]:
    """Specular light from ``wo`` that comes back and that goes through, by quadrature over all directions."""
    cosines = np.abs(DIRECTIONS[:, 2]) * WEIGHTS
    back = model.specular_reflection(DIRECTIONS, wo, UP, TANGENT, alpha, depth)
    through = model.specular_transmission(DIRECTIONS, wo, UP, TANGENT, alpha, depth)
    return float(np.sum(back * cosines)), float(np.sum(through * cosines))


@pytest.mark.parametrize("alpha", ALPHAS)
def test_white_flakes_scatter_no_more_than_they_meet(alpha: float) -> None:
    """Reflected, transmitted and unscattered light: at most 1, and as much as scatters once at least half of it."""
    for wo in VIEWS:
        back, through = scattered(wo, alpha)
        passed = math.exp(-model.OPTICAL_DEPTH * float(model.smith_lambda(wo, UP, TANGENT, alpha)))
        assert back > 0.0 and through > 0.0
        assert back + through + passed <= 1.0
        # What is missing was scattered more than once, which the model leaves out.
        assert back + through + passed > 0.25


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("view", range(4))
def test_a_thin_layer_scatters_all_that_it_meets(alpha: float, view: int) -> None:
    """Single scattering: as T rho goes to 0, reflected plus transmitted light tends to T rho Lambda."""
    wo, ratios = VIEWS[view], []
    for depth in (2e-3, 1e-3):
        met = depth * float(model.smith_lambda(wo, UP, TANGENT, alpha))
        ratios.append(sum(scattered(wo, alpha, depth)) / met)
    # What is lost to grazing ways through the layer falls with its depth.
    assert 1.0 - ratios[1] < 0.03 and abs(1.0 - ratios[1]) < abs(1.0 - ratios[0]) + 2e-3


def test_transmission_where_both_lambdas_are_equal() -> None:
    """G_t tends to T rho exp(-T rho L), from both sides and without a jump."""
    for level in (0.3, 1.0, 4.0):
        limit = model.OPTICAL_DEPTH * math.exp(-model.OPTICAL_DEPTH * level)
        for gap in (1e-2, 1e-5, 1e-8, 1e-10, 0.0, -1e-10, -1e-5):
            g = float(model.attenuation_transmission(level + gap, level))
            plain = math.exp(-2 * level) - math.exp(-2 * (level + gap))
            if abs(gap) > 1e-6:
                assert g == pytest.approx(plain / gap, rel=1e-6)
            assert g == pytest.approx(limit, rel=2 * abs(gap) + 1e-9)


def test_reflection_of_a_thick_layer_forgets_its_depth() -> None:
    assert model.attenuation_reflection(30.0, 30.0) == pytest.approx(1 / 60, rel=1e-12)
    assert model.attenuation_reflection(1e-9, 1e-9) == pytest.approx(model.OPTICAL_DEPTH, rel=1e-6)


@given(angle, turn, angle, turn, turn, alphas)
def test_specular_light_is_reciprocal(ti: float, pi: float, to: float, po: float, tangent: float, alpha: float) -> None:
    wi, wo, t = direction(ti, pi), direction(to, po), direction(math.pi / 2, tangent)
    there = model.specular_reflection(wi, wo, UP, t, alpha)
    assert there == pytest.approx(model.specular_reflection(wo, wi, UP, t, alpha), rel=1e-9)
    below = wi * [1, 1, -1]
    through = model.specular_transmission(below, wo, UP, t, alpha)
    assert through == pytest.approx(model.specular_transmission(wo, below, UP, t, alpha), rel=1e-6, abs=1e-12)
    # Nothing leaks to the wrong side.
    assert model.specular_reflection(below, wo, UP, t, alpha) == 0 == model.specular_transmission(wi, wo, UP, t, alpha)


@given(angle, turn, angle, turn, turn, alphas)
def test_every_value_is_finite_and_not_negative(
    ti: float, pi: float, to: float, po: float, tangent: float, alpha: float
) -> None:
    t = direction(math.pi / 2, tangent)
    for sign in (1, -1):
        wi, wo = direction(ti, pi) * [1, 1, sign], direction(to, po)
        terms = (model.specular_reflection, model.specular_transmission)
        values = [float(term(wi, wo, UP, t, alpha)) for term in terms]
        values.append(float(model.diffuse(wi, UP, UP)))
        assert np.isfinite(values).all() and min(values) >= 0.0


def test_light_that_goes_straight_on_is_finite() -> None:
    wo = direction(0.7, 0.2)
    for alpha in ALPHAS:
        straight = float(model.specular_transmission(-wo, wo, UP, TANGENT, alpha))
        beside = [
            float(model.specular_transmission(-direction(0.7, 0.2 + d), wo, UP, TANGENT, alpha)) for d in (1e-5, -1e-5)
        ]
        assert 0.0 < straight < 1e3 and np.isfinite(beside).all()


def test_the_lambert_blend() -> None:
    """Of one normal it is Lambert; over the cloth's hemisphere no white point reflects more than 1."""
    half = DIRECTIONS[:, 2] > 0
    light, weights = DIRECTIONS[half], WEIGHTS[half]
    assert np.allclose(model.diffuse(light, UP, UP), 1 / math.pi)
    assert np.sum(model.diffuse_cosine(light, UP, UP) * weights) == pytest.approx(1.0, rel=1e-6)
    for lean in (0.2, 0.8, 1.3):
        normal = direction(lean, 1.0)
        whole = np.sum(model.diffuse_cosine(light, normal, UP) * weights)
        # The yarn's own Lambert term loses what shines on it from below the cloth: (1 - cos) / 2 of it.
        assert whole == pytest.approx(1.0 - model.DIFFUSE_BLEND * (1 - math.cos(lean)) / 2, rel=2e-3)


@njit(cache=True)
def _pair(wi, wo, t, alpha):
    ci, co = abs(wi[2]), abs(wo[2])
    ti = wi[0] * t[0] + wi[1] * t[1] + wi[2] * t[2]
    to = wo[0] * t[0] + wo[1] * t[1] + wo[2] * t[2]
    io = wi[0] * wo[0] + wi[1] * wo[1] + wi[2] * wo[2]
    return flake_reflection(ci, co, ti, to, io, alpha), flake_transmission(ci, co, ti, to, io, alpha)


@given(angle, turn, angle, turn, turn, alphas)
def test_the_kernel_agrees(ti: float, pi: float, to: float, po: float, tangent: float, alpha: float) -> None:
    t, wo = direction(math.pi / 2, tangent), direction(to, po)
    for sign in (1, -1):
        wi = direction(ti, pi) * [1, 1, sign]
        cosines = abs(wi[2] * wo[2])
        back, through = _pair(wi, wo, t, alpha)
        # A straight line has no half vector; beside it rounding decides.
        if np.linalg.norm(wi + wo) < 1e-4:
            continue
        if sign > 0:
            assert back == pytest.approx(cosines * model.specular_reflection(wi, wo, UP, t, alpha), rel=1e-6)
        else:
            assert through == pytest.approx(
                cosines * model.specular_transmission(wi, wo, UP, t, alpha), rel=1e-5, abs=1e-14
            )
