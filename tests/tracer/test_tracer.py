"""The tracer against what is known without it: furnaces, radiometry, geometry, symmetry, repeatability."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, lambert, look, plane, swatch

from usdfab.errors import UsdfabError
from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.film import CHANNELS
from usdfab.tracer.kernel import render_tile
from usdfab.tracer.patch_scene import tile_copies
from usdfab.tracer.reference import reference_fibers, trace
from usdfab.tracer.render import pack_view
from usdfab.usd.scene import DistantLight, PointLight, RectLight, SphereLight

UP_POLE = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Turns the dome's pole, +y, to the world's +z."""


def mean_and_error(render, mask=None):
    """Mean of the picture (3,) and its standard error."""
    mask = np.ones(render.pixels.shape[:2], dtype=bool) if mask is None else mask
    count = mask.sum()
    return render.pixels[mask].mean(axis=0, dtype=float), np.sqrt(render.variance[mask].sum(axis=0)) / count


# --- furnaces --------------------------------------------------------------------------------------------------------


def check_furnace(scene, camera, spp, tolerance=5e-3):
    render = Tracer(scene).render(camera, RenderSettings((32, 32), spp=spp, max_depth=2000))
    mask = render.alpha > 0.5  # what the cloth covers
    assert mask.mean() > 0.5
    mean, error = mean_and_error(render, mask)
    assert error.max() < tolerance / 2, f"too noisy to tell: {error}"
    assert np.all(abs(mean - 1.0) < 3.0 * error), f"{mean} +- {error}"
    assert np.all(abs(mean - 1.0) < tolerance), f"{mean} +- {error}"


@pytest.mark.parametrize("weave", ["plain", pytest.param("satin 5/2", marks=pytest.mark.slow)])
def test_furnace_on_flat_cloth(weave):
    scene, camera = swatch(fabric(weave, albedo=(1, 1, 1)), dome())
    check_furnace(scene, camera, 160)


@pytest.mark.parametrize("shape", ["strip", pytest.param("sphere", marks=pytest.mark.slow)])
def test_furnace_on_curved_cloth(shape):
    if shape == "strip":
        mesh = scenes.strip()
    else:

        def point(a, b):
            around, polar = 2 * math.pi * a, math.pi * (0.98 * b + 0.01)
            ring = np.sin(polar)
            return 0.02 * np.stack([ring * np.cos(around), ring * np.sin(around), -np.cos(polar)], axis=-1)

        mesh = scenes.sheet(point, lambda a, b: np.stack([0.12 * a, 0.06 * b], axis=-1), 32, 16)
    scene = scenes.scene([mesh], [cloth_material()], [dome()], [fabric(albedo=(1, 1, 1))])
    check_furnace(scene, look((0.01, -0.05, 0.1), (0, 0, 0.01), (0.1, 0.1)), 192 if shape == "strip" else 1000)


# --- radiometry on a diffuse plane -----------------------------------------------------------------------------------

AIM = look((0.0, 0.15, 0.4), (0.0, 0.0, 0.0), (1e-4, 1e-4))
"""Sees a point-like spot about the origin."""


def rect_form_factor(a, b):
    """Irradiance over pi L below the corner of a rectangle whose sides are a and b times its distance away."""
    x, y = math.sqrt(1 + a * a), math.sqrt(1 + b * b)
    return (a / x * math.atan(b / x) + b / y * math.atan(a / y)) / (2 * math.pi)


def rect(center, u, v, radiance=2.0):
    """A rectangle or parallelogram light that shines along -z."""
    center, u, v = (np.asarray(x, dtype=float) for x in (center, u, v))
    return RectLight("/Rect", center - u / 2 - v / 2, u, v, np.array([0.0, 0.0, -1.0]), np.full(3, radiance))


def over(irradiance):
    """(pixel value of the gray plane at an irradiance)"""
    return 0.5 * irradiance / math.pi


TILT = np.array([0.6, 0.0, -0.8])
POSITION = np.array([0.6, 0.2, 0.9])
R2 = float(POSITION @ POSITION)
LIGHTS = {
    "point": (PointLight("/P", POSITION, np.full(3, 3.0)), 3.0 * 0.9 / R2**1.5),
    "sphere": (SphereLight("/S", POSITION, 0.4, np.full(3, 2.0)), 2.0 * math.pi * 0.16 / R2 * 0.9 / R2**0.5),
    "parallel": (DistantLight("/D", TILT, np.full(3, 3.0), 0.0), 3.0 * 0.8),
    "distant": (DistantLight("/D", TILT, np.full(3, 3.0), 0.3), 3.0 * 0.8),
    "rect": (rect((0, 0, 0.5), (1.0, 0, 0), (0, 0.6, 0)), 2.0 * math.pi * 4 * rect_form_factor(1.0, 0.6)),
    "dome": (dome(0.7), 0.7 * math.pi),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_known_radiance(name):
    """Depth 2: next-event estimation and BSDF sampling, weighted, must add up to the analytic value."""
    light, irradiance = LIGHTS[name]
    tracer = Tracer(scenes.scene([plane(4.0)], [lambert()], [light]))
    render = tracer.render(AIM, RenderSettings((16, 16), spp=256, max_depth=2))
    mean, error = mean_and_error(render)
    assert error.max() < 5e-3 * mean.max()
    assert np.all(abs(mean - over(irradiance)) < 4 * error + 2e-4 * mean), f"{mean} +- {error}, not {over(irradiance)}"


def test_many_lights_add_up():
    lights = [light for light, _ in LIGHTS.values() if not isinstance(light, (RectLight, SphereLight))]
    expected = over(sum(e for light, e in LIGHTS.values() if not isinstance(light, (RectLight, SphereLight))))
    tracer = Tracer(scenes.scene([plane(4.0)], [lambert()], lights))
    mean, error = mean_and_error(tracer.render(AIM, RenderSettings((16, 16), spp=256, max_depth=2)))
    assert np.all(abs(mean - expected) < 4 * error + 2e-4 * mean)


def test_slanted_parallelogram():
    """A sheared rectangle light, against a quadrature over its area."""
    light = rect((0.1, 0, 0.5), (1.0, 0.2, 0), (0.6, 0.6, 0))
    a, b = np.meshgrid(*2 * [(np.arange(400) + 0.5) / 400])
    place = light.corner + a[..., None] * light.edge_u + b[..., None] * light.edge_v
    area = np.linalg.norm(np.cross(light.edge_u, light.edge_v))
    expected = over(2.0 * area * np.mean(place[..., 2] ** 2 / np.sum(place**2, axis=-1) ** 2))
    tracer = Tracer(scenes.scene([plane(4.0)], [lambert()], [light]))
    mean, error = mean_and_error(tracer.render(AIM, RenderSettings((16, 16), spp=512, max_depth=2)))
    assert np.all(abs(mean - expected) < 4 * error + 2e-4 * mean), f"{mean} +- {error}, not {expected}"


@pytest.mark.parametrize("radiance", [0.0, 2.0])
def test_area_lights_cover_the_dome(radiance):
    """What lies behind a light is not seen past it, by shadow rays no more than by others."""
    light = rect((0, 0, 0.5), (1.0, 0, 0), (0, 0.6, 0), radiance)
    covered = 4 * rect_form_factor(1.0, 0.6)
    expected = over(math.pi * (1.0 - covered + radiance * covered))
    tracer = Tracer(scenes.scene([plane(4.0)], [lambert()], [light, dome()]))
    mean, error = mean_and_error(tracer.render(AIM, RenderSettings((16, 16), spp=512, max_depth=2)))
    assert np.all(abs(mean - expected) < 4 * error + 2e-4 * mean), f"{mean} +- {error}, not {expected}"


def test_textured_dome():
    """A dome with a bright spot and a turned frame, against the sum over its texels."""
    rng = np.random.default_rng(1)
    texture = rng.uniform(0.1, 1.0, (16, 32, 3)).astype(np.float32)
    texture[3, 20] = 200.0
    turn = math.radians(40)
    about_z = np.eye(4)
    about_z[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    tip = math.radians(25)
    about_x = np.eye(4)
    about_x[1:3, 1:3] = [[math.cos(tip), -math.sin(tip)], [math.sin(tip), math.cos(tip)]]
    to_world = about_x @ about_z @ UP_POLE

    fine = 24  # each texel in fine x fine pieces
    v, u = ((np.arange(n * fine) + 0.5) / (n * fine) for n in texture.shape[:2])
    polar, around = np.pi * v[:, None], 2 * np.pi * (0.5 - u[None, :])
    # Middle of the image towards +z, left quarter towards +x, top towards +y of the dome's frame.
    own = np.stack([np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around, np.sin(polar) * np.cos(around)])
    height = np.einsum("x,xij->ij", to_world[2, :3], own)
    solid = np.sin(polar) * (np.pi / len(v)) * (2 * np.pi / len(u))
    value = texture.repeat(fine, 0).repeat(fine, 1).astype(float)
    irradiance = np.einsum("ij,ijc->c", np.maximum(height, 0.0) * solid, value)

    light = dome(1.5, texture, to_world)
    tracer = Tracer(scenes.scene([plane(4.0)], [lambert()], [light]))
    mean, error = mean_and_error(tracer.render(AIM, RenderSettings((16, 16), spp=1024, max_depth=2)))
    expected = 1.5 * 0.5 * irradiance / math.pi
    assert error.max() < 0.01 * expected.max()
    assert np.all(abs(mean - expected) < 4 * error + 1e-3 * expected), f"{mean} +- {error}, not {expected}"


def test_dome_texture_is_the_right_way_round():
    """Seen by the camera: left quarter of the image towards +x of the dome, top towards its pole."""
    texture = np.zeros((4, 8, 3), dtype=np.float32)
    texture[1, 2] = (1, 0, 0)  # just above the horizon, just beyond the left quarter
    tracer = Tracer(scenes.scene([plane(1e-3, z=-5.0)], [lambert()], [dome(1.0, texture)]))
    middle = math.pi * 1.5 / 4, 2 * math.pi * (0.5 - 2.5 / 8)
    towards = np.array([math.sin(middle[0]) * math.sin(middle[1]), math.cos(middle[0]),
                        math.sin(middle[0]) * math.cos(middle[1])])  # fmt: skip
    seen = tracer.render(look((0, 0, 0), towards, (1e-3, 1e-3)), RenderSettings((2, 2), spp=1))
    np.testing.assert_allclose(seen.pixels, np.broadcast_to([1.0, 0, 0], (2, 2, 3)))
    beside = tracer.render(look((0, 0, 0), towards * [-1, 1, 1], (1e-3, 1e-3)), RenderSettings((2, 2), spp=1))
    assert not beside.pixels.any()


# --- repeatability and error -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sample():
    scene, camera = swatch(fabric())
    return Tracer(scene), camera


def test_threads_do_not_show(sample):
    tracer, camera = sample
    first, *others = (tracer.render(camera, RenderSettings((24, 21), spp=5, threads=n)) for n in (1, 2, 3))
    for other in others:
        for name in ("pixels", "variance", "albedo", "normal", "depth", "alpha", "rays"):
            np.testing.assert_array_equal(getattr(first, name), getattr(other, name), err_msg=name)


def test_passes_do_not_show(sample):
    tracer, camera = sample
    seen: list[tuple[int, int]] = []
    render = tracer.render(camera, RenderSettings((16, 16), spp=11, seed=3), lambda *at: seen.append(at))
    assert len(seen) > 2 and seen[-1][0] == seen[-1][1] and seen == sorted(seen)
    view = pack_view(camera, 16, 16, False)
    film, squares = np.zeros((16, 16, CHANNELS)), np.zeros((16, 16, 3))
    render_tile(tracer.world, view, np.uint64(3), (0, 0, 16, 16), 0, 11, 64, film, squares, None)
    np.testing.assert_array_equal(render.pixels, (film[..., :3] / 11).astype(np.float32))


def test_seeds_differ(sample):
    tracer, camera = sample
    a, b = (tracer.render(camera, RenderSettings((16, 16), spp=1, seed=s)).pixels for s in (0, 1))
    assert (a != b).mean() > 0.5


def test_time_limit_ends_after_a_whole_pass(sample):
    tracer, camera = sample
    short = tracer.render(camera, RenderSettings((8, 8), spp=1000, time_limit=0.0))
    assert short.spp == 1
    np.testing.assert_array_equal(short.pixels, tracer.render(camera, RenderSettings((8, 8), spp=1)).pixels)


def test_error_falls_with_the_root_of_the_samples(sample):
    tracer, camera = sample
    counts, errors = (16, 64, 256), []
    for spp in counts:
        a, b = (tracer.render(camera, RenderSettings((24, 24), spp=spp, seed=s)) for s in (10 * spp, 10 * spp + 1))
        squared = np.mean((a.pixels - b.pixels) ** 2, dtype=float) / 2
        stated = np.mean(a.variance + b.variance, dtype=float) / 2
        assert 0.7 < squared / stated < 1.3, "the stated variance is not that of the pixels"
        errors.append(math.sqrt(squared))
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert abs(slope + 0.5) < 0.06, f"error falls as spp^{slope:.3f}"


# --- geometry --------------------------------------------------------------------------------------------------------


def open_fraction(cloth, tilt=0.0, count=90):
    """Fraction of parallel rays that pass the cloth, by tracing a grid of them against every fiber."""
    fibers = reference_fibers(cloth, generate_patch(cloth, copies=tile_copies(cloth)))
    direction = np.array([math.sin(tilt), 0.0, -math.cos(tilt)])
    x, y = ((np.arange(count) + 0.5) / count * side for side in fibers.size)
    free = [trace(fibers, np.array([a, b, 1e-2]), direction)[1] < 0 for a in x for b in y]
    return float(np.mean(free)), 1.0 / count  # the border of the holes decides the error; 1 / count is generous


def test_camera_sees_through_the_gaps():
    cloth = fabric(fibers=3, radius=1.2e-4)
    fraction, error = open_fraction(cloth)
    assert 0.2 < fraction < 0.8
    width = 4 * cloth.cell[0]  # one tile
    scene = scenes.scene([plane(0.1)], [cloth_material()], [dome()], [cloth])
    camera = look((0, 0, 10.0), (0, 0, 0), 2 * (width / 20,))
    render = Tracer(scene).render(camera, RenderSettings((64, 64), spp=16, max_depth=1))
    assert abs(render.pixels.mean() - fraction) < error
    # Depth 1 and seen nothing: alpha is what the cloth covers, or the dome, never half of it.
    assert set(np.unique(render.pixels * 16 % 1)) == {0.0}


@pytest.mark.parametrize("degrees", [0, 40])
def test_light_comes_through_the_gaps(degrees):
    """A diffuse plane under open cloth in parallel light, seen from between them: direct light only."""
    cloth = fabric(fibers=3, radius=1.2e-4)
    tilt = math.radians(degrees)
    fraction, error = open_fraction(cloth, tilt)
    sun = DistantLight("/Sun", np.array([math.sin(tilt), 0, -math.cos(tilt)]), np.full(3, math.pi), 0.0)
    scene = scenes.scene([plane(0.2), plane(0.2, 1, z=-0.05)], [cloth_material(), lambert((1, 1, 1))], [sun], [cloth])
    tile = 4 * cloth.cell[0]
    camera = look((0, 0, -0.01), (0, 0, -0.05), 2 * (2 * tile / 0.04,))  # four by four tiles
    render = Tracer(scene).render(camera, RenderSettings((64, 64), spp=16, max_depth=2))
    assert abs(render.pixels.mean() / math.cos(tilt) - fraction) < error + 0.01


def blocks(image, size=8):
    height, width = image.shape[:2]
    return image.reshape(height // size, size, width // size, size, -1).mean(axis=(1, 3), dtype=float)


def test_mirrored_uv_gives_a_mirrored_picture():
    cloth = fabric(albedo=(0.8, 0.5, 0.3))
    scene, camera = swatch(cloth)
    lamp = scene.lights[0]
    assert isinstance(lamp, PointLight)
    settings = RenderSettings((40, 40), spp=64, max_depth=6)
    straight = Tracer(scene).render(camera, settings)
    mesh = scene.meshes[0]
    assert mesh.uv is not None
    uv = mesh.uv.copy()
    uv[..., 0] = cloth.size[0] - uv[..., 0]
    mirrored = replace(
        scene,
        meshes=(replace(mesh, uv=uv),),
        lights=(PointLight(lamp.path, lamp.position * [-1, 1, 1], lamp.intensity),),
    )
    other = Tracer(mirrored).render(camera, replace(settings, seed=1))
    a, b = blocks(straight.pixels), blocks(other.pixels[:, ::-1])
    z = (a - b) / np.sqrt((blocks(straight.variance) + blocks(other.variance[:, ::-1])) / 64)
    assert np.sqrt(np.mean(z**2)) < 1.5, f"z scores of rms {np.sqrt(np.mean(z**2))}"
    np.testing.assert_allclose(other.normal[:, ::-1][..., 0].mean(), -straight.normal[..., 0].mean(), atol=0.02)


def test_colours_per_yarn():
    cloth = fabric()
    red, blue = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)
    cloth = replace(cloth, warp=replace(cloth.warp, yarn_albedo=(red, blue)), weft=replace(cloth.weft, albedo=red))
    scene, camera = swatch(cloth, zoom=0.8)
    albedo = Tracer(scene).render(camera, RenderSettings((64, 64), spp=4, max_depth=1)).albedo
    colours = albedo.reshape(-1, 3)
    near_red, near_blue = (np.abs(colours - c).max(axis=1) < 0.01 for c in (red, blue))
    assert near_red.mean() > 0.4 and near_blue.mean() > 0.1
    # Blue ends repeat every second cell along x.
    is_blue = np.abs(albedo - blue).max(axis=2).argmin(axis=1)
    spectrum = np.abs(np.fft.rfft((np.abs(albedo - blue).max(axis=2) < 0.01).mean(axis=0)))
    assert spectrum[1:].argmax() + 1 == 4 and is_blue.size == 64  # 0.8 of ten cells: four pairs


def test_two_fabrics_and_a_plain_surface():
    red, blue = fabric(albedo=(0.9, 0.1, 0.1)), fabric("twill 2/2", albedo=(0.1, 0.1, 0.9))
    meshes = [plane(0.1, k, center=(0.1 * (k - 1), 0.0)) for k in range(3)]
    scene = scenes.scene(
        meshes, [cloth_material(0), lambert((0.2, 0.6, 0.2)), cloth_material(1)], [dome()], [red, blue]
    )
    tracer = Tracer(scene)
    render = tracer.render(look((0, 0, 1), (0, 0, 0), (0.15, 0.05)), RenderSettings((48, 0), spp=16))
    assert render.pixels.shape == (16, 48, 3)
    third = [render.pixels[:, 16 * k : 16 * k + 16].mean(axis=(0, 1)) for k in range(3)]
    assert third[0].argmax() == 0 and third[1].argmax() == 1 and third[2].argmax() == 2
    np.testing.assert_allclose(third[1], (0.2, 0.6, 0.2), rtol=0.1)
    np.testing.assert_allclose(render.albedo[8, 24], (0.2, 0.6, 0.2), atol=1e-6)
    np.testing.assert_allclose(render.normal[8, 24], (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(render.depth[8, 24], 1.0, rtol=2e-3)


def test_camera_offset():
    """The film's offset, in half widths: what lay in the middle comes to the left by as much."""
    scene = scenes.scene(
        [plane(1.0, 0, center=(-0.5, 0)), plane(1.0, 1, center=(0.5, 0))],
        [lambert((1, 0, 0)), lambert((0, 1, 0))],
        [dome()],
    )
    camera = look((0, 0, 1), (0, 0, 0), (0.4, 0.4))
    tracer = Tracer(scene)
    for offset in (0.0, 0.5, -0.25):
        albedo = tracer.render(replace(camera, offset=np.array([offset, 0.0])), RenderSettings((80, 8), spp=1)).albedo
        assert abs(albedo[..., 0].mean() - 0.5 * (1 - offset)) < 0.02
    up = replace(camera, tan_half=np.array([1e-6, 0.1]), offset=np.array([0.0, 2.0]))
    depth = tracer.render(up, RenderSettings((1, 1), spp=64, max_depth=1)).depth[0, 0]
    np.testing.assert_allclose(depth, math.hypot(1.0, 0.2), rtol=2e-3)


def test_memory_does_not_depend_on_the_area():
    small, large = (
        Tracer(scenes.scene([plane(side)], [cloth_material()], [dome()], [fabric()])) for side in (1e-3, 10.0)
    )
    assert small.segments == large.segments


def test_one_fabric_on_many_meshes_is_built_once():
    cloth = fabric()
    meshes = [plane(0.1), plane(0.1, 1, z=-0.1)]
    tracer = Tracer(scenes.scene(meshes, [cloth_material(0), cloth_material(1)], [dome()], [cloth, fabric()]))
    assert tracer.segments == Tracer(scenes.scene(meshes[:1], [cloth_material(0)], [dome()], [cloth])).segments


# --- edges -----------------------------------------------------------------------------------------------------------

EXTREMES = {
    "one fiber": {"fibers": 1},
    "very open": {"fibers": 2, "radius": 1e-5},
    "no crimp": {"crimp": 0.0, "irregularity": 0.0},
    "flat yarns": {"flattening": 8.0, "crimp": 0.3},
    "black": {"albedo": (0.0, 0.0, 0.0)},
    "narrow lobes": {"roughness_longitudinal": 0.01, "roughness_azimuthal": 0.01, "roughness_primary": 0.01},
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_fabrics_are_finite(name):
    scene, camera = swatch(fabric(**EXTREMES[name]))
    render = Tracer(scene).render(camera, RenderSettings((24, 24), spp=8))
    for image in ("pixels", "variance", "albedo", "normal", "depth", "alpha"):
        values = getattr(render, image)
        assert np.isfinite(values).all(), image
        assert image == "normal" or values.min() >= 0.0, image


@pytest.mark.parametrize("degrees", [80.0, 89.5])
def test_grazing_camera(degrees):
    angle = math.radians(degrees)
    cloth = fabric(albedo=(1, 1, 1))
    scene = scenes.scene([plane(10.0)], [cloth_material()], [dome()], [cloth])
    camera = look((0, -math.sin(angle), math.cos(angle)), (0, 0, 0), (1e-3, 1e-3), up=(0, 0, 1))
    render = Tracer(scene).render(camera, RenderSettings((16, 16), spp=64, max_depth=2000))
    assert np.isfinite(render.pixels).all()
    mean, error = mean_and_error(render)
    assert np.all(abs(mean - 1.0) < 4 * error + 1e-3), f"{mean} +- {error}"


def test_nothing_to_see_is_said():
    with pytest.raises(UsdfabError, match="no light"):
        Tracer(scenes.scene([plane(1.0)], [lambert()], []))
    with pytest.raises(UsdfabError, match="no visible mesh"):
        Tracer(scenes.scene([], [lambert()], [dome()]))
    texture = np.ones((2, 4, 3), dtype=np.float32)
    with pytest.raises(UsdfabError, match="second dome"):
        Tracer(scenes.scene([plane(1.0)], [lambert()], [dome(1.0, texture), dome(1.0, texture)]))
    with pytest.raises(UsdfabError, match="not loaded"):
        Tracer(scenes.scene([plane(1.0)], [lambert()], [replace(dome(), texture_path="sky.exr")]))
    tracer = Tracer(scenes.scene([plane(1.0)], [lambert()], [dome()]))
    for settings in (RenderSettings(spp=0), RenderSettings(max_depth=0), RenderSettings((10**5, 10**5))):
        with pytest.raises(UsdfabError):
            tracer.render(AIM, settings)
