"""``usdfab evaluate neural`` from the command line."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("torch")

from usdfab.neural.evaluation import SCALES, Scale
from usdfab.neural.evaluation_scenes import stages


def test_tables_pictures_and_numbers(run, tmp_path, monkeypatch):
    monkeypatch.setitem(SCALES, "draft", Scale(8, 1, 8))
    lamp = stages()[3:4]
    for module in ("evaluation", "evaluation_scenes"):  # one small weave: tables of horizons take a second for each
        monkeypatch.setattr(f"usdfab.neural.{module}.stages", lambda: lamp)
    folder = tmp_path / "out"
    code, out, err = run("evaluate", "neural", "-o", folder, "--count", 8, "--json")
    assert code == 0, err
    said = json.loads(out)
    assert len(said["rows"]) == 4 and len(said["zoom"]) == 1 and said["ablations"] == []
    assert {row["method"] for row in said["rows"]} == {"neural", "surface 1", "surface 3", "equal time"}
    assert {p.name for p in folder.iterdir()} == {"lamp.png", "zoom.png", "neural.json"}
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
