"""Variants of the tile: other cloth in every tile, no seam between tiles, the same light on average."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import cloth_material, dome, fabric, look, plane

from usdfab.fibers import patch_variants
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.patch_scene import tile_copies
from usdfab.tracer.slab import variant_at
from usdfab.usd.scene import DistantLight

SUN = DistantLight("/Sun", np.array([0.36, 0.48, -0.8]), np.full(3, 2.0), 0.0)


def cloth(variants: int, **changes):
    """Irregular enough for variants to differ."""
    return fabric(variants=variants, **({"irregularity": 0.8, "fibers": 8, "radius": 2.0e-4} | changes))


def tracer_of(variants: int, light=SUN, **changes):
    return Tracer(scenes.scene([plane(1.0)], [cloth_material()], [light], [cloth(variants, **changes)]))


def tile_size():
    return np.array(patch_variants(cloth(1), copies=tile_copies(cloth(1)))[0].size)


def over_tiles(count: int, height: float = 1.0):
    """A camera that sees ``count`` tiles each way, from tile (0, 0) on."""
    middle = np.r_[0.5 * count * tile_size(), 0.0]
    return look(middle + np.array([0, 0, height]), middle, 0.5 * count * tile_size() / height)


def test_tiles_differ_and_do_not_repeat():
    """The same place in neighbouring tiles: alike with one variant, mostly not with four."""
    settings = RenderSettings((160, 160), spp=4, max_depth=1)
    same = []
    for variants in (1, 4):
        depth = tracer_of(variants).render(over_tiles(5), settings).alpha
        tiles = depth.reshape(5, 32, 5, 32).transpose(0, 2, 1, 3).reshape(25, 32, 32)
        same.append(np.mean([np.abs(tiles[i] - tiles[0]).mean() < 0.03 for i in range(1, 25)]))
    assert same[0] == 1.0
    assert 0.05 < same[1] < 0.6


def test_every_variant_is_used_about_equally():
    count = np.bincount([variant_at(3, 4, i, j) - 3 for i in range(-40, 40) for j in range(-40, 40)], minlength=4)
    assert len(count) == 4 and np.all(abs(count / 6400 - 0.25) < 0.02)
    neighbours = np.mean([variant_at(0, 4, i, 0) == variant_at(0, 4, i + 1, 0) for i in range(2000)])
    assert abs(neighbours - 0.25) < 0.05


def test_the_picture_is_the_same_each_time():
    settings = RenderSettings((24, 24), spp=4, max_depth=16)
    a, b = (tracer_of(4).render(over_tiles(3), replace(settings, threads=n)) for n in (1, 2))
    np.testing.assert_array_equal(a.pixels, b.pixels)


@pytest.mark.parametrize("axis", [0, 1])
def test_no_seams(axis):
    """Across a tile's border there stands what stands there in cloth of one variant, which is periodic and smooth."""
    one, four = tracer_of(1), tracer_of(4)
    size = tile_size()
    differing = []
    for start in (0.0, 0.5):
        pairs = []
        for tile in range(5):
            # A strip of two fibers' width across the border between two tiles, along the whole of it.
            middle = np.zeros(3)
            middle[axis], middle[1 - axis] = (tile + 1 + start) * size[axis], 0.5 * size[1 - axis]
            half = np.zeros(2)
            half[axis], half[1 - axis] = 3e-5, 0.5 * size[1 - axis]
            camera = look(middle + np.array([0, 0, 0.1]), middle, half / 0.1)
            resolution = (8, 96) if axis == 0 else (96, 8)
            pairs.append([t.render(camera, RenderSettings(resolution, spp=1, max_depth=1)) for t in (one, four)])
        differing.append(np.mean([a.fiber_id != b.fiber_id for a, b in pairs]))
        if start == 0.0:
            for a, b in pairs:
                covered = (a.alpha == b.alpha) & (a.alpha > 0)
                assert covered.mean() > 0.2
                np.testing.assert_allclose(b.depth[covered], a.depth[covered], atol=2e-6)
    assert differing[0] < 1e-3  # silhouettes, by rounding
    assert differing[1] > 0.1


def test_brightness_and_coverage_stay():
    """On average over fabrics: each is one draw of the same irregular cloth, or four."""
    settings = RenderSettings((40, 40), spp=64, max_depth=32)
    light, cover = [], []
    for seed in range(4):
        pictures = [
            Tracer(
                scenes.scene([plane(1.0)], [cloth_material()], [SUN], [replace(cloth(n, irregularity=0.2), seed=seed)])
            ).render(over_tiles(8), settings)
            for n in (1, 4)
        ]
        light.append(pictures[1].pixels.mean() / pictures[0].pixels.mean() - 1.0)
        cover.append(pictures[1].alpha.mean() - pictures[0].alpha.mean())
    assert abs(np.mean(light)) < 0.02 and np.abs(light).max() < 0.05, light
    assert abs(np.mean(cover)) < 0.01 and np.abs(cover).max() < 0.03, cover


def test_furnace_over_the_borders():
    """White light in, white light out: light that crosses from variant to variant is not lost."""
    render = tracer_of(4, dome(), albedo=(1, 1, 1)).render(
        over_tiles(4, 0.1), RenderSettings((24, 24), spp=200, max_depth=4000)
    )
    mean = render.pixels.mean(axis=(0, 1), dtype=float)
    error = np.sqrt(render.variance.sum(axis=(0, 1))) / render.alpha.size
    assert error.max() < 3e-3 and np.all(abs(mean - 1.0) < 4 * error), f"{mean} +- {error}"


def test_ids_stay_in_range_in_all_variants():
    patch = patch_variants(cloth(4), copies=tile_copies(cloth(4)))[0]
    curves = sum(system.curves for system in patch.curves)
    yarns = int(patch.warp.yarn.max()) + int(patch.weft.yarn.max()) + 2
    seen = tracer_of(4).render(over_tiles(6), RenderSettings((96, 96), spp=1, max_depth=1))
    assert seen.fiber_id.max() <= curves and seen.yarn_id.max() == yarns
    assert set(np.unique(seen.yarn_id)) - {0} == set(range(1, yarns + 1))
