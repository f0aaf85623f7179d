"""``usdfab render --backend mitsuba``: the same files and options where they make sense, clear words where not."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdLux

from usdfab.imaging import read_image, write_image
from usdfab.mi import llvm, variant

pytest.importorskip("mitsuba")

SMALL = ("--resolution", 12, "--spp", 4, "--backend", "mitsuba", "--device", "scalar")


def test_pictures_and_facts(run, tiny, tmp_path):
    target = tmp_path / "swatch.exr"
    code, out, err = run("render", tiny, "-o", target, *SMALL, "--json", "-q")
    assert code == 0 and not err
    facts = json.loads(out)
    picture = read_image(target).pixels
    assert picture.shape == (12, 12, 3) and picture.mean() > 0.01
    assert facts["backend"] == "mitsuba" and facts["device"] == "scalar" and facts["spp"] == 4
    assert facts["fibers"] == "flattened", "the scalar variant has no Dr.Jit"
    assert facts["control_points"] > 1000 and facts["full_size"] == [12, 12] and facts["noise"] > 0
    again = tmp_path / "again.exr"
    run("render", tiny, "-o", again, *SMALL, "-q")
    np.testing.assert_array_equal(read_image(again).pixels, picture)
    run("render", tiny, "-o", again, *SMALL, "-q", "--overwrite", "--seed", 1)
    assert not np.array_equal(read_image(again).pixels, picture)


def test_a_region_lies_where_it_belongs(run, tiny, tmp_path):
    whole, part = tmp_path / "whole.exr", tmp_path / "part.exr"
    more = ("--backend", "mitsuba", "--device", "scalar", "-q", "--resolution", 16, "--max-depth", 2)
    run("render", tiny, "-o", whole, *more, "--spp", 64)
    code, _, err = run("render", tiny, "-o", part, *more, "--spp", 64, "--region", "8,0,16,4")
    assert code == 0, err
    small = read_image(part).pixels
    assert small.shape == (4, 8, 3)
    full = read_image(whole).pixels
    errors = {(x, y): np.abs(full[y : y + 4, x : x + 8] - small).mean() for x in range(9) for y in range(13)}
    assert min(errors, key=errors.__getitem__) == (8, 0)


def test_files_are_not_overwritten_and_exposure_counts(run, tiny, tmp_path):
    target, bright = tmp_path / "a.png", tmp_path / "b.png"
    assert run("render", tiny, "-o", target, *SMALL)[0] == 0
    code, _, err = run("render", tiny, "-o", target, *SMALL)
    assert code == 2 and "the file exists" in err
    run("render", tiny, "-o", bright, *SMALL, "--exposure", 2)
    assert read_image(bright).pixels.mean() > 1.5 * read_image(target).pixels.mean()


@pytest.mark.parametrize(
    "options",
    [("--noise", 0.1), ("--time", 0), ("--tile", "1/2"), ("--workers", 2), ("--resume",),
     ("--aov",), ("--denoise",), ("--scheduler", "local")],
)  # fmt: skip
def test_options_that_make_no_sense_there(run, tiny, tmp_path, options):
    code, out, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, *options)
    assert code == 2 and not out
    assert err == f"usdfab: {options[0]}: the Mitsuba backend has no such option; use --backend embree\n"


@pytest.mark.skipif(llvm.choose().library is None, reason="no LLVM library for Dr.Jit")
def test_fibers_tiled_and_flattened(run, tiny, tmp_path):
    found = {}
    for options in ((), ("--fibers", "tiled"), ("--fibers", "flattened")):
        target = tmp_path / f"{len(found)}.exr"
        more = ("--resolution", 8, "--spp", 16, "--backend", "mitsuba", "--device", "llvm", "--json", "-q")
        code, out, err = run("render", tiny, "-o", target, *more, *options)
        assert code == 0 and not err
        found[options] = json.loads(out), read_image(target).pixels
    assert [facts["fibers"] for facts, _ in found.values()] == ["tiled", "tiled", "flattened"]
    default, tiled, flattened = (pixels for _, pixels in found.values())
    np.testing.assert_array_equal(default, tiled)
    np.testing.assert_allclose(flattened.mean(), tiled.mean(), rtol=0.25)  # 1000 paths


def moving_lamp(path, pictured=()):
    """A stage with a plane, a lamp that is three times as bright at time 2, and dome lights with pictures."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.Camera.Define(stage, "/C").AddTranslateOp().Set((0, 0, 1))
    intensity = UsdLux.DistantLight.Define(stage, "/L").CreateIntensityAttr()
    intensity.Set(1.0, 1)
    intensity.Set(3.0, 2)
    for number, picture in enumerate(pictured):
        UsdLux.DomeLight.Define(stage, f"/Dome{number}").CreateTextureFileAttr(str(picture))
    mesh = UsdGeom.Mesh.Define(stage, "/M")
    mesh.CreatePointsAttr([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    stage.Save()
    return path


def test_frames(run, tmp_path):
    stage = moving_lamp(tmp_path / "moving.usda")
    code, out, err = run("render", stage, "-o", tmp_path / "a.##.exr", *SMALL, "--frames", "1-2", "--json")
    assert code == 0, err
    assert [frame["backend"] for frame in json.loads(out)["frames"]] == ["mitsuba", "mitsuba"]
    first, second = (read_image(tmp_path / f"a.0{k}.exr").pixels.mean() for k in (1, 2))
    assert first > 0 and second == pytest.approx(3 * first, rel=0.01)


def test_lights_that_mitsuba_has_not(run, tmp_path):
    sky = []
    for name in ("a.exr", "b.exr"):
        sky.append(tmp_path / name)
        write_image(sky[-1], np.ones((4, 8, 3), dtype=np.float32))
    stage = moving_lamp(tmp_path / "domes.usda", sky)
    code, out, err = run("render", stage, "-o", tmp_path / "c.exr", *SMALL, "--strict")
    assert (code, out) == (2, "")
    assert err == "usdfab: /Dome1: Mitsuba has one dome light with a picture; use --backend embree\n"
    code, _, err = run("render", stage, "-o", tmp_path / "c.exr", *SMALL)
    assert code == 0 and "warning: /Dome1: a second dome light with a texture is not supported, left out\n" in err


@pytest.mark.parametrize("device", ["scalar", "llvm"])
def test_a_fabric_without_fibers(run, tiny, tmp_path, device):
    empty = tmp_path / "empty.usda"
    empty.write_text(tiny.read_text().replace("warp:fiberCount = 4", "warp:fiberCount = 0"))
    more = ("--resolution", 8, "--spp", 1, "--backend", "mitsuba", "--device", device)
    code, out, err = run("render", empty, "-o", tmp_path / "a.exr", *more)
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert "fiberCount>: 0 is not between 1 and" in err


def test_without_llvm(run, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(llvm, "choose", lambda: llvm.Choice(None, ()))
    more = ("-o", tmp_path / "a.exr", "--resolution", 8, "--spp", 1, "--backend", "mitsuba", "--device", "llvm")
    code, out, err = run("render", tiny, *more)
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert err.startswith("usdfab: no LLVM library for Dr.Jit was found; run: pip install 'usdfab[mitsuba]'")


def test_what_cannot_be(run, tiny, tmp_path, monkeypatch):
    target = tmp_path / "a.exr"
    more = ("-o", target, "--resolution", 8, "--spp", 1)
    assert "choose embree or mitsuba" in run("render", tiny, *more, "--backend", "arnold")[2]
    assert "is for --backend mitsuba" in run("render", tiny, *more, "--device", "llvm")[2]
    assert "--fibers: is for --backend mitsuba" in run("render", tiny, *more, "--fibers", "tiled")[2]
    mitsuba = (*more, "--backend", "mitsuba", "--device", "scalar")
    assert "--fibers: there is no 'woven'" in run("render", tiny, *mitsuba, "--fibers", "woven")[2]
    assert "--fibers tiled: tiled fibers need Dr.Jit" in run("render", tiny, *mitsuba, "--fibers", "tiled")[2]
    monkeypatch.setattr(variant, "cuda_driver", lambda: "")
    variant.cuda_verdict.cache_clear()
    code, _, err = run("render", tiny, *more, "--backend", "mitsuba", "--device", "cuda")
    assert code == 2 and "there is no NVIDIA driver; use llvm" in err
    variant.cuda_verdict.cache_clear()
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    code, _, err = run("render", tiny, *more, "--backend", "mitsuba")
    assert code == 2 and "run: pip install 'usdfab[mitsuba]'" in err
    assert not target.exists()


def test_the_embree_backend_loads_no_mitsuba(tiny, tmp_path):
    code = (
        "import sys\nfrom usdfab.cli.main import _run\n"
        f"assert _run(['render', {str(tiny)!r}, '-o', {str(tmp_path / 'a.png')!r}, '--resolution', '8', '-q']) == 0\n"
        "assert not {'mitsuba', 'drjit'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
