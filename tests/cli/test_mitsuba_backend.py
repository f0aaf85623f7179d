"""``usdfab render --backend mitsuba``: the same files and options where they make sense, clear words where not."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from usdfab.imaging import read_image
from usdfab.mi import variant

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
    [("--noise", 0.1), ("--time", 0), ("--frames", "1-2"), ("--tile", "1/2"), ("--workers", 2), ("--resume",),
     ("--aov",), ("--denoise",), ("--scheduler", "local")],
)  # fmt: skip
def test_options_that_make_no_sense_there(run, tiny, tmp_path, options):
    code, out, err = run("render", tiny, "-o", tmp_path / "a.exr", *SMALL, *options)
    assert code == 2 and not out
    assert err == f"usdfab: {options[0]}: the Mitsuba backend has no such option; use --backend embree\n"


def test_what_cannot_be(run, tiny, tmp_path, monkeypatch):
    target = tmp_path / "a.exr"
    more = ("-o", target, "--resolution", 8, "--spp", 1)
    assert "choose embree or mitsuba" in run("render", tiny, *more, "--backend", "arnold")[2]
    assert "is for --backend mitsuba" in run("render", tiny, *more, "--device", "llvm")[2]
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
