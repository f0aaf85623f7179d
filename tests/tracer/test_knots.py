"""Which knots of the fibers' splines are kept: nothing tears, and tangents stay right."""

import numpy as np
import pytest
from scenes import fabric

from usdfab.fibers import FiberSystem, generate_patch
from usdfab.tracer import knots


def of(weave: str, **changes) -> FiberSystem:
    return generate_patch(fabric(weave, **changes)).weft


CASES = [
    of("plain", fibers=8),
    of("satin", fibers=30, twist=0.3),
    of("twill_1_3", fibers=12, migration=0.7, ply_count=3),
]


def wave(amplitude: float, count: int = 100) -> FiberSystem:
    """One fiber of radius 1 along a sine of period 100, in the plane."""
    x = 100.0 * np.arange(count) / count
    points = np.c_[x, np.zeros(count), amplitude * np.sin(0.02 * np.pi * x)]
    zero = np.zeros(1, dtype=np.int64)
    return FiberSystem(
        "weft", points, np.array([0, count]), zero, zero, zero, 1.0, np.ones((1, 3)), np.array([100.0, 0.0, 0.0])
    )


def errors(system: FiberSystem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At all knots: (M, 3) vector from the polyline to the spline in radii, angle to its tangent, and length (M,)."""
    points, tangents, offsets = knots.spline_vertices(system)
    places, directions, kept_offsets = knots.polylines(system)
    away, angle, weight = [], [], []
    for c in range(system.curves):
        true, tangent = (a[offsets[c] + 1 : offsets[c + 1] - 2] for a in (points, tangents))
        vertex, own = (a[kept_offsets[c] + 1 : kept_offsets[c + 1] - 2] for a in (places, directions))
        # Kept knots are those whose tangent is there, in this order.
        index: list[int] = []
        for t in own:
            start = index[-1] + 1 if index else 0
            index.append(start + int(np.flatnonzero((tangent[start:] == t).all(axis=1))[0]))
        step = np.linalg.norm(np.diff(true, axis=0), axis=1)
        arc = np.r_[0.0, np.cumsum(step)]
        at = lambda of: np.stack([np.interp(arc, arc[index], of[:, x]) for x in range(3)], axis=1)  # noqa: E731, B023
        away.append((true - at(vertex)) / system.radius)
        shading = at(own)
        shading /= np.linalg.norm(shading, axis=1, keepdims=True)
        angle.append(np.arccos(np.clip(np.einsum("kx,kx->k", shading, tangent), -1.0, 1.0)))
        weight.append(0.5 * (np.r_[step, 0.0] + np.r_[0.0, step]))
    return np.concatenate(away), np.concatenate(angle), np.concatenate(weight)


@pytest.mark.parametrize("system", CASES)
def test_curves_go_on_in_the_next_tile(system):
    places, tangents, offsets = knots.polylines(system)
    begin, end = offsets[:-1] + 1, offsets[1:] - 3
    assert np.allclose(
        places[end], places[begin[system.successor]] + system.period, rtol=0.0, atol=1e-9 * system.radius
    )
    assert np.allclose(tangents[end], tangents[begin[system.successor]], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("system", CASES)
def test_fewer_knots_with_bounded_errors(system):
    away, angle, weight = errors(system)
    assert len(knots.polylines(system)[0]) < 0.7 * len(knots.spline_vertices(system)[0])
    assert np.sqrt(np.average(angle**2, weights=weight)) < knots.TILT
    assert np.quantile(angle, 0.99) < 3.0 * knots.TILT
    place = np.linalg.norm(away, axis=1)
    assert np.sqrt(np.average(place**2, weights=weight)) < 0.8 * knots.BEND
    assert np.quantile(place, 0.99) < 1.6 * knots.BEND


def test_segments_follow_from_the_curvature():
    """On a gentle sine: the integral of the root of the larger of curvature / 8 BEND r and its slope / 8 TILT."""
    amplitude, k = 3.0, 0.02 * np.pi
    x = np.linspace(0.0, 100.0, 10001)
    place = amplitude * k**2 * abs(np.sin(k * x)) / (8.0 * knots.BEND)
    tilt = amplitude * k**3 * abs(np.cos(k * x)) / (8.0 * knots.TILT)
    expected = 100.0 * np.sqrt(np.maximum(place, tilt)).mean()
    segments = len(knots.polylines(wave(amplitude))[0]) - 4
    assert 0.0 <= segments - expected < 0.1 * expected + 1.0


def test_all_knots_where_no_error_is_allowed(monkeypatch):
    monkeypatch.setattr(knots, "BEND", 1e-9)
    for kept, all_knots in zip(knots.polylines(CASES[0]), knots.spline_vertices(CASES[0]), strict=True):
        assert np.array_equal(kept, all_knots)
