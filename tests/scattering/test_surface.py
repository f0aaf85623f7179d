"""The ladder of tests of UsdPreviewSurface: create, reference, reciprocity, furnace, samples, chi-square, Mitsuba."""

import itertools
import math

import numpy as np
import pytest
import scattering_checks as checks
from hypothesis import given, strategies as st
from numba import njit

from usdfab.errors import UsdfabError
from usdfab.scattering import surface_numba
from usdfab.scattering.surface_numba import (
    ALPHA_MIN,
    SURFACE_SIZE,
    eval_surface,
    load_surface,
    pack_surface,
    prepare_surface,
    sample_surface,
)

WHITE = (1.0, 1.0, 1.0)
ORANGE = (0.9, 0.5, 0.1)
# One of each kind.
MATERIALS = {
    "diffuse": pack_surface(ORANGE, ior=1.0),
    "default": pack_surface((0.18, 0.18, 0.18)),
    "white plastic": pack_surface(WHITE, 0.1),
    "rough": pack_surface(ORANGE, 1.0),
    "mirror": pack_surface(WHITE, 0.0, 1.0),
    "gold": pack_surface(ORANGE, 0.3, 1.0),
    "half metal": pack_surface(ORANGE, 0.6, 0.5),
    "coated": pack_surface(ORANGE, 0.5, 0.0, None, 1.0, 0.1),
    "coated metal": pack_surface(WHITE, 0.4, 1.0, None, 0.6, 0.01),
    "specular workflow": pack_surface(WHITE, 0.35, 0.7, (0.9, 0.3, 0.0)),
    "dense": pack_surface(WHITE, 0.2, 0.0, None, 0.5, 0.3, 3.0),
    "thin air": pack_surface(WHITE, 0.3, 0.0, None, 0.5, 0.3, 1.03),
    "black": pack_surface((0.0, 0.0, 0.0), ior=1.0),
}
ANGLES = tuple(math.radians(angle) for angle in (0.0, 30.0, 60.0, 80.0, 89.0))
ONE = float(np.nextafter(1.0, 0.0))


def direction(theta, phi):
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


# --- Quadrature and samples; azimuth is counted from the mirror direction of wo, which lies at azimuth pi ---


@njit(cache=True)
def _tabulate(p, theta_o, theta, w_theta, cell_theta, phi, w_phi, cell_phi, cells, out):
    """Add integrals of value rgb and pdf over the hemisphere to out (4,), of the pdf over cells to cells."""
    prep = prepare_surface(p, math.cos(theta_o))
    for i in range(theta.size):
        sine, cosine = math.sin(theta[i]), math.cos(theta[i])
        for j in range(phi.size):
            x, y = -sine * math.cos(phi[j]), sine * math.sin(phi[j])
            r, g, b, pdf = eval_surface(prep, x, y, cosine, math.sin(theta_o), 0.0, math.cos(theta_o))
            w = w_theta[i] * w_phi[j] * sine
            out[0] += w * r
            out[1] += w * g
            out[2] += w * b
            out[3] += w * pdf
            cells[cell_theta[i], cell_phi[j]] += w * pdf


@njit(cache=True)
def _draw(p, theta_o, u):
    """Samples for every row of u (n, 3): (n, 7), wi, weight rgb, pdf."""
    prep = prepare_surface(p, math.cos(theta_o))
    out = np.empty((u.shape[0], 7))
    for i in range(u.shape[0]):
        out[i] = sample_surface(prep, math.sin(theta_o), 0.0, math.cos(theta_o), u[i, 0], u[i, 1], u[i, 2])
    return out


def _edges(p, theta_o, theta_cells=(), phi_cells=()):
    """Break points around the mirror direction, doubling from a fraction of the narrowest lobe."""
    width = min(max(p[3] ** 2, ALPHA_MIN), max(p[10] ** 2, ALPHA_MIN) if p[9] > 0 else 1.0)
    steps = width * 2.0 ** np.arange(-2.0, 13.0)
    half = math.pi / 2
    theta = np.concatenate([np.linspace(0, half, 9), theta_o + steps, theta_o - steps, [theta_o], half - steps])
    # Seen at a grazing angle the highlight is a narrow streak: its width in azimuth is alpha times the cosine.
    narrow = width * max(math.cos(theta_o), width) / max(math.sin(theta_o), width)
    around = narrow * 2.0 ** np.arange(-2.0, 28.0)
    phi = np.concatenate([np.linspace(-math.pi, math.pi, 17), around, -around])
    theta = np.concatenate([theta[(theta > 0) & (theta < half)], [0, half], theta_cells])
    return theta, np.concatenate([phi[abs(phi) < math.pi], [-math.pi, math.pi], phi_cells])


def integrate(p, theta_o, theta_cells=(0.0, math.pi / 2), phi_cells=(-math.pi, math.pi)):
    """Integrals of value rgb and pdf (4,), and the pdf's over the cells."""
    theta_edges, phi_edges = _edges(p, theta_o, theta_cells, phi_cells)
    theta, phi = checks._composite_gauss(theta_edges), checks._composite_gauss(phi_edges)
    cells, out = np.zeros((len(theta_cells) - 1, len(phi_cells) - 1)), np.zeros(4)
    owner_theta = np.searchsorted(theta_cells, theta[0]) - 1
    owner_phi = np.searchsorted(phi_cells, phi[0]) - 1
    _tabulate(p, theta_o, *theta, owner_theta, *phi, owner_phi, cells, out)
    return out, cells


# --- Create ---


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        ({"base_color": (0.5, 0.5)}, "base_color"),
        ({"base_color": (0.5, 1.1, 0.5)}, "base_color"),
        ({"base_color": (0.5, math.nan, 0.5)}, "base_color"),
        ({"roughness": -0.1}, "roughness"),
        ({"metallic": math.nan}, "metallic"),
        ({"specular_color": (-1.0, 0.0, 0.0)}, "specular_color"),
        ({"clearcoat": 2.0}, "clearcoat"),
        ({"clearcoat_roughness": math.inf}, "clearcoat_roughness"),
        ({"ior": 0.0}, "ior"),
        ({"ior": math.inf}, "ior"),
    ],
)
def test_pack_refuses(arguments, place):
    with pytest.raises(UsdfabError, match=f"^{place}: "):
        pack_surface(**({"base_color": (0.5, 0.5, 0.5)} | arguments))


def test_rows_of_a_table():
    """A row loaded from a wider table is the material itself."""
    table = np.hstack([np.stack(list(MATERIALS.values())), np.full((len(MATERIALS), 3), np.nan)])
    for k, p in enumerate(MATERIALS.values()):
        assert p.shape == (SURFACE_SIZE,)
        assert load_surface(table, k) == tuple(p)
        assert prepare_surface(load_surface(table, k), 0.7) == prepare_surface(p, 0.7)


def test_texture_values_are_clamped():
    """What a texture puts into the tuple may be out of range; the result is that of the nearest valid value."""
    p = pack_surface((1.0, 0.0, 0.5), 1.0, 0.0)
    wild = (1.7, -0.2, 0.5, 3.0, -1.0, *p[5:])
    assert prepare_surface(wild, 0.6) == prepare_surface(p, 0.6)


# --- Values against the equations, written plainly ---


def reference(p, wi, wo):
    """f cos by the textbook: lambda form of Smith, D by the tangent, one lobe after the other."""

    def lobe(alpha, f0, f90):
        h = (wi + wo) / np.linalg.norm(wi + wo)
        tan2 = 1.0 / h[2] ** 2 - 1.0
        d = 1.0 / (math.pi * alpha**2 * h[2] ** 4 * (1.0 + tan2 / alpha**2) ** 2)
        lambdas = [0.5 * (math.sqrt(1.0 + alpha**2 * (1.0 / w[2] ** 2 - 1.0)) - 1.0) for w in (wi, wo)]
        f = f0 + (f90 - f0) * (1.0 - wo @ h) ** 5
        return d * f / (1.0 + sum(lambdas)) / (4.0 * wi[2] * wo[2])

    def bound(alpha, mu):
        b, n = surface_numba._grazing(alpha)
        return b * (1.0 - mu) ** n + 5e-4

    base, metallic = p[:3], 0.0 if p[8] else p[4]
    f0 = (1.0 - metallic) * p[5:8] + metallic * base
    f90 = min(1.0, 1000.0 * f0.max())
    alpha, coat_alpha = (max(r * r, ALPHA_MIN) for r in (p[3], p[10]))
    value = lobe(alpha, f0, f90) if f90 > 0 else np.zeros(3)
    mu = np.polynomial.legendre.leggauss(200)
    average = 0.5 * mu[1] @ ((mu[0] + 1.0) * (1.0 - f90 * bound(alpha, 0.5 * (mu[0] + 1.0))))
    left = (1.0 - f90 * bound(alpha, wi[2])) * (1.0 - f90 * bound(alpha, wo[2])) / average
    value = value + (1.0 - metallic) * base * (1.0 - f0) / math.pi * left
    coat_f90 = min(1.0, 1000.0 * p[11]) * p[9]
    if coat_f90 > 0:
        coat_f0 = p[9] * p[11]
        through = [1.0 - coat_f0 - (coat_f90 - coat_f0) * bound(coat_alpha, w[2]) for w in (wi, wo)]
        value = value * min(through) + lobe(coat_alpha, coat_f0, coat_f90)
    return value * wi[2]


@pytest.mark.parametrize("name", MATERIALS)
def test_against_reference(name):
    p = MATERIALS[name]
    rng = np.random.default_rng(5)
    for _ in range(30):
        wo = direction(math.acos(rng.uniform(0.05, 1.0)), rng.uniform(0, 2 * math.pi))
        prep = prepare_surface(p, wo[2])
        drawn = np.array(sample_surface(prep, *wo, *rng.random(3))[:3])
        for wi in (drawn, direction(math.acos(rng.uniform(0.02, 1.0)), rng.uniform(0, 2 * math.pi))):
            if wi[2] > 1e-3:
                got = eval_surface(prep, *wi, *wo)[:3]
                np.testing.assert_allclose(got, reference(p, wi, wo), rtol=1e-6, atol=1e-12)


def test_diffuse_only_is_lambert():
    prep = prepare_surface(MATERIALS["diffuse"], 0.5)
    value = eval_surface(prep, 0.6, 0.0, 0.8, math.sqrt(0.75), 0.0, 0.5)
    np.testing.assert_allclose(value, [*(np.array(ORANGE) * 0.8 / math.pi), 0.8 / math.pi], rtol=1e-14)


@pytest.mark.parametrize("name", MATERIALS)
def test_reciprocity(name):
    p = MATERIALS[name]
    rng = np.random.default_rng(7)
    for _ in range(50):
        wi, wo = (direction(math.acos(rng.uniform(0.01, 1.0)), rng.uniform(0, 2 * math.pi)) for _ in range(2))
        there = np.array(eval_surface(prepare_surface(p, wo[2]), *wi, *wo)[:3]) / wi[2]
        back = np.array(eval_surface(prepare_surface(p, wi[2]), *wo, *wi)[:3]) / wo[2]
        np.testing.assert_allclose(there, back, rtol=1e-12)


def test_below_the_horizon():
    for p in MATERIALS.values():
        prep = prepare_surface(p, 0.8)
        assert eval_surface(prep, 0.6, 0.0, -0.8, 0.6, 0.0, 0.8) == (0.0, 0.0, 0.0, 0.0)
        prep = prepare_surface(p, -0.8)
        assert eval_surface(prep, 0.6, 0.0, 0.8, 0.6, 0.0, -0.8) == (0.0, 0.0, 0.0, 0.0)
        assert sample_surface(prep, 0.6, 0.0, -0.8, 0.3, 0.4, 0.5)[3:] == (0.0, 0.0, 0.0, 0.0)


# --- Energy ---


def test_grazing_bound():
    """The fit lies above the quadrature of the grazing part of GGX's reflection, and not far above.

    A white specular lobe's albedo less that of one with F0 = 0: B itself is what F = (1 - wo.h)^5 reflects.
    """
    mean = []
    for roughness in (0.0, 0.1, 0.2, 0.3, 0.45, 0.7, 1.0):
        nodes, weights = np.polynomial.legendre.leggauss(24)
        mus = 0.5 * (nodes + 1.0)
        gaps = []
        for mu in mus:
            # Black base in the specular workflow, F0 = x: E = x A + B; A from F0 = 1.
            white, faint = (
                integrate(pack_surface((0, 0, 0), roughness, 0.0, (x, x, x)), math.acos(mu))[0][0] for x in (1.0, 0.5)
            )
            exact = 2.0 * faint - white  # (A/2 + B/2 + B/2) 2 - (A + B)
            b, n = surface_numba._grazing(max(roughness**2, ALPHA_MIN))
            gaps.append(b * (1.0 - mu) ** n + 5e-4 - exact)
        assert min(gaps) > 0.0
        mean.append(weights @ (np.array(gaps) * mus))
    print(f"B is too large, mean over the cosine, by up to {max(mean):.4f}")
    assert max(mean) < 4e-3


@pytest.mark.parametrize("roughness", [0.0, 0.15, 0.3, 0.5, 0.75, 1.0])
@pytest.mark.parametrize(("ior", "clearcoat"), [(1.5, 0.0), (1.5, 1.0), (2.5, 0.0), (1.02, 0.0)])
def test_white_furnace(roughness, ior, clearcoat):
    """A white dielectric reflects at most 1 wherever it is seen from, and little less."""
    p = pack_surface(WHITE, roughness, 0.0, None, clearcoat, 0.2, ior)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    mus = 0.5 * (nodes + 1.0)
    albedo = np.array([integrate(p, math.acos(mu))[0][0] for mu in np.r_[mus, 0.005, 1.0]])
    mean = weights @ (albedo[:16] * mus)
    print(f"mean {mean:.4f}, from {albedo.min():.4f} to {albedo.max():.4f}")
    assert albedo.max() <= 1.0 + 1e-6
    # F0 of what GGX loses between microfacets, and the fit's 0.4 %; a coat takes its toll on the way in, too.
    f0 = ((1.0 - ior) / (1.0 + ior)) ** 2
    assert mean > 1.0 - 0.005 - 0.6 * f0 * roughness**2 - 0.06 * clearcoat


@pytest.mark.parametrize("name", MATERIALS)
def test_never_gains(name):
    for theta_o in ANGLES:
        value, _ = integrate(MATERIALS[name], theta_o)
        assert value[:3].max() <= 1.0 + 1e-6
        assert value[3] <= 1.0 + 1e-6


def test_smooth_metal_is_a_mirror():
    """Nearly all of F comes back, in its colour."""
    for theta_o in ANGLES[:3]:
        value, _ = integrate(pack_surface(ORANGE, 0.0, 1.0), theta_o)
        f = np.array(ORANGE) + (1.0 - np.array(ORANGE)) * (1.0 - math.cos(theta_o)) ** 5
        np.testing.assert_allclose(value[:3], f, rtol=2e-3)


@pytest.mark.parametrize("theta_o", ANGLES)
def test_density_integrates_to_one(theta_o):
    """What is missing is what falls below the horizon: the share of samples without weight."""
    for p in MATERIALS.values():
        value, _ = integrate(p, theta_o)
        samples = _draw(p, theta_o, np.random.default_rng(1).random((40_000, 3)))
        lost = np.mean(samples[:, 6] == 0.0)
        assert value[3] == pytest.approx(1.0 - lost, abs=5.0 * math.sqrt(max(lost, 1e-6) / 40_000) + 1e-5)


# --- Samples ---


@pytest.mark.parametrize("name", MATERIALS)
def test_sampled_albedo(name):
    """Mean weight = integral of the value: sampling and evaluation are of one mind."""
    for theta_o in ANGLES:
        value, _ = integrate(MATERIALS[name], theta_o)
        weights = _draw(MATERIALS[name], theta_o, np.random.default_rng(2).random((60_000, 3)))[:, 3:6]
        error = weights.std(axis=0) / math.sqrt(len(weights))
        assert np.all(abs(weights.mean(axis=0) - value[:3]) < 5.0 * error + 1e-5)
        assert weights.max() < 3.5


CASES = list(itertools.product([name for name in MATERIALS if name != "black"], ANGLES))


@pytest.mark.parametrize("name", [name for name in MATERIALS if name != "black"])
def test_chi_square(name):
    """Cells are quantiles of a pilot draw; one more cell holds what fell below the horizon."""
    p = MATERIALS[name]
    for theta_o in ANGLES:
        rng = np.random.default_rng(11)
        pilot = _draw(p, theta_o, rng.random((20_000, 3)))
        pilot = pilot[pilot[:, 6] > 0.0]

        def angles(samples):
            return np.arccos(np.clip(samples[:, 2], -1, 1)), np.arctan2(samples[:, 1], -samples[:, 0])

        edges = []
        ends = (0.0, -math.pi), (math.pi / 2, math.pi)
        for values, count, low, high in zip(angles(pilot), (20, 24), *ends, strict=True):
            inner = np.quantile(values, np.linspace(0.0, 1.0, count + 1)[1:-1])
            edges.append(np.unique(np.concatenate([[low], inner, [high]])))
        integrals, expected = integrate(p, theta_o, *edges)
        count = 80_000
        samples = _draw(p, theta_o, rng.random((count, 3)))
        seen = samples[samples[:, 6] > 0.0]
        observed = np.histogram2d(*angles(seen), bins=edges)[0]
        assert observed.sum() == len(seen)
        observed = np.append(observed, count - len(seen))
        expected = np.append(expected, max(1.0 - integrals[3], 0.0)) * count
        assert checks.goodness_of_fit(observed, expected) > checks.sidak(0.01, len(CASES))


def test_isotropy():
    """Turned about the normal with the same numbers: the weights of a lobe stay, whatever wo's azimuth."""
    p = MATERIALS["gold"]
    rng = np.random.default_rng(3)
    u = rng.random((20_000, 3))
    means = []
    for phi in (0.0, 1.0, 4.0):
        wo = direction(1.2, phi)
        prep = prepare_surface(p, wo[2])
        means.append(np.mean([sample_surface(prep, *wo, *row)[3:6] for row in u[:4000]], axis=0))
    np.testing.assert_allclose(means[1:], [means[0]] * 2, atol=0.01)


unit = st.floats(0.0, 1.0)


@given(
    st.tuples(unit, unit, unit), unit, unit, st.none() | st.tuples(unit, unit, unit), unit, unit, st.floats(0.1, 10.0),
    st.floats(-1.0, 1.0), st.floats(0.0, math.pi / 2), st.floats(0.0, 2 * math.pi), st.tuples(*3 * [st.floats(0, ONE)]),
)  # fmt: skip
def test_numbers_stay_finite(color, roughness, metallic, specular, coat, coat_roughness, ior, oz, theta, phi, u):
    p = pack_surface(color, roughness, metallic, specular, coat, coat_roughness, ior)
    prep = prepare_surface(p, oz)
    assert all(math.isfinite(x) for x in prep)
    assert sum(prep[16:]) == pytest.approx(1.0)
    wo = (math.sqrt(1.0 - oz * oz), 0.0, oz)
    assert all(math.isfinite(x) and x >= 0.0 for x in eval_surface(prep, *direction(theta, phi), *wo))
    sample = sample_surface(prep, *wo, *u)
    assert all(math.isfinite(x) for x in sample)
    assert np.linalg.norm(sample[:3]) == pytest.approx(1.0, abs=1e-6)
    assert min(sample[3:]) >= 0.0
    assert max(sample[3:6]) < 3.5
    if sample[6] > 0.0:
        assert sample[3:6] == pytest.approx(np.divide(eval_surface(prep, *sample[:3], *wo)[:3], sample[6]))


# --- Mitsuba ---


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.9])
def test_ggx_against_mitsuba(roughness):
    """Mitsuba's `roughconductor` of GGX without Fresnel; its Smith shadowing is separable, so G2 is swapped."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    alpha = roughness**2
    bsdf = mi.load_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha})
    p = pack_surface(WHITE, roughness, 1.0)
    rng = np.random.default_rng(13)
    for _ in range(100):
        wo = direction(math.acos(rng.uniform(0.05, 1.0)), rng.uniform(0, 2 * math.pi))
        prep = prepare_surface(p, wo[2])
        wi = np.array(sample_surface(prep, *wo, *rng.random(3))[:3])
        if wi[2] < 0.02:
            continue
        si = mi.SurfaceInteraction3f()
        si.t, si.wi = 1.0, mi.Vector3f(*wo)
        si.sh_frame = mi.Frame3f([1, 0, 0], [0, 1, 0], [0, 0, 1])
        theirs = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*wi))[0]
        lambdas = [0.5 * (math.sqrt(1.0 + alpha**2 * (1.0 / w[2] ** 2 - 1.0)) - 1.0) for w in (wi, wo)]
        theirs *= (1.0 + lambdas[0]) * (1.0 + lambdas[1]) / (1.0 + sum(lambdas))
        ours = eval_surface(prep, *wi, *wo)
        assert ours[0] == pytest.approx(theirs, rel=2e-3)
        assert ours[3] == pytest.approx(bsdf.pdf(mi.BSDFContext(), si, mi.Vector3f(*wi)), rel=2e-3)
