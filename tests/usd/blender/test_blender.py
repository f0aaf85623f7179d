"""Blender reads what ``usdfab expand`` writes, and Cycles draws it: with samples/blender_import.py, in its own Python.

    python3.11 -m venv bpy && bpy/bin/pip install bpy==5.0.1
    USDFAB_BLENDER_PYTHON=bpy/bin/python pytest -m slow tests/usd/blender

A ``bpy`` wheel wants a Python version and a NumPy of its own, so it never shares an environment with usdfab.
"""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

from usdfab.fabric import preset
from usdfab.imaging import read_image
from usdfab.usd.expand import ExpandOptions, expand

ROOT = Path(__file__).parents[3]
PYTHON = os.environ.get("USDFAB_BLENDER_PYTHON", "")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHON, reason="USDFAB_BLENDER_PYTHON names no Python that has bpy"),
]


def blender(file: Path, *arguments: str) -> dict:
    """Run the helper; returns the counts it prints."""
    command = [PYTHON, str(ROOT / "samples" / "blender_import.py"), str(file), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))


@pytest.mark.parametrize("mode", ["instancer", "xform", "baked"])
def test_cycles_draws_the_drape(tmp_path, mode):
    region = None if mode == "instancer" else (0.45, 0.3, 0.55, 0.4) if mode == "xform" else (0.5, 0.35, 0.51, 0.36)
    options = ExpandOptions(mode=mode, region=region, vertices_per_segment=10)
    fabric = replace(preset("wool-twill"), variants=2)
    result = expand(ROOT / "samples" / "drape.usda", tmp_path / "drape.usdc", fabric, options)
    counts = blender(result.path, "--render", str(tmp_path / "drape.png"), "--resolution", "96x72", "--samples", "4")
    assert counts["materials"] == 2  # warp and weft, as long as no flyaways are asked for
    if mode == "instancer":
        assert counts["instances"] == 2 * result.instances
    elif mode == "baked":
        assert counts["curve_objects"] == 2
    picture = read_picture(tmp_path / "drape.png")
    assert picture.shape == (72, 96, 3) and picture.std() > 0.02


def test_tints_reach_the_copies(tmp_path):
    """Half of a cloth is tinted blue; seen from above, that half is."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "cloth.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/World/Cloth")
    points = [(x, y, 0) for y in (0, 0.02) for x in (0, 0.01, 0.01, 0.02)]
    mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in points])
    mesh.CreateFaceVertexCountsAttr([4, 4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 5, 4, 2, 3, 7, 6])
    mesh.CreateSubdivisionSchemeAttr("none")
    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    st.Set([Gf.Vec2f(100 * x, 100 * y) for x, y, _ in points])
    tint = primvars.CreatePrimvar("usdfab:albedo", Sdf.ValueTypeNames.Color3fArray, "vertex")
    tint.Set([Gf.Vec3f(1, 1, 1) if k % 4 < 2 else Gf.Vec3f(0.02, 0.02, 1) for k in range(8)])
    lamp = stage.DefinePrim("/World/Lamp", "DistantLight")
    lamp.CreateAttribute("inputs:intensity", Sdf.ValueTypeNames.Float).Set(3.0)
    stage.Save()
    fabric = preset("linen")
    result = expand(tmp_path / "cloth.usda", tmp_path / "f.usdc", fabric, ExpandOptions(vertices_per_segment=8))
    picture = tmp_path / "tint.png"
    blender(
        result.path, "--render", str(picture), "--resolution", "64x64", "--samples", "8",
        "--eye=0.01,0.01,0.05", "--target=0.01,0.0101,0", "--angle", "20",
    )  # fmt: skip
    pixels = read_picture(picture)[8:-8, 8:-8]
    left, right = pixels[:, :20].mean(axis=(0, 1)), pixels[:, -20:].mean(axis=(0, 1))
    assert right[2] > 2.0 * right[0] and left[2] < 1.2 * left[0]


def read_picture(path: Path) -> np.ndarray:
    """(H, W, 3) linear."""
    return np.asarray(read_image(path).pixels)[..., :3]
