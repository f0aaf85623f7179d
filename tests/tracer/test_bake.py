"""Baked maps against the path tracer on the same fibers, and against what the weave says must be where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import cloth_material, dome, fabric, look, plane, scene

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, weave_from_name
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.bake import BakedMaps, BakeSettings, bake, map_resolution
from usdfab.tracer.patch_scene import tile_copies

CLOTH = replace(fabric("twill 3/1", fibers=10), size=(6e-3, 4e-3))
SIDE = 48


def upper_half() -> np.ndarray:
    """A dome's image: white above the horizon, black below."""
    image = np.zeros((64, 128, 3), np.float32)
    image[:32] = 1.0
    return image


def upright() -> np.ndarray:
    """Turns a dome's pole (+y) to +z."""
    to_world = np.eye(4)
    to_world[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return to_world


@pytest.fixture(scope="module")
def front_and_back() -> list[BakedMaps]:
    settings = BakeSettings((SIDE, 0), tile_copies(CLOTH), rays=64)
    return bake(CLOTH, settings, ("front", "back"))


@pytest.fixture(scope="module")
def traced(front_and_back):
    """One tile seen from so far that rays are parallel, under a white upper half of the sky."""
    size = np.asarray(front_and_back[0].size)
    middle = 0.5 * size
    far = 400.0 * size.max()
    camera = look((*middle, far), (*middle, 0.0), tuple(0.5 * size / far))
    sheet = plane(12 * size.max(), center=(0.0, 0.0))
    sky = dome(texture=upper_half(), to_world=upright())
    world = scene([sheet], [cloth_material()], [sky], [CLOTH])
    rows, columns = front_and_back[0].opacity.shape
    return Tracer(world).render(camera, RenderSettings(resolution=(columns, rows), spp=64, max_depth=512))


def test_every_texel_lies_where_the_path_tracer_sees_it(front_and_back, traced) -> None:
    """Rows from the top, x to the right: place, coverage and normal agree texel by texel."""
    front = front_and_back[0]
    assert np.abs(traced.alpha - front.opacity).mean() < 0.01
    # Within 64 samples' noise of the mean of very different normals.
    covered = front.opacity > 0.99
    agree = (traced.normal * front.normal).sum(axis=-1)[covered]
    assert agree.mean() > 0.98
    depth = 400.0 * max(front.size) - traced.depth
    seen = covered & np.isfinite(depth)
    assert np.corrcoef(depth[seen], front.height[seen])[0, 1] > 0.99


def test_reflectance_is_the_path_tracers(front_and_back, traced) -> None:
    expected = traced.pixels.mean(axis=(0, 1))
    error = np.sqrt(traced.variance.mean(axis=(0, 1)) / traced.pixels[..., 0].size)
    assert front_and_back[0].mean_reflectance == pytest.approx(expected, abs=float(6 * error.max()))


def test_reflectance_of_each_region_is_the_path_tracers(front_and_back, traced) -> None:
    """The filter moves little light from place to place: means of 6 x 6 texels agree, not only that of all."""
    front = front_and_back[0]
    product = front.reflectance * front.opacity[..., None]
    rows = product.shape[0] // 6 * 6

    def blocks(pixels: np.ndarray) -> np.ndarray:
        return pixels[:rows].reshape(rows // 6, 6, SIDE // 6, 6, 3).mean(axis=(1, 3))

    a, b = blocks(product), blocks(traced.pixels)
    assert np.sqrt(((a - b) ** 2).mean()) < 0.1 * b.mean()
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.98


def test_white_fibers_lose_no_light() -> None:
    white = replace(CLOTH, warp=replace(CLOTH.warp, albedo=(1.0,) * 3), weft=replace(CLOTH.weft, albedo=(1.0,) * 3))
    [maps] = bake(white, BakeSettings((24, 0), rays=64))
    total = maps.mean_reflectance + np.asarray(maps.transmittance)
    assert total == pytest.approx(np.ones(3), abs=0.02)


def test_maps_know_the_weave(front_and_back) -> None:
    """At the middle of each crossing the fibers of the yarn on top run its way."""
    front = front_and_back[0]
    weave = CLOTH.weave.tiled(*(c for c in reversed(tile_copies(CLOTH))))
    rows, columns = front.opacity.shape
    for pick in range(weave.picks):
        for end in range(weave.ends):
            row = int((1.0 - (pick + 0.5) / weave.picks) * rows)
            column = int((end + 0.5) / weave.ends * columns)
            doubled = front.orientation[row - 1 : row + 1, column - 1 : column + 1, 0].mean()
            assert doubled > 0.5 if weave.matrix[pick, end] else doubled < -0.5, (pick, end)


def test_normals_lean_down_the_slopes() -> None:
    """+x along u, +y along v (up in the picture): the slope of the yarns' height is the normals'."""
    smooth = replace(CLOTH, warp=replace(CLOTH.warp, fiber_count=60), weft=replace(CLOTH.weft, fiber_count=60))
    [maps] = bake(smooth, BakeSettings((SIDE, 0), rays=32))
    right = 0.5 * (np.roll(maps.height, -1, 1) - np.roll(maps.height, 1, 1)) / maps.texel[0]
    up = 0.5 * (np.roll(maps.height, 1, 0) - np.roll(maps.height, -1, 0)) / maps.texel[1]
    solid = maps.opacity > 0.999
    for slope, component in ((right, 0), (up, 1)):
        steep = solid & (np.abs(slope) < 2.0)
        assert np.corrcoef(-slope[steep], maps.normal[..., component][steep])[0, 1] > 0.25  # chance is within 0.03 of 0


def test_there_is_no_seam(front_and_back) -> None:
    """Across the border texels differ as they do elsewhere."""
    for maps in front_and_back:
        for layer in (maps.reflectance[..., 1], maps.height, maps.ao, maps.orientation[..., 0], maps.opacity):
            for axis in (0, 1):
                step = np.abs(layer - np.roll(layer, 1, axis))
                border = step.take(0, axis).mean()
                others = step.mean(axis=1 - axis)
                # No farther out than the steepest of the inner lines.
                assert border <= 1.1 * np.delete(others, 0).max(), (maps.side, axis)


def test_both_sides_show_the_same_cloth(front_and_back) -> None:
    front, back = front_and_back
    assert np.abs(front.opacity - back.opacity).mean() < 0.02
    both = (front.opacity > 0.99) & (back.opacity > 0.99)
    assert (front.height + back.height)[both].min() > 0.0, "the face lies above the back"
    assert (back.normal[..., 2] > 0).all() and (front.normal[..., 2] > 0).all()
    # A 3/1 twill shows the other yarns on its back.
    assert front.orientation[..., 0].mean() < back.orientation[..., 0].mean() - 0.2


def test_maps_are_finite_and_in_range(front_and_back) -> None:
    for maps in front_and_back:
        for name in ("reflectance", "roughness", "opacity", "ao"):
            layer = getattr(maps, name)
            assert layer.dtype == np.float32 and layer.min() >= 0.0 and layer.max() <= 1.0 + 1e-6, name
        assert np.linalg.norm(maps.normal, axis=-1) == pytest.approx(1.0, abs=1e-5)
        assert np.linalg.norm(maps.orientation, axis=-1).max() <= 1.0 + 1e-5
        low, high = -3e-3, 3e-3
        assert low < maps.height.min() < maps.height.max() < high
        assert 0 < maps.thickness < 2e-3


def test_threads_and_bands_change_nothing() -> None:
    settings = BakeSettings((20, 34), rays=4, threads=1)
    [one] = bake(CLOTH, settings)
    [two] = bake(CLOTH, replace(settings, threads=2))
    for name in ("reflectance", "normal", "height", "ao", "roughness"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    [other] = bake(CLOTH, replace(settings, seed=1))
    assert not np.array_equal(one.height, other.height)


def test_gaps_are_seen_through() -> None:
    thin = replace(CLOTH.warp, radius=8e-5)
    loose = replace(CLOTH, warp=thin, weft=thin, weave=weave_from_name("plain"))
    [maps] = bake(loose, BakeSettings((32, 0), rays=32))
    assert 0.1 < maps.opacity.mean() < 0.7
    assert np.all(np.asarray(maps.transmittance) > 1.0 - maps.opacity.mean())
    # What lies in a gap is filled from around it, so that filtering bleeds no black.
    assert maps.reflectance[maps.opacity == 0].min() > 0.0


@pytest.mark.parametrize(("asked", "expected"), [((100, 0), (100, 50)), ((64, 64), (64, 64)), ((8, 0), (8, 4))])
def test_texels_are_square_unless_asked_otherwise(asked, expected) -> None:
    assert map_resolution(asked, (2e-3, 1e-3)) == expected


@pytest.mark.parametrize("settings", [BakeSettings((2, 2)), BakeSettings((9000, 9000)), BakeSettings(repeats=(0, 1))])
def test_impossible_sizes_are_refused(settings: BakeSettings) -> None:
    with pytest.raises(UsdfabError):
        bake(CLOTH, settings)


def test_too_many_repeats_are_refused() -> None:
    with pytest.raises(UsdfabError, match="segments"):
        bake(FabricParameters(), BakeSettings((64, 64), repeats=(400, 400)))
