"""The schema: generated from the table, one test per attribute, usable without usdfab."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

import usdfab
from usdfab.fabric import YARN_PARAMETERS
from usdfab.usd.generate_schema import SCHEMA_FILES, generate_schema
from usdfab.usd.registration import FABRIC_API, YARN_API
from usdfab.usd.schema_source import (
    FABRIC_ATTRIBUTES,
    YARN_ATTRIBUTES,
    camel,
    fabric_attribute_name,
    schema_source,
    yarn_attribute_name,
)


@pytest.mark.skipif(Usd.GetVersion() < (0, 26, 11), reason="usdGenSchema of an older USD than the files were made with")
def test_the_committed_files_are_what_the_table_generates(tmp_path):
    generate_schema(tmp_path)
    for name in SCHEMA_FILES:
        committed = (usdfab.schema_dir() / name).read_text(encoding="utf-8")
        generated = (tmp_path / name).read_text(encoding="utf-8")
        assert committed == generated, f"{name} is stale: run `python -m usdfab.usd.generate_schema`"


def test_no_placeholder_is_left():
    assert "@PLUG" not in (usdfab.schema_dir() / "plugInfo.json").read_text(encoding="utf-8")


def test_every_parameter_is_in_the_schema_once():
    assert [a.field for a in YARN_ATTRIBUTES] == [p.name for p in YARN_PARAMETERS]
    assert len({a.name for a in YARN_ATTRIBUTES}) == len(YARN_ATTRIBUTES)


@pytest.mark.parametrize(
    ("snake", "expected"),
    [("count", "count"), ("fiber_count", "fiberCount"), ("roughness_longitudinal", "roughnessLongitudinal")],
)
def test_camel_case(snake, expected):
    assert camel(snake) == expected


@pytest.mark.parametrize("attribute", FABRIC_ATTRIBUTES + YARN_ATTRIBUTES, ids=lambda a: a.name)
def test_the_source_documents_units_and_range(attribute):
    assert attribute.doc in schema_source().replace("\n        ", "\n")
    if attribute.hard is not None:
        assert "Units:" in attribute.doc
        assert "Range:" in attribute.doc


def material() -> Usd.Prim:
    stage = Usd.Stage.CreateInMemory()
    material.stage = stage  # a prim does not keep its stage alive
    return UsdShade.Material.Define(stage, "/M").GetPrim()


def as_plain(value):
    if isinstance(value, (str, int, float)):
        return value
    if isinstance(value, Sdf.AssetPath):
        return value.path
    return [as_plain(v) for v in value]


def names_and_attributes():
    yield from ((fabric_attribute_name(a.name), a) for a in FABRIC_ATTRIBUTES)
    for system in ("warp", "weft"):
        yield from ((yarn_attribute_name(system, a.name), a) for a in YARN_ATTRIBUTES)


OTHER = {
    "int": 7,
    "asset": Sdf.AssetPath("./maps/indigo.png"),
    "double": 0.1 + 0.2,
    "string": "Leinwand »fein«",
    "int2": Gf.Vec2i(3, 5),
    "double2": Gf.Vec2d(0.1, 1 / 3),
    "color3d": Gf.Vec3d(0.1, 1 / 3, 0.7),
    "int[]": [1, 1, 0],
    "string[]": ["analysis", "path"],
    "color3d[]": [Gf.Vec3d(0.1, 0.2, 0.3), Gf.Vec3d(1, 0, 0)],
}


@pytest.mark.parametrize(
    ("name", "attribute"), list(names_and_attributes()), ids=lambda v: v if isinstance(v, str) else ""
)
def test_attribute(name, attribute):
    prim = material()
    assert not prim.GetAttribute(name)
    prim.ApplyAPI(FABRIC_API)
    prim.ApplyAPI(YARN_API, "warp")
    prim.ApplyAPI(YARN_API, "weft")
    usd = prim.GetAttribute(name)
    # unauthored: the fallback is the table's default, and nothing is in the file
    assert not usd.HasAuthoredValue()
    assert usd.GetTypeName() == attribute.type_name
    assert usd.GetVariability() == Sdf.VariabilityUniform
    assert not usd.IsCustom()
    assert as_plain(usd.Get()) == as_plain(attribute.default)
    assert usd.GetDisplayName() == attribute.label
    assert usd.GetDisplayGroup() == attribute.group
    # set and read back, without loss
    assert usd.Set(OTHER[attribute.type_name])
    assert as_plain(usd.Get()) == as_plain(OTHER[attribute.type_name])
    # limits
    for limits, expected in ((usd.GetHardLimits(), attribute.hard), (usd.GetSoftLimits(), attribute.soft)):
        if expected is None:
            assert limits.GetMinimum() is None
        else:
            assert limits.GetMinimum() == expected[0]
            assert limits.GetMaximum() == (expected[1] if np.isfinite(expected[1]) else None)


def test_only_materials_may_carry_it():
    stage = Usd.Stage.CreateInMemory()
    cube = UsdGeom.Cube.Define(stage, "/C").GetPrim()
    looks = UsdShade.Material.Define(stage, "/M").GetPrim()
    assert looks.CanApplyAPI(FABRIC_API)
    assert looks.CanApplyAPI(YARN_API, "warp")
    assert not cube.CanApplyAPI(FABRIC_API)
    assert not cube.CanApplyAPI(YARN_API, "weft")
    assert not looks.CanApplyAPI(YARN_API, "left")


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, text=True, timeout=60
    )


def test_any_usd_program_can_load_it_through_the_plugin_path():
    code = (
        "import sys\n"
        "from pxr import Usd\n"
        "stage = Usd.Stage.CreateInMemory()\n"
        "prim = stage.DefinePrim('/M', 'Material')\n"
        "prim.ApplyAPI('UsdfabFabricAPI'); prim.ApplyAPI('UsdfabYarnAPI', 'weft')\n"
        "print(prim.GetAttribute('usdfab:yarn:weft:fiberCount').Get())\n"
        "assert not any(m.startswith('usdfab') for m in sys.modules)\n"
    )
    done = run_python(code, PXR_PLUGINPATH_NAME=str(usdfab.schema_dir()))
    assert (done.returncode, done.stdout.strip()) == (0, "200"), done.stderr


def test_importing_usdfab_with_the_plugin_path_set_is_harmless():
    code = "import usdfab.usd; usdfab.usd.require_schema(); print('fine')"
    done = run_python(code, PXR_PLUGINPATH_NAME=str(usdfab.schema_dir()))
    assert (done.returncode, done.stdout.strip(), done.stderr.strip()) == (0, "fine", "")


def test_importing_too_late_says_what_to_do():
    code = (
        "from pxr import Usd\n"
        "Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('CollectionAPI')\n"
        "import usdfab.usd\n"
        "from usdfab.errors import UsdfabError\n"
        "try:\n    usdfab.usd.require_schema()\n"
        "except UsdfabError as error:\n    print(error)\n"
    )
    done = run_python(code, PXR_PLUGINPATH_NAME="")
    assert done.returncode == 0, done.stderr
    assert "import usdfab.usd before any stage is opened" in done.stdout


def test_import_does_not_start_the_schema_registry():
    # A schema registered after `import usdfab.usd` must still be seen: here a copy of our own under another name.
    code = (
        "import json, pathlib, sys, tempfile\n"
        "import usdfab, usdfab.usd, usdfab.usd.fabric_io, usdfab.usd.read_scene, usdfab.usd.check\n"
        "from pxr import Plug, Usd\n"
        "folder = pathlib.Path(tempfile.mkdtemp())\n"
        "for name in ('plugInfo.json', 'generatedSchema.usda'):\n"
        "    text = (usdfab.schema_dir() / name).read_text().replace('Usdfab', 'Other')\n"
        "    text = text.replace('\"usdfab\"', '\"other\"')\n"
        "    (folder / name).write_text(text.replace('usdfab:', 'other:'))\n"
        "Plug.Registry().RegisterPlugins(str(folder))\n"
        "assert Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('OtherFabricAPI')\n"
        "usdfab.usd.require_schema()\n"
        "print('fine')\n"
    )
    done = run_python(code)
    assert (done.returncode, done.stdout.strip()) == (0, "fine"), done.stderr
