"""``usdfab view``: pictures off screen, the window's reactions, and everything that stands in the way."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parent.parent / "neural"))

from neural_examples import lively
from pxr import Usd, UsdGeom, UsdLux

from usdfab.fabric import weave_from_name
from usdfab.imaging import read_image
from usdfab.neural.material_file import Weights, save_material_network
from usdfab.neural.network import KINDS
from usdfab.usd.fabric_io import read_fabric

SMALL = ("--resolution", "24x16", "--spp", 1)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> tuple:
    """Options that name weights which need no training."""
    folder = tmp_path_factory.mktemp("weights")
    options: list = []
    for kind in KINDS:
        save_material_network(Weights(lively("lean", kind), {}), folder / f"{kind}.safetensors")
        options += [f"--{kind}-weights", folder / f"{kind}.safetensors"]
    return tuple(options)


def test_pictures_follow_what_is_set(run, tiny, tmp_path, weights):
    def picture(name: str, *options: object) -> np.ndarray:
        code, out, err = run("view", tiny, "--screenshot", tmp_path / name, *SMALL, *weights, "-q", *options)
        assert (code, out, err) == (0, "", "")
        return read_image(tmp_path / name).pixels

    first = picture("a.exr")
    assert first.shape == (16, 24, 3) and np.isfinite(first).all() and first.max() > 0
    for k, options in enumerate(
        (("--orbit", "40,-20"), ("--zoom", 2), ("--light", "120,30"), ("--set", "both.roughness_primary=.9"),
         ("--set", "both.flattening=2"), ("--weave", "twill 2/1"))
    ):  # fmt: skip
        assert not np.allclose(picture(f"b{k}.exr", *options), first, rtol=1e-3)
    # Less red in the cloth is less red in the picture, and nothing else.
    red = picture("c.exr", "--set", "both.albedo=.1,.5,.5") / picture("d.exr", "--set", "both.albedo=.5,.5,.5")
    assert red[..., 0].mean() < 0.6 and np.allclose(red[..., 1:], 1)


def test_what_was_set_is_printed_as_arguments_of_edit(run, tiny, tmp_path, weights):
    options = ("--weave", "twill 2/2", "--set", "warp.albedo=.1,.2,.5", "--set", "both.flattening=1.5")
    code, out, err = run("view", tiny, "--screenshot", tmp_path / "a.png", *SMALL, *weights, *options, "--json")
    said = json.loads(out)
    assert (code, err) == (0, "") and said["output"] == str(tmp_path / "a.png")
    assert run("edit", tiny, "-o", tmp_path / "edited.usda", *said["edit"], "-q")[0] == 0
    found = read_fabric(tmp_path / "edited.usda")
    assert found.warp.albedo == pytest.approx((0.1, 0.2, 0.5)) and found.weave == weave_from_name("twill 2/2")
    code, _, err = run("view", tiny, "--screenshot", tmp_path / "b.png", *SMALL, *weights, *options)
    assert code == 0 and f"usdfab edit {tiny} --weave 'twill 2/2' --set warp.albedo=.1,.2,.5" in err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--orbit", "40"), "--orbit: '40' is not two numbers"),
        (("--light", "nan,3"), "--light: 'nan,3' is not two angles"),
        (("--zoom", 0), "--zoom: 0.0 is no factor"),
        (("--spp", 0), "--spp: 0 samples are none"),
        (("--set", "warp.colour=1"), "unknown parameter 'warp.colour'"),
        (("--set", "warp.albedo=2,0,0"), "warp.albedo"),
        (("--weave", "moire"), "unknown weave 'moire'"),
        (("--weave", "/".join("1" * k + "0" + "1" * (16 - k) for k in range(17))), "larger than the encoder takes"),
        (("--reflection-weights", "none.safetensors"), "none.safetensors: no such file"),
    ],
)
def test_impossible_wishes_end_in_one_line(run, tiny, tmp_path, weights, options, said):
    code, out, err = run("view", tiny, "--screenshot", tmp_path / "a.png", *SMALL[:2], *weights[2:], *options)
    assert code == 2 and not out and said in err and err.count("\n") == 1
    assert not (tmp_path / "a.png").exists()


def test_stages_that_cannot_be_shown(run, tmp_path, weights):
    stage = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    cube = UsdGeom.Mesh.Define(stage, "/M")
    cube.CreatePointsAttr([(-1, -1, 0), (1, -1, 0), (1, 1, 0)])
    cube.CreateFaceVertexCountsAttr([3])
    cube.CreateFaceVertexIndicesAttr([0, 1, 2])
    stage.Save()
    show = ("--screenshot", tmp_path / "a.png", *SMALL, *weights)
    code, _, err = run("view", tmp_path / "bare.usda", *show)
    assert code == 2 and "the stage has no camera" in err
    UsdGeom.Camera.Define(stage, "/C").AddTranslateOp().Set((0, 0, 3))
    UsdLux.DistantLight.Define(stage, "/L").CreateIntensityAttr(1.0)
    stage.Save()
    code, _, err = run("view", tmp_path / "bare.usda", *show)
    assert code == 2 and "nothing in the stage wears a fabric" in err


def test_no_window_system(run, tiny, monkeypatch):
    pytest.importorskip("pyvista")
    if not sys.platform.startswith("linux"):
        pytest.skip("other systems always have one")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    code, out, err = run("view", tiny)
    assert code == 2 and not out and err.count("\n") == 1
    assert "there is no display to open a window on" in err and "--screenshot" in err


def test_the_window_follows_mouse_and_keys(tiny, tmp_path, monkeypatch):
    """Off screen, with the events that a hand would send."""
    pytest.importorskip("pyvista")
    probe = "from usdfab.view.gl import check_off_screen; check_off_screen(); import pyvista as p; "
    probe += "q = p.Plotter(off_screen=True); q.add_mesh(p.Sphere()); q.screenshot(return_img=True)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=120)
    if done.returncode:
        pytest.skip("VTK cannot draw here: " + done.stderr.strip()[-200:])
    from usdfab.cli.scene_source import SceneSource
    from usdfab.cli.view_session import ViewSession

    monkeypatch.chdir(tmp_path)
    networks = {kind: Weights(lively("lean", kind), {}) for kind in KINDS}
    session = ViewSession(SceneSource(str(tiny)), networks, 2)
    window = session.make_window((240, 160), "seen.png", 1, off_screen=True)
    hand = window.interactor

    def at(x: int, y: int, event: str) -> None:
        hand.SetEventInformation(x, y, 0, 0)
        hand.InvokeEvent(event)

    def press(key: str) -> None:
        hand.SetKeySym(key)
        hand.InvokeEvent("KeyPressEvent")

    first = window.pixels().astype(int)
    assert first.shape == (160, 240, 3) and np.ptp(first) > 30
    eye = session.orbit.to_world[:3, 3].copy()
    at(150, 80, "LeftButtonPressEvent")
    at(190, 80, "MouseMoveEvent")
    at(190, 80, "LeftButtonReleaseEvent")
    assert not np.allclose(session.orbit.to_world, session.first.to_world)
    at(120, 80, "MouseMoveEvent")  # no button is down
    turned = session.orbit
    hand.InvokeEvent("MouseWheelForwardEvent")
    assert np.linalg.norm(session.orbit.to_world[:3, 3] - session.orbit.target) < np.linalg.norm(eye - turned.target)
    at(150, 80, "RightButtonPressEvent")
    at(180, 100, "MouseMoveEvent")
    at(180, 100, "RightButtonReleaseEvent")
    assert session.sun != (30.0, 45.0) and session.orbit.target is not None
    press("w")
    assert session.live.edit_arguments()[0] == "--weave"
    session.live.set({"both.albedo": ".9,.05,.05"})
    window.refresh(full=True)
    after = window.pixels().astype(int)
    assert after[40:120, 120:].mean(axis=(0, 1))[0] > 1.5 * after[40:120, 120:].mean(axis=(0, 1))[2]
    press("r")
    assert np.array_equal(session.orbit.to_world, session.first.to_world)
    press("s")
    press("s")
    assert read_image(tmp_path / "seen.png").pixels.shape == (160, 240, 3) and (tmp_path / "seen-2.png").exists()
    press("h")
    assert np.abs(window.pixels()[:, :50].astype(int) - after[:, :50]).max() > 50  # the sliders are gone
    window.close()


def test_larger_weaves_leave_the_scene_as_it_was(tiny):
    from usdfab.cli.scene_source import SceneSource
    from usdfab.errors import UsdfabError
    from usdfab.neural.live import LiveScene

    networks = {kind: Weights(lively("lean", kind), {}) for kind in KINDS}
    scene, _ = SceneSource(str(tiny)).read()
    live = LiveScene(scene, networks, {})
    before = live.picture(scene.cameras[0], (8, 8)).pixels
    large = "/".join("1" * k + "0" + "1" * (16 - k) for k in range(17))
    with pytest.raises(UsdfabError, match="larger than the encoder takes"):
        live.set({"weave": large})
    assert live.edit_arguments() == [] and np.array_equal(live.picture(scene.cameras[0], (8, 8)).pixels, before)
    live.set({"weave": "twill 2/2"})
    assert not np.array_equal(live.picture(scene.cameras[0], (8, 8)).pixels, before)
