"""Any fabric that validates can be written, read, bound, expanded and rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from usdfab.fabric import NAMED_WEAVES, YARN_PARAMETERS, FabricParameters, YarnParameters
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.bind import bind
from usdfab.usd.check import check, exit_code
from usdfab.usd.expand import ExpandOptions, expand
from usdfab.usd.fabric_io import read_fabric, write_fabric
from usdfab.usd.read_scene import read_scene

SIDE = 4e-3
QUICK = {"count": (1, 8), "fiber_count": (1, 6), "flyaway_density": (0.0, 2000.0), "flyaway_length": (1e-4, 2e-3)}
"""Ranges that keep a case under a second; all others are the table's own."""

channel = st.floats(0, 1)
color = st.tuples(channel, channel, channel)


def values_of(parameter):
    if parameter.kind == "color":
        return color
    if parameter.kind == "colors":
        return st.lists(color, max_size=3).map(tuple)
    low, high = QUICK.get(parameter.name, parameter.hard)
    if parameter.kind == "int":
        return st.integers(int(low), int(high))
    if parameter.name == "radius":
        return st.floats(2e-5, 5e-4)
    if parameter.name == "fiber_radius":
        return st.just(0.0) | st.floats(2e-6, 5e-5)
    return st.floats(low, high)


yarns = st.fixed_dictionaries({p.name: values_of(p) for p in YARN_PARAMETERS}).map(lambda v: YarnParameters(**v))
fabrics = st.builds(
    FabricParameters, st.sampled_from(list(NAMED_WEAVES.values())), st.just((SIDE, SIDE)), yarns, yarns,
    st.integers(0, 2**31 - 1), variants=st.integers(1, 2),
)  # fmt: skip


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Path:
    """A curved sheet of 4 mm, a camera above it and a lamp."""
    path = tmp_path_factory.mktemp("bare") / "sheet.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/World/Sheet")
    x = np.linspace(-SIDE / 2, SIDE / 2, 4)
    mesh.CreatePointsAttr([Gf.Vec3f(a, b, 40.0 * a * a) for b in x for a in x])
    mesh.CreateFaceVertexCountsAttr([4] * 9)
    corners = [(4 * j + i, 4 * j + i + 1, 4 * j + i + 5, 4 * j + i + 4) for j in range(3) for i in range(3)]
    mesh.CreateFaceVertexIndicesAttr([k for face in corners for k in face])
    mesh.CreateSubdivisionSchemeAttr("none")
    uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    uv.Set([Gf.Vec2f(i / 3, j / 3) for j in range(4) for i in range(4)])
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 0.02))
    light = UsdLux.DomeLight.Define(stage, "/World/Sky")
    light.CreateIntensityAttr(1.0)
    stage.Save()
    return path


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(fabric=fabrics)
def test_whatever_validates_goes_all_the_way(bare, tmp_path_factory, fabric):
    folder = tmp_path_factory.mktemp("trip")
    path = write_fabric(fabric, folder / "fabric.usda")
    assert exit_code(check(path)) == 0
    assert read_fabric(path) == fabric

    bound = bind(bare, path, folder / "bound.usda").path
    assert exit_code(check(bound)) == 0
    scene = read_scene(bound)
    assert [surface.fabric for surface in scene.fabrics] == [fabric]

    expanded = expand(bound, folder / "fibers.usdc", options=ExpandOptions(vertices_per_segment=4))
    assert exit_code(check(expanded.path)) == 0
    assert expanded.instances > 0 and expanded.points > 0

    render = Tracer(scene).render(scene.cameras[0], RenderSettings((6, 6), spp=2, max_depth=8))
    assert np.isfinite(render.pixels).all() and render.pixels.min() >= 0.0
    # White fibers under a white sky are never brighter than the sky, but for noise.
    assert render.pixels.mean() < 1.5
