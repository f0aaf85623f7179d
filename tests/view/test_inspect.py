"""Fibers as tubes and as pictures."""

import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pyvista")

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fibers.patch import generate_patch
from usdfab.view import fiber_scene, inspect as inspect_module, render, screenshot, show
from usdfab.view.inspect import _connectivity, _lines

SMALL = (200, 150)


@pytest.fixture(scope="module")
def patch():
    yarn = YarnParameters(count=10, fiber_count=12, albedo=(0.7, 0.2, 0.1))
    return generate_patch(FabricParameters(warp=yarn, weft=YarnParameters(count=10, fiber_count=12)), 6)


@pytest.fixture(scope="module")
def opengl():
    """Skips where VTK cannot draw, and says why."""
    probe = "from usdfab.view.gl import check_off_screen; check_off_screen(); import pyvista as p; "
    probe += "q = p.Plotter(off_screen=True); q.add_mesh(p.Sphere()); q.screenshot(return_img=True)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=120)
    if "VTK finds no OpenGL" in done.stderr:
        pytest.skip(done.stderr.strip().splitlines()[-1])
    assert done.returncode == 0, done.stderr  # anything else is a fault of ours, not of the machine


def test_tubes_have_the_fibers_radius_and_place(patch):
    tubes = fiber_scene(patch)
    low, high = patch.z_range
    assert tubes.bounds[4] == pytest.approx(low, abs=0.3 * patch.warp.radius)
    assert tubes.bounds[5] == pytest.approx(high, abs=0.3 * patch.warp.radius)
    assert tubes.bounds[0] == pytest.approx(patch.weft.extended(0, 1)[0][:, 0].min(), abs=5 * patch.warp.radius)
    assert np.isfinite(tubes.points).all() and "TubeNormals" in tubes.point_data


def test_tiles_enlarge_the_bounds_by_the_patch(patch):
    one, many = fiber_scene(patch), fiber_scene(patch, tiles=(3, 2))
    grown = np.subtract(many.bounds, one.bounds)
    expected = [0, 2 * patch.size[0], 0, patch.size[1], 0, 0]
    np.testing.assert_allclose(grown, expected, atol=1e-6 * patch.size[0])
    assert many.n_points == 6 * one.n_points


def test_tiles_meet(patch):
    """The vertex added at a curve's end is where the next tile's curve begins."""
    for system in patch.systems:
        points, offsets = _lines(system, 1)
        following = system.points[system.offsets[:-1]][system.successor] + system.period
        np.testing.assert_allclose(points[offsets[1:] - 1], following, atol=1e-15)


def test_colour_modes_differ(patch):
    scenes = {mode: fiber_scene(patch, mode) for mode in ("yarn", "fiber", "albedo", "height")}
    colors = {mode: len(np.unique(scenes[mode]["color"], axis=0)) for mode in ("yarn", "fiber", "albedo")}
    assert colors["albedo"] == 2
    assert 2 < colors["yarn"] <= len(np.unique(patch.warp.yarn)) + len(np.unique(patch.weft.yarn))
    assert colors["fiber"] > colors["yarn"]
    height = scenes["height"]["height"]
    assert height.min() < 0 < height.max() and 1e6 * patch.z_range[1] == pytest.approx(height.max(), rel=0.2)


def test_albedo_is_shown_as_srgb(patch):
    assert [218, 124, 89] in np.unique(fiber_scene(patch, "albedo")["color"], axis=0).tolist()


def test_connectivity():
    np.testing.assert_array_equal(_connectivity(np.array([3, 2])), [3, 0, 1, 2, 2, 3, 4])


def test_big_scenes_lose_vertices_and_say_so(patch, monkeypatch, caplog):
    whole = fiber_scene(patch)
    count = sum(len(system.points) for system in patch.systems)
    monkeypatch.setattr(inspect_module, "MAX_VERTICES", count // 2)
    thinned = fiber_scene(patch)
    assert "every 3. of them" in caplog.text or "every 2. of them" in caplog.text
    assert thinned.n_points < 0.75 * whole.n_points
    np.testing.assert_allclose(thinned.bounds, whole.bounds, atol=6 * patch.warp.radius)
    with pytest.raises(UsdfabError, match="too many to show; show fewer tiles"):
        fiber_scene(patch, tiles=(9, 9))


def test_flyaways_are_shown_in_the_colours_of_their_yarns(patch):
    yarn = YarnParameters(count=10, fiber_count=12, albedo=(0.7, 0.2, 0.1), flyaway_density=2e4, flyaway_spread=0.9)
    hairy = generate_patch(FabricParameters(warp=yarn, weft=YarnParameters(count=10, fiber_count=12)), 6)
    (flyaways,) = hairy.flyaways
    points, offsets = _lines(flyaways, 1)
    np.testing.assert_array_equal(points, flyaways.points)
    np.testing.assert_array_equal(offsets, flyaways.offsets)
    for mode in ("yarn", "albedo"):
        bare, tubes = fiber_scene(patch, mode), fiber_scene(hairy, mode)
        assert tubes.n_points > bare.n_points
        np.testing.assert_array_equal(np.unique(tubes["color"], axis=0), np.unique(bare["color"], axis=0))
    assert tubes.bounds[5] == pytest.approx(hairy.z_range[1], abs=0.3 * yarn.radius)
    assert tubes.bounds[5] > 1.2 * bare.bounds[5]


def test_thinning_keeps_both_ends(patch):
    whole, offsets = _lines(patch.warp, 1)
    thin, thin_offsets = _lines(patch.warp, 4)
    np.testing.assert_array_equal(thin[thin_offsets[:-1]], whole[offsets[:-1]])
    np.testing.assert_array_equal(thin[thin_offsets[1:] - 1], whole[offsets[1:] - 1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [({"color": "pink"}, "colour mode"), ({"tiles": (0, 2)}, "tile counts"), ({"sides": 2}, "sides")],
)
def test_refusals(patch, arguments, words):
    with pytest.raises(UsdfabError, match=words):
        fiber_scene(patch, **arguments)


def test_render_refusals(patch, opengl):
    with pytest.raises(UsdfabError, match="resolution"):
        render(patch, resolution=(5, 5))
    with pytest.raises(UsdfabError, match="background"):
        render(patch, background="pink", resolution=SMALL)


def test_pictures(patch, opengl, capfd):
    pictures = {}
    for mode in ("yarn", "fiber", "height", "albedo"):
        picture = render(patch, color=mode, tiles=(1, 1), resolution=SMALL)
        assert picture.shape == (150, 200, 3) and picture.dtype == np.uint8
        cloth = (picture < 250).any(axis=-1)
        assert 0.15 < cloth.mean() < 0.9
        assert (picture[0, 0] == 255).all()
        # Centred: as much white on the left as on the right, above as below.
        across, down = np.flatnonzero(cloth.any(axis=0)), np.flatnonzero(cloth.any(axis=1))
        if mode != "height":
            assert abs(across[0] - (199 - across[-1])) < 20 and abs(down[0] - (149 - down[-1])) < 20
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500
        pictures[mode] = picture
    for a, b in (("yarn", "fiber"), ("fiber", "height"), ("height", "albedo")):
        assert np.abs(pictures[a].astype(int) - pictures[b]).mean() > 3
    dark = render(patch, tiles=(1, 1), resolution=SMALL, background="dark")
    assert dark[0, 0].max() < 40
    assert capfd.readouterr().err == ""


def test_screenshot_file(patch, opengl, tmp_path):
    from usdfab.imaging import read_image

    path = screenshot(tmp_path / "a.png", patch, tiles=(2, 1), resolution=SMALL)
    assert read_image(path).pixels.shape == (150, 200, 3)
    with pytest.raises(UsdfabError, match="exists"):
        screenshot(path, patch, tiles=(1, 1), resolution=SMALL)
    assert list(tmp_path.iterdir()) == [path]


def test_turntable_turns_until_the_mouse_takes_over(patch, opengl):
    plotter = inspect_module._plotter(patch, "yarn", (1, 1), "white", off_screen=True, window_size=list(SMALL))
    places = [np.array(plotter.camera.position)]
    inspect_module._turntable(plotter)
    plotter.iren.initialize()
    for event in ("TimerEvent", "StartInteractionEvent", "TimerEvent"):
        plotter.iren.interactor.InvokeEvent(event)
        places.append(np.array(plotter.camera.position))
    plotter.close()
    assert np.linalg.norm(places[1] - places[0]) > 0
    assert places[1][2] == pytest.approx(places[0][2])
    np.testing.assert_array_equal(places[3], places[1])


@pytest.mark.skipif(sys.platform != "linux", reason="displays are a matter of X11 and Wayland")
def test_no_display_is_told(patch, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(UsdfabError, match=r"no display .* --screenshot"):
        show(patch)


@pytest.mark.skipif(sys.platform != "linux", reason="VTK's choice of windows is Linux's")
def test_no_opengl_is_told_and_does_not_crash():
    from usdfab.view.gl import _has_osmesa

    if _has_osmesa():
        pytest.skip("OSMesa is there, so VTK can draw")
    script = "from usdfab.view.gl import check_off_screen; check_off_screen()"
    environment = {"VTK_DEFAULT_OPENGL_WINDOW": "vtkOSOpenGLRenderWindow", "PATH": "/usr/bin"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 1 and "finds no OpenGL" in done.stderr


def test_missing_pyvista_is_told(patch, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(UsdfabError, match=r"pip install 'usdfab\[view\]'"):
        fiber_scene(patch)


def test_import_is_light():
    script = "import sys, usdfab.view; sys.exit('pyvista' in sys.modules or 'vtkmodules' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == 0
