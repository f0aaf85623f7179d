"""Aggregation over footprints: against a slow reference, and what must hold whatever the numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from surface_reference import Surface, aggregate_slowly

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import weave_from_name
from usdfab.neural.aggregation import aggregate, delta_transmission
from usdfab.neural.surface_material import SurfaceMaterial, weave_of
from usdfab.scattering import surface_model as model


def material(weave: str = "plain", **values) -> SurfaceMaterial:
    numbers = {"twist": (0.5, -0.4), "inclination": (0.5, 0.35), "roughness": 0.3} | values
    return SurfaceMaterial(weave_of(weave_from_name(weave)), name=weave, **numbers)


def directions(count: int, rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(-1, 1, (8 * count + 64, 2))
    return points[np.sum(points**2, axis=1) < 0.95][:count]


def queries(count: int, seed: int = 0, size: float | None = None, below: bool = False) -> np.ndarray:
    rng = np.random.default_rng(seed)
    wi, wo = directions(count, rng), directions(count, rng)
    wiz = np.sqrt(1 - np.sum(wi**2, axis=1)) * (-1 if below else 1)
    sizes = rng.uniform(0, 3, count) if size is None else np.full(count, size)
    return np.column_stack([rng.random((count, 2)), sizes, wi, wiz, wo])


def whole(material: SurfaceMaterial, rows: np.ndarray, transmission: bool = False, samples: int = 4096) -> np.ndarray:
    return np.column_stack(
        [aggregate(material, rows, transmission=transmission, samples=samples),
         delta_transmission(material, rows, samples=samples)]
    )  # fmt: skip


@pytest.mark.parametrize(
    "weave,below", [("plain", False), ("twill_3x3", True), ("satin_5x10", False), ("satin_5x10", True)]
)
def test_it_agrees_with_the_reference(weave: str, below: bool) -> None:
    """Another sampling, exact heights and finely marched shadows give the same four numbers."""
    m = material(weave)
    rows = queries(6, seed=3, below=below)
    rows[:, 2] = (0.4, 0.7, 1.0, 1.0, 2.0, 3.0)
    fast = whole(m, rows, below, samples=1 << 15)
    slow = np.array([aggregate_slowly(m, row, below) for row in rows])
    scale = slow.max(axis=0)
    assert slow[:, :4].max() > 0.05 and slow[:, 4].max() > 0.05
    # Sampling noise of both is 1 %; horizons between texels show a little too much of the gaps.
    assert np.all(np.abs(fast - slow)[:, :4] <= 0.03 * scale[:4] + 0.02 * slow[:, :4])
    assert np.abs(fast - slow)[:, 4].max() < 0.025
    assert fast[:, :4].mean(axis=0) == pytest.approx(slow[:, :4].mean(axis=0), rel=0.03)


def test_shadows_matter() -> None:
    """Without them the same cloth would be brighter in oblique light: yarns hide one another."""
    low = np.array([[0.3, 0.4, 1.0, 0.9, 0.0, math.sqrt(1 - 0.81), 0.0, 0.0]])
    light = [aggregate(material(height_scale=beta), low, samples=1 << 13)[0, :2].sum() for beta in (0.0, 0.5, 1.0, 2.0)]
    assert light[0] > 0.5 * light[1]
    open_ = Surface(material(height_scale=1.0))
    points = np.random.default_rng(0).random((4000, 2)) * 2
    seen = open_.free(points, low[0, 3:6]).mean()
    assert 0.2 < seen < 0.8


def test_a_flat_cloth_needs_no_shadows() -> None:
    """beta = 0: all normals are up; the components follow from the point model and the yarns' areas alone."""
    m = material(height_scale=0.0, twist=(0.0, 0.0), inclination=(0.0, 0.0))
    rows = queries(5, size=1.0)
    found = whole(m, rows, samples=1 << 16)
    for row, values in zip(rows, found, strict=True):
        wi, wo = row[3:6], np.array([row[6], row[7], math.sqrt(1 - row[6] ** 2 - row[7] ** 2)])
        up, share = np.array([0.0, 0, 1]), 0.5 * (1 - m.gap)
        expected = [share * wi[2] / math.pi] * 2
        for t in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)):
            expected.append(share * wi[2] * float(model.specular_reflection(wi, wo, up, np.array(t), m.roughness)))
        assert values == pytest.approx([*expected, m.gap], rel=3e-3)


@pytest.mark.parametrize("below", [False, True])
def test_a_footprint_of_no_size_is_the_point(below: bool) -> None:
    m = material("twill_3x3")
    surface = Surface(m)
    rows = queries(200, seed=1, size=0.0, below=below)
    found = aggregate(m, rows, transmission=below, samples=3)
    warp, gap, normal, t = surface.frame(rows[:, :2] * [m.columns, m.rows])
    up = np.array([0.0, 0.0, 1.0])
    lit = 0
    for k, row in enumerate(rows):
        wi, wo = row[3:6], np.array([row[6], row[7], math.sqrt(1 - row[6] ** 2 - row[7] ** 2)])
        if not found[k].any():
            continue  # a gap, shadowed, or hidden from the viewer
        lit += 1
        assert not gap[k]
        term = model.specular_transmission if below else model.specular_reflection
        specular = float(term(wi, wo, normal[k], t[k], m.roughness)) * abs(float(wi @ normal[k]))
        side = [-1, -1, -1] if below else [1, 1, 1]
        diffuse = float(model.diffuse_cosine(wi * side, normal[k], up))
        one = [diffuse, 0, specular, 0] if warp[k] else [0, diffuse, 0, specular]
        assert found[k] == pytest.approx(one, rel=1e-4, abs=1e-7)
    assert lit > 60


def test_a_footprint_of_whole_tiles_is_the_mean_wherever_it_lies() -> None:
    m = material("satin_5x5")
    row = queries(1, seed=5)[0]
    rows = np.tile(row, (6, 1))
    rows[:, :2] = np.random.default_rng(0).random((6, 2))
    rows[:, 2] = (1, 1, 2, 5, 40, 1e4)
    found = whole(m, rows, samples=1 << 15)
    mean = np.sum(found * 1.0, axis=0) / len(found)
    assert found == pytest.approx(np.tile(mean, (6, 1)), rel=0.01)


def test_more_samples_come_nearer() -> None:
    """Faster than random samples, whose error falls as the root: 64 times as many are 8 times nearer."""
    m = material("twill_3x3")
    rows = queries(60, seed=2)
    truth = whole(m, rows, samples=1 << 17)
    errors = [float(np.sqrt(np.mean((whole(m, rows, samples=n) - truth) ** 2))) for n in (64, 4096)]
    assert errors[1] < errors[0] / 10


def test_the_specular_part_is_reciprocal() -> None:
    """f_P A_P(wo) does not change when the directions change places; A_P is cos for a whole tile, about."""
    m = material("plain", height_scale=0.6)
    rows = queries(40, size=1.0)
    swapped = rows.copy()
    woz = np.sqrt(1 - np.sum(rows[:, 6:] ** 2, axis=1))
    swapped[:, 3:6] = np.column_stack([rows[:, 6:], woz])
    swapped[:, 6:] = rows[:, 3:5]
    there, back = aggregate(m, rows), aggregate(m, swapped)
    ratio = (there[:, 2:] * woz[:, None]) / (back[:, 2:] * rows[:, 5:6])
    # The maps' normals belong to no height field exactly, so that A_P is the cosine only about.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    assert np.percentile(np.abs(ratio - 1), 90) < 0.25


def test_light_on_the_wrong_side_gives_nothing() -> None:
    m = material()
    above, below = queries(20), queries(20, below=True)
    assert not aggregate(m, above, transmission=True, samples=64).any()
    assert not aggregate(m, below, samples=64).any()
    assert aggregate(m, below, transmission=True, samples=64).any(axis=1).sum() > 15


def test_gaps_let_light_through() -> None:
    straight = np.array([[0.3, 0.6, 1.0, 0, 0, 1, 0, 0]])
    for gap in (0.1, 0.4):
        share = delta_transmission(material(gap=gap), straight, samples=1 << 14)
        assert share[0] == pytest.approx(gap, abs=0.003)
    # A low view sees less of them.
    low = straight.copy()
    low[0, 6] = 0.9
    assert delta_transmission(material(gap=0.4), low)[0] < 0.3


def test_a_white_cloth_reflects_no_more_than_it_gets() -> None:
    """Over all light, from every view: the specular part of white flakes alone, and the Lambert part alone, below 1."""
    rng = np.random.default_rng(0)
    count = 1500
    wi = directions(count, rng)
    wiz = np.sqrt(1 - np.sum(wi**2, axis=1))
    # The disk is drawn uniformly within radius^2 0.95; f_P has the cosine in it, which the density has as well.
    for view in ((0.0, 0.0), (0.6, 0.0), (0.5, -0.7)):
        rows = np.column_stack([np.full((count, 2), 0.4), np.ones(count), wi, wiz, np.tile(view, (count, 1))])
        for m in (material(), material("satin_8x8", roughness=0.1, height_scale=2.0)):
            light = aggregate(m, rows, samples=128) / wiz[:, None]
            rows_below = rows.copy()
            rows_below[:, 5] *= -1
            through = aggregate(m, rows_below, transmission=True, samples=128) / wiz[:, None]
            total = (light + through).mean(axis=0) * math.pi * 0.95
            assert 0.05 < total[2:].sum() < 1.0
            diffuse = light[:, :2].mean(axis=0).sum() * math.pi * 0.95
            assert 0.3 < diffuse < 1.0 - 0.9 * delta_transmission(m, rows[:1], samples=4096)[0]


def test_it_does_not_depend_on_threads_and_does_on_the_seed() -> None:
    m, rows = material(), queries(50)
    one = aggregate(m, rows, samples=32, threads=1)
    assert np.array_equal(one, aggregate(m, rows, samples=32, threads=2))
    assert np.array_equal(one[:10], aggregate(m, rows[:10], samples=32))
    assert not np.array_equal(one, aggregate(m, rows, samples=32, seed=1))


tangle = st.floats(0.0, 0.9999)


@settings(max_examples=40)
@given(tangle, st.floats(-4, 4), tangle, st.floats(-4, 4), st.floats(0, 10), st.floats(0.02, 1), st.floats(0, 4))
def test_every_value_is_finite_and_not_negative(
    ri: float, pi: float, ro: float, po: float, size: float, alpha: float, beta: float
) -> None:
    wi = ri * math.cos(pi), ri * math.sin(pi), math.sqrt(1 - ri * ri)
    row = np.array([[0.1, 0.9, size, *wi, ro * math.cos(po), ro * math.sin(po)]])
    m = material(roughness=alpha, height_scale=beta)
    for below in (False, True):
        row[0, 5] = -abs(row[0, 5]) if below else abs(row[0, 5])
        values = whole(m, row, below, samples=64)
        assert np.isfinite(values).all() and values.min() >= 0.0
        assert values[0, 4] <= 1.0 and values[0, :2].sum() <= 1 / math.pi + 1e-6


@pytest.mark.parametrize(
    "column,value,said",
    [(0, math.nan, "not finite"), (2, -1.0, "negative"), (3, 2.0, "unit vector"), (6, 1.5, "unit disk")],
)
def test_bad_queries_are_named(column: int, value: float, said: str) -> None:
    rows = queries(4)
    rows[2, column] = value
    with pytest.raises(UsdfabError, match=f"query 2 .*{said}"):
        aggregate(material(), rows)
    with pytest.raises(UsdfabError, match="columns"):
        aggregate(material(), rows[:, :7])
