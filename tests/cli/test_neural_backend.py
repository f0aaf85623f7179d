"""``usdfab render --backend neural``: pictures, and everything that stands in the way."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parent.parent / "neural"))

from neural_examples import lively
from pxr import Sdf, Usd, UsdGeom, UsdLux

from usdfab.fabric import preset, weave_from_name
from usdfab.imaging import read_image
from usdfab.neural.material_file import Weights, save_material_network
from usdfab.neural.network import KINDS
from usdfab.usd.fabric_io import write_fabric

SMALL = ("--backend", "neural", "--resolution", 8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> tuple:
    """Options that name weights which need no training."""
    folder = tmp_path_factory.mktemp("weights")
    options: list = []
    for kind in KINDS:
        save_material_network(Weights(lively("lean", kind), {}), folder / f"{kind}.safetensors")
        options += [f"--{kind}-weights", folder / f"{kind}.safetensors"]
    return tuple(options)


def stage_with(path: Path, *, uv: bool = True) -> Path:
    """A square of cloth to be, a lamp and a camera with a lens."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    camera = UsdGeom.Camera.Define(stage, "/C")
    camera.AddTranslateOp().Set((0, 0, 1))
    camera.CreateFStopAttr(2.0)
    camera.CreateFocusDistanceAttr(1.0)
    UsdLux.DistantLight.Define(stage, "/L").CreateIntensityAttr(1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/M")
    mesh.CreatePointsAttr([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    if uv:
        api = UsdGeom.PrimvarsAPI(mesh)
        coordinates = api.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        coordinates.Set([(0, 0), (2, 0), (2, 2), (0, 2)])
    stage.Save()
    return path


def test_swatch_and_stage(run, tiny, tmp_path, weights):
    facts = []
    for name, extra in (("a.exr", ()), ("b.exr", ("--threads", 3)), ("c.exr", ("--spp", 3, "--region", "0,2,8,6"))):
        code, out, err = run("render", tiny, "-o", tmp_path / name, *SMALL, *weights, "--json", "-q", *extra)
        assert (code, err) == (0, "")
        facts.append(json.loads(out))
    assert [f["backend"] for f in facts] == 3 * ["neural"]
    # One lamp in the rig: one answer for each pixel of cloth and sample, which fills the picture.
    assert [f["decodes"] for f in facts] == [64, 64, 96] and [f["spp"] for f in facts] == [1, 1, 3]
    first, second, third = (read_image(tmp_path / f"{name}.exr").pixels for name in "abc")
    assert np.array_equal(first, second) and np.isfinite(first).all() and first.max() > 0
    assert third.shape == (4, 8, 3)
    stage = stage_with(tmp_path / "stage.usda")
    code, out, err = run("render", stage, "--fabric", tiny, "-o", tmp_path / "d.exr", *SMALL, *weights)
    assert code == 0 and not out
    assert "/C: the neural backend has no depth of field" in err and "neural, 0.00 million answers" in err
    code, _, err = run("render", stage, "--fabric", tiny, "-o", tmp_path / "e.exr", *SMALL, *weights, "--strict")
    assert code == 2 and "/C: the neural backend has no depth of field" in err and err.count("\n") == 1
    assert not (tmp_path / "e.exr").exists()


@pytest.mark.parametrize(
    "options",
    [("--noise", 0.1), ("--time", 0), ("--tile", "1/2"), ("--workers", 2), ("--resume",),
     ("--aov",), ("--denoise",), ("--scheduler", "local")],
)  # fmt: skip
def test_options_that_make_no_sense_there(run, tiny, tmp_path, options):
    code, out, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, *options)
    assert code == 2 and not out
    assert err == f"usdfab: {options[0]}: the neural backend has no such option; use --backend embree\n"


def test_options_of_other_backends(run, tiny, tmp_path, weights):
    code, _, err = run("render", tiny, "-o", tmp_path / "a.exr", *weights)
    assert code == 2 and err == "usdfab: --reflection-weights: is for --backend neural\n"
    code, _, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, "--device", "llvm")
    assert code == 2 and err == "usdfab: --device: is for --backend mitsuba\n"
    code, _, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, "--spp", 0, *weights)
    assert code == 2 and "--spp" in err


def test_bad_weights_and_stages_end_in_one_line(run, tiny, tmp_path, weights):
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(weights[1].read_bytes()[:500])
    for file, said in (
        (tmp_path / "none.safetensors", "no such file"),
        (damaged, "no whole weights file of a neural material"),
        (weights[3], "for transmission, not reflection"),
    ):
        code, _, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, "--reflection-weights", file)
        assert code == 2 and said in err and err.count("\n") == 1 and str(file) in err
    stage = stage_with(tmp_path / "naked.usda", uv=False)
    # Stages without texture coordinates are unwrapped when they are read.
    code, _, err = run("render", stage, "--fabric", tiny, "-o", tmp_path / "b.exr", *SMALL, *weights)
    assert code == 0 and "/M: the cloth has no texture coordinates; it is unwrapped" in err
    rows = "/".join("1" * k + "0" + "1" * (16 - k) for k in range(17))
    write_fabric(replace(preset("denim"), weave=weave_from_name(rows)), tmp_path / "large.usda")
    code, _, err = run("render", tmp_path / "large.usda", "-o", tmp_path / "a.exr", *SMALL, *weights)
    assert code == 2 and "larger than the encoder takes" in err and err.count("\n") == 1
    assert not (tmp_path / "a.exr").exists()


def test_fibers_near_and_the_network_far(run, tiny, tmp_path, weights):
    def draw(name: str, backend: str, *options: object) -> tuple[dict, np.ndarray]:
        more = weights if backend != "embree" else ()
        code, out, err = run(
            "render", tiny, "-o", tmp_path / name, "--backend", backend, *more, "--json", "-q", *options
        )
        assert (code, err) == (0, "")
        return json.loads(out), read_image(tmp_path / name).pixels

    # The swatch is three millimetres wide, a yarn is 1.7 mm: at 32 pixels all are fibers, at 2 none is.
    facts, near = draw("a.exr", "auto", "--resolution", 32, "--spp", 2)
    assert facts["neural"] == 0 and facts["tiles_traced"] == facts["tiles"]
    assert np.array_equal(near, draw("b.exr", "embree", "--resolution", 32, "--spp", 2)[1])
    part, cut = draw("c.exr", "auto", "--resolution", 32, "--spp", 2, "--region", "5,3,30,20")
    assert part["region"] == [5, 3, 30, 20] and np.array_equal(cut, near[3:20, 5:30])
    facts, far = draw("d.exr", "auto", "--resolution", 1, "--spp", 2)
    assert facts["neural"] == 1 and facts["tiles_traced"] == 0 and facts["decodes"] == 4
    assert np.allclose(far, near.mean(axis=(0, 1)), rtol=0.3) and far.min() > 0
