"""Motion and lens: what is smeared is smeared by what geometry says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane

from usdfab.tracer import RenderSettings, Tracer

GRAY_DOME = dome(1.0)
WIDE = 64
STRIP = RenderSettings((WIDE, 4), spp=1000, max_depth=1)


def across(half=1.0):
    """A camera one metre above that sees x in [-half, half] and next to nothing of y."""
    return look((0, 0, 1), (0, 0, 0), (half, 1e-3))


def position(half=1.0):
    """x at the middles of the columns of ``STRIP``."""
    return half * (2 * (np.arange(WIDE) + 0.5) / WIDE - 1)


def box_filtered(edges, values, half=1.0):
    """Means over the columns of a function that is linear between its nodes."""
    fine = half * (2 * (np.arange(WIDE * 64) + 0.5) / (WIDE * 64) - 1)
    return np.interp(fine, edges, values).reshape(WIDE, 64).mean(axis=1)


def alpha(meshes, camera, materials=None, fabrics=(), settings=STRIP):
    scene = scenes.scene(meshes, materials or [lambert()], [GRAY_DOME], fabrics)
    return Tracer(scene).render(camera, settings).alpha.mean(axis=0, dtype=float)


# A square of 0.4 m that moves by 0.6 m covers each place for a share of the time that is a trapezoid.
TRAPEZOID = box_filtered([-0.5, -0.1, 0.1, 0.5], [0.0, 2 / 3, 2 / 3, 0.0])
BEFORE, AFTER = np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0])


def moving(kind):
    """(mesh, camera) whose picture is the trapezoid."""
    square, camera = plane(0.4), across()
    if kind == "points":
        return replace(square, points=square.points + BEFORE, points_close=square.points + AFTER), camera
    if kind in ("placements", "turned copy"):
        placed = np.stack([np.column_stack([np.eye(3), end]) for end in (BEFORE, AFTER)])
        if kind == "turned copy":  # the mesh lies elsewhere and is brought here by its placement
            turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
            square = replace(square, points=square.points @ turn.T)
            placed[:, :, :3] = turn.T
        return replace(square, placements=placed[:1], placements_close=placed[1:]), camera
    opening, closing = camera.to_world.copy(), camera.to_world.copy()
    opening[:3, 3] -= BEFORE
    closing[:3, 3] -= AFTER
    return square, replace(camera, to_world=opening, to_world_close=closing)


@pytest.mark.parametrize("kind", ["points", "placements", "turned copy", "camera"])
@pytest.mark.parametrize("fabrics", [False, True])
def test_coverage_of_a_moving_square(kind, fabrics):
    mesh, camera = moving(kind)
    if fabrics:  # closed cloth, much smaller yarns than pixels
        cloth = fabric(radius=4e-4)
        seen = alpha([mesh], camera, [cloth_material()], [cloth])
        still = alpha([plane(4.0)], across(), [cloth_material()], [cloth]).mean()
        np.testing.assert_allclose(seen / still, TRAPEZOID, atol=0.03)
        assert still > 0.97
    else:
        seen = alpha([mesh], camera)
        np.testing.assert_allclose(seen, TRAPEZOID, atol=0.03)
    # Errors of sampling, not of the shape: they cancel over the columns.
    scale = 1.0 if not fabrics else still
    assert abs(seen.mean() / scale - TRAPEZOID.mean()) < 3e-3


@pytest.mark.parametrize("kind", ["points", "placements"])
def test_shadows_move(kind):
    """The shadow of a moving square on the ground in parallel light: the trapezoid again, upside down."""
    from usdfab.usd.scene import DistantLight

    mesh, _ = moving(kind)
    lift = np.array([0.0, 0.0, 0.5])
    if kind == "points":
        mesh = replace(mesh, points=mesh.points + lift, points_close=mesh.points_close + lift)
    else:
        up = np.zeros((3, 4))
        up[:, 3] = lift
        mesh = replace(mesh, placements=mesh.placements + up, placements_close=mesh.placements_close + up)
    sun = DistantLight("/Sun", np.array([0.0, 0, -1]), np.full(3, math.pi), 0.0)
    scene = scenes.scene([mesh, plane(4.0, 1, z=-1e-3)], [lambert(), lambert((1, 1, 1))], [sun])
    camera = replace(look((0, 0, 0.3), (0, 0, 0), (1.0 / 0.301, 1e-3)))
    render = Tracer(scene).render(camera, replace(STRIP, max_depth=2))
    np.testing.assert_allclose(render.pixels[..., 0].mean(axis=0), 1.0 - TRAPEZOID, atol=0.035)


def test_rotating_normals():
    """A square that turns from facing +x to facing +z: its mean normal lies between, its mean shading too."""
    square = plane(0.2)
    angle = math.radians(40)
    tilt = np.array([[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])
    camera = look((0, 0, 1), (0, 0, 0), (1e-3, 1e-3))
    settings = RenderSettings((8, 8), spp=400, max_depth=2)
    found = []
    for smooth in (False, True):
        normals = np.broadcast_to([0.0, 0, 1], (2, 3, 3)) if smooth else None
        by_points = replace(square, normals=normals, points_close=square.points @ tilt.T)
        placed = np.column_stack([np.eye(3), np.zeros(3)])[None]
        turned = np.column_stack([tilt, np.zeros(3)])[None]
        by_copy = replace(square, normals=normals, placements=placed, placements_close=turned)
        found += [
            Tracer(scenes.scene([m], [lambert()], [GRAY_DOME])).render(camera, settings) for m in (by_points, by_copy)
        ]
    # Corners move on straight lines: the tangent of the angle at time t is t sin / (1 - t + t cos).
    t = (np.arange(1000) + 0.5) / 1000
    at = np.arctan2(t * math.sin(angle), 1 - t + t * math.cos(angle))
    mean = np.array([-np.sin(at).mean(), 0.0, np.cos(at).mean()])
    for render in found:
        normal = render.normal.reshape(-1, 3).mean(axis=0)
        np.testing.assert_allclose(normal, mean / np.linalg.norm(mean), atol=6e-3)
        np.testing.assert_allclose(render.alpha, 1.0)


def test_cloth_turns_with_a_rotating_copy():
    """Halfway through a quarter turn about its normal the yarns lie at 45 degrees, and the furnace stays white."""
    turn = np.column_stack([np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3)])
    mesh = replace(plane(0.1), placements=np.eye(3, 4)[None], placements_close=turn[None])
    scene = scenes.scene([mesh], [cloth_material()], [GRAY_DOME], [fabric(albedo=(1, 1, 1))])
    render = Tracer(scene).render(
        look((0, 0, 0.2), (0, 0, 0), (0.05, 0.05)), RenderSettings((24, 24), spp=128, max_depth=2000)
    )
    error = np.sqrt(render.variance.sum(axis=(0, 1))) / render.alpha.size
    mean = render.pixels.mean(axis=(0, 1), dtype=float)
    assert error.max() < 4e-3 and np.all(abs(mean - 1) < 4 * error), f"{mean} +- {error}"


def test_what_does_not_move_is_not_sampled_in_time():
    """Equal ends are no motion, bit for bit."""
    mesh = replace(plane(0.1), placements=np.eye(3, 4)[None])
    camera = look((0.02, 0, 0.2), (0, 0, 0), (0.02, 0.02))
    settings = RenderSettings((16, 16), spp=4, max_depth=8)

    def picture(m, c):
        return Tracer(scenes.scene([m], [cloth_material()], [GRAY_DOME], [fabric()])).render(c, settings).pixels

    expected = picture(mesh, camera)
    close = replace(mesh, points_close=mesh.points.copy(), placements_close=mesh.placements.copy())
    np.testing.assert_array_equal(picture(close, camera), expected)
    np.testing.assert_array_equal(picture(mesh, replace(camera, to_world_close=camera.to_world.copy())), expected)


def test_still_things_beside_moving_ones():
    """Another mesh's motion changes nothing but the random numbers."""
    still, other = plane(0.4, 0), plane(0.1, 0, z=-2.0, center=(9.0, 0))
    other = replace(other, points_close=other.points + 0.5)
    scene = scenes.scene([still, other], [lambert()], [GRAY_DOME])
    render = Tracer(scene).render(across(0.1), STRIP)
    np.testing.assert_allclose(render.alpha, 1.0)
    np.testing.assert_allclose(render.normal, np.broadcast_to([0, 0, 1], render.normal.shape), atol=1e-6)


# --- depth of field --------------------------------------------------------------------------------------------------


def blurred_edge(distance, focus, radius):
    """Coverage over the film's x of a half plane x > 0 at a distance, by the thin lens; in units of x at the focus."""
    # A film point in focus at X sees, through the lens point a, the place a + (X - a) distance / focus.
    x = position(0.1) * focus
    # The half plane is seen where a (1 - k) + X k > 0 with k = distance / focus, a over the disk.
    k = distance / focus
    limit = np.clip(-x * k / (abs(1 - k) * radius) if k != 1 else -np.sign(x) * 2, -1, 1)
    # Share of a unit disk beyond a chord.
    return (np.arccos(limit) - limit * np.sqrt(1 - limit**2)) / math.pi


@pytest.mark.parametrize(("distance", "focus"), [(2.0, 1.0), (1.0, 1.6), (1.5, 0.9)])
def test_blur_of_an_edge(distance, focus):
    radius = 0.03
    half = replace(plane(4.0), points=plane(4.0).points + np.array([2.0, 0, -distance]))
    camera = replace(look((0, 0, 0), (0, 0, -1), (0.1, 1e-3)), lens_radius=radius, focus_distance=focus)
    seen = alpha([half], camera)
    np.testing.assert_allclose(seen, blurred_edge(distance, focus, radius), atol=0.035)
    # The width of the blur, from the profile's second moment: the disk's is radius / 2 in each direction.
    weight = np.diff(np.r_[0.0, seen, 1.0])
    at = np.r_[position(0.1), 0.1] - 0.1 / WIDE
    spread = math.sqrt(np.sum(weight * (at - np.sum(weight * at)) ** 2))
    assert spread == pytest.approx(0.5 * radius * abs(1 / distance - 1 / focus), rel=0.05)


def test_what_is_in_focus_is_sharp():
    """In the plane in focus a lens shows what a pinhole shows; the same picture of cloth."""
    scene = scenes.scene([plane(0.1)], [cloth_material()], [GRAY_DOME], [fabric(fibers=3, radius=1.5e-4)])
    tracer = Tracer(scene)
    camera = look((0, 0, 0.2), (0, 0, 0), (0.01, 0.01))
    settings = RenderSettings((48, 48), spp=16, max_depth=1)
    sharp = tracer.render(camera, settings)
    focused = tracer.render(replace(camera, lens_radius=2e-3, focus_distance=0.2), settings)
    blurred = tracer.render(replace(camera, lens_radius=2e-3, focus_distance=0.3), settings)

    def contrast(render):
        return float(np.var(render.alpha))

    assert contrast(focused) > 0.9 * contrast(sharp) > 4 * contrast(blurred)
    assert np.abs(focused.alpha - sharp.alpha).mean() < 0.05
    assert abs(focused.alpha.mean() - blurred.alpha.mean()) < 0.02


def test_lens_and_motion_together():
    """A camera that moves sideways with an open lens: the blur of both, one upon the other."""
    mesh, camera = moving("camera")
    wide = replace(camera, lens_radius=0.1, focus_distance=0.5)
    seen = alpha([mesh], wide)
    # The lens blurs by its radius at twice the distance in focus: a disk of radius 0.1 on the ground.
    fine = np.linspace(-1.2, 1.2, 4801)
    kernel = np.sqrt(np.maximum(0.01 - fine**2, 0.0))
    profile = np.convolve(
        np.interp(fine, [-0.5, -0.1, 0.1, 0.5], [0, 2 / 3, 2 / 3, 0]), kernel / kernel.sum(), mode="same"
    )
    np.testing.assert_allclose(seen, np.interp(position(), fine, profile), atol=0.03)
