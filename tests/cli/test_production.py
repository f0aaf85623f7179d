"""Production-like stages through ``usdfab render``: what is seen must be what physics and the stage say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from production import CELL, HEIGHT, LIGHTS, Builder, halves, showroom
from pxr import Gf, Sdf, UsdGeom, UsdShade

from usdfab.imaging import read_image, read_layers

SIZE = 36, 24
GREEN, YELLOW = (0.1, 0.7, 0.1), (0.8, 0.7, 0.05)


@pytest.fixture
def texture(tmp_path: Path) -> Path:
    return halves(tmp_path / "halves.png", GREEN, YELLOW)


@pytest.fixture
def render(run, tmp_path: Path):
    """``render(builder, ...)``: (pixels of the picture, what --json says)."""

    def call(builder: Builder, *arguments, spp: int = 24, depth: int = 5, name: str = "a.exr"):
        stage = builder.save(tmp_path / "stage.usda")
        command = (
            "render",
            stage,
            "-o",
            tmp_path / name,
            "--resolution",
            f"{SIZE[0]}x{SIZE[1]}",
            "--overwrite",
            "--json",
        )
        code, out, err = run(*command, "--spp", spp, "--max-depth", depth, "-q", *arguments)
        assert code == 0, err
        return read_image(tmp_path / name).pixels if (tmp_path / name).exists() else None, json.loads(out)

    return call


def mean(pixels: np.ndarray, column: int, row: int, left: float = 0.2, right: float = 0.8) -> np.ndarray:
    """Mean colour of a cell between two shares of its width, away from its border."""
    side = SIZE[1] // 2
    top = SIZE[1] - side * (row + 1)
    x0 = side * column
    part = pixels[top + 2 : top + side - 2, x0 + round(left * side) : x0 + round(right * side)]
    return part.reshape(-1, 3).mean(axis=0)


def test_everything_is_seen_where_it_is(render, texture) -> None:
    pixels, facts = render(showroom(texture))
    r, g, b = mean(pixels, 0, 0)
    assert r > 1.7 * g and r > 1.7 * b
    left, right = mean(pixels, 1, 0, 0.1, 0.45), mean(pixels, 1, 0, 0.6, 0.9)
    np.testing.assert_allclose(left, (r, g, b), rtol=0.12, atol=0.01)
    assert right[2] > 1.7 * right[0]
    # Under a uniform dome of radiance 0.5 a diffuse surface shows half its colour, and a little of its reflection.
    for seen, color in ((mean(pixels, 2, 0, 0.1, 0.4), GREEN), (mean(pixels, 2, 0, 0.6, 0.9), YELLOW)):
        np.testing.assert_allclose(seen, 0.5 * np.array(color), atol=0.035)
    np.testing.assert_allclose(mean(pixels, 0, 1), 0.5 * np.array(GREEN), rtol=0.01)
    # The copies are of the size of the cloth that they copy: 0.64 of the cell, and black between.
    copies = mean(pixels, 1, 1, 0.2, 0.8)
    assert copies[0] > 1.7 * copies[1]
    # Of the refined cube the corners are gone, beside it is the dome; its middle is blue cloth.
    ball = mean(pixels, 2, 1, 0.3, 0.7)
    assert ball[2] > 1.7 * ball[0]
    np.testing.assert_allclose(pixels[2, -2], 0.5)
    assert [w for w in facts["warnings"] if "unwrapped" in w] == facts["warnings"]


def test_one_picture_in_any_unit_axis_and_orientation(render, texture) -> None:
    """The paths are the same, but for rounding."""
    lights = ("DistantLight", "RectLight")
    metres, _ = render(showroom(texture, lights))
    for options in ({"meters": 0.01, "up": "Y"}, {"left_handed": True}):
        other, _ = render(showroom(texture, lights, **options))
        np.testing.assert_allclose(other.mean(axis=(0, 1)), metres.mean(axis=(0, 1)), rtol=0.02, err_msg=str(options))
        for column, row in [(i, j) for i in range(3) for j in range(2)]:
            # How xatlas cuts the ball depends on how it lies in space, and the directions of its yarns with it.
            tolerance = 0.25 if (column, row) == (2, 1) else 0.03
            ours, theirs = mean(other, column, row), mean(metres, column, row)
            np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=0.005, err_msg=f"{options} {column} {row}")


def test_lights_add_up(render, texture) -> None:
    alone = {kind: render(showroom(texture, [kind]), spp=16)[0].mean(axis=(0, 1)) for kind in LIGHTS}
    for kind, color in alone.items():
        assert color.min() > 0.02 and color.max() < 5, (kind, color)
    together = render(showroom(texture, LIGHTS), spp=48)[0].mean(axis=(0, 1))
    np.testing.assert_allclose(together, sum(alone.values()), rtol=0.04)


def test_frames_show_the_cloth_where_it_is(render, texture, tmp_path) -> None:
    def moving(b: Builder) -> None:
        b.stage.SetStartTimeCode(1)
        b.stage.SetEndTimeCode(3)
        for name in ("Both", "Textured", "Shown", "Copies", "Cage"):
            UsdGeom.Imageable(b.stage.GetPrimAtPath(f"/World/{name}")).MakeInvisible()
        shift = UsdGeom.Xformable(b.stage.GetPrimAtPath("/World/Red")).AddTranslateOp()
        for frame in (1, 2, 3):
            shift.Set(Gf.Vec3d((frame - 1) * CELL, 0, 0), frame)

    for frames, numbers in (("1-3x2", (1, 3)), ("all", (1, 2, 3))):
        render(showroom(texture, change=moving), "--frames", frames, spp=8, name="f.exr")
        for number in numbers:
            pixels = read_image(tmp_path / f"f.{number:04d}.exr").pixels
            # The dome itself is behind the cloth: 0.5 in all channels.
            greenish = [mean(pixels, column, 0)[1] for column in range(3)]
            assert int(np.argmin(greenish)) == number - 1, (frames, number, greenish)
            assert sorted(greenish)[1] == pytest.approx(0.5)


def flat(texture: Path, change) -> Builder:
    """Only a grey square of half a cell in the middle of the picture."""
    b = Builder()
    b.sheet("/World/Square", (0, 0, 0), CELL, uv=None).CreateDisplayColorAttr([Gf.Vec3f(0.4)])
    camera = b.camera()
    b.light("DomeLight")
    change(b, camera)
    return b


def test_depth_of_field_blurs_as_a_thin_lens_does(render, texture, tmp_path) -> None:
    def focused(distance: float):
        def change(b: Builder, camera: UsdGeom.Camera) -> None:
            camera.CreateFStopAttr(2.0)  # 50 mm at f/2: a lens of 12.5 mm radius
            camera.CreateFocusDistanceAttr(distance)

        return change

    def alpha(change) -> np.ndarray:
        render(flat(texture, change), "--aov", "alpha", spp=64, depth=2)
        return read_layers(tmp_path / "a.exr")["A"][..., None][..., 0]

    sharp, soft = alpha(focused(HEIGHT)), alpha(focused(2 * HEIGHT))
    assert ((sharp > 0.01) & (sharp < 0.99)).mean() < 0.12
    # On the square's plane the cone of rays has radius 12.5 mm * (1 - HEIGHT / focus) = 6.25 mm.
    half = 0.5 * CELL
    row = soft[SIZE[1] // 2 - 1 : SIZE[1] // 2 + 1].mean(axis=0)
    x = (np.arange(SIZE[0]) + 0.5) / SIZE[0] * 3 * CELL - 1.5 * CELL
    t = np.clip((half - abs(x)) / 6.25e-3, -1, 1)
    covered = 0.5 + (t * np.sqrt(1 - t * t) + np.arcsin(t)) / np.pi  # part of a disk on one side of a line
    np.testing.assert_allclose(row, covered, atol=0.09)


def test_motion_blur_is_the_share_of_time(render, texture, tmp_path) -> None:
    def change(b: Builder, camera: UsdGeom.Camera) -> None:
        b.stage.SetStartTimeCode(1)
        b.stage.SetEndTimeCode(2)
        camera.CreateShutterOpenAttr(0.0)
        camera.CreateShutterCloseAttr(1.0)
        shift = UsdGeom.Xformable(b.stage.GetPrimAtPath("/World/Square")).AddTranslateOp()
        shift.Set(Gf.Vec3d(0, 0, 0), 1)
        shift.Set(Gf.Vec3d(CELL, 0, 0), 2)

    render(flat(texture, change), "--aov", "alpha", "--time-code", "1", spp=64, depth=2)
    row = read_layers(tmp_path / "a.exr")["A"][SIZE[1] // 2 - 3 : SIZE[1] // 2 + 3].mean(axis=0)
    x = (np.arange(SIZE[0]) + 0.5) / SIZE[0] * 3 * CELL - 1.5 * CELL
    # A square of one cell that moves by one cell covers a point for a time that falls off like a tent.
    np.testing.assert_allclose(row, np.clip(1 - abs(x - 0.5 * CELL) / CELL, 0, 1), atol=0.06)


def test_an_albedo_map_colours_the_swatch(run, tiny, tmp_path) -> None:
    image = halves(tmp_path / "map.png", (1.0, 0.05, 0.05), (0.05, 0.05, 1.0))
    cloth = tmp_path / "mapped.usda"
    assert run("edit", tiny, "-o", cloth, "--set", f"albedo_map={image}")[0] == 0
    out = tmp_path / "a.exr"
    command = ("render", cloth, "-o", out, "--resolution", "24", "--spp", 16, "--max-depth", 6, "-q", "--overwrite")
    assert run(*command)[0] == 0
    pixels = read_image(out).pixels
    left, right = pixels[:, 2:10].reshape(-1, 3).mean(axis=0), pixels[:, 14:22].reshape(-1, 3).mean(axis=0)
    assert left[0] > 3 * left[2] and right[2] > 3 * right[0]
    image.unlink()
    code, _, err = run(*command[:-2], "--overwrite")
    assert code == 0 and "warning: " in err and "map.png does not exist" in err
    code, _, err = run(*command, "--strict")
    assert code == 2 and err.count("\n") == 1 and "map.png does not exist" in err


# --- what is wrong with a stage --------------------------------------------------------------------------------------


def _missing_texture(b: Builder) -> str:
    image = UsdShade.Shader(b.stage.GetPrimAtPath("/World/Looks/Paint/Image"))
    image.GetInput("file").Set(Sdf.AssetPath("./nowhere.png"))
    return "/World/Looks/Paint"


def _broken_texture(b: Builder) -> str:
    image = UsdShade.Shader(b.stage.GetPrimAtPath("/World/Looks/Paint/Image"))
    path = Path(image.GetInput("file").Get().path)
    path.write_bytes(b"\x89PNG but not really")
    return str(path)


def _broken_dome(b: Builder) -> str:
    path = Path(UsdShade.Shader(b.stage.GetPrimAtPath("/World/Looks/Paint/Image")).GetInput("file").Get().path)
    broken = path.with_name("sky.exr")
    broken.write_bytes(b"no picture")
    dome = b.light("DomeLight", "/World/Sky")
    dome.CreateTextureFileAttr(str(broken))
    return str(broken)


def _second_dome(b: Builder) -> str:
    image = UsdShade.Shader(b.stage.GetPrimAtPath("/World/Looks/Paint/Image")).GetInput("file").Get().path
    for path in ("/World/Sky1", "/World/Sky2"):
        b.light("DomeLight", path).CreateTextureFileAttr(image)
    return "/World/Sky2"


def _zero_area_light(b: Builder) -> str:
    b.light("RectLight", "/World/Zero").CreateWidthAttr(0.0)
    return "/World/Zero"


def _nan_transform(b: Builder) -> str:
    UsdGeom.Xformable(b.stage.GetPrimAtPath("/World/Shown")).AddTranslateOp().Set(Gf.Vec3d(float("nan"), 0, 0))
    return "/World/Shown"


def _no_area(b: Builder) -> str:
    b.sheet("/World/Point", (0, 0, 0), 0.0)
    return "/World/Point"


def _bad_index(b: Builder) -> str:
    b.mesh("/World/Torn", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 7]])
    return "/World/Torn"


def _bad_fabric(b: Builder) -> str:
    b.stage.GetPrimAtPath("/World/Looks/Red").GetAttribute("usdfab:yarn:warp:radius").Set(-1.0)
    return "/World/Looks/Red"


FAULTS = [_missing_texture, _broken_texture, _broken_dome, _second_dome, _zero_area_light]
FAULTS += [_nan_transform, _no_area, _bad_index, _bad_fabric]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__[1:])
def test_one_bad_prim_is_a_warning_or_with_strict_an_error(run, texture, tmp_path, fault) -> None:
    named = []
    stage = showroom(texture, change=lambda b: named.append(fault(b))).save(tmp_path / "stage.usda")
    out = tmp_path / "a.exr"
    command = ("render", stage, "-o", out, "--resolution", "12x8", "--spp", 2, "--max-depth", 3)
    code, _, err = run(*command)
    assert code == 0, err
    said = [line for line in err.splitlines() if named[0] in line]
    assert len(said) == 1 and said[0].startswith("warning: "), err
    assert np.isfinite(read_image(out).pixels).all() and read_image(out).pixels.mean() > 0.05
    out.unlink()
    code, _, err = run(*command, "--strict", "-q")
    assert code == 2 and err.startswith("usdfab: ") and err.count("\n") == 1 and named[0] in err, err
    assert not out.exists()


def test_cloth_whose_uv_covers_no_area_is_unwrapped(run, texture, tmp_path) -> None:
    def change(b: Builder) -> None:
        st = UsdGeom.PrimvarsAPI(b.stage.GetPrimAtPath("/World/Red")).GetPrimvar("st")
        st.Set([Gf.Vec2f(0.5, 0.5)] * 9)

    stage = showroom(texture, change=change).save(tmp_path / "stage.usda")
    command = ("render", stage, "-o", tmp_path / "a.exr", "--resolution", "36x24", "--spp", 16, "--max-depth", 5)
    code, _, err = run(*command)
    assert code == 0 and any("/World/Red" in line and "unwrapped" in line for line in err.splitlines()), err
    r, g, b = mean(read_image(tmp_path / "a.exr").pixels, 0, 0)
    assert r > 1.7 * g and r > 1.7 * b


@pytest.mark.parametrize("strict", [[], ["--strict"]])
def test_a_stage_that_cannot_be_a_picture_is_one_line(run, texture, tmp_path, strict) -> None:
    def render(builder: Builder, *arguments) -> str:
        stage = builder.save(tmp_path / "stage.usda")
        command = ("render", stage, "-o", tmp_path / "a.exr", "--resolution", "12x8", "--spp", 1, "-q")
        code, _, err = run(*command, *strict, *arguments)
        assert code == 2 and err.startswith("usdfab: ") and err.count("\n") == 1 and not (tmp_path / "a.exr").exists()
        return err

    assert "has no camera" in render(showroom(texture, change=lambda b: b.stage.RemovePrim("/World/Camera")))
    assert "/World/Nowhere" in render(showroom(texture), "--camera", "/World/Nowhere")
    assert "has no light" in render(showroom(texture, lights=()))
    empty = Builder()
    empty.camera()
    assert "mesh" in render(empty)
