"""Fiber geometry: equations at known points, no seams, reproducible, differentiable."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import NAMED_WEAVES, PRESETS, FabricParameters, YarnParameters, edited, preset, weave_from_name
from usdfab.fibers import YarnShape, draw, fiber_offsets, generate_patch, lay_out, successors
from usdfab.fibers.centerline import unit_centerline
from usdfab.fibers.noise import perlin3
from usdfab.fibers.randomness import normal, uniform

SHAPE = YarnShape(
    radius=1.3e-4,
    flattening=1.4,
    inclination=0.8,
    crimp=0.7,
    twist=0.09,
    irregularity=0.2,
    migration=0.7,
    migration_rate=0.3,
)


# --- centre line (eq. 5, 6) ------------------------------------------------------------------------------------------


@given(st.integers(1, 8), st.floats(0.05, 1.5))
def test_centerline_starts_and_ends_at_zero_and_peaks_at_one(length: int, u: float) -> None:
    y = np.linspace(0, length, 101)
    z = unit_centerline(y, np.full_like(y, length), u)
    assert z[[0, -1]] == pytest.approx([0, 0], abs=1e-9)
    assert z[50] == pytest.approx(1)
    assert z == pytest.approx(z[::-1])


@given(st.floats(0.05, 1.5))
def test_short_segments_are_arcs_with_the_given_inclination(u: float) -> None:
    y = np.array([0.0, 1e-6])
    r = 1 / (2 * np.sin(u))
    z = unit_centerline(y, np.ones(2), u) * (r - r * np.cos(u))
    assert np.arctan((z[1] - z[0]) / 1e-6) == pytest.approx(u, abs=1e-4)


def test_long_floats_follow_equation_5_with_w_one() -> None:
    length, u, y = 4.0, 0.9, np.array([1.0])
    r = length / (2 * np.sin(u))
    arc = np.sqrt(r**2 - (y - r * np.sin(u)) ** 2) - r * np.cos(u)
    parabola = (y - r * np.sin(u)) ** 2 / (r * length) + 1
    assert unit_centerline(y, np.array([length]), u) == pytest.approx(arc * parabola / (r - r * np.cos(u)))


# --- the patch -------------------------------------------------------------------------------------------------------


def _fabric(weave: str, **yarn: float) -> FabricParameters:
    system = YarnParameters(**({"fiber_count": 40} | yarn))
    return FabricParameters(weave_from_name(weave), (5e-3, 4e-3), system, system, seed=3)


@pytest.mark.parametrize("weave", ["plain", "twill 3/1", "satin 5/2", "herringbone", "1100/0110/0011/1001"])
@pytest.mark.parametrize("twist", [0.0, 0.03, -0.21])
def test_no_seam_where_patches_meet(weave: str, twist: float) -> None:
    fabric = _fabric(weave, twist=twist, irregularity=0.3)
    patch, patch_weave = generate_patch(fabric), fabric.weave
    for system in patch.systems:
        points, offsets = system.extended(3, 3)
        edges = np.diff(points, axis=0)
        length = np.linalg.norm(edges, axis=1)
        inside = np.ones(len(edges), dtype=bool)
        inside[offsets[1:-1] - 1] = False
        cosine = np.einsum("ij,ij->i", edges[1:], edges[:-1]) / (length[1:] * length[:-1])
        bend = np.arccos(np.clip(cosine, -1, 1))
        last = offsets[1:] - 4  # last own vertex of each curve
        across_border = np.r_[bend[last - 1], bend[last]]
        valid = inside[1:] & inside[:-1]
        # Steps over the border are as long as any other, and do not bend more. Where segments meet fibers do bend
        # (y^kappa has a kink there), and the border may be such a place.
        layout = lay_out(patch_weave, system.system, 40)
        begins = [layout.y[layout.first[k] : layout.first[k + 1]] == 0 for k in range(layout.yarns)]
        joint = np.concatenate([np.r_[0, 0, 0, begins[k], 0, 0, 0] for k in system.yarn]).astype(bool)
        joint[np.r_[offsets[:-1], offsets[1:] - 4][:, None] + np.arange(4)] = False
        assert length[last].max() <= 1.2 * np.quantile(length[inside], 0.999)
        usual = max(np.quantile(bend[valid], 0.99), np.quantile(bend[joint[1:-1]], 0.9) if joint.any() else 0.0)
        assert np.quantile(across_border, 0.9) <= 1.5 * usual


def test_every_fiber_has_one_successor() -> None:
    patch = generate_patch(_fabric("twill 2/2", twist=0.17))
    for system in patch.systems:
        assert np.array_equal(np.sort(system.successor), np.arange(system.curves))
        assert np.array_equal(system.yarn[system.successor], system.yarn)
        assert (system.successor != np.arange(system.curves)).any()


def test_without_twist_fibers_close_on_themselves() -> None:
    patch = generate_patch(_fabric("plain", twist=0.0))
    assert all(np.array_equal(s.successor, np.arange(s.curves)) for s in patch.systems)


@pytest.mark.parametrize("twist", [0.1, -0.1])
def test_positive_twist_is_z_twist_in_both_systems(twist: float) -> None:
    # Z: on the face, fibers of an upright yarn lean like the stroke of a Z (/), those of a lying yarn like \.
    fabric = _fabric("plain", twist=twist, irregularity=0.0, migration=0.0, crimp=0.0)
    patch = generate_patch(fabric)
    for system, along, across, sense in ((patch.warp, 1, 0, 1), (patch.weft, 0, 1, -1)):
        edges = np.diff(system.points, axis=0)
        top = system.points[:-1, 2] > 0.6 * fabric.warp.radius
        top &= np.linalg.norm(edges, axis=1) < 1e-4
        lean = edges[top, across] / edges[top, along]
        assert np.sign(np.median(lean)) == sense * np.sign(twist)


def test_the_yarn_on_top_is_the_one_the_weave_says() -> None:
    fabric = _fabric("twill 3/1", irregularity=0.0, crimp=1.0)
    patch = generate_patch(fabric)
    dx, dy = fabric.cell
    for i in range(4):
        for j in range(4):
            heights = []
            for system in patch.systems:
                near = np.all(
                    np.abs(system.points[:, :2] - [(j + 0.5) * dx, (i + 0.5) * dy]) < [dx / 4, dy / 4], axis=1
                )
                heights.append(system.points[near, 2].mean())
            assert (heights[1] > heights[0]) == bool(fabric.weave.matrix[i, j])


def test_crimp_one_lets_equal_yarns_just_touch() -> None:
    fabric = _fabric("plain", irregularity=0.0, crimp=1.0, migration=0.0, twist=0.0)
    patch = generate_patch(fabric)
    for system in patch.systems:
        # Mean over a yarn's fibers at the middle of a segment is the centre line: one yarn radius up or down.
        heights = [system.points[system.offsets[:-1] + k, 2].reshape(2, -1).mean(axis=1) for k in (20, 60)]
        assert np.abs(heights) == pytest.approx(np.full((2, 2), fabric.warp.radius), rel=0.08)


def test_fibers_lie_within_the_yarn() -> None:
    fabric = _fabric("plain", irregularity=0.0, crimp=0.0, flattening=2.0)
    patch = generate_patch(fabric)
    dx, _ = fabric.cell
    across = np.abs((patch.warp.points[:, 0] / dx) % 1.0 - 0.5) * dx
    # Jitter J S reaches beyond the radius by a few tenths at most (eq. 7).
    assert np.quantile(across, 0.99) <= 1.1 * fabric.warp.radius * 2.0
    assert np.abs(patch.warp.points[:, 2]).max() <= 1.4 * fabric.warp.radius


def test_a_seed_fixes_everything_and_another_changes_it() -> None:
    fabric = _fabric("plain")
    a, b = generate_patch(fabric), generate_patch(fabric)
    c = generate_patch(dataclasses.replace(fabric, seed=4))
    assert np.array_equal(a.warp.points, b.warp.points)
    assert not np.array_equal(a.warp.points, c.warp.points)


def test_copies_are_not_copies() -> None:
    fabric = _fabric("plain")
    patch = generate_patch(fabric, copies=(2, 1))
    assert patch.size == pytest.approx((4 * fabric.cell[0], 2 * fabric.cell[1]))
    yarns = patch.warp.points.reshape(4, -1, 3)
    shifted = yarns[2] - [2 * fabric.cell[0], 0, 0]
    assert np.abs(shifted - yarns[0]).max() > 0.1 * fabric.warp.radius


def test_yarn_dyed_cloth_keeps_its_colors() -> None:
    fabric = edited(_fabric("plain"), {"warp.yarn_albedo": "1,0,0;0,1,0;0,0,1"})
    warp = generate_patch(fabric).warp
    assert warp.yarn.max() == 5
    assert np.array_equal(warp.albedo, np.eye(3)[warp.yarn % 3])


@pytest.mark.parametrize("name", PRESETS)
def test_presets_generate(name: str) -> None:
    patch = generate_patch(preset(name))
    low, high = patch.z_range
    assert np.isfinite(patch.warp.points).all() and np.isfinite(patch.weft.points).all()
    assert low < 0 < high < 2e-3


def test_resolution_is_forty_vertices_a_segment() -> None:
    patch = generate_patch(_fabric("twill 3/1"))
    assert np.array_equal(np.diff(patch.warp.offsets), np.full(patch.warp.curves, 80))


def test_too_few_vertices_are_refused() -> None:
    with pytest.raises(UsdfabError, match="vertices"):
        generate_patch(_fabric("plain"), vertices_per_segment=2)


@settings(max_examples=25)
@given(
    st.sampled_from(sorted(NAMED_WEAVES)),
    st.floats(0.02, 1.55),
    st.floats(0, 1),
    st.floats(-0.5, 0.5),
    st.integers(1, 12),
)
def test_any_parameters_give_finite_fibers(name: str, u: float, q: float, twist: float, fibers: int) -> None:
    patch = generate_patch(_fabric(name, inclination=u, irregularity=q, twist=twist, fiber_count=fibers), 8)
    for system in patch.systems:
        assert np.isfinite(system.points).all()
        assert np.array_equal(np.sort(system.successor), np.arange(system.curves))


# --- randomness and noise --------------------------------------------------------------------------------------------


def test_draws_have_the_right_moments() -> None:
    k = np.arange(200_000)
    u, n = uniform(1, k), normal(2, k)
    assert u.mean() == pytest.approx(0.5, abs=3e-3) and u.var() == pytest.approx(1 / 12, rel=0.02)
    assert n.mean() == pytest.approx(0, abs=0.01) and n.var() == pytest.approx(1, rel=0.02)
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 0.01


def test_noise_vanishes_on_the_lattice_and_is_smooth() -> None:
    grid = np.arange(4.0)
    assert perlin3(grid, grid, grid, 1) == pytest.approx(np.zeros(4))
    x = np.linspace(0, 8, 4001)
    y = np.full_like(x, 0.3)
    values = perlin3(x, y, y, 1)
    assert 0.2 < np.abs(values).max() <= 1.1
    assert np.abs(np.diff(values, 2)).max() < 1e-4


# --- differentiable --------------------------------------------------------------------------------------------------


def test_torch_and_numpy_agree_and_every_gradient_matches_finite_differences() -> None:
    torch = pytest.importorskip("torch")
    layout = lay_out(weave_from_name("twill 3/1"), "weft", 10)
    draws = draw(layout, 12, seed=5)
    successor = successors(SHAPE, layout, draws)
    names = list(YarnShape.__dataclass_fields__)
    values = torch.tensor([float(getattr(SHAPE, n)) for n in names], dtype=torch.float64)
    # Lengths in units of the yarn radius, so that gradcheck's absolute tolerance means something.
    scale = torch.ones(len(names), dtype=torch.float64)
    scale[names.index("radius")] = 1e-4
    weights = torch.tensor(np.random.default_rng(0).normal(size=(2, 12, len(layout.yarn))))

    def projected(v):
        shape = YarnShape(**dict(zip(names, v * scale, strict=True)))
        across, height = fiber_offsets(shape, layout, draws, successor, xp=torch)
        return torch.stack([(weights[0] * across).sum(), (weights[1] * height).sum()]) / 1e-4

    assert torch.autograd.gradcheck(projected, ((values / scale).requires_grad_(),), eps=1e-6, atol=1e-5, rtol=1e-5)

    across, height = fiber_offsets(SHAPE, layout, draws, successor)
    t_shape = YarnShape(**{n: torch.tensor(float(getattr(SHAPE, n)), dtype=torch.float64) for n in names})
    t_across, t_height = fiber_offsets(t_shape, layout, draws, successor, xp=torch)
    assert t_across.numpy() == pytest.approx(across, abs=1e-15)
    assert t_height.numpy() == pytest.approx(height, abs=1e-15)


@pytest.mark.slow
def test_a_twill_patch_of_200_fibers_takes_well_under_a_second() -> None:
    fabric = _fabric("twill 3/1", fiber_count=200)
    generate_patch(fabric)
    start = time.perf_counter()
    generate_patch(fabric)
    print(f"twill patch, 200 fibers a yarn: {time.perf_counter() - start:.3f} s")
