"""Lights as kernels sample and hit them: each kind against quadrature, densities against each other, the choice."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numba import njit
from scenes import dome

from usdfab.errors import UsdfabError
from usdfab.tracer.lights import _choice, _choose, escaped_radiance, hit_light, light_blocks, pack_lights, sample_light
from usdfab.usd.scene import (
    CylinderLight,
    DiskLight,
    DistantLight,
    PointLight,
    RectLight,
    SphereLight,
)

FAR = 1e30
RADIANCE = np.array([2.0, 3.0, 0.5])


def pack(*lights, textures=None):
    return pack_lights(SimpleNamespace(lights=lights), textures or {})


# --- lights of all kinds ---------------------------------------------------------------------------------------------


def orthonormal(seed):
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation


def make(kind, center, frame, a, b):
    """An area light about ``center`` of the sizes a and b, turned by ``frame`` (rows)."""
    u, v, normal = a * frame[0], b * frame[1], np.cross(frame[0], frame[1])
    if kind == "sphere":
        return SphereLight("/Sphere", center, a, RADIANCE)
    if kind == "rect":
        return RectLight("/Rect", center - 0.5 * (u + v), u, v, normal, RADIANCE)
    if kind == "sheared":
        v = v + 0.7 * u
        return RectLight("/Sheared", center - 0.5 * (u + v), u, v, normal, RADIANCE)
    if kind == "disk":
        return DiskLight("/Disk", center, u, v + 0.3 * u, normal, RADIANCE)
    return CylinderLight("/Cylinder", center, v, 0.5 * a, RADIANCE)


KINDS = ("sphere", "rect", "sheared", "disk", "cylinder")


def surface(light, n):
    """Places (K, 3), normals (K, 3) and areas (K,) of a fine division of a light."""
    a, b = (x.ravel() for x in np.meshgrid(*2 * [(np.arange(n) + 0.5) / n]))
    if isinstance(light, SphereLight):
        z, phi = 2.0 * a - 1.0, 2.0 * math.pi * b
        normal = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
        return light.center + light.radius * normal, normal, np.full(n * n, 4 * math.pi * light.radius**2 / n**2)
    if isinstance(light, CylinderLight):
        axis = light.half / np.linalg.norm(light.half)
        x = np.cross(axis, [0.3, 0.5, 0.7])
        x /= np.linalg.norm(x)
        phi = 2.0 * math.pi * b[:, None]
        normal = np.cos(phi) * x + np.sin(phi) * np.cross(axis, x)
        area = 4.0 * math.pi * light.radius * np.linalg.norm(light.half)
        place = light.center + light.radius * normal + (2.0 * a[:, None] - 1.0) * light.half
        return place, normal, np.full(n * n, area / n**2)
    if isinstance(light, DiskLight):
        r, phi = np.sqrt(a)[:, None], 2.0 * math.pi * b[:, None]
        place = light.center + r * np.cos(phi) * light.axis_u + r * np.sin(phi) * light.axis_v
        area = math.pi * np.linalg.norm(np.cross(light.axis_u, light.axis_v))
    else:
        place = light.corner + a[:, None] * light.edge_u + b[:, None] * light.edge_v
        area = np.linalg.norm(np.cross(light.edge_u, light.edge_v))
    return place, np.broadcast_to(light.normal, place.shape), np.full(n * n, area / n**2)


def fluence(light, p, n, exponent):
    """Sum over the light of |cos at p|^exponent dw, the cosine being that with the z axis; only what shines at p."""
    place, normal, area = surface(light, n)
    way = place - p
    d = np.linalg.norm(way, axis=1)
    shining = np.maximum(-np.einsum("ki,ki->k", way, normal) / d, 0.0)
    return np.sum(area * shining / d**2 * np.abs(way[:, 2] / d) ** exponent)


@njit(cache=True)
def _by_sampling(lights, p, u, exponent, out):
    """Sum over rows of u (n, 3) of weighted samples: out (4,) value and, last, the number that shine."""
    for k in range(len(u)):
        _x, _y, z, _d, r, g, b, pdf = sample_light(lights, p[0], p[1], p[2], u[k, 0], u[k, 1], u[k, 2])
        if pdf > 0.0:
            w = abs(z) ** exponent
            out[0] += w * r
            out[1] += w * g
            out[2] += w * b
            out[3] += 1.0


def by_sampling(lights, p, exponent, n=128):
    """The same as ``fluence`` times radiance, by ``sample_light`` with stratified numbers: (3,)."""
    rng = np.random.default_rng(0)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n)))
    u = np.column_stack([rng.random(n * n), (i + rng.random(n * n)) / n, (j + rng.random(n * n)) / n])
    out = np.zeros(4)
    _by_sampling(lights, np.asarray(p, dtype=float), u, exponent, out)
    return out[:3] / (n * n)


@njit(cache=True)
def _hits(lights, o, p, directions, bsdf_pdf, out):
    for k in range(len(directions)):
        d = directions[k]
        out[k] = hit_light(lights, o[0], o[1], o[2], d[0], d[1], d[2], FAR, bsdf_pdf, p[0], p[1], p[2])


def hits(lights, p, directions, bsdf_pdf=-1.0, origin=None):
    """``hit_light`` for directions (n, 3): (n, 4)."""
    out = np.zeros((len(directions), 4))
    p = np.asarray(p, dtype=float)
    _hits(lights, p if origin is None else origin, p, np.asarray(directions, dtype=float), bsdf_pdf, out)
    return out


def density(lights, p, directions, radiance=RADIANCE):
    """The density that ``hit_light`` uses, from its weight w = 1 / (1 + density): (n,), 0 where nothing shines."""
    weight = hits(lights, p, directions, 1.0)[:, 1] / radiance[0]
    return np.where(weight > 0.0, 1.0 / np.where(weight > 0.0, weight, 1.0) - 1.0, 0.0)


def draw(lights, p, n, seed=0):
    """Samples (n, 8) that shine."""
    rng = np.random.default_rng(seed)
    samples = np.array([sample_light(lights, *p, *u) for u in rng.random((n, 3))])
    return samples[samples[:, 7] > 0.0]


sizes = st.floats(0.05, 2.0)
coordinates = st.floats(-1.5, 1.5)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25)
@given(place=st.tuples(coordinates, coordinates, coordinates), a=sizes, b=sizes, seed=st.integers(0, 1000))
def test_solid_angle_and_irradiance(kind, place, a, b, seed):
    """Samples, weighted, against a quadrature over the light's surface."""
    light = make(kind, np.array(place), orthonormal(seed), a, b)
    p = np.array([0.1, -0.2, 0.3])
    places, _, _ = surface(light, 30)
    # Very near the light the quadrature fails; inside there is nothing to compare.
    if np.linalg.norm(places - p, axis=1).min() < 0.2 * max(a, b):
        return
    lights = pack(light)
    for exponent in (0, 1):
        expected = fluence(light, p, 300, exponent)
        np.testing.assert_allclose(
            by_sampling(lights, p, exponent), expected * RADIANCE, rtol=0.015, atol=2e-3 * RADIANCE.max() * a * b
        )


def test_known_solid_angles():
    """Seen from the middle of a cube a side fills 4 pi / 6; a hemisphere's rim, a cone of 60 degrees, a long tube."""
    side = RectLight("/R", np.array([-1.0, -1, 1]), np.eye(3)[0] * 2, np.eye(3)[1] * 2, -np.eye(3)[2], RADIANCE)
    np.testing.assert_allclose(by_sampling(pack(side), np.zeros(3), 0, 8), 4 * math.pi / 6 * RADIANCE, rtol=1e-12)
    ball = SphereLight("/S", np.array([0, 0, 2.0]), math.sqrt(3.0), RADIANCE)
    np.testing.assert_allclose(by_sampling(pack(ball), np.zeros(3), 0, 8), math.pi * RADIANCE, rtol=1e-12)
    disk = DiskLight("/D", np.array([0, 0, 1.0]), np.eye(3)[0], np.eye(3)[1], -np.eye(3)[2], RADIANCE)
    expected = 2 * math.pi * (1 - math.sqrt(0.5)) * RADIANCE
    np.testing.assert_allclose(by_sampling(pack(disk), np.zeros(3), 0), expected, rtol=1e-3)
    tube = CylinderLight("/C", np.array([0, 0, 2.0]), np.array([1000.0, 0, 0]), 0.5, RADIANCE)
    # A wedge of azimuth 2 asin(r / D) fills twice that angle.
    np.testing.assert_allclose(by_sampling(pack(tube), np.zeros(3), 0), 4 * math.asin(0.25) * RADIANCE, rtol=2e-3)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40)
@given(
    place=st.tuples(coordinates, coordinates, coordinates), a=sizes, b=sizes, seed=st.integers(0, 1000),
    log_scale=st.floats(-4.0, 3.0),
)  # fmt: skip
def test_samples_are_hit(kind, place, a, b, seed, log_scale):
    """A ray along a sample meets the light where the sample said, with the same density, at any scale."""
    scale = 10.0**log_scale
    light = make(kind, scale * np.array(place), orthonormal(seed), scale * a, scale * b)
    p = scale * np.array([0.1, -0.2, 0.3])
    lights = pack(light)
    samples = draw(lights, p, 20)
    directions = samples[:, :3]
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(samples[:, 4:7] * samples[:, 7:], np.broadcast_to(RADIANCE, (len(samples), 3)))
    found = hits(lights, p, directions)
    # On the rim rounding decides whether a ray hits.
    seen = found[:, 0] < FAR
    assert seen.sum() >= len(seen) - 1
    assert np.all(found[seen, 1:] == RADIANCE)
    np.testing.assert_allclose(found[seen, 0], samples[seen, 3], rtol=1e-5)
    # The weight 1 / (1 + pdf) of large densities leaves few digits of them; compare where it does.
    pdf = samples[seen, 7]
    fair = (pdf > 1e-4) & (pdf < 1e6)
    np.testing.assert_allclose(density(lights, p, directions[seen])[fair], pdf[fair], rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_origin_may_move_on(kind):
    """The weight belongs to the point where the direction was drawn, wherever on the way the ray begins."""
    light = make(kind, np.array([0.3, 0.2, 1.5]), np.diag([1.0, -1.0, -1.0]), 0.4, 0.7)
    lights, p = (
        pack(light, SphereLight("/Other", np.array([0.0, -3.0, 2.0]), 0.5, RADIANCE)),
        np.array([0.1, -0.2, 0.3]),
    )
    for x, y, z, distance, *_, pdf in draw(lights, p, 50):
        there = hit_light(lights, *p, x, y, z, FAR, 0.5, *p)
        on = hit_light(lights, *(p + 0.7 * distance * np.array([x, y, z])), x, y, z, FAR, 0.5, *p)
        assert on[0] == pytest.approx(0.3 * distance, rel=1e-6)
        assert on[1:] == pytest.approx(there[1:], rel=1e-6)
        assert there[1] == pytest.approx(RADIANCE[0] * 0.5 / (0.5 + pdf), rel=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_density_integrates_to_one(kind, seed):
    """Thrown rays: the mean of the density that ``hit_light`` uses, and of the radiance against the quadrature."""
    rng = np.random.default_rng(seed)
    light = make(kind, np.array([0.3, 0.2, 1.5]), orthonormal(seed + 20), 0.9, 0.7)
    p = np.zeros(3)
    if fluence(light, p, 100, 0) == 0.0:
        light = make(kind, np.array([0.3, 0.2, -1.5]), orthonormal(seed + 20), 0.9, 0.7)
    lights = pack(light)
    # Stratified directions.
    n = 800
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n)))
    z, phi = 2.0 * (i + rng.random(n * n)) / n - 1.0, 2.0 * math.pi * (j + rng.random(n * n)) / n
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    assert 4 * math.pi * density(lights, p, directions).mean() == pytest.approx(1.0, rel=0.01)
    radiance = hits(lights, p, directions)[:, 1:]
    irradiance = 4 * math.pi * (radiance * abs(directions[:, 2:])).mean(axis=0)
    np.testing.assert_allclose(irradiance, fluence(light, p, 300, 1) * RADIANCE, rtol=0.015)


def test_near_a_rectangle():
    """Beside, just above and at the corner of one: samples by solid angle have no noise in it."""
    light = RectLight("/R", np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), RADIANCE)
    lights = pack(light)
    for p in ((1.0, 0.5, 1e-3), (0.0, 0.0, 0.1), (5.0, 0.5, 0.2), (-1.0, 3.0, 2.0), (1.9, 0.95, 1e-6)):
        samples = draw(lights, p, 200)
        assert len(samples) == 200
        angle = 1.0 / samples[:, 7]
        assert np.ptp(angle) == 0.0
        places = np.array(p) + samples[:, 3:4] * samples[:, :3]
        np.testing.assert_allclose(places[:, 2], 0.0, atol=1e-9)
        assert places[:, 0].min() > -1e-9
        assert places[:, 0].max() < 2 + 1e-9
        assert places[:, 1].min() > -1e-9
        assert places[:, 1].max() < 1 + 1e-9
    assert angle[0] == pytest.approx(2 * math.pi, rel=1e-4)
    # On its plane and behind it is dark.
    for p in ((1.0, 0.5, 0.0), (1.0, 0.5, -1.0), (4.0, 0.5, 0.0)):
        assert len(draw(lights, p, 20)) == 0


# --- who stands in whose way -----------------------------------------------------------------------------------------


def test_backs_are_dark_and_opaque():
    for kind in ("rect", "disk"):
        lamp = make(kind, np.array([0, 0, 1.0]), np.eye(3), 1.0, 1.0)  # shines along +z
        behind = SphereLight("/S", np.array([0, 0, 3.0]), 0.5, np.ones(3))
        lights = pack(lamp, behind)
        assert hit_light(lights, 0, 0, 0, 0, 0, 1.0, FAR, -1.0, 0, 0, 0) == (1.0, 0.0, 0.0, 0.0)
        assert light_blocks(lights, 0, 0, 0, 0, 0, 1.0, 1.5)
        assert not light_blocks(lights, 0, 0, 0, 0, 0, 1.0, 0.5)
        t, *color = hit_light(lights, 0, 0, 1.5, 0, 0, -1.0, FAR, -1.0, 0, 0, 0)
        assert (t, color) == (0.5, list(RADIANCE))


def test_nothing_is_seen_from_inside():
    """A ray from inside a sphere or a tube leaves it; so does one that comes in by the tube's open end."""
    for light in (make("sphere", np.zeros(3), np.eye(3), 1.0, 1.0), make("cylinder", np.zeros(3), np.eye(3), 2.0, 1.0)):
        lights = pack(light)
        assert hit_light(lights, 0.1, 0.2, 0.0, 0.6, 0.0, 0.8, FAR, -1.0, 0, 0, 0)[0] == FAR
        assert len(draw(lights, (0.1, 0.2, 0.0), 20)) == 0
    # Through the end at y = -1, out through the side.
    direction = np.array([0.5, 1.0, 0.0]) / math.sqrt(1.25)
    assert not light_blocks(lights, 0.0, -2.0, 0.0, *direction, FAR)
    assert len(draw(lights, (0.0, -2.0, 0.0), 20)) == 0
    # Past the end but beside the axis the side is seen.
    assert len(draw(lights, (3.0, -2.0, 0.0), 20)) == 20


def test_the_nearest_counts():
    lights = pack(*(SphereLight("/S", np.array([0, 0, z]), 0.5, np.full(3, z)) for z in (5.0, 2.0, 8.0)))
    assert hit_light(lights, 0, 0, 0, 0, 0, 1.0, FAR, -1.0, 0, 0, 0) == (1.5, 2.0, 2.0, 2.0)
    assert hit_light(lights, 0, 0, 3.0, 0, 0, 1.0, FAR, -1.0, 0, 0, 0)[1] == 5.0
    assert hit_light(lights, 0, 0, 0, 0, 0, 1.0, 1.0, -1.0, 0, 0, 0) == (1.0, 0.0, 0.0, 0.0)


# --- choice ----------------------------------------------------------------------------------------------------------


def everything():
    """One light of each kind."""
    texture = np.random.default_rng(3).uniform(0.1, 1.0, (8, 16, 3)).astype(np.float32)
    turn = np.eye(4)
    turn[:3, :3] = orthonormal(2)
    return [
        make("sphere", np.array([1.6, 0, 1.0]), np.eye(3), 0.3, 0.3),
        make("rect", np.array([-1.6, 0.3, 1.0]), np.diag([1.0, -1.0, -1.0]), 0.5, 0.8),
        make("sheared", np.array([-1.6, -1.0, 1.5]), np.diag([1.0, -1.0, -1.0]), 0.5, 0.8),
        make("disk", np.array([0.0, -1.0, 0.7]), np.diag([1.0, -1.0, -1.0]), 0.4, 0.2),
        make("cylinder", np.array([0.0, 1.5, 0.7]), np.eye(3), 0.2, 0.4),
        PointLight("/P", np.array([0.5, 0.5, 2.0]), RADIANCE),
        DistantLight("/Sun", np.array([0.6, 0.0, -0.8]), 0.3 * RADIANCE, 0.2),
        DistantLight("/Parallel", np.array([-0.6, 0.0, -0.8]), 0.2 * RADIANCE, 0.0),
        dome(0.2, texture, turn),
        dome(0.1),
    ]


points = st.tuples(coordinates, coordinates, st.floats(-1.0, 3.0))


@given(points, st.floats(0.0, 1.0, exclude_max=True))
def test_probabilities(p, u):
    table = pack(*everything()).table
    probabilities = [_choice(table, k, *p) for k in range(len(table))]
    assert sum(probabilities) == pytest.approx(1.0)
    chosen, probability = _choose(table, *p, u)
    assert probability == pytest.approx(probabilities[chosen])


def test_frequencies():
    table = pack(*everything()).table
    p = (0.2, 0.1, 0.0)
    count = 20_000
    chosen = [_choose(table, *p, (k + 0.5) / count)[0] for k in range(count)]
    observed = np.bincount(chosen, minlength=len(table))
    expected = np.array([_choice(table, k, *p) for k in range(len(table))])
    np.testing.assert_allclose(observed / count, expected, atol=1.5 * len(table) / count)


def test_near_lights_are_chosen():
    """In a long row of equal lamps, the nearest; never the back of a flat one."""
    row = [make("sphere", np.array([2.0 * k, 0, 1.0]), np.eye(3), 0.1, 0.1) for k in range(50)]
    table = pack(*row).table
    for k in (0, 17, 49):
        probabilities = [_choice(table, i, 2.0 * k, 0.0, 0.0) for i in range(50)]
        assert np.argmax(probabilities) == k
        assert max(probabilities) > 0.3
    flat = pack(make("disk", np.zeros(3), np.eye(3), 1.0, 1.0), *row).table
    assert _choice(flat, 0, 0.0, 0.0, -0.1) == 0.0
    assert _choice(flat, 0, 0.0, 0.0, 0.1) > 0.5
    assert _choice(pack(row[3]).table, 0, 5.0, 5.0, 5.0) == 1.0


def test_black_lights():
    lights = pack(*(PointLight("/P", np.array([k, 0, 1.0]), np.zeros(3)) for k in range(3)))
    assert sample_light(lights, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5)[4:] == (0.0, 0.0, 0.0, 0.0)
    lights = pack(PointLight("/P", np.zeros(3), np.ones(3)))
    assert sample_light(lights, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5)[4:] == (0.0, 0.0, 0.0, 0.0)


@njit(cache=True)
def _weighted(lights, p, u, out):
    """Irradiance on the upper side of a plane at p: (n, 3) from the lights and (n, 3) from a uniform BSDF, weighted.

    The second ray's origin moves on, as through a slab, by less than the way to the nearest light.
    """
    uniform = 0.5 / math.pi
    for k in range(len(u)):
        x, y, z, distance, r, g, b, pdf = sample_light(lights, p[0], p[1], p[2], u[k, 0], u[k, 1], u[k, 2])
        if z > 0.0 and not light_blocks(lights, p[0], p[1], p[2], x, y, z, distance * (1.0 - 1e-6)):
            w = z if pdf == 0.0 else z * pdf / (pdf + uniform)
            out[k, 0], out[k, 1], out[k, 2] = w * r, w * g, w * b
        z, phi = u[k, 3], 2.0 * math.pi * u[k, 4]
        sine = math.sqrt(1.0 - z * z)
        x, y = sine * math.cos(phi), sine * math.sin(phi)
        on = 0.6 * u[k, 2]
        ox, oy, oz = p[0] + on * x, p[1] + on * y, p[2] + on * z
        t, r, g, b = hit_light(lights, ox, oy, oz, x, y, z, FAR, uniform, p[0], p[1], p[2])
        if t >= FAR:
            r, g, b = escaped_radiance(lights, x, y, z, uniform, p[0], p[1], p[2])
        out[k, 3], out[k, 4], out[k, 5] = z * r / uniform, z * g / uniform, z * b / uniform


def test_both_techniques_add_up():
    """All kinds at once: sampled lights and thrown rays, weighted, add up to what quadrature says of each light."""
    listed = everything()
    p = np.array([0.2, 0.1, 0.0])
    # No finite light stands before another one or before the distant ones, but they cover the domes.
    out = np.zeros((1_000_000, 6))
    _weighted(pack(*listed), p, np.random.default_rng(4).random((len(out), 5)), out)
    both = out[:, :3] + out[:, 3:]
    mean, error = both.mean(axis=0), both.std(axis=0) / math.sqrt(len(out))
    expected = sum(fluence(light, p, 400, 1) for light in listed[:5]) * RADIANCE
    way = listed[5].position - p
    expected = expected + RADIANCE * way[2] / np.linalg.norm(way) ** 3 + 0.2 * RADIANCE * 0.8
    n = 1000
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n)))
    z, phi = (i + 0.5) / n, 2.0 * math.pi * (j + 0.5) / n
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    free = hits(pack(*listed), p, directions)[:, 0] >= FAR
    sky = np.zeros((len(directions), 3))
    _escaped(pack(*listed[6:]), directions[free], -1.0, seen := np.zeros((free.sum(), 3)))
    sky[free] = seen
    # A camera ray does not see distant lights: their disc of uniform radiance is added.
    sun = directions @ [-0.6, 0.0, 0.8] > math.cos(0.2)
    sky += sun[:, None] * 0.3 * RADIANCE / (math.pi * math.sin(0.2) ** 2)
    assert free[sun].all()
    expected = expected + 2.0 * math.pi * (sky * z[:, None]).mean(axis=0)
    assert error.max() < 0.005 * expected.max()
    assert np.all(abs(mean - expected) < 4.0 * error + 1e-3 * expected), f"{mean} +- {error}, not {expected}"


@njit(cache=True)
def _escaped(lights, directions, bsdf_pdf, out):
    for k in range(len(directions)):
        d = directions[k]
        out[k] = escaped_radiance(lights, d[0], d[1], d[2], bsdf_pdf, 0.2, 0.1, 0.0)


def test_density_of_light_from_infinity():
    """``escaped_radiance`` weights a sampled direction by the density with which it was sampled."""
    texture = np.random.default_rng(3).uniform(0.1, 1.0, (8, 16, 3)).astype(np.float32)
    turn = np.eye(4)
    turn[:3, :3] = orthonormal(2)
    near = SphereLight("/S", np.array([0.0, 0.0, 1.0]), 0.1, RADIANCE)
    sun = DistantLight("/Sun", np.array([0.6, 0.0, -0.8]), RADIANCE, 0.3)
    for light in (dome(0.7), dome(1.0, texture, turn), sun):
        for lights in (pack(light), pack(near, light)):
            p = (0.2, 0.1, 0.0)
            samples = draw(lights, p, 200)
            samples = samples[samples[:, 3] == FAR]
            assert len(samples) > 20
            for x, y, z, _, r, _g, _b, pdf in samples:
                weight = escaped_radiance(lights, x, y, z, 2.0, *p)[0] / (r * pdf)
                assert weight == pytest.approx(2.0 / (2.0 + pdf), rel=1e-9)


@pytest.mark.parametrize("half_angle", [0.0, 1e-6, 0.005, 0.3, 1.4, math.pi / 2, 2.0, math.pi])
def test_distant_irradiance(half_angle):
    """``irradiance`` is what a surface that faces the light receives, however wide the light is."""
    lights = pack(DistantLight("/Sun", np.array([0, 0, -1.0]), RADIANCE, half_angle))
    rng = np.random.default_rng(5)
    samples = np.array([sample_light(lights, 0, 0, 0, *u) for u in rng.random((20_000, 3))])
    irradiance = samples[:, 4:7] * np.maximum(samples[:, 2:3], 0.0)
    error = irradiance.std(axis=0) / math.sqrt(len(samples))
    assert np.all(abs(irradiance.mean(axis=0) - RADIANCE) < 4 * error + 1e-6)


# --- packing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("light", "match"),
    [
        (SphereLight("/L", np.zeros(3), 0.0, RADIANCE), "no area"),
        (RectLight("/L", np.zeros(3), np.ones(3), np.ones(3), np.eye(3)[2], RADIANCE), "no area"),
        (DiskLight("/L", np.zeros(3), np.zeros(3), np.ones(3), np.eye(3)[2], RADIANCE), "no area"),
        (CylinderLight("/L", np.zeros(3), np.zeros(3), 1.0, RADIANCE), "no area"),
        (CylinderLight("/L", np.zeros(3), np.ones(3), 0.0, RADIANCE), "no area"),
        (SphereLight("/L", np.array([0, np.nan, 0]), 1.0, RADIANCE), "not finite"),
        (PointLight("/L", np.zeros(3), np.full(3, np.inf)), "not finite"),
    ],
)
def test_pack_refuses(light, match):
    with pytest.raises(UsdfabError, match=f"^/L: .*{match}"):
        pack(light)


def test_one_textured_dome():
    texture = np.ones((2, 4, 3), dtype=np.float32)
    with pytest.raises(UsdfabError, match="second dome light with a texture"):
        pack(dome(1.0, texture), dome(1.0, texture))
    assert len(pack(dome(1.0, texture), dome(1.0)).table) == 2
