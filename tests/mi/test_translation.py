"""Cameras, lights, meshes and textures in Mitsuba's terms, against formulas and against the tracer."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mitsuba")
sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))

import scenes
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from usdfab.errors import UsdfabError
from usdfab.mi.camera import sensor
from usdfab.mi.fibers import make_cloth
from usdfab.mi.render import MitsubaSettings, passes, render
from usdfab.mi.space import Space
from usdfab.mi.variant import load
from usdfab.mi.visible import MARGIN_CELLS, boxes_around
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import (
    CylinderLight,
    DiskLight,
    DistantLight,
    DomeLight,
    PointLight,
    RectLight,
    SphereLight,
    Texture,
)

SIZE = (40, 20)
WHOLE = (0, 0, *SIZE)
SPACE = Space(250.0, np.array([0.3, -0.2, 0.1]))


@pytest.fixture
def mi():
    return load("scalar")


def camera(**changes):
    return replace(scenes.look((0.5, -0.4, 1.2), (0.1, 0.2, 0.0), (0.3, 0.15), (0.1, 0.2, 0.9)), **changes)


def ray(mi, view, place, aperture=(0.5, 0.5)):
    """Origin in metres and unit direction of the ray through a place of the film, from (0, 0) top left to (1, 1)."""
    loaded = mi.load_dict(view)
    found, _ = loaded.sample_ray(0.0, 0.5, mi.Point2f(*place), mi.Point2f(*aperture))
    return np.array(found.o) / SPACE.scale + SPACE.origin, np.array(found.d)


@pytest.mark.parametrize("lens", [0.0, 0.02])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.25, -0.4)])
@pytest.mark.parametrize("region", [WHOLE, (10, 5, 30, 9)])
def test_rays_are_the_cameras(mi, lens, offset, region):
    own = camera(offset=np.array(offset), lens_radius=lens, focus_distance=0.7)
    view, warnings = sensor(mi, own, SIZE, region, SPACE)
    assert not warnings, "these offsets are whole pixels"
    for place in ((0.5, 0.5), (0.05, 0.9), (1.0, 0.0)):
        x, y = (region[k] + place[k] * (region[k + 2] - region[k]) for k in (0, 1))
        s, t = 2.0 * x / SIZE[0] - 1.0, 1.0 - 2.0 * y / SIZE[1]
        local = np.array([own.tan_half[0] * (s + offset[0]), own.tan_half[1] * (t + offset[1]), -1.0])
        focus = own.to_world[:3, 3] + 0.7 * own.to_world[:3, :3] @ local
        for aperture in ((0.5, 0.5), (0.9, 0.2)):
            origin, direction = ray(mi, view, place, aperture)
            away = (focus - origin) - np.dot(focus - origin, direction) * direction
            assert np.linalg.norm(away) < 2e-5, "the ray goes through the point in focus"
            # Mitsuba's rays start at the near plane, 0.1 mm on.
            assert np.linalg.norm(origin - own.to_world[:3, 3]) < lens + 2e-4


def test_pixels_that_are_not_square_are_refused(mi):
    with pytest.raises(UsdfabError, match=r"--resolution: 40x30 pixels are not square .* write 40x20 or 40"):
        sensor(mi, camera(), (40, 30), (0, 0, 40, 30), SPACE)


def test_what_a_camera_cannot_do_is_told(mi):
    moved = camera().to_world + np.eye(4)[:, [3, 0, 1, 2]] * 0.1
    _, warnings = sensor(mi, camera(to_world_close=moved), SIZE, WHOLE, SPACE)
    assert len(warnings) == 1 and "no motion blur" in warnings[0]
    _, warnings = sensor(
        mi, camera(lens_radius=0.1, focus_distance=1.0, offset=np.array([0.012, 0.0])), SIZE, WHOLE, SPACE
    )
    assert len(warnings) == 1 and "whole pixels" in warnings[0]


RADIANCE = np.array([3.0, 2.0, 1.0])
PICTURE = np.linspace(0.2, 2.0, 8 * 16 * 3).reshape(8, 16, 3)
TURN = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
U, V = np.array([0.3, 0.1, 0.0]), np.array([-0.05, 0.2, 0.1])
AT = np.array([0.2, 0.1, 0.6])
LIGHTS = {
    "point": PointLight("/L", AT, RADIANCE),
    "sphere": SphereLight("/L", AT, 0.1, 10.0 * RADIANCE),
    "parallel": DistantLight("/L", np.array([0.0, -0.6, -0.8]), RADIANCE, 0.0),
    "sun": DistantLight("/L", np.array([0.6, 0.0, -0.8]), RADIANCE, 0.2),
    "rect": RectLight("/L", AT, U, V, -np.cross(U, V) / np.linalg.norm(np.cross(U, V)), 5.0 * RADIANCE),
    "disk": DiskLight("/L", AT, U, V, -np.cross(U, V) / np.linalg.norm(np.cross(U, V)), 5.0 * RADIANCE),
    "cylinder": CylinderLight("/L", AT, 0.3 * U, 0.05, 5.0 * RADIANCE),
    "dome": scenes.dome(0.7),
    "picture": DomeLight("/L", TURN, np.array([1.0, 0.5, 2.0]), texture=PICTURE),
}
CAMERA = scenes.look((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (0.2, 0.2))


def both(scene, view=CAMERA, side=8, spp=256, depth=2, **more):
    """The means of a scene's picture in the tracer and in Mitsuba, and the standard error of their difference."""
    reader = more.get("textures")
    settings = MitsubaSettings((side, side), (0, 0, side, side), spp, depth, device="scalar")
    theirs = render(scene, view, settings, textures=reader)
    ours = Tracer(scene).render(view, RenderSettings((side, side), spp=spp, max_depth=depth))
    error = np.sqrt((ours.variance + theirs.variance).sum(axis=(0, 1))) / side**2
    return ours.pixels.mean(axis=(0, 1), dtype=float), theirs.pixels.mean(axis=(0, 1), dtype=float), error


@pytest.mark.parametrize("kind", LIGHTS)
def test_a_lambert_plane_under_each_light(kind):
    white = scenes.lambert((0.8, 0.6, 0.4))
    ours, theirs, error = both(scenes.scene([scenes.plane(1.0)], [white], [LIGHTS[kind]]))
    assert np.all(error < 0.03 * ours), "too noisy to tell"
    assert np.all(np.abs(ours - theirs) < 4.0 * error + 0.002 * ours), f"{kind}: {ours} {theirs} +- {error}"


def test_domes_add_up_and_two_pictures_are_refused():
    white, sky = scenes.lambert((1.0, 1.0, 1.0)), replace(LIGHTS["picture"], texture_path="")
    lights = [scenes.dome(0.5), scenes.dome(0.25)]
    _, theirs, _ = both(scenes.scene([scenes.plane(1.0)], [white], lights), spp=64)
    np.testing.assert_allclose(theirs, 0.75, rtol=0.03)
    scene = scenes.scene([scenes.plane(1.0)], [white], [sky, sky])
    with pytest.raises(UsdfabError, match="one dome light with a picture; use --backend embree"):
        render(scene, CAMERA, MitsubaSettings((4, 4), (0, 0, 4, 4), 1, device="scalar"))


def test_mirrored_copies_and_emissive_materials():
    glow = replace(scenes.lambert((0.0, 0.0, 0.0)), emissive=np.array([0.5, 1.0, 2.0]))
    mirror = np.column_stack([np.diag([-1.0, 1.0, 1.0]), [0.0, 0.0, 0.1]])
    plain = np.column_stack([0.3 * np.eye(3), [0.0, 0.0, 0.2]])
    mesh = replace(scenes.plane(0.2), placements=np.stack([mirror, plain]))
    ours, theirs, error = both(scenes.scene([mesh], [glow], [scenes.dome(0.1)]), depth=1, spp=64)
    assert np.all(np.abs(ours - theirs) < 4.0 * error + 1e-3), "upper sides shine, also of a mirrored copy"
    # Both copies are seen: 0.2 m at 1.9 m from the camera, of what is 0.76 m wide there, hides the smaller one.
    np.testing.assert_allclose(theirs, 0.1 + (0.2 / 0.76) ** 2 * (glow.emissive - 0.1), rtol=0.05)


def test_a_textured_plane():
    """A colour that grows along u and v, each at its own rate: the picture is that function, pixel by pixel."""
    texture = Texture("file", "rgb", ("repeat", "repeat"), True, np.ones(4), np.zeros(4), np.eye(2, 3))

    def read(_, uv):
        return np.stack([0.5 + 2.0 * uv[:, 0], 0.5 + uv[:, 1], np.full(len(uv), 0.5)], axis=1)

    look = replace(scenes.lambert((0.0, 0.0, 0.0)), textures={"diffuseColor": texture})
    mesh = scenes.plane(0.4)
    scene = scenes.scene([mesh], [look], [scenes.dome(1.0)])
    view = scenes.look((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (0.08, 0.08))
    done = render(scene, view, MitsubaSettings((4, 4), (0, 0, 4, 4), 256, 2, device="scalar"), textures=read)
    place = 0.16 * ((np.arange(4) + 0.5) / 2.0 - 1.0)
    expected = read(None, np.stack(np.meshgrid(place, place[::-1]), axis=-1).reshape(-1, 2)).reshape(4, 4, 3)
    # The blue channel is constant and knows the light's noise.
    np.testing.assert_allclose(done.pixels / done.pixels[..., 2:] * 0.5, expected, atol=1.2e-2)


def test_opacity_and_what_is_left_out():
    half = replace(scenes.lambert((1.0, 1.0, 1.0)), opacity=0.5, specular_color=np.ones(3))
    scene = scenes.scene([scenes.plane(1.0)], [half], [scenes.dome(1.0)])
    done = render(scene, CAMERA, MitsubaSettings((4, 4), (0, 0, 4, 4), 64, 3, device="scalar"))
    np.testing.assert_allclose(done.pixels.mean(), 1.0, rtol=0.02)
    assert done.warnings == ("/Lambert: specularColor is left out",)


def test_a_preview_surface_is_nearly_the_same():
    paint = replace(scenes.lambert((0.5, 0.3, 0.2)), roughness=0.5, ior=1.5)
    ours, theirs, _ = both(scenes.scene([scenes.plane(1.0)], [paint], [LIGHTS["rect"]]), spp=256)
    np.testing.assert_allclose(theirs, ours, rtol=0.1)


def test_without_light_or_mesh():
    settings = MitsubaSettings((4, 4), (0, 0, 4, 4), 1, device="scalar")
    with pytest.raises(UsdfabError, match="no light"):
        render(scenes.scene([scenes.plane(1.0)], [scenes.lambert()], []), CAMERA, settings)
    with pytest.raises(UsdfabError, match="no visible mesh"):
        render(scenes.scene([], [], [scenes.dome()]), CAMERA, settings)


def test_only_the_cloth_in_view_is_made_where_all_is_too_much():
    cloth = scenes.fabric(fibers=4)
    scene, view = scenes.swatch(cloth, zoom=0.2)
    whole = make_cloth(scene, view, None)
    assert not whole.warnings
    part = make_cloth(scene, view, None, budget=whole.points // 4)
    assert part.points < whole.points / 4
    assert part.warnings and "only the cloth in view" in part.warnings[0]
    low, high = part.bounds
    # The camera sees 0.2 of 5 mm, and four yarns of 0.5 mm more on each side; control points end one step beyond.
    reach = 0.5e-3 + MARGIN_CELLS * 0.5e-3
    assert np.all(np.abs(np.r_[low[:2] + reach, high[:2] - reach]) < 0.2e-3)
    with pytest.raises(UsdfabError, match=r"control points, above 1e\+03; use --backend embree"):
        make_cloth(scene, view, None, budget=1000)


def test_passes():
    assert passes(1, 100) == [1] and passes(3, 100) == [1, 1, 1] and passes(10, 100) == [2, 3, 2, 3]
    many = passes(1000, 1_000_000)
    assert sum(many) == 1000 and max(many) <= 2
    assert math.isclose(sum(passes(7, 10**9)), 7)


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(1, 40), st.just(2)), elements=st.floats(-20, 20)), st.floats(0.05, 3.0)
)
def test_boxes_hold_every_place_and_do_not_overlap(places, margin):
    boxes = np.array(boxes_around(places, margin))
    inside = (places[:, None] - margin >= boxes[None, :, :2] - 1e-9) & (
        places[:, None] + margin <= boxes[None, :, 2:] + 1e-9
    )
    assert inside.all(axis=2).any(axis=1).all()
    for k, box in enumerate(boxes):
        others = np.delete(boxes, k, axis=0)
        assert not ((others[:, :2] < box[2:]) & (others[:, 2:] > box[:2])).all(axis=1).any()


def test_groups_far_apart_have_boxes_of_their_own():
    assert len(boxes_around(np.array([[0.0, 0.0], [0.5, 0.2], [9.0, 0.0]]), 1.0)) == 2
    assert boxes_around(np.zeros((0, 2)), 1.0) == []


def test_cloth_out_of_view_is_a_surface():
    cloth = scenes.fabric(fibers=3)
    corners = (np.stack(np.meshgrid(np.arange(12), np.arange(12)), axis=-1).reshape(-1, 2) - 6.0) * 4e-3
    squares = [replace(scenes.plane(4e-3, 0, 0.0, c), uv=scenes.plane(4e-3, 0, 0.0, c).uv) for c in corners]
    points = np.concatenate([s.points for s in squares])
    triangles = np.concatenate([s.triangles + 4 * k for k, s in enumerate(squares)]).astype(np.int32)
    uv = np.concatenate([s.uv for s in squares])
    sheet = replace(squares[0], points=points, triangles=triangles, uv=uv, face_material=np.zeros(len(uv), np.int32))
    view = scenes.look((0.0, 0.0, 0.05), (0.0, 0.0, 0.0), (0.02, 0.02))
    scene = scenes.scene([sheet], [scenes.cloth_material()], [scenes.dome()], [cloth])
    whole = make_cloth(scene, view, None, budget=10**9)
    part = make_cloth(scene, view, None, budget=whole.points // 4)
    assert not whole.rest and len(part.rest) == 1
    reach = 1e-3 + MARGIN_CELLS * 0.5e-3
    middle = uv[part.rest[0].faces]
    assert 200 < len(middle) < len(uv), "most of the sheet"
    assert (np.abs(middle).max(axis=2).max(axis=1) >= reach - 1e-9).all()
    near = (np.abs(uv).max(axis=2) < reach).any(axis=1)
    assert not part.rest[0].faces[near].any(), "no surface among the fibers"
