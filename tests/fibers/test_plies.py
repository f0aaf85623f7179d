"""Plied yarns: where the plies lie, how they twist, that they close over the patch, that single yarns are unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.fabric import FabricParameters, YarnParameters, ply_circles, ply_fill, weave_from_name
from usdfab.fibers import YarnShape, closed_twist, draw, fiber_offsets, generate_patch, lay_out, successors

PLAIN = weave_from_name("plain")
ROUND = YarnShape(
    radius=1.0,
    flattening=1.0,
    inclination=0.6,
    crimp=0.0,
    twist=0.25,
    irregularity=0.0,
    migration=0.5,
    migration_rate=0.2,
    ply_twist=-0.15,
)


def _fabric(plies: int, weave: str = "plain", **yarn: float) -> FabricParameters:
    system = YarnParameters(**({"fiber_count": 60, "ply_count": plies, "twist": 0.2, "ply_twist": -0.2} | yarn))
    return FabricParameters(weave_from_name(weave), (5e-3, 4e-3), system, system, seed=3)


def _offsets(shape: YarnShape, plies: int, fibers: int = 90, weave=PLAIN, vertices: int = 40, seed: int = 1):
    """Across and height (yarns, fibers, stations), successors and layout."""
    layout = lay_out(weave, "weft", vertices)
    draws = draw(layout, fibers, seed, plies)
    successor = successors(shape, layout, draws)
    offsets = [
        np.stack(np.split(array, layout.yarns, axis=1)) for array in fiber_offsets(shape, layout, draws, successor)
    ]
    return *offsets, successor, layout


# --- where plies lie -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plies", [2, 3, 4])
def test_plies_touch_each_other_and_the_yarns_circle(plies: int) -> None:
    radius, distance = ply_circles(plies)
    angle = 2 * np.pi / plies * np.arange(plies + 1)
    centers = distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1) == pytest.approx(np.full(plies, 2 * radius))
    assert distance + radius == pytest.approx(1)
    assert ply_fill(plies) == pytest.approx(plies * radius**2)


def test_one_ply_is_the_yarn() -> None:
    assert ply_circles(1) == (1.0, 0.0) and ply_fill(1) == 1.0


@pytest.mark.parametrize("plies", [2, 3, 4])
def test_fibers_lie_in_their_plies(plies: int) -> None:
    across, height, _, _ = _offsets(ROUND, plies, fibers=600)
    radius, distance = ply_circles(plies)
    for ply in range(plies):
        x, z = across[:, ply::plies], height[:, ply::plies]
        cx, cz = x.mean(axis=1), z.mean(axis=1)
        assert np.hypot(cx, cz) == pytest.approx(np.full(cx.shape, distance), abs=0.08 * radius)
        from_center = np.hypot(x - cx[:, None], z - cz[:, None])
        # Jitter J S reaches beyond the radius by a few tenths at most (eq. 7).
        assert np.quantile(from_center, 0.97) < 1.1 * radius
        assert np.quantile(from_center, 0.9) > 0.5 * radius


def test_flattening_acts_on_the_whole_cross_section() -> None:
    across, height, _, _ = _offsets(ROUND, 3)
    wide, same, _, _ = _offsets(replace(ROUND, flattening=2.5), 3)
    assert wide == pytest.approx(2.5 * across) and same == pytest.approx(height)


@pytest.mark.parametrize("plies", [2, 3, 4])
def test_closing_does_not_pinch_the_yarn(plies: int) -> None:
    across, height, _, _ = _offsets(ROUND, plies, fibers=600)
    thickness = np.sqrt((across**2 + height**2).mean(axis=1))
    assert thickness.min() > 0.93 * thickness.max()


def test_fiber_radius_follows_the_packing_of_the_plies() -> None:
    yarn = YarnParameters(radius=1e-4, packing=0.4, fiber_count=100, ply_count=2)
    # Two circles of half the radius hold half the area.
    assert 100 * yarn.effective_fiber_radius**2 / (0.5 * yarn.radius**2) == pytest.approx(0.4)


@given(st.integers(1, 23), st.integers(1, 4))
@settings(max_examples=30)
def test_all_plies_hold_equally_many_fibers(fibers: int, plies: int) -> None:
    draws = draw(lay_out(PLAIN, "warp", 4), fibers, 0, plies)
    assert draws.fibers % plies == 0 and fibers <= draws.fibers < fibers + plies


# --- twist -----------------------------------------------------------------------------------------------------------


@given(st.floats(-2, 2), st.integers(2, 64), st.integers(2, 4), st.integers(0, 3))
def test_closed_twist_is_the_nearest_that_closes(twist: float, length: int, plies: int, step: int) -> None:
    closed = closed_twist(twist, length, plies)
    assert closed * length * plies == pytest.approx(round(closed * length * plies), abs=1e-9)
    assert abs(closed - twist) <= 0.5 / (plies * length) + 1e-12
    # With the step settled: the same, if the step is its own; else the nearest that goes on by that many plies.
    own = round(closed * length * plies)
    assert closed_twist(twist, length, plies, own % plies) == pytest.approx(closed)
    other = closed_twist(twist, length, plies, step)
    assert round(other * length * plies) % plies == step % plies and abs(other - twist) <= 0.5 / length + 1e-12


def _turns_per_cell(x: np.ndarray, z: np.ndarray, layout) -> np.ndarray:
    step = layout.position[1] - layout.position[0]
    return np.diff(np.unwrap(np.arctan2(z, x), axis=-1), axis=-1) / (2 * np.pi * step)


@pytest.mark.parametrize("plies", [2, 3])
@pytest.mark.parametrize(("twist", "own"), [(0.25, -0.15), (-0.25, 0.1), (0.25, 0.2)])
def test_plies_and_their_fibers_turn_as_asked(plies: int, twist: float, own: float) -> None:
    shape = replace(ROUND, twist=twist, ply_twist=own, migration=0.0)
    across, height, _, layout = _offsets(shape, plies, fibers=600, weave=weave_from_name("twill 2/2"))
    closed = closed_twist(twist, 4, plies)
    for ply in range(plies):
        x, z = across[:, ply::plies], height[:, ply::plies]
        cx, cz = x.mean(axis=1), z.mean(axis=1)
        assert _turns_per_cell(cx, cz, layout).mean() == pytest.approx(closed, abs=0.01)
        local = _turns_per_cell(x - cx[:, None], z - cz[:, None], layout)
        assert np.median(local) == pytest.approx(own, abs=0.05 * abs(own))


def test_balanced_two_ply_fibers_run_along_the_outside() -> None:
    # With the fibers twisted as much against the plies, what looks outwards moves with the sum of both turns: not.
    across, height, _, layout = _offsets(replace(ROUND, twist=0.25, ply_twist=-0.25, migration=0.0), 2, fibers=600)
    outer = np.hypot(across, height) > 0.9
    outer = outer[..., 1:] & outer[..., :-1]
    turning = _turns_per_cell(across, height, layout)[outer]
    same = _offsets(replace(ROUND, twist=0.25, ply_twist=0.25, migration=0.0), 2, fibers=600)
    outer = np.hypot(same[0], same[1]) > 0.9
    outer = outer[..., 1:] & outer[..., :-1]
    assert abs(np.median(turning)) < 0.03
    assert np.median(_turns_per_cell(same[0], same[1], layout)[outer]) == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("twist", [0.25, -0.25])
def test_positive_ply_twist_is_z_twist_in_both_systems(twist: float) -> None:
    # Z: on the face, the plies of an upright yarn lean like the stroke of a Z (/), those of a lying yarn like \.
    fabric = _fabric(2, twist=twist, ply_twist=twist, irregularity=0.0, migration=0.0, crimp=0.0)
    patch = generate_patch(fabric)
    for system, along, across, sense in ((patch.warp, 1, 0, 1), (patch.weft, 0, 1, -1)):
        edges = np.diff(system.points, axis=0)
        top = (system.points[:-1, 2] > 0.6 * fabric.warp.radius) & (edges[:, along] > 0)
        lean = edges[top, across] / edges[top, along]
        assert np.sign(np.median(lean)) == sense * np.sign(twist)


# --- closing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plies", [2, 3, 4])
@pytest.mark.parametrize("twist", [0.0, 0.17, -0.31])
def test_each_ply_continues_as_a_whole_on_a_ply(plies: int, twist: float) -> None:
    _, _, successor, layout = _offsets(replace(ROUND, twist=twist), plies)
    fibers = successor.shape[1]
    assert np.array_equal(np.sort(successor, axis=1), np.broadcast_to(np.arange(fibers), successor.shape))
    step = round(closed_twist(twist, layout.length, plies) * plies * layout.length)
    assert np.array_equal((successor - np.arange(fibers)) % plies, np.full(successor.shape, step % plies))


@pytest.mark.parametrize("plies", [2, 3, 4])
@pytest.mark.parametrize("weave", ["plain", "twill 2/2"])
def test_position_and_direction_agree_over_the_border(plies: int, weave: str) -> None:
    # Without crimp and noise, and with floats of one length, fibers are smooth and evenly sampled, so third differences
    # show any jump of position, direction or curvature: over the border they are as small as inside.
    patch = generate_patch(_fabric(plies, weave, crimp=0.0, irregularity=0.0))
    for system in patch.systems:
        points, offsets = system.extended(4, 4)
        third = np.linalg.norm(np.diff(points, n=3, axis=0), axis=1)
        curve = np.repeat(np.arange(system.curves), np.diff(offsets))
        valid = curve[3:] == curve[:-3]
        borders = np.r_[offsets[:-1], offsets[1:] - 7][:, None] + np.arange(4)
        inside = valid.copy()
        inside[borders.ravel()] = False
        assert third[borders].max() <= 1.5 * third[inside].max()
        # And a step is no jump: far below a fiber's radius.
        assert third[borders].max() < 0.2 * system.radius


# --- what must not change --------------------------------------------------------------------------------------------


OLD_WARP = [
    (0.00023640646547108614, 0.0, 1.5815105111555964e-05),
    (0.00024105613630505114, 0.00028, -0.00012013038406046845),
    (0.00021023472453532332, 0.001, 0.00015473317574483554),
    (0.001314385949437675, 0.0006800000000000002, 0.00018695039047420358),
]
OLD_WEFT = [
    (0.0, 0.00022031724548689198, 2.3739709394712424e-05),
    (0.00035, 0.0002117531487624054, 0.00017664564171226244),
    (0.00125, 0.0003256425956399575, -0.0001324024333505782),
    (0.0008500000000000001, 0.000936925196360198, 5.370723507580514e-05),
]


def test_single_yarns_are_what_they_were() -> None:
    # Vertices of usdfab 0.1's patch of this fabric, from before there were plies, flyaways and variants.
    yarn = YarnParameters(fiber_count=40, twist=0.07, irregularity=0.3)
    patch = generate_patch(FabricParameters(weave_from_name("twill 3/1"), (5e-3, 4e-3), yarn, yarn, seed=11), 10)
    for system, rows in ((patch.warp, OLD_WARP), (patch.weft, OLD_WEFT)):
        assert system.points[[0, 7, 555, 2345]] == pytest.approx(np.array(rows), rel=1e-9, abs=1e-15)
    assert patch.flyaways == ()


def test_ply_twist_means_nothing_to_single_yarns() -> None:
    a, b = (generate_patch(_fabric(1, ply_twist=t), 8) for t in (-0.3, 0.4))
    assert np.array_equal(a.warp.points, b.warp.points)


# --- differentiable --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plies", [2, 3])
def test_torch_and_numpy_agree_and_every_gradient_matches_finite_differences(plies: int) -> None:
    torch = pytest.importorskip("torch")
    layout = lay_out(weave_from_name("twill 2/1"), "weft", 8)
    draws = draw(layout, 12, 5, plies)
    base = replace(ROUND, crimp=0.7, irregularity=0.2, flattening=1.4, twist=0.21)
    successor = successors(base, layout, draws)
    names = list(YarnShape.__dataclass_fields__)
    values = torch.tensor([float(getattr(base, n)) for n in names], dtype=torch.float64, requires_grad=True)
    weights = torch.tensor(np.random.default_rng(0).normal(size=(2, draws.fibers, len(layout.yarn))))

    def projected(v):
        across, height = fiber_offsets(YarnShape(**dict(zip(names, v, strict=True))), layout, draws, successor, torch)
        return torch.stack([(weights[0] * across).sum(), (weights[1] * height).sum()])

    assert torch.autograd.gradcheck(projected, (values,), eps=1e-6, atol=1e-5, rtol=1e-5)
    gradient = torch.autograd.grad(projected(values).sum(), values)[0]
    # The plies' twist about the yarn goes in steps; everything else has a slope.
    assert [n for n, g in zip(names, gradient, strict=True) if g == 0] == ["twist"]
    t_across, t_height = fiber_offsets(
        YarnShape(**dict(zip(names, values.detach(), strict=True))), layout, draws, successor, torch
    )
    across, height = fiber_offsets(base, layout, draws, successor)
    assert t_across.numpy() == pytest.approx(across, abs=1e-12) and t_height.numpy() == pytest.approx(height, abs=1e-12)


@settings(max_examples=25)
@given(
    st.sampled_from(["plain", "satin 5/2", "herringbone", "crepe"]),
    st.integers(1, 4),
    st.floats(-1, 1),
    st.floats(-1, 1),
    st.integers(1, 12),
    st.floats(0, 1),
)
def test_any_plies_give_finite_fibers(
    name: str, plies: int, twist: float, own: float, fibers: int, noise: float
) -> None:
    fabric = _fabric(plies, name, twist=twist, ply_twist=own, fiber_count=fibers, irregularity=noise)
    for system in generate_patch(fabric, 8).systems:
        assert np.isfinite(system.points).all()
        assert np.array_equal(np.sort(system.successor), np.arange(system.curves))
