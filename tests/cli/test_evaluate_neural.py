"""``usdfab evaluate neural`` from the command line."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("torch")

from usdfab.neural.evaluation import Scale


def test_tables_pictures_and_numbers(run, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("usdfab.neural.evaluation", fromlist=["SCALES"]).SCALES, "draft", Scale(8, 1, 8))
    folder = tmp_path / "out"
    code, out, err = run("evaluate", "neural", "-o", folder, "--count", 8, "--json")
    assert code == 0, err
    said = json.loads(out)
    assert len(said["rows"]) == 5 * 4 and len(said["zoom"]) == 1 and said["ablations"] == []
    assert {row["method"] for row in said["rows"]} == {"neural", "surface 1", "surface 3", "equal time"}
    names = {"single-cloth.png", "single-cloth-twill-4x4.png", "bowl.png", "lamp.png", "sofa.png", "zoom.png"}
    assert {p.name for p in folder.iterdir()} == names | {"neural.json"}
    assert json.loads((folder / "neural.json").read_text())["rows"] == said["rows"]
    code, _, err = run("evaluate", "neural", "-o", folder, "--count", 8)
    assert code == 2 and "the file exists" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [((), "needs a folder"), (("-o", "a", "--count", 2), "2 pixels"), (("photos", "-o", "a"), "makes its own fabrics")],
)
def test_options_that_make_no_sense(run, tmp_path, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("evaluate", "neural", *options)
    assert code == 2 and not out and said in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
