"""Choosing LLVM: unfit libraries are refused with a reason, never loaded here, and remembered."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from usdfab.errors import UsdfabError
from usdfab.mi import llvm, variant, verdicts
from usdfab.mi.llvm import Library
from usdfab.mi.verdicts import Verdict, judged, remembered_probe
from usdfab.tracer.embree import library as embree_library

pytestmark = pytest.mark.usefixtures("fresh_probes")


def no_llvm() -> str:
    """A shared library that is no LLVM."""
    return embree_library()._name


def compiled(folder: Path, source: str) -> str:
    """A shared library from C source."""
    compiler = shutil.which("cc")
    if compiler is None or sys.platform == "win32":
        pytest.skip("no C compiler")
    (folder / "fake.c").write_text(source)
    target = folder / "libLLVM-99.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", target, folder / "fake.c"], check=True)
    return str(target)


VERSION = (
    "void LLVMContextCreate() {} void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c) { *a = %s; *b = *c = 1; }"
)


def test_what_is_no_library_is_refused(tmp_path):
    text = tmp_path / "libLLVM.so"
    text.write_text("not a library\n")
    missing, folder = str(tmp_path / "missing.so"), str(tmp_path)
    expected = {str(text): "cannot be loaded", missing: "does not exist", folder: "is no file", no_llvm(): "is no LLVM"}
    for path, reason in expected.items():
        verdict = llvm.try_library(Library(path, "test"))
        assert not verdict.fit and reason in verdict.reason, path


def test_old_versions_are_refused(tmp_path):
    verdict = llvm.try_library(Library(compiled(tmp_path, "void LLVMContextCreate() {}"), "test"))
    assert verdict == Verdict(False, "15 or older", "LLVM 16 or newer is needed")
    path = compiled(tmp_path, VERSION % 15 + " int newer_file;")
    verdict = llvm.try_library(Library(path, "test"))
    assert verdict == Verdict(False, "15.1.1", "LLVM 16 or newer is needed")


def test_a_library_that_lacks_what_drjit_needs_is_refused(tmp_path):
    pytest.importorskip("drjit")
    verdict = llvm.try_library(Library(compiled(tmp_path, VERSION % 99), "test"))
    assert verdict == Verdict(False, "99.1.1", "Dr.Jit does not take it")


def test_a_library_that_ends_the_process_is_refused(tmp_path):
    source = "#include <stdio.h>\n#include <stdlib.h>\n__attribute__((constructor)) static void die() "
    path = compiled(tmp_path, source + '{ fputs("LLVM ERROR: Cannot select\\n", stderr); abort(); }')
    verdict = llvm.try_library(Library(path, "test"))
    assert verdict == Verdict(False, "", "ends the process with SIGABRT (LLVM ERROR: Cannot select)")


@pytest.mark.parametrize(
    ("stdout", "stderr", "code", "expected"),
    [
        ('{"version": "19.1.7"}\n{"fit": true}\n', "warning", 0, Verdict(True, "19.1.7")),
        # It works but dies at the end: not fit.
        ('{"version": "19.1.7"}\n{"fit": true}\n', "", -11, Verdict(False, "19.1.7", "ends the process with SIGSEGV")),
        # Out of memory says nothing of the library.
        ('{"version": "19.1.7"}\n', "", -9, Verdict(False, "19.1.7", "ends the process with SIGKILL", False)),
        ("nonsense\n[1]\n", "Traceback\nOSError: x", 1, Verdict(False, "", "fails (OSError: x)", False)),
    ],
)  # fmt: skip
def test_judging_a_probe(stdout, stderr, code, expected):
    assert judged(stdout, stderr, code) == expected


class Counted:
    """Stands in for the probe and counts its runs."""

    def __init__(self, verdict):
        self.verdict, self.runs = verdict, 0

    def __call__(self, arguments):
        self.runs += 1
        return self.verdict


@pytest.mark.parametrize("verdict", [Verdict(True, "19.1.7"), Verdict(False, "", "cannot be loaded")])
def test_verdicts_are_remembered_until_the_file_changes(monkeypatch, tmp_path, verdict):
    probe = Counted(verdict)
    monkeypatch.setattr(verdicts, "probe", probe)
    path = tmp_path / "libLLVM.so"
    path.write_text("1")
    for _ in range(3):
        assert llvm.try_library(Library(str(path), "test")) == verdict
    assert probe.runs == 1
    os.utime(path, (1, 1))
    llvm.try_library(Library(str(path), "test"))
    assert probe.runs == 2


def test_what_may_not_last_is_not_remembered(monkeypatch):
    probe = Counted(Verdict(False, reason="gave no answer", lasting=False))
    monkeypatch.setattr(verdicts, "probe", probe)
    for _ in range(2):
        remembered_probe(("llvm", "x"), (1,))
    assert probe.runs == 2


def test_a_cache_that_cannot_be_used_costs_only_the_probe(monkeypatch, tmp_path):
    probe = Counted(Verdict(True, "19.1.7"))
    monkeypatch.setattr(verdicts, "probe", probe)
    occupied = tmp_path / "file"
    occupied.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(occupied))
    monkeypatch.setenv("LOCALAPPDATA", str(occupied))
    for _ in range(2):
        assert remembered_probe(("llvm", "x"), (1,)) == probe.verdict
    assert probe.runs == 2


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"fit": true}', "\x00"])
def test_damaged_memories_are_ignored(monkeypatch, damage):
    probe = Counted(Verdict(True, "19.1.7"))
    monkeypatch.setattr(verdicts, "probe", probe)
    remembered_probe(("llvm", "x"), (1,))
    (file,) = verdicts.cache_folder().iterdir()
    assert json.loads(file.read_text())["probe"] == ["llvm", "x"]
    file.write_text(damage)
    assert remembered_probe(("llvm", "x"), (1,)) == probe.verdict
    assert probe.runs == 2


def test_the_first_that_fits_is_taken(monkeypatch):
    fit = {"/a": Verdict(False, "15 or older", "LLVM 16 or newer is needed"), "/b": Verdict(True, "19.1.7")}
    monkeypatch.setattr(llvm, "try_library", lambda library: fit[library.path])
    choice = llvm.first_fit(Library(path, "system") for path in ("/a", "/b", "/c"))
    assert choice.library == Library("/b", "system")
    assert choice.refusals == "/a LLVM 16 or newer is needed"


def test_the_variable_comes_first_and_a_file_only_once(monkeypatch, tmp_path):
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1"):
        (tmp_path / name).write_text("")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.19.1")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    monkeypatch.setenv(llvm.VARIABLE, "/mine.so")
    found = [Path(library.path).name for library in llvm.candidates()]
    assert found[0] == "mine.so"
    assert found.count("libLLVM.so.19.1") == 1 and "libLLVM.so" not in found
    assert found.index("libLLVM.so.19.1") < found.index("libLLVM-15.so.1"), "newest first"


@pytest.mark.parametrize("linked", [True, False])
def test_libcxx_is_loaded_first_where_its_links_are_missing(monkeypatch, tmp_path, linked):
    names = ["lib/libLLVM.so.23.1", *(f"lib/x86/{n}.so.1.0" for n in ("libc++", "libc++abi", "libunwind"))]
    (tmp_path / "lib/x86").mkdir(parents=True)
    for name in names:
        (tmp_path / name).write_text("")
        if linked:
            (tmp_path / name[:-2]).symlink_to(tmp_path / name)

    class File(str):
        def locate(self):
            return tmp_path / self

    monkeypatch.setattr(importlib.metadata, "files", lambda package: [File(name) for name in names])
    (library,) = (found for found in llvm.candidates() if found.origin == llvm.PACKAGE)
    assert library.path == str((tmp_path / names[0]).resolve())
    order = [] if linked else ["libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0"]
    assert [Path(path).name for path in library.preload] == order


def test_devices(monkeypatch):
    with pytest.raises(UsdfabError, match="there is no 'gpu'; choose auto, llvm"):
        variant.load("gpu")
    monkeypatch.setattr(variant, "cuda_driver", lambda: "")
    with pytest.raises(UsdfabError, match="--device cuda: CUDA cannot be used: there is no NVIDIA driver; use llvm"):
        variant.load("cuda")
    assert variant.resolve_device("scalar") == "scalar"


def test_nothing_fits(monkeypatch):
    monkeypatch.setattr(variant, "cuda_driver", lambda: "")
    refused = llvm.Tried(Library("/old.so", "system"), Verdict(False, "15", "LLVM 16 or newer is needed"))
    monkeypatch.setattr(llvm, "first_fit", lambda libraries: llvm.Choice(None, (refused,)))
    with pytest.raises(UsdfabError, match=r"/old.so LLVM 16 or newer.*pip install 'usdfab\[mitsuba\]'"):
        variant.load()


@pytest.mark.parametrize("missing", ["mitsuba", "drjit"])
def test_without_mitsuba(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UsdfabError, match=rf"needs {missing}, which is not installed; run: pip install 'usdfab\[mi"):
        variant.load("scalar")


def test_llvm_works_where_there_is_one():
    pytest.importorskip("mitsuba")
    if llvm.choose().library is None:
        pytest.skip(f"no LLVM here: {llvm.choose().refusals}")
    # In a process of its own: other tests may have set another variant, or started Dr.Jit.
    code = "from usdfab.mi.variant import load; mi = load('llvm'); print(mi.variant(), mi.Float([1, 2]) + 1)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split(maxsplit=1) == ["llvm_ad_rgb", "[2, 3]\n"]


def test_drjit_that_others_imported_with_another_library_is_refused():
    pytest.importorskip("mitsuba")
    choice = llvm.choose()
    if choice.library is None:
        pytest.skip(f"no LLVM here: {choice.refusals}")
    code = (
        "import drjit\nfrom usdfab.mi.variant import load\n"
        "try:\n    print(load('llvm').Float([1]) + 1)\nexcept Exception as error:\n    print(error)\n"
    )
    # Dr.Jit does not try another file where this one is no library.
    for path, expected in ((choice.library.path, "[2]"), (__file__, "Dr.Jit was imported without LLVM")):
        environment = os.environ | {llvm.VARIABLE: path}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
        assert expected in done.stdout, done.stdout
