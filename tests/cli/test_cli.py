"""The command line as people and programs use it: results, talk, exit codes, nothing half-written."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from usdfab.cli.main import COMMANDS
from usdfab.fabric import PRESETS, FabricParameters, YarnParameters, weave_from_name
from usdfab.imaging import read_image, write_image
from usdfab.usd.fabric_io import read_fabric, write_fabric

SAMPLES = Path(__file__).resolve().parents[2] / "samples"


def usdfab(*arguments: object, cwd: Path | None = None, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "usdfab.cli.main", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=timeout,
        check=False,
    )


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fabric that renders fast."""
    path = tmp_path_factory.mktemp("small") / "small.usda"
    yarn = YarnParameters(count=6, radius=2e-4, fiber_count=12)
    write_fabric(FabricParameters(weave_from_name("plain"), (3e-3, 3e-3), yarn, yarn), path)
    return path


def refused(done: subprocess.CompletedProcess[str], *words: str, code: int = 2) -> None:
    """Exit code 2 or another, one line on stderr that names the words, nothing on stdout."""
    assert done.returncode == code, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("usdfab: "), done.stderr
    assert done.stdout == ""
    for word in words:
        assert word in lines[0], lines[0]


# --- help ------------------------------------------------------------------------------------------------------------


def test_help_lists_every_command_and_shows_examples() -> None:
    done = usdfab("--help")
    assert done.returncode == 0
    names = {
        "fit",
        "render",
        "merge",
        "inspect",
        "view",
        "bind",
        "expand",
        "new",
        "draft",
        "edit",
        "info",
        "check",
        "evaluate",
        "export",
        "dataset",
        "train",
    }
    assert names | {"schema"} == set(COMMANDS)
    for name in COMMANDS:
        assert name in done.stdout
        page = usdfab(name, "--help")
        assert page.returncode == 0
        assert "Usage examples" in page.stdout


def test_help_and_light_commands_load_nothing_heavy(small: Path) -> None:
    script = (
        "import sys\nfrom usdfab.cli.main import _run\n"
        "assert _run(sys.argv[1:]) == 0\n"
        "heavy = {'torch', 'mitsuba', 'drjit', 'pyvista', 'numba', 'OpenImageIO', 'distributed'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    for arguments in (["--help"], ["info", str(small)], ["render", "--help"]):
        done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_version_comes_from_one_place() -> None:
    import usdfab as package

    assert usdfab("--version").stdout.strip() == package.__version__


# --- the commands ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["denim", "twill 2/2", "1100/0110/0011/1001", "satin_rot90"])
def test_new_writes_what_info_reads(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    assert usdfab("new", kind, "-o", path, "--set", "both.fiber_count=33").returncode == 0
    done = usdfab("info", path, "--json")
    table = json.loads(done.stdout)
    assert table["schema"] == "usdfab/1"
    assert table["warp"]["fiber_count"] == table["weft"]["fiber_count"] == 33
    assert np.array_equal(table["weave"]["matrix"], read_fabric(path).weave.matrix)
    assert "picks/cm" in usdfab("info", path).stdout


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_passes_the_check(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    assert usdfab("new", name, "-o", path).returncode == 0
    done = usdfab("check", path, "--strict", "--json")
    # The yarns of dense satins are closer than they are wide.
    rules = ["usdfab:cover"] if name in ("silk-satin", "cotton-sateen") else []
    issues = json.loads(done.stdout)["issues"]
    assert [issue["rule"] for issue in issues if issue["severity"] != "info"] == rules
    assert done.returncode == (1 if rules else 0)
    assert usdfab("check", path).returncode == 0


def test_edit_changes_only_what_it_is_told(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "b.usda"
    done = usdfab("edit", small, "--set", "warp.albedo=.1,.2,.5", "--set", "weave=twill 2/2", "-o", out, "--json")
    assert json.loads(done.stdout)["fabric"]["warp"]["albedo"] == [0.1, 0.2, 0.5]
    before, after = read_fabric(small), read_fabric(out)
    assert after.weft == before.weft and after.size == before.size
    assert after.weave.classify() == "twill"


def test_check_finds_an_error_and_says_so_by_its_exit_code(tmp_path: Path, small: Path) -> None:
    path = tmp_path / "bad.usda"
    path.write_text(
        small.read_text().replace("double usdfab:yarn:warp:radius = 0.0002", "double usdfab:yarn:warp:radius = -1")
    )
    done = usdfab("check", path, "--json")
    assert done.returncode == 2
    result = json.loads(done.stdout)
    assert result["counts"]["error"] == 1 and result["exit_code"] == 2 and result["schema"] == "usdfab/1"
    assert any("radius" in issue["site"] for issue in result["issues"])


def test_schema_folder_serves_any_usd_program(small: Path) -> None:
    folder = usdfab("schema").stdout.strip()
    script = (
        "import sys\nfrom pxr import Usd\n"
        f"stage = Usd.Stage.Open({str(small)!r})\n"
        "print(stage.GetPrimAtPath('/Looks/Fabric').GetAppliedSchemas())\n"
        "assert 'usdfab' not in sys.modules\n"
    )
    environment = os.environ | {"PXR_PLUGINPATH_NAME": folder}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=True)
    assert "UsdfabFabricAPI" in done.stdout and "UsdfabYarnAPI:warp" in done.stdout


def test_render_of_a_swatch_is_the_same_on_any_number_of_threads(small: Path, tmp_path: Path) -> None:
    pictures = []
    for threads in (1, 3):
        out = tmp_path / f"{threads}.exr"
        done = usdfab("render", small, "-o", out, "--resolution", "24", "--spp", "4", "--threads", threads, "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["width"] == 24
        pictures.append(read_image(out).pixels)
    assert np.array_equal(*pictures)
    assert pictures[0].max() > 0.05
    other = tmp_path / "other.exr"
    usdfab("render", small, "-o", other, "--resolution", "24", "--spp", "4", "--seed", "1")
    assert not np.array_equal(read_image(other).pixels, pictures[0])


def test_render_of_the_drape_wearing_a_fabric(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "drape.exr"
    done = usdfab(
        "render", SAMPLES / "drape.usda", "--fabric", small, "-o", out, "--resolution", "48x36", "--spp", "4", "--aov"
    )
    assert done.returncode == 0, done.stderr
    from usdfab.imaging import read_layers

    layers = read_layers(out)
    assert {"", "albedo", "normal", "Z", "A", "variance", "samples", "uv"} <= set(layers)
    assert all(np.isfinite(layer).all() for layer in layers.values())
    assert layers[""].mean() > 0.02


def test_expand_writes_instanced_curves(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "fibers.usdc"
    done = usdfab(
        "expand", SAMPLES / "drape.usda", "--fabric", small, "-o", out,
        "--region", "0.45,0.45,0.55,0.55", "--vertices-per-segment", "8", "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["instances"] > 100 and result["prototype_curves"] > 0 and result["mode"] == "instancer"
    seams = result["seams"]
    assert 0 < seams["median"] <= seams["p99"] <= seams["largest"] and seams["p99"] < seams["yarn_width"]


def test_expand_bakes_a_region_and_draws_seams(small: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "fibers.usdc", tmp_path / "seams.png"
    cloth = (SAMPLES / "drape.usda", "--fabric", small, "-o", out, "--region", "0.45,0.45,0.47,0.47")
    done = usdfab("expand", *cloth, "--mode", "baked", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["instances"] == 0 and result["prototype_points"] > 1000 and result["seams"] is None
    done = usdfab("expand", *cloth, "--mode", "xform", "--overwrite", "--screenshot", picture, "--resolution", "80x60")
    if done.returncode == 2 and "VTK finds no OpenGL" in done.stderr:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0 and "pieces meet" in done.stderr, done.stderr
    assert len(np.unique(read_image(picture).pixels.reshape(-1, 3), axis=0)) > 50
    done = usdfab("expand", *cloth)
    assert done.returncode == 2 and "exists" in done.stderr and len(done.stderr.strip().splitlines()) == 1


def test_inspect_draws_a_picture_without_a_display(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "fibers.png"
    done = usdfab(
        "inspect", small, "--screenshot", out, "--resolution", "160x120", "--tiles", "1x1", "--color", "fiber"
    )
    if done.returncode == 2 and "VTK finds no OpenGL" in done.stderr:  # the machine's lack, said as it should be
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    assert len(np.unique(read_image(out).pixels.reshape(-1, 3), axis=0)) > 50


# --- bad input -------------------------------------------------------------------------------------------------------


def test_bad_names_and_values_end_in_one_line(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.usda"
    refused(usdfab("new", "tartan", "-o", out), "tartan", "plain", "denim")
    refused(usdfab("new", "satin 6/3", "-o", out), "satin")
    refused(usdfab("edit", small, "--set", "warp.radius=-1mm", "-o", out), "warp.radius")
    refused(usdfab("edit", small, "--set", "warp.colour=1", "-o", out), "warp.colour")
    refused(usdfab("edit", small, "--set", "nonsense", "-o", out), "NAME=VALUE")
    refused(usdfab("render", small, "-o", tmp_path / "x.gif"), ".gif")
    refused(usdfab("render", small, "-o", tmp_path / "x.png", "--resolution", "big"), "--resolution")
    refused(usdfab("render", small, "-o", tmp_path / "x.png", "--spp", "0"), "spp")
    refused(usdfab("inspect", small, "--screenshot", tmp_path / "x.png", "--tiles", "2"), "--tiles")
    refused(usdfab("nonsense"), "nonsense")
    refused(usdfab("render"), "STAGE")
    refused(usdfab("info", tmp_path / "missing.usda"), "missing.usda")
    assert list(tmp_path.iterdir()) == []


def test_existing_output_is_kept_unless_told_otherwise(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.usda"
    out.write_text("mine")
    refused(usdfab("new", "denim", "-o", out), "--overwrite")
    assert out.read_text() == "mine"
    assert usdfab("new", "denim", "-o", out, "--overwrite").returncode == 0
    assert read_fabric(out).weave.classify() == "twill"


STAGES = {
    "empty": ("", ""),
    "no mesh": ('def Xform "World" {}\ndef Camera "C" {}\ndef DomeLight "L" {}', "mesh"),
    "no uv": (
        'def Mesh "M" { int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0,1,2]\n'
        "point3f[] points = [(0,0,0),(1,0,0),(0,1,0)] }",
        "uv",
    ),
    "NaN": (
        'def Mesh "M" { int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0,1,2]\n'
        "point3f[] points = [(0,0,0),(nan,0,0),(0,1,0)]\n"
        'texCoord2f[] primvars:st = [(0,0),(1,0),(0,1)] ( interpolation = "vertex" ) }',
        "M",
    ),
}


@pytest.mark.parametrize("kind", STAGES)
def test_broken_stages_end_in_one_line(kind: str, small: Path, tmp_path: Path) -> None:
    text, _ = STAGES[kind]
    stage, out = tmp_path / "stage.usda", tmp_path / "x.png"
    stage.write_text("#usda 1.0\n" + text)
    refused(usdfab("render", stage, "--fabric", small, "-o", out), "stage.usda")
    assert not out.exists()


@pytest.mark.parametrize("kind", ["corrupt", "text", "tiny", "black", "noise", "missing", "gradient"])
def test_photos_that_show_no_cloth_end_in_one_line(kind: str, tmp_path: Path) -> None:
    photo, out = tmp_path / "photo.png", tmp_path / "fabric.usda"
    if kind == "corrupt":
        write_image(photo, np.random.default_rng(0).random((200, 200, 3)))
        photo.write_bytes(photo.read_bytes()[:5000])
    elif kind == "text":
        photo.write_text("not an image")
    elif kind != "missing":
        y, x = np.mgrid[:200, :200] / 200
        pixels = {
            "tiny": np.full((8, 8), 0.5),
            "black": np.zeros((200, 200)),
            "noise": np.random.default_rng(0).random((200, 200)),
            "gradient": 0.2 + 0.5 * x * y,
        }[kind]
        write_image(photo, np.repeat(pixels[..., None], 3, axis=2))
    # Pictures that can be read and show no woven fabric have an exit code of their own.
    code = 3 if kind in ("black", "noise", "gradient") else 2
    refused(usdfab("fit", photo, "-o", out), "photo.png", code=code)
    assert not out.exists()


def test_unwritable_output_is_found_before_the_work(tmp_path: Path, small: Path) -> None:
    refused(usdfab("render", small, "-o", tmp_path / "no" / "x.png"), "folder")
    refused(usdfab("fit", SAMPLES / "microscope.png", "-o", tmp_path / "no" / "x.usda"), "folder")


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_interrupt_ends_with_130_and_no_picture(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.png"
    arguments = ["render", str(small), "-o", str(out), "--resolution", "400", "--spp", "100000"]
    command = [sys.executable, "-m", "usdfab.cli.main", *arguments]
    # A shell's background jobs, and with them these tests, may ignore interrupts, and children inherit that.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heed) as process:
        try:
            time.sleep(15)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 130, errors
    assert "interrupted" in errors and "--resume" in errors
    assert list(tmp_path.iterdir()) == [tmp_path / "x.png.partial"]


# --- the main job ----------------------------------------------------------------------------------------------------


def test_the_main_job_on_the_sample_photo(tmp_path: Path) -> None:
    out, report = tmp_path / "fabric.usda", tmp_path / "report"
    done = usdfab(
        "fit", SAMPLES / "microscope.png", "-o", out, "--size", "4mm", "--report", report, "--report-spp", 1, "--json"
    )
    assert done.returncode == 0, done.stderr
    truth, found = read_fabric(SAMPLES / "microscope_truth.usda"), read_fabric(out)
    assert found.weave.equivalent(truth.weave)
    for system in ("warp", "weft"):
        assert found.system(system).count == pytest.approx(truth.system(system).count, rel=0.05)
        assert np.abs(np.subtract(found.system(system).albedo, truth.system(system).albedo)).mean() < 0.15
    assert found.provenance.source == "microscope.png" and "analysis" in found.provenance.stages
    result = json.loads(done.stdout)
    assert result["fabric"]["weave"]["class"] == truth.weave.classify()
    for name in ("photo", "swatch", "comparison"):
        assert (report / f"{name}.png").stat().st_size > 1000
    assert usdfab("check", out).returncode == 0
