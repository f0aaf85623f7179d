"""``usdfab info --system``: what this machine has, also where things are missing or broken."""

from __future__ import annotations

import json
import sys

import pytest

from usdfab._version import __version__
from usdfab.mi import llvm, variant


@pytest.fixture(autouse=True)
def fresh_probes(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for function in (llvm.choose, variant.cuda_verdict):
        function.cache_clear()
    yield
    for function in (llvm.choose, variant.cuda_verdict):
        function.cache_clear()


def test_json(run):
    code, out, _ = run("info", "--system", "--json")
    facts = json.loads(out)
    assert code == 0 and facts["schema"] == "usdfab/1" and facts["usdfab"] == __version__
    assert facts["embree"]["version"].startswith("4.") and facts["embree"]["features"]["curves"]
    assert facts["usd"]["schema_registered"] and facts["threads"] >= 1
    assert facts["libraries"]["numpy"] and facts["memory"]["total_bytes"] > facts["memory"]["available_bytes"]


def test_for_people(run):
    code, out, err = run("info", "--system")
    names = [line.split("  ")[0] for line in out.splitlines() if not line.startswith(" ")]
    assert code == 0 and not err
    assert names[:6] == ["usdfab", "processor", "memory", "Embree", "Mitsuba", "LLVM"]


def test_an_unfit_llvm_is_told_and_ends_nothing(run, monkeypatch, tmp_path):
    pytest.importorskip("drjit")
    broken = tmp_path / "libLLVM.so"
    broken.write_text("no library")
    monkeypatch.setenv(llvm.VARIABLE, str(broken))
    code, out, _ = run("info", "--system", "--json")
    found = json.loads(out)["llvm"]
    assert code == 0 and found["path"] != str(broken)
    assert found["refused"][0]["path"] == str(broken) and found["refused"][0]["origin"] == llvm.VARIABLE
    assert "cannot be loaded" in found["refused"][0]["reason"]


def test_without_mitsuba(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    code, out, _ = run("info", "--system", "--json")
    found = json.loads(out)["mitsuba"]
    assert code == 0 and found["device"] is None
    assert "pip install 'usdfab[mitsuba]'" in found["reason"]


@pytest.mark.parametrize(("arguments", "words"), [((), "no file is given"), (("--system", "a.usda"), "needs no file")])
def test_a_file_or_the_system(run, arguments, words):
    code, out, err = run("info", *arguments)
    assert code == 2 and not out
    assert words in err and "usdfab info FILE or usdfab info --system" in err
