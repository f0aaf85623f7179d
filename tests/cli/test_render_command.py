"""``usdfab render`` and ``usdfab merge``: one picture in many ways, layers by name, one line for every mistake."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Usd, UsdGeom, UsdLux

from usdfab.imaging import linear_to_srgb, read_image, read_layers, view_transform
from usdfab.tracer.aovs import AOVS

SHORT = ("--resolution", "40x36", "--max-depth", "4", "-q")
SMALL = (*SHORT, "--spp", "3")


@pytest.fixture(scope="module")
def whole(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from usdfab.cli.main import _run

    path = tmp_path_factory.mktemp("whole") / "whole.exr"
    assert _run(["render", str(tiny), "-o", str(path), *SMALL, "--aov"]) == 0
    return path


def test_all_layers_have_their_standard_names(whole: Path) -> None:
    spec = oiio.ImageInput.open(str(whole)).spec()
    colors = {f"{name}.{c}" for name in ("albedo", "direct", "indirect", "variance") for c in "RGB"}
    others = {"normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "Z", "fiber_id", "yarn_id", "samples"}
    assert set(spec.channelnames) == {"R", "G", "B", "A"} | colors | others
    layers = read_layers(whole)
    assert set(layers) == {""} | set(AOVS.values())
    np.testing.assert_allclose(layers["direct"] + layers["indirect"], layers[""], atol=2e-3 * layers[""].max())
    assert set(np.unique(layers["samples"])) == {3.0}
    assert np.array_equal(layers["fiber_id"], np.round(layers["fiber_id"]))
    length = np.linalg.norm(layers["normal"], axis=-1)
    assert np.all((abs(length - 1) < 1e-3) | (length == 0))


def test_chosen_layers_only(run, tiny: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.exr"
    assert run("render", tiny, "-o", out, *SMALL, "--aov", "depth,alpha", "normal")[0] == 0
    layers = read_layers(out)
    assert set(layers) == {"", "Z", "A", "normal"}
    for name, values in layers.items():
        np.testing.assert_array_equal(values, read_layers(whole)[name])


def test_a_region_is_a_window_of_the_whole(run, tiny: Path, whole: Path, tmp_path: Path) -> None:
    for text in ("10,9,30,36", "25%,25%,75%,100%"):
        out = tmp_path / f"{text[:2]}.exr"
        assert run("render", tiny, "-o", out, *SMALL, "--aov", "--region", text)[0] == 0
        spec = oiio.ImageInput.open(str(out)).spec()
        assert (spec.x, spec.y, spec.full_width, spec.full_height) == (10, 9, 40, 36)
        for name, values in read_layers(out).items():
            np.testing.assert_array_equal(values, read_layers(whole)[name][9:36, 10:30], err_msg=name)
    png = tmp_path / "a.png"
    assert run("render", tiny, "-o", png, *SMALL, "--region", "10,9,30,36")[0] == 0
    assert read_image(png).pixels.shape == (27, 20, 3)


def test_parts_merge_into_the_whole(run, tiny: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.exr"
    for i in (1, 2, 3):
        code, text, _ = run("render", tiny, "-o", out, *SMALL, "--tile", f"{i}/3", "--json")
        assert code == 0
        facts = json.loads(text)
        assert facts["tile"] == f"{i}/3" and facts["spp"] == 3 and facts["output"].endswith(f"{i}of3.part")
    parts = sorted(tmp_path.iterdir())
    code, text, err = run("merge", *parts[:2], "-o", out)
    assert code == 2 and "tiles 3/3 of the picture are missing" in err and not out.exists()
    code, text, _ = run("merge", *reversed(parts), "-o", out, "--aov", "--json")
    assert code == 0
    assert json.loads(text)["width"] == 40
    for name, values in read_layers(out).items():
        np.testing.assert_array_equal(values, read_layers(whole)[name], err_msg=name)
    assert run("merge", "-o", tmp_path / "b.exr")[0] == 2
    assert run("merge", tiny, "-o", tmp_path / "b.exr")[2].startswith(f"usdfab: {tiny}: this is no unfinished render")


def test_interrupted_and_resumed_is_undisturbed(run, tiny, whole, tmp_path, monkeypatch) -> None:
    from usdfab.tracer import Tracer

    out, calls, sample = tmp_path / "a.exr", [], Tracer.sample

    def interrupted(*arguments):
        calls.append(None)
        if len(calls) == 14:
            raise KeyboardInterrupt
        return sample(*arguments)

    monkeypatch.setattr(Tracer, "sample", interrupted)
    command = (
        "render",
        tiny,
        "-o",
        out,
        "--resolution",
        "40x36",
        "--max-depth",
        4,
        "--spp",
        3,
        "--aov",
        "--threads",
        1,
    )
    code, _, err = run(*command)
    assert code == 130 and "a.exr.partial; --resume goes on" in err
    monkeypatch.setattr(Tracer, "sample", sample)
    code, _, err = run(*command)
    assert code == 2 and "--resume" in err and err.count("\n") == 1
    code, _, err = run(*command, "--resume", "--seed", "3")
    assert code == 2 and "differs in: seed" in err
    code, text, _ = run(*command, "--resume", "--json")
    assert code == 0 and json.loads(text)["spp_min"] == 3
    assert list(tmp_path.iterdir()) == [out]
    for name, values in read_layers(out).items():
        np.testing.assert_array_equal(values, read_layers(whole)[name], err_msg=name)
    code, text, _ = run(*command, "--resume", "--json")
    assert code == 0 and json.loads(text)["skipped"] is True


def test_frames(run, tiny: Path, tmp_path: Path) -> None:
    command = ("render", tiny, "-o", tmp_path / "a.##.png", *SMALL, "--frames", "1-5x2", "--json")
    code, text, _ = run(*command)
    facts = json.loads(text)
    names = ["a.01.png", "a.03.png", "a.05.png"]
    assert code == 0 and [Path(p).name for p in facts["outputs"]] == names
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    assert run(*command)[0] == 2
    (tmp_path / "a.03.png").unlink()
    kept = (tmp_path / "a.01.png").stat().st_mtime_ns
    code, text, _ = run(*command, "--resume")
    assert [bool(frame.get("skipped")) for frame in json.loads(text)["frames"]] == [True, False, True]
    assert (tmp_path / "a.01.png").stat().st_mtime_ns == kept


def test_frames_show_their_time(run, tiny: Path, tmp_path: Path) -> None:
    stage = tmp_path / "moving.usda"
    made = Usd.Stage.CreateNew(str(stage))
    UsdGeom.SetStageMetersPerUnit(made, 1.0)
    UsdGeom.SetStageUpAxis(made, UsdGeom.Tokens.z)
    UsdGeom.Camera.Define(made, "/C").AddTranslateOp().Set((0, 0, 1))
    intensity = UsdLux.DistantLight.Define(made, "/L").CreateIntensityAttr()
    intensity.Set(1.0, 1)
    intensity.Set(3.0, 2)
    mesh = UsdGeom.Mesh.Define(made, "/M")
    mesh.CreatePointsAttr([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    made.Save()
    code, _, err = run("render", stage, "-o", tmp_path / "a.exr", "--frames", "1-2", *SMALL)
    assert code == 0, err
    first, second = (read_image(tmp_path / f"a.000{k}.exr").pixels.mean() for k in (1, 2))
    assert second == pytest.approx(3 * first, rel=0.01)
    assert first > 0


def test_json_tells_what_was_reached(run, tiny: Path, tmp_path: Path) -> None:
    command = ("render", tiny, "-o", tmp_path / "a.png", *SHORT, "--json")
    facts = json.loads(run(*command, "--spp", "64", "--noise", "5")[1])
    assert facts["spp"] == facts["spp_min"] == facts["spp_max"] == 16 and 0 < facts["noise"] < 5
    assert facts["rays"] > 0 and facts["seconds"] > 0 and facts["warnings"] == []
    assert facts["outputs"] == [facts["output"]] and facts["full_size"] == [40, 36] and facts["schema"] == "usdfab/1"
    limited = json.loads(run(*command, "--overwrite", "--spp", "100000000", "--time", "0.2")[1])
    assert 1 <= limited["spp"] < 10**6


def test_exposure_and_view_change_the_png_only(run, tiny: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    assert run("render", tiny, "-o", out, *SMALL, "--exposure", "1.5", "--view", "reinhard")[0] == 0
    expected = linear_to_srgb(view_transform(read_image(whole).pixels, 1.5, "reinhard"))
    np.testing.assert_allclose(linear_to_srgb(read_image(out).pixels), expected, atol=0.004)
    code, _, err = run("render", tiny, "-o", tmp_path / "b.exr", *SMALL, "--exposure", "1")
    assert code == 2 and "scene-linear" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--region", "0,0,99,99"], "--region"),
        (["--region", "a"], "--region"),
        (["--frames", "9-x"], "--frames"),
        (["--frames", "all"], "--frames"),
        (["--frames", "1-2", "--time-code", "3"], "--time-code"),
        (["--frames", "1-2", "--checkpoint", "x"], "--checkpoint"),
        (["--aov", "depth"], "--aov"),
        (["--noise", "-1"], "--noise"),
        (["--time", "-1"], "--time"),
        (["--tile", "3/2"], "--tile"),
        (["--threads", "0"], "--threads"),
        (["--workers", "0"], "--workers"),
        (["--workers", "2", "--scheduler", "tcp://a:1"], "--workers"),
        (["--view", "x"], "--view"),
        (["--seed", "-1"], "--seed"),
    ],
)
def test_mistakes_end_in_one_line_and_nothing_is_left(run, tiny: Path, tmp_path: Path, arguments, words) -> None:
    code, out, err = run("render", tiny, "-o", tmp_path / "a.png", *SMALL, *arguments)
    assert code == 2 and out == "" and words in err and err.startswith("usdfab: ") and err.count("\n") == 1, err
    assert not list(tmp_path.iterdir())


def test_a_picture_that_does_not_fit_is_refused(run, tiny, tmp_path, monkeypatch) -> None:
    code, _, err = run("render", tiny, "-o", tmp_path / "a.png", "--resolution", "100000")
    assert code == 2 and "too many" in err and err.count("\n") == 1
    monkeypatch.setattr("usdfab.tracer.memory.available_memory", lambda: 10**5)
    code, _, err = run("render", tiny, "-o", tmp_path / "a.png", *SMALL)
    assert code == 2 and "GiB of memory" in err and err.count("\n") == 1


def test_a_full_disk_is_one_line_and_no_half_written_part(run, tiny, tmp_path, monkeypatch) -> None:
    def full(file, **arrays):
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("usdfab.tracer.checkpoint.np.savez", full)
    code, _, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, "--tile", "1/2")
    assert code == 2 and "No space left on device" in err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_picture_that_cannot_be_written_is_not_lost(run, tiny, whole, tmp_path, monkeypatch) -> None:
    from usdfab.cli import render_frame
    from usdfab.errors import UsdfabError

    def full(*_):
        raise UsdfabError("cannot be written (No space left on device)", place="a.exr")

    write = render_frame.write_picture
    monkeypatch.setattr(render_frame, "write_picture", full)
    command = ("render", tiny, "-o", tmp_path / "a.exr", *SMALL, "--aov")
    code, _, err = run(*command)
    assert code == 2 and err.splitlines()[-1] == "usdfab: a.exr: cannot be written (No space left on device)"
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr.partial"]
    monkeypatch.setattr(render_frame, "write_picture", write)
    assert run(*command, "--resume")[0] == 0
    for name, values in read_layers(tmp_path / "a.exr").items():
        np.testing.assert_array_equal(values, read_layers(whole)[name], err_msg=name)
