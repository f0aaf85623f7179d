"""UsdPreviewSurface through the whole tracer: emission, opacity, normal maps, textures, both sides."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from PIL import Image
from scenes import cloth_material, dome, fabric, lambert, look, plane

from usdfab.scattering.surface_numba import pack_surface, prepare_surface, sample_surface
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import DistantLight, Texture

ABOVE = look((0, 0, 1), (0, 0, 0), (0.1, 0.1))
SUN = DistantLight("/Sun", np.array([0.0, 0, -1]), np.full(3, math.pi), 0.0)


def texture(path, pixels, channels="rgb", linear=True, wrap="clamp", scale=(1.0,) * 4, bias=(0.0,) * 4, transform=None):
    """A PNG of (H, W), (H, W, 3) or (H, W, 4) values in [0, 1], and the Texture that reads it."""
    Image.fromarray(np.round(255 * np.asarray(pixels)).astype(np.uint8)).save(path)
    matrix = np.array([[1.0, 0, 0], [0, 1, 0]]) if transform is None else np.asarray(transform, dtype=float)
    return Texture(str(path), channels, (wrap, wrap), linear, np.array(scale), np.array(bias), matrix)


def unit_plane(material=0, z=0.0, side=0.2):
    """A square whose uv go from 0 to 1, v up."""
    mesh = plane(side, material, z)
    return replace(mesh, uv=mesh.uv / side + 0.5)


def render(meshes, materials, lights, camera=ABOVE, fabrics=(), **settings):
    values = {"resolution": (16, 16), "spp": 64, "max_depth": 4} | settings
    tracer = Tracer(scenes.scene(meshes, materials, lights, fabrics), strict=True)
    return tracer.render(camera, RenderSettings(**values))


def mean_and_error(picture):
    return picture.pixels.mean(axis=(0, 1), dtype=float), np.sqrt(
        picture.variance.sum(axis=(0, 1))
    ) / picture.alpha.size


def test_an_emissive_square_lights_the_ground():
    """No light but a glowing square: what it sends to a point below its middle, after the form factor."""
    glow = replace(lambert((0, 0, 0)), emissive=np.array([3.0, 2.0, 1.0]))
    lamp, ground = plane(1.0, 0, z=0.5), plane(4.0, 1)
    camera = look((0, 1.0, 0.3), (0, 0, 0), (1e-4, 1e-4))
    mean, error = mean_and_error(render([lamp, ground], [glow, lambert()], [], camera, spp=600, max_depth=2))
    half = 0.5 / 0.5
    side = math.hypot(1, half)
    factor = 4 * (half / side * math.atan(half / side)) * 2 / (2 * math.pi)
    expected = 0.5 * factor * np.array([3.0, 2.0, 1.0])
    assert np.all(error < 0.01 * expected) and np.all(abs(mean - expected) < 4 * error)
    seen = render([lamp], [glow], [], look((0, 0, 1.5), (0, 0, 0.5), (0.1, 0.1)), spp=1)
    np.testing.assert_allclose(seen.pixels, np.broadcast_to([3.0, 2.0, 1.0], seen.pixels.shape))
    np.testing.assert_allclose(seen.direct, seen.pixels)


def test_an_emissive_texture_is_light_enough(tmp_path):
    pixels = np.zeros((2, 2, 3))
    pixels[0, 0] = 1.0
    image = texture(tmp_path / "e.png", np.kron(pixels, np.ones((16, 16, 1))), scale=(4.0,) * 4)
    glow = replace(lambert((0, 0, 0)), textures={"emissiveColor": image})
    seen = render([unit_plane()], [glow], [], spp=1)
    np.testing.assert_allclose(seen.pixels[2, 2], 4.0)  # the top row of the file is up, the first column left
    assert not seen.pixels[10:].any() and not seen.pixels[:, 10:].any()


@pytest.mark.parametrize("panes", [1, 3])
def test_half_transparent_panes(panes):
    """Light through panes of opacity a on white ground: (1 - a)^n for the shadow, the same again for the eye."""
    pane = replace(lambert((0, 0, 0)), opacity=0.4)
    meshes = [plane(2.0, 0, z=0.1 * (k + 1)) for k in range(panes)] + [plane(4.0, 1)]
    under = look((0, 0, 0.05), (0, 0, 0), (0.1, 0.1))
    shadow = render(meshes, [pane, lambert((1, 1, 1))], [SUN], under, spp=4)
    np.testing.assert_allclose(shadow.pixels, 0.6**panes, rtol=1e-6)
    mean, error = mean_and_error(render(meshes, [pane, lambert((1, 1, 1))], [SUN], ABOVE, spp=256))
    assert error.max() < 0.01 and np.all(abs(mean - 0.6 ** (2 * panes)) < 4 * error)


def test_a_cut_out_is_a_hole(tmp_path):
    """An opacity texture with a threshold: the shadow and the picture of a checker board, exactly."""
    board = np.array([[1.0, 0.2], [0.3, 0.9]])
    leaf = replace(
        lambert((0, 0, 0)),
        opacity_threshold=0.5,
        textures={"opacity": texture(tmp_path / "o.png", np.kron(board, np.ones((32, 32))), "r")},
    )
    ground = plane(4.0, 1)
    under = look((0, 0, 0.05), (0, 0, 0), (2.0, 2.0))
    seen = render([unit_plane(0, 0.1), ground], [leaf, lambert((1, 1, 1))], [SUN], under, spp=16)
    opaque = np.kron(board > 0.5, np.ones((8, 8)))
    inner = np.ones((16, 16), dtype=bool)
    inner[[7, 8]] = inner[:, [7, 8]] = False
    np.testing.assert_allclose(seen.pixels[..., 0][inner], 1.0 - opaque[inner], atol=1e-6)
    straight = render([unit_plane(0, 0.0, 0.2)], [leaf], [dome()], spp=4, max_depth=1)
    np.testing.assert_allclose(straight.alpha[inner], opaque[inner])
    soft = replace(leaf, opacity_threshold=0.0)
    seen = render([unit_plane(0, 0.1), ground], [soft, lambert((1, 1, 1))], [SUN], under, spp=4)
    expected = 1.0 - np.kron(board, np.ones((8, 8)))
    np.testing.assert_allclose(seen.pixels[..., 0][inner], expected[inner], atol=2.5e-3)


def test_cloth_behind_and_before_a_pane():
    """Fabric seen through a pane, and lit through it: factors 1 - a for each passage, many bounces left out."""
    clear, grey = (replace(lambert((0, 0, 0)), opacity=a) for a in (0.0, 0.5))
    eye = look((0, 0, 0.3), (0, 0, 0), (0.02, 0.02))
    pictures = [
        render([plane(0.2, 1), plane(0.5, 0, z=0.1)], [pane, cloth_material()], [SUN], eye, [fabric()], max_depth=2)
        for pane in (clear, grey)
    ]
    (full, _), (through, error) = (mean_and_error(p) for p in pictures)
    assert np.all(abs(through - 0.25 * full) < 4 * error + 1e-3 * full)
    np.testing.assert_allclose(pictures[0].alpha, render([plane(0.2)], [cloth_material()], [SUN], eye, [fabric()],
                                                         max_depth=2).alpha, atol=0.1)  # fmt: skip


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("uv", [np.eye(2), np.array([[0.0, 1], [-1, 0]]), np.array([[-1.0, 0], [0, 1]])])
def test_a_normal_map_tilts_the_shading(tmp_path, uv, below):
    """x of the map goes along dp/du, y along dp/dv; the sheet seen from behind is the same sheet."""
    tilt = np.array([0.48, 0.36, 0.8])
    pixels = np.broadcast_to(0.5 + 0.5 * tilt, (4, 4, 3))
    bumpy = replace(
        lambert((1, 1, 1)),
        textures={"normal": texture(tmp_path / "n.png", pixels, scale=(2.0,) * 4, bias=(-1.0,) * 4)},
    )
    mesh = unit_plane()
    mesh = replace(mesh, uv=(mesh.uv - 0.5) @ uv.T + 0.5)
    # uv = uv @ position: dp/du and dp/dv are the columns of the inverse.
    frame = np.linalg.inv(uv)
    expected = np.r_[frame @ tilt[:2], tilt[2]] * (-1.0 if below else 1.0)
    light = np.array([0.36, 0.0, 0.93295 if below else -0.93295])
    sun = DistantLight("/Sun", light / np.linalg.norm(light), np.full(3, math.pi), 0.0)
    camera = look((0, 0, -1.0 if below else 1.0), (0, 0, 0), (0.05, 0.05))
    seen = render([mesh], [bumpy], [sun], camera, spp=4, max_depth=2)
    np.testing.assert_allclose(seen.normal.reshape(-1, 3), np.broadcast_to(expected, (256, 3)), atol=0.01)
    np.testing.assert_allclose(seen.pixels, -(sun.direction @ expected), atol=0.01)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("degrees", [10, 70])
def test_rough_surfaces_keep_the_energy_of_their_lobes(roughness, metallic, degrees):
    """A plane in a dome, light and lobe sampling weighted, against the mean weight of lobe sampling alone."""
    angle = math.radians(degrees)
    packed = pack_surface((0.8, 0.8, 0.8), roughness, metallic, None, 0.0, 0.01, 1.5)
    prepared = prepare_surface(tuple(packed), math.cos(angle))
    u = np.random.default_rng(2).random((20_000, 3))
    weight = np.array([sample_surface(prepared, math.sin(angle), 0.0, math.cos(angle), *x)[3:7] for x in u])
    # Directions below the horizon have no density.
    weight = np.where(weight[:, 3] > 0.0, weight[:, 0], 0.0)
    material = replace(lambert((0.8, 0.8, 0.8)), roughness=roughness, metallic=metallic, ior=1.5)
    eye = look((0, math.sin(angle), math.cos(angle)), (0, 0, 0), (1e-4, 1e-4))
    mean, error = mean_and_error(render([plane(4.0)], [material], [dome()], eye, spp=128))
    tolerance = 4 * math.hypot(error[0], weight.std() / math.sqrt(len(u))) + 1e-3
    assert tolerance < 0.03 and abs(mean[0] - weight.mean()) < tolerance


def test_textures_lie_where_uv_says(tmp_path):
    """Four colours in the corners: v goes up, sRGB is made linear, a transform moves them."""
    quarters = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [188, 188, 188]]]) / 255.0
    picture = np.kron(quarters, np.ones((16, 16, 1)))

    def corners(**changes):
        look_up = texture(tmp_path / "c.png", picture, linear=False, **changes)
        seen = render([unit_plane()], [replace(lambert(), textures={"diffuseColor": look_up})], [dome()], spp=1)
        return seen.albedo[[4, 4, 11, 11], [4, 11, 4, 11]]

    red, green, blue, grey = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5029,) * 3
    np.testing.assert_allclose(corners(), [red, green, blue, grey], atol=2e-3)
    half = [[1.0, 0, 0.5], [0, 1, 0]]
    np.testing.assert_allclose(corners(transform=half, wrap="repeat"), [green, red, grey, blue], atol=2e-3)


def test_both_sides_are_lit():
    for z, sun in ((1.0, SUN), (-1.0, replace(SUN, direction=np.array([0.0, 0, 1])))):
        seen = render([plane(0.4)], [lambert()], [sun], look((0, 0, z), (0, 0, 0), (0.1, 0.1)), spp=1)
        np.testing.assert_allclose(seen.pixels, 0.5, rtol=1e-5)
        np.testing.assert_allclose(seen.normal, np.broadcast_to([0, 0, z], seen.normal.shape), atol=1e-6)
        other = render([plane(0.4)], [lambert()], [replace(sun, direction=-sun.direction)],
                       look((0, 0, z), (0, 0, 0), (0.1, 0.1)), spp=1)  # fmt: skip
        assert not other.pixels.any()


@pytest.mark.parametrize("offset", [0.0, 100.0, 3000.0])
def test_far_from_the_origin(offset):
    """Single precision where coordinates are large: a surface does not shadow itself."""
    mesh = scenes.strip(0.5)
    move = offset * np.array([0.7, -0.5, 0.4])
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    mesh = replace(mesh, points=10 * mesh.points @ turn.T + move, normals=mesh.normals @ turn.T)
    up = turn @ [0, 0, 1]
    sun = replace(SUN, direction=-up)
    top = move + 5.0 * up
    # Depth 2 about the crest, where the sun stands in the zenith.
    seen = render([mesh], [lambert((1, 1, 1))], [sun], look(top + 5 * up, top, (0.02, 0.02)), spp=4, max_depth=2)
    np.testing.assert_allclose(seen.pixels, 1.0, rtol=0.01)
