"""The two-scale integrator against the Embree tracer: the same cloth, fiber by fiber, by two programs.

Pictures are compared pixel by pixel with the noise of both taken into account: z = difference / standard error.
"""

from __future__ import annotations

import itertools
import math
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba_variant
import numpy as np
import pytest

if mitsuba_variant.why_not():
    pytest.skip(mitsuba_variant.why_not(), allow_module_level=True)

sys.path.append(str(Path(__file__).parents[1] / "tracer"))

import scenes
from scipy.stats import poisson

from usdfab.errors import UsdfabError
from usdfab.fibers import patch_variants
from usdfab.fibers.tiles import tile_variants
from usdfab.imaging import write_image
from usdfab.mi.render import MitsubaSettings, _tiled, render
from usdfab.mi.two_scale_tiles import build_tiles, tile_segments
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.texture_reader import TextureReader
from usdfab.usd.scene import PointLight, SphereLight, Texture

LAMP = PointLight("/Lamp", np.array([0.02, 0.01, 0.05]), np.full(3, 0.006))
SAMPLES = Path(__file__).parents[2] / "samples"


def swatch():
    """A fabric of four variants, under the rig."""
    return scenes.swatch(scenes.fabric(fibers=6, variants=4), zoom=0.3)


def fabrics():
    """A twill of four variants, and a plain weave of red warp with smooth fibers that have a cuticle."""
    plain = scenes.fabric(fibers=6)
    red = replace(plain.warp, albedo=(0.8, 0.2, 0.1), roughness_longitudinal=0.4, cuticle_tilt=0.05)
    return [scenes.fabric("twill 2/2", fibers=6, variants=4), replace(plain, warp=red)]


def two_on_a_sheet():
    """Two fabrics on the faces of one bent sheet, its uv sheared and mirrored, over a table: a lamp, a sky, a bulb."""

    def point(a, b):
        x, y = 12e-3 * (a - 0.5), 12e-3 * (b - 0.5)
        return np.stack([x, 0.012 * np.sin(y / 0.012), 0.012 * (np.cos(y / 0.012) - 1.0)], axis=-1)

    def uv(a, b):
        return np.stack([-12e-3 * a + 2e-3 * b + 0.4, 12e-3 * b - 0.3], axis=-1)

    sheet = scenes.sheet(point, uv, 4, 24)
    sheet = replace(sheet, face_material=(sheet.uv[:, :, 0].mean(axis=1) > 0.394).astype(np.int32))
    table = scenes.plane(0.04, 2, -0.004)
    bulb = SphereLight("/Bulb", np.array([-0.01, 0.0, 0.012]), 0.002, np.array([4.0, 6.0, 8.0]))
    materials = [scenes.cloth_material(0), scenes.cloth_material(1), scenes.lambert((0.4, 0.5, 0.6))]
    scene = scenes.scene([sheet, table], materials, [LAMP, bulb, scenes.dome(0.3)], fabrics())
    return scene, scenes.look((0.004, -0.012, 0.03), (0.0, 0.0, 0.0), (0.16, 0.16))


def bound_drape(folder, preset="denim"):
    """The sample's draped cloth with a preset put on it by ``usdfab bind``, and its pictures."""
    from usdfab.cli.main import _run
    from usdfab.cli.scene_source import SceneSource, read_textures

    fabric, bound = folder / "fabric.usda", folder / "bound.usda"
    assert _run(["new", preset, "-o", str(fabric)]) == 0
    assert _run(["bind", str(SAMPLES / "drape.usda"), str(fabric), "-o", str(bound)]) == 0
    scene, _ = SceneSource(str(bound)).read()
    scene, pictures = read_textures(scene)
    assert not pictures
    return scene, scene.cameras[0]


def pictures(scene, view, size, spp, depth=64):
    """(ours, theirs): (pixels, variance) of the tracer and of the two-scale integrator."""
    settings = MitsubaSettings(size, (0, 0, *size), spp, depth, device="llvm", fibers="tiled")
    theirs = render(scene, view, settings, textures=TextureReader())
    assert theirs.tiled and not theirs.warnings
    ours = Tracer(scene).render(view, RenderSettings(size, spp=2 * spp, max_depth=depth))
    return [(np.asarray(r.pixels, dtype=float), np.asarray(r.variance, dtype=float)) for r in (ours, theirs)]


def agree(ours, theirs, largest_error):
    """Whether two pictures are of the same thing: their means within 1 % and their noise, and pixel by pixel.

    Returns the z scores of pixels, one for each (their three colours have the same noise).
    """
    (a, va), (b, vb) = ours, theirs
    variance = va + vb
    mean = b.mean(axis=(0, 1))
    error = np.sqrt(variance.sum(axis=(0, 1))) / a[..., 0].size / mean
    ratio = a.mean(axis=(0, 1)) / mean
    assert error.max() < largest_error, f"too noisy to tell: {error}"
    assert np.all(np.abs(ratio - 1.0) < np.minimum(4.0 * error, 0.01 + 2.0 * error)), f"{ratio} +- {error}"
    # Colours have about the same noise, correlated: its deviation is at most the mean of theirs.
    noise = np.sqrt(variance).mean(axis=-1)
    seen = noise > 1e-3 * b.mean(axis=-1)  # the sky behind the cloth has none
    z = (a - b).mean(axis=-1)[seen] / noise[seen]
    rms, count = math.sqrt(float(np.mean(z**2))), z.size
    assert 0.7 < rms < 1.0 + 4.0 / math.sqrt(2 * count), f"z scores of {count} pixels have rms {rms}"
    beyond = int((np.abs(z) > 3.0).sum())
    # 0.27 % of a normal distribution; so many or more by chance once in ten thousand times.
    assert beyond <= poisson.isf(1e-4, 0.0027 * count), f"{beyond} of {count} pixels differ by 3 sigma or more"
    return z


@pytest.mark.parametrize(("make", "spp"), [(swatch, 384), (two_on_a_sheet, 256)])
def test_agrees_with_the_tracer(make, spp):
    agree(*pictures(*make(), (16, 16), spp), 0.012)


def test_agrees_on_the_drape(tmp_path):
    scene, view = bound_drape(tmp_path)
    agree(*pictures(scene, view, (20, 15), 192), 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("make", [swatch, two_on_a_sheet])
def test_agrees_closely_with_the_tracer(make):
    ours, theirs = pictures(*make(), (32, 32), 2048)
    agree(ours, theirs, 0.0025)
    with pytest.raises(AssertionError):
        agree((1.02 * ours[0], ours[1]), theirs, 0.0025)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["denim", "satin"])
def test_agrees_closely_on_the_drape(tmp_path, preset):
    scene, view = bound_drape(tmp_path, preset)
    agree(*pictures(scene, view, (64, 48), 1024), 0.004)


def test_direct_light_alone_and_single_pixels():
    """Depth 2 has little noise: a mistake of one percent in geometry or density shows in every pixel."""
    z = agree(*pictures(*swatch(), (12, 12), 2048, depth=2), 0.004)
    assert abs(z.mean()) < 4.0 / math.sqrt(z.size)


def test_colours_of_the_mesh_and_copies_that_are_mirrored_and_larger():
    cloth = scenes.fabric(fibers=6)
    square = scenes.plane(4e-3)
    corner = 0.2 + 0.8 * (square.points[square.triangles] / 4e-3 + 0.5)
    plain = np.column_stack([np.eye(3), [-2.5e-3, 0.0, 0.0]])
    mirrored = np.column_stack([np.diag([-1.3, 1.0, 1.0]), [2.8e-3, 0.0, 5e-4]])
    mesh = replace(square, albedo=corner, placements=np.stack([plain, mirrored]))
    scene = scenes.scene([mesh], [scenes.cloth_material()], [LAMP, scenes.dome(0.3)], [cloth])
    agree(*pictures(scene, scenes.look((0, 0, 0.04), (0, 0, 0), (0.15, 0.1)), (18, 12), 384), 0.015)


def test_an_albedo_map(tmp_path):
    """A picture that colours the fibers, looked up with coordinates of its own."""
    colors = np.linspace(0.1, 1.0, 4 * 5 * 3).reshape(4, 5, 3).astype(np.float32)
    file = write_image(tmp_path / "map.exr", colors, half=False)
    turned = np.array([[0.0, 180.0, 0.1], [210.0, 0.0, 0.3]])
    texture = Texture(str(file), "rgb", ("repeat", "mirror"), True, np.full(4, 0.9), np.full(4, 0.05), turned)
    scene = scenes.scene([scenes.plane(8e-3)], [scenes.cloth_material()], [LAMP], [scenes.fabric(fibers=6)])
    scene = replace(scene, fabrics=(replace(scene.fabrics[0], albedo_map=texture),))
    agree(*pictures(scene, scenes.look((0, 0, 0.04), (0, 0, 0), (0.08, 0.08)), (12, 12), 512), 0.015)


def test_a_transparent_surface_over_cloth():
    glass = replace(scenes.lambert((0.9, 0.5, 0.2)), opacity=0.4)
    sheet, cover = scenes.plane(8e-3), scenes.plane(4e-3, 1, 2e-3)
    materials = [scenes.cloth_material(), glass]
    scene = scenes.scene([sheet, cover], materials, [LAMP, scenes.dome(0.5)], [scenes.fabric(fibers=6)])
    agree(*pictures(scene, scenes.look((0, 0, 0.04), (0, 0, 0), (0.09, 0.09)), (12, 12), 512), 0.015)


# --- Pieces ---


@pytest.fixture
def slab():
    from usdfab.mi.variant import load

    load("llvm")
    from usdfab.mi import two_scale_slab

    return two_scale_slab


def test_the_same_variant_stands_everywhere(slab):
    import mitsuba as mi

    i, j = (a.ravel() for a in np.meshgrid(np.r_[-3:4, 2**31 - 1, -(2**31)], np.r_[-70000, -2:3, 123456]))
    key = mi.UInt64(mi.UInt32(mi.Int32(i))) | (mi.UInt64(mi.UInt32(mi.Int32(j))) << 32)
    np.testing.assert_array_equal(np.array(slab.mix(slab.mix(key)) % 5), tile_variants(i, j, 5))


def test_tilts_of_several_materials_in_one_program():
    import mitsuba as mi

    from usdfab.scattering.fiber_drjit import eval_fiber, pack_fiber, prepare_fiber

    wo, (sin_ti, cos_ti, alpha) = (0.5, -0.3, math.sqrt(0.66)), (0.28, 0.96, mi.Float(0.7))

    def value(tilt):
        packed = pack_fiber(mi.Color3f(0.7, 0.4, 0.2), *(mi.Float(x) for x in (0.4, 0.3, 0.2, 1.55)), tilt)
        prepared = prepare_fiber(packed, *(mi.Float(x) for x in wo))
        color, pdf = eval_fiber(packed, prepared, mi.Float(sin_ti), mi.Float(cos_ti), alpha)
        return np.r_[np.array(color), np.array(pdf)[None]]

    tilts = (0.0, 0.05, -0.1)
    together = value(mi.Float(tilts))
    np.testing.assert_allclose(together, np.concatenate([value(t) for t in tilts], axis=1), rtol=1e-4)
    assert np.ptp(together[3]) > 0.02 * together[3].mean()


def halfway(control, starts):
    """The middles of segments of cubic B-splines."""
    a, b, c, d = (control[starts + k] for k in range(4))
    return (a + 23.0 * (b + c) + d) / 48.0


def test_a_tile_holds_all_that_overlaps_its_cell():
    """Points of the infinite cloth's curves that lie in the cell lie on the tile's segments, each on one."""
    patch = patch_variants(scenes.fabric(fibers=3))[0]
    for system in patch.curves:
        control, segments, curve = tile_segments(system, patch.size)
        assert segments.max() + 3 < len(control) and curve.max() < system.curves
        middle = (
            control[segments] + 23.0 * (control[segments + 1] + control[segments + 2]) + control[segments + 3]
        ) / 48.0
        inside = np.all((middle[:, :2] >= 0.0) & (middle[:, :2] < patch.size), axis=1)
        points, offsets = system.extended(1, 2)
        every = halfway(points, np.concatenate([np.arange(a, b - 3) for a, b in itertools.pairwise(offsets)]))
        wrapped = np.c_[np.mod(every[:, :2], patch.size), every[:, 2]]
        order = [a[np.lexsort(np.round(a, 10).T)] for a in (middle[inside], wrapped)]
        np.testing.assert_allclose(*order, atol=1e-9)


def test_tiles_stand_apart():
    tiles = build_tiles([scenes.fabric(fibers=3, variants=3), scenes.fabric("twill 2/2", fibers=3)])
    assert [(t.first, t.variants) for t in tiles.fabrics] == [(0, 3), (3, 1)]
    sizes = np.array([tiles.fabrics[k].size for k in (0, 0, 0, 1)])
    for k, (low, size) in enumerate(zip(tiles.offsets, sizes, strict=True)):
        for other in range(k):
            apart = (tiles.offsets[other] >= low + size) | (tiles.offsets[other] + sizes[other] <= low)
            assert apart.any()
    own = np.array([m.albedo for m in tiles.materials])[tiles.material]
    np.testing.assert_allclose(own, np.broadcast_to((0.7, 0.4, 0.2), own.shape))


def test_memory_does_not_grow_with_the_cloth():
    cloth = scenes.fabric(fibers=6)
    view = scenes.look((0, 0, 0.04), (0, 0, 0), (0.1, 0.1))
    points = []
    for side in (5e-3, 5.0):
        scene = scenes.scene([scenes.plane(side)], [scenes.cloth_material()], [LAMP], [cloth])
        points.append(render(scene, view, MitsubaSettings((4, 4), (0, 0, 4, 4), 4, 3, device="llvm")).points)
    assert points[0] == points[1] < 50_000


def test_flattened_and_tiled_are_the_same_picture():
    scene, view = swatch()
    settings = [
        MitsubaSettings((12, 12), (0, 0, 12, 12), 512, 3, device="llvm", fibers=fibers)
        for fibers in ("tiled", "flattened")
    ]
    tiled, flattened = (render(scene, view, s) for s in settings)
    assert tiled.tiled and not flattened.tiled and flattened.points > tiled.points
    variance = (tiled.variance + flattened.variance).sum(axis=(0, 1), dtype=float)
    means = [r.pixels.mean(axis=(0, 1), dtype=float) for r in (tiled, flattened)]
    assert np.all(np.abs(means[0] - means[1]) < 4.0 * np.sqrt(variance) / 144)


def test_the_same_seed_gives_the_same_picture():
    scene, view = swatch()
    settings = MitsubaSettings((8, 8), (0, 0, 8, 8), 16, device="llvm")
    first, second, other = (render(scene, view, replace(settings, seed=seed)).pixels for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_what_is_refused():
    scene, view = swatch()
    settings = MitsubaSettings((4, 4), (0, 0, 4, 4), 1, device="scalar", fibers="tiled")
    with pytest.raises(UsdfabError, match=r"--fibers tiled: tiled fibers need Dr.Jit.* use --device llvm"):
        render(scene, view, settings)
    assert not _tiled("auto", "cuda") and not _tiled("auto", "scalar") and _tiled("auto", "llvm")
    with pytest.raises(
        UsdfabError, match=r"--fibers tiled: .* two scenes .* OptiX; use --device llvm, or --fibers flat"
    ):
        _tiled("tiled", "cuda")
    with pytest.raises(UsdfabError, match="--fibers: there is no 'woven'; choose auto, tiled, flattened"):
        render(scene, view, replace(settings, fibers="woven"))
    with pytest.raises(UsdfabError, match="no light"):
        render(replace(scene, lights=()), view, replace(settings, device="llvm"))
