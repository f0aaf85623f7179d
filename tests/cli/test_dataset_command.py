"""``usdfab dataset``: made in one go, in parts, killed and gone on with, always the same files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from usdfab.fit.dataset.reader import read_dataset

TINY = ("--prior", "paper", "--size", 8, "--spp", 1, "--shard", 3, "--no-denoise")

Run = Callable[..., tuple[int, str, str]]


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five samples made in one go."""
    from usdfab.cli.main import _run

    root = tmp_path_factory.mktemp("whole") / "set"
    assert _run([str(a) for a in ("dataset", "fabrics", "-o", root, "--count", 5, *TINY, "--workers", 1, "-q")]) == 0
    return root


def test_what_is_written(whole: Path, run: Run, tmp_path: Path) -> None:
    assert [stored.index for stored in read_dataset(whole)] == list(range(5))
    sheet = tmp_path / "sheet.png"
    code, out, err = run("dataset", "fabrics", "-o", whole, "--count", 5, *TINY, "--picture", sheet, "--json")
    assert (code, err) == (0, "")
    said = json.loads(out)
    assert (said["samples"], said["made"], said["asked"]) == (5, 0, 5)
    assert said["settings"]["prior"] == "paper"
    from usdfab.imaging import read_image

    # Five pictures of 8 pixels in three columns with gaps of 8.
    assert read_image(sheet).pixels.shape == (8 + 8 + 8, 3 * 8 + 2 * 8, 3)


def test_parts_make_the_same_files(whole: Path, run: Run, tmp_path: Path) -> None:
    for part in ("2/2", "1/2"):
        code, _, err = run("dataset", "fabrics", "-o", tmp_path / "set", "--count", 5, *TINY, "--part", part,
                           "--workers", 1)  # fmt: skip
        assert code == 0, err
    assert "3 of 3 samples, 3 made now" in err
    assert contents(tmp_path / "set") == contents(whole)


def test_a_killed_run_goes_on_with_nothing_lost(whole: Path, run: Run, tmp_path: Path) -> None:
    root = tmp_path / "set"
    arguments = ["dataset", "fabrics", "-o", root, "--count", 5, *TINY]
    command = [sys.executable, "-m", "usdfab.cli.main", *map(str, arguments), "--workers", "2"]
    # Its output goes nowhere: a pipe would stay open as long as a worker lives.
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not list(root.glob("loose/*.json")) and process.poll() is None:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before = {name: content for name, content in contents(root).items() if name.endswith((".json", ".tar"))}
    assert len(before) > 1
    code, out, err = run(*arguments, "--workers", 1, "--json")
    assert code == 0, err
    assert json.loads(out)["samples"] == 5
    after = contents(root)
    for name in list(after):
        if name.startswith("claims/") or "/." in name:  # of the dead; they hold nothing
            del after[name]
    assert after == contents(whole)


@pytest.mark.parametrize(
    "options,said",
    [
        (("--count", -1), "--count"),
        (("--start", 10**6), "--count"),
        (("--part", "3/2"), "--part"),
        (("--workers", 0), "--workers"),
        (("--prior", "narrow"), "--prior"),
        (("--spp", 0), "--spp"),
        (("--size", 4), "--size"),
        (("--picture", "sheet.exr"), "cannot write"),
        (("--picture-count", 0), "--picture-count"),
    ],
)
def test_bad_options_are_said_in_one_line(run: Run, tmp_path: Path, options: tuple, said: str) -> None:
    code, out, err = run("dataset", "fabrics", "-o", tmp_path / "set", *options)
    assert code == 2 and out == ""
    assert said in err and err.count("\n") == 1
    assert not (tmp_path / "set").exists()


def test_other_settings_are_refused(whole: Path, run: Run) -> None:
    code, _, err = run("dataset", "fabrics", "-o", whole, "--count", 5, *TINY, "--seed", 3)
    assert code == 2
    assert "the data set here is another one (seed 0, not 3)" in err and err.count("\n") == 1


def test_an_empty_set_has_no_picture(run: Run, tmp_path: Path) -> None:
    code, _, err = run("dataset", "fabrics", "-o", tmp_path / "set", "--count", 0, "--picture", tmp_path / "a.png")
    assert code == 2 and "no samples to draw" in err
