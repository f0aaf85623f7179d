"""The fast tracer against the one meant to be read, on a patch of a few fibers."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import dome, fabric, swatch

from usdfab.errors import UsdfabError
from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer, knots, render as render_module
from usdfab.tracer.patch_scene import build_patch_scene
from usdfab.tracer.reference import reference_fibers, render_reference, trace
from usdfab.usd.scene import DistantLight, RectLight, SphereLight

CLOTH = fabric(fibers=4, radius=1.5e-4)
PATCH = generate_patch(CLOTH, vertices_per_segment=8)
LIGHTS = {
    "point": None,  # the rig's own
    "dome": dome(),
    "rect": RectLight(
        "/R", np.array([0.01, -0.02, 0.03]), np.array([0.03, 0, 0]), np.array([0, 0.03, 0.0]), np.array([0, 0, -1.0]),
        np.full(3, 5.0),
    ),
    "parallel, from below": DistantLight("/S", np.array([0.6, 0.0, 0.8]), np.full(3, 3.0), 0.0),
}  # fmt: skip
CASES = [("point", 2, 64), ("point", 12, 192), ("dome", 4, 96), ("rect", 3, 64), ("parallel, from below", 4, 128)]


@pytest.mark.parametrize(("name", "depth", "spp"), CASES)
def test_fast_equals_reference(name, depth, spp, monkeypatch):
    check(name, depth, spp, 12, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "depth", "spp"), CASES)
def test_fast_equals_reference_closely(name, depth, spp, monkeypatch):
    """On the same segments: with all knots of the splines, of which the tracer otherwise leaves some out."""
    monkeypatch.setattr(knots, "BEND", 1e-9)
    check(name, depth, 16 * spp, 24, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("vertices", [8, 40])
def test_knots_that_are_left_out_are_hardly_missed(vertices, monkeypatch):
    """Tangents are then up to 0.01 rad off here and there: 7 % in single pixels of these few fibers, 0.3 % in all."""
    patch = generate_patch(CLOTH, vertices_per_segment=vertices)
    scene, camera = swatch(CLOTH, zoom=0.3)
    settings = RenderSettings((24, 24), spp=16384, max_depth=2)
    renders = []
    for bend in (1e-9, knots.BEND):
        monkeypatch.setattr(knots, "BEND", bend)
        monkeypatch.setattr(render_module, "build_tiles", lambda cloth: [build_patch_scene(cloth, patch)])
        renders.append(Tracer(scene).render(camera, settings))
    exact, usual = renders
    assert usual.patch_segments < exact.patch_segments
    error = np.sqrt((exact.variance + usual.variance).sum()) / exact.pixels.sum()
    assert error < 1e-3
    assert abs(usual.pixels.mean() / exact.pixels.mean() - 1.0) < 5e-3


def check(name, depth, spp, side, monkeypatch):
    monkeypatch.setattr(render_module, "build_tiles", lambda cloth: [build_patch_scene(cloth, PATCH)])
    light = LIGHTS[name]
    scene, camera = swatch(CLOTH, *([light] if light else []), zoom=0.3)
    # The swatch's plane shows the cloth's middle at the world's origin.
    middle = CLOTH.size[0] / 2, CLOTH.size[1] / 2
    fibers = reference_fibers(CLOTH, PATCH)
    slow, slow_variance = render_reference(fibers, camera, scene.lights, (side, side), spp, depth, middle, seed=1)
    fast = Tracer(scene).render(camera, RenderSettings((side, side), spp=16 * spp, max_depth=depth))

    mean_error = np.sqrt((slow_variance + fast.variance).sum(axis=(0, 1))) / side**2
    difference = slow.mean(axis=(0, 1)) - fast.pixels.mean(axis=(0, 1))
    assert slow.mean() > 0.0
    assert np.all(abs(difference) < 3.5 * mean_error), f"means differ by {difference} +- {mean_error}"

    # Blocks of 4 x 4 pixels: Gaussian enough. One that is dark in the reference may have missed rare light.
    def blocks(image):
        return image.reshape(side // 4, 4, side // 4, 4, 3).mean(axis=(1, 3))

    z = (blocks(slow) - blocks(fast.pixels)) / np.sqrt(blocks(slow_variance + fast.variance) / 16)
    assert np.sqrt(np.mean(z**2)) < 1.5 and abs(z).max() < 6.0, f"z scores: rms {np.sqrt(np.mean(z**2))}"


def test_reference_meets_a_fiber_where_it_is():
    fibers = reference_fibers(CLOTH, PATCH)
    k = int(np.argmax(fibers.a[:, 2]))  # the top of the cloth: nothing above it
    middle = fibers.a[k] + 0.5 * fibers.length[k] * fibers.axis[k]
    for shift in (0.0, 7.0):  # the patch repeats
        start = middle + np.array([shift * fibers.size[0], 0.0, 1e-3])
        t, segment, along, copy = trace(fibers, start, np.array([0.0, 0.0, -1.0]))
        assert abs(t - 1e-3 + fibers.radius[k]) < 0.02 * fibers.radius[k]
        np.testing.assert_allclose(
            start[0] - copy[0], middle[0] - np.round((middle[0] - start[0] + copy[0]) / fibers.size[0]) * fibers.size[0]
        )
        assert segment >= 0 and 0.0 <= along <= 1.0
    assert trace(fibers, np.array([0.0, 0, 1e-3]), np.array([0.0, 0, 1.0]))[1] == -1


def test_reference_says_what_it_lacks():
    _, camera = swatch(CLOTH)
    sphere = SphereLight("/Ball", np.ones(3), 0.1, np.ones(3))
    with pytest.raises(UsdfabError, match="/Ball"):
        render_reference(reference_fibers(CLOTH, PATCH), camera, (sphere,), (2, 2), 1, 2)
