"""Figure 11's comparison: what pixels see, the model of Irawan and Marschner, the pictures and the command."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from usdfab.cli.main import _run
from usdfab.fabric import FabricParameters
from usdfab.fabric.presets import preset
from usdfab.fabric.weave import weave_from_name
from usdfab.imaging import read_image
from usdfab.neural import surface_comparison
from usdfab.neural.cylinder import Cylinder
from usdfab.neural.irawan import irawan_components
from usdfab.neural.surface_comparison import FIBERS, IRAWAN, JIN, Scale, compare_surfaces
from usdfab.neural.surface_material import SurfaceMaterial, weave_of
from usdfab.neural.surface_swatch import View, swatch_view
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import rig_for, swatch_scene
from usdfab.usd.scene import Scene


def small(name: str = "linen") -> FabricParameters:
    fabric = preset(name)
    few = {"fiber_count": 12, "flyaway_density": 0.0}
    return replace(fabric, warp=replace(fabric.warp, **few), weft=replace(fabric.weft, **few), variants=1)


def traced_uv(scene: Scene, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """uv in metres of the fibers first seen in each pixel, and where there are any."""
    render = Tracer(scene).render(scene.cameras[0], RenderSettings(size, spp=4, max_depth=2, threads=1))
    return render.uv.reshape(-1, 2), (render.alpha.reshape(-1) > 0.99)


def seen_uv(view: View, fabric: FabricParameters) -> np.ndarray:
    tile = np.array([fabric.weave.ends, fabric.weave.picks]) * fabric.cell
    return view.queries[:, :2] * tile


def distance_on_tile(a: np.ndarray, b: np.ndarray, fabric: FabricParameters) -> np.ndarray:
    tile = np.array([fabric.weave.ends, fabric.weave.picks]) * fabric.cell
    d = (a - b) / tile
    return np.linalg.norm((d - np.round(d)) * tile, axis=-1)


def test_a_swatch_pixel_sees_what_the_tracer_sees_there() -> None:
    fabric = small()
    view = swatch_view(fabric, rig_for(fabric.size), (24, 24))
    uv, full = traced_uv(swatch_scene(fabric), (24, 24))
    off = distance_on_tile(seen_uv(view, fabric), uv, fabric)[full]
    assert full.mean() > 0.3
    # Half a pixel of jitter, and fibers above the mid-surface.
    assert np.median(off) < 1.0 * fabric.size[0] / 24
    # The lamp stands at +x: light comes from there, and from straight above at its foot.
    assert np.all(view.queries[:, 3] > 0) and np.all(view.queries[:, 5] > 0.9)
    assert np.max(view.light) / math.pi == pytest.approx(1.0, abs=0.1)
    rig = rig_for(fabric.size)
    behind = swatch_view(fabric, rig, (24, 24), np.array(rig.light_position) * [1, 1, -1])
    assert np.allclose(behind.queries[:, 3:6], view.queries[:, 3:6] * [1, 1, -1])


def test_a_cylinder_pixel_sees_what_the_tracer_sees_there() -> None:
    fabric = small()
    cylinder = Cylinder(fabric, cells=10)
    view = cylinder.view(24)
    uv, full = traced_uv(cylinder.scene(), (24, 24))
    facing = view.queries[:, 6] ** 2 + view.queries[:, 7] ** 2 < 0.6
    off = distance_on_tile(seen_uv(view, fabric), uv[view.hit], fabric)[facing & full[view.hit]]
    assert len(off) > 100
    assert np.median(off) < 1.2 * 2 * cylinder.radius / 24


def test_a_cylinders_frame_turns_with_it() -> None:
    cylinder = Cylinder(small(), cells=30)
    view = cylinder.view(21)
    index = np.cumsum(view.hit).reshape(view.shape) - 1
    middle = view.queries[index[10, 10]]
    assert np.allclose(middle[6:], 0, atol=1e-9)
    assert np.allclose(middle[3:6], cylinder.to_light, atol=1e-9)
    # On the right the cloth looks to the right: the camera is to its left, the light nearer to its normal.
    right, left = view.queries[index[10, 17]], view.queries[index[10, 3]]
    assert right[6] < -0.4 and left[6] > 0.4
    assert right[5] > left[5]
    assert np.allclose(np.sum(view.queries[:, 3:6] ** 2, axis=1), 1)
    # A pixel's area on the slanted cloth is larger.
    assert right[2] > middle[2]


# --- Irawan and Marschner ---------------------------------------------------------------------------------------------


def material(**values) -> SurfaceMaterial:
    numbers = {"twist": (0.0, 0.0), "inclination": (0.6, 0.5), "roughness": 0.2} | values
    return SurfaceMaterial(weave_of(weave_from_name("plain")), **numbers)


def random_rows(count: int, seed: int, wo: tuple[float, float] | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)

    def disk() -> np.ndarray:
        radius, turn = np.sqrt(rng.random(count) * 0.98), rng.random(count) * 2 * np.pi
        return np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])

    wi = disk()
    out = disk() if wo is None else np.tile(wo, (count, 1))
    z = np.sqrt(1 - np.sum(wi**2, axis=1))
    return np.column_stack([rng.random((count, 2)), np.ones(count), wi, z, out])


def test_white_yarns_of_theirs_reflect_all_at_normal_incidence() -> None:
    rows = random_rows(8_000, 3, (0.0, 0.0))
    values = irawan_components(material(twist=(0.4, -0.4)), rows, samples=64)
    total = math.pi * 0.98 * np.mean(values[:, 2:].sum(axis=1) / rows[:, 5])
    assert total == pytest.approx(1.0, abs=0.04)
    # Lambert: warp and weft cover half of a plain weave each.
    assert np.mean(values[:, 0] / rows[:, 5]) * math.pi == pytest.approx(0.5, rel=0.01)
    assert np.mean(values[:, 1] / rows[:, 5]) * math.pi == pytest.approx(0.5, rel=0.01)


def test_their_highlight_is_reciprocal() -> None:
    rows = random_rows(50, 4)
    woz = np.sqrt(1 - np.sum(rows[:, 6:] ** 2, axis=1))
    swapped = rows.copy()
    swapped[:, 3:6], swapped[:, 6:] = np.column_stack([rows[:, 6:], woz]), rows[:, 3:5]
    a = irawan_components(material(), rows, samples=512)[:, 2:] / rows[:, 5:6]
    b = irawan_components(material(), swapped, samples=512)[:, 2:] / woz[:, None]
    assert a == pytest.approx(b, rel=0.02, abs=1e-4)


@pytest.mark.parametrize("lean", [-0.3, 0.0, 0.2])
def test_their_highlight_lies_where_fibers_are_across_the_half_vector(lean: float) -> None:
    """Untwisted: on the warp, at u = the half vector's lean along the yarn."""
    m = material(roughness=0.05)
    y = np.linspace(0.0, 1.0, 401)
    # Seen from straight above, lit at twice the lean; the warp on top of cell (row 0, column 1).
    rows = np.zeros((401, 8))
    column = 1 if m.weave[0, 1] else 0
    rows[:, 0], rows[:, 1] = (column + 0.5) / 2, y / 2
    rows[:, 4], rows[:, 5] = math.sin(2 * lean), math.cos(2 * lean)
    values = irawan_components(m, rows, samples=1)[:, 2]
    brightest = float(y[np.argmax(values)])
    assert 2 * m.inclination[0] * (brightest - 0.5) == pytest.approx(lean, abs=0.02)


# --- pictures and command ---------------------------------------------------------------------------------------------


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_comparison, "preset", lambda name: small())
    monkeypatch.setattr(surface_comparison, "FABRICS", {"plain": "linen"})
    monkeypatch.setitem(surface_comparison.SCALES, "draft", Scale(32, 16, 16, 64, threads=1))


def test_the_models_come_near_the_fibers(tiny: None) -> None:
    # So few pixels want many samples: at 32 the mean of the fibers from afar is off by 15 % one time in a few.
    result = compare_surfaces(Scale(32, 16, 256, 64, threads=1), weaves=("plain",))
    assert set(result.pictures) == {("plain", v, m) for v in ("close", "distant") for m in (IRAWAN, JIN, FIBERS)}
    for row in result.rows:
        assert 0.7 < row.brightness < 1.5 and 0 < row.flip < 0.6
    # Fitted to the close view: colours are those of the fibers there.
    close = [result.pictures["plain", "close", m].mean(axis=(0, 1)) for m in (JIN, FIBERS)]
    assert close[0] == pytest.approx(close[1], rel=0.15)


def test_the_command_writes_a_picture_and_numbers(
    tiny: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["evaluate", "surface", "-o", str(tmp_path / "a"), "--json"]
    assert _run(arguments) == 0
    printed = json.loads(capsys.readouterr().out)
    kept = json.loads((tmp_path / "a" / "surface.json").read_text())
    assert printed["rows"] == kept["rows"] and len(kept["rows"]) == 4
    assert read_image(tmp_path / "a" / "surface.png").pixels.shape[1] == 3 * 32 + 2 * 8
    assert _run(arguments) == 2
    assert "exists" in capsys.readouterr().err


@pytest.mark.parametrize("arguments,said", [((), "needs a folder"), (("photos",), "makes its own")])
def test_bad_calls_are_one_line(arguments: tuple, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(["evaluate", "surface", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
