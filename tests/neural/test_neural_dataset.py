"""Data sets of surface materials: what is drawn, what is kept, and what is refused."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from scipy import stats

from usdfab.cli.main import _run
from usdfab.errors import UsdfabError
from usdfab.neural.aggregation import aggregate
from usdfab.neural.dataset_draws import PAPER_WEAVES, DatasetSettings, draw_material, draw_queries, make_targets
from usdfab.neural.dataset_reader import list_materials, material_metadata, material_of, read_manifest, read_material
from usdfab.neural.dataset_store import MaterialStore, make_material, produce_materials

SMALL = DatasetSettings("both", queries=40, samples=16)
OPTIONS = ("--queries", 40, "--samples", 16, "--workers", 1, "-q")


def command(root: Path, *options: object) -> int:
    return _run([str(a) for a in ("dataset", "neural", "-o", root, *OPTIONS, *options)])


def contents(root: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(root.glob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("neural") / "set"
    assert command(root, "--materials", 3) == 0
    return root


def test_what_is_written_is_what_is_read(whole: Path) -> None:
    assert [p.name for p in list_materials(whole, "transmission")] == [
        f"transmission-0000{i}.safetensors" for i in range(3)
    ]
    for kind in ("reflection", "transmission"):
        for index, path in enumerate(list_materials(whole, kind)):
            material, queries, targets = read_material(path)
            assert material == draw_material(SMALL, index)
            assert np.array_equal(queries, draw_queries(SMALL, index, kind))
            assert np.array_equal(targets, make_targets(SMALL, index, kind)[2])
            assert np.all(queries[:, 5] > 0) == (kind == "reflection")
            truth = aggregate(material, queries, transmission=kind == "transmission", samples=1 << 14)
            # 16 samples are few; their mean over all queries is not far off.
            assert np.abs(targets - truth).mean() < 0.5 * truth.mean()
            assert targets.mean() == pytest.approx(truth.mean(), rel=0.15)
            with safe_open(path, "numpy") as file:
                about = file.metadata()
                assert set(file.keys()) == {"queries", "targets"}
            assert about["weave_name"] == PAPER_WEAVES[index] and about["kind"] == kind
    assert read_manifest(whole)["materials"] == 3


def test_metadata_keep_every_number() -> None:
    material = draw_material(SMALL, 5)
    assert material_of(material_metadata(material)) == material


def test_a_broken_off_or_longer_set_is_the_same_set(whole: Path, tmp_path: Path) -> None:
    assert command(tmp_path / "set", "--materials", 1) == 0
    one = contents(tmp_path / "set")
    assert command(tmp_path / "set", "--materials", 3) == 0
    assert contents(tmp_path / "set") == contents(whole)
    assert one.items() - contents(whole).items() == {("dataset.json", one["dataset.json"])}


def test_a_killed_run_goes_on(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    arguments = [str(a) for a in ("dataset", "neural", "-o", root, *OPTIONS, "--materials", 3)]
    process = subprocess.Popen([sys.executable, "-m", "usdfab.cli.main", *arguments])
    while not list(root.glob("*.safetensors")) and process.poll() is None:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert command(root, "--materials", 3) == 0
    there = {name: data for name, data in contents(root).items() if not name.startswith(".")}
    assert there == contents(whole)


def test_a_claimed_file_is_left_to_its_claimant(tmp_path: Path) -> None:
    store = MaterialStore(tmp_path / "set", SMALL, 1)
    with MaterialStore(tmp_path / "set", SMALL, 1).claim(1) as mine:
        assert mine
        made = produce_materials(store, 1)
    assert (made.made, made.others) == (1, 1)
    assert produce_materials(store, 1).made == 1


def test_other_settings_are_refused(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(whole, "--materials", 3, "--seed", 1) == 2
    assert "the data set here is another one (seed 0, not 1)" in capsys.readouterr().err
    assert command(whole.parent, "--materials", 3) == 2
    assert "holds other things" in capsys.readouterr().err


def test_draws_have_the_papers_distributions() -> None:
    """Table 2 of Chen et al. 2024."""
    settings = DatasetSettings(queries=4000)
    materials = [draw_material(settings, i) for i in range(210)]
    assert [m.name for m in materials[:7]] == list(PAPER_WEAVES)
    twists = np.degrees([t for m in materials for t in m.twist]).round(6)
    assert {float(t) for t in twists} == {-30.0, 0.0, 30.0}
    for values, low, high in (
        (np.degrees([u for m in materials for u in m.inclination]), 15, 45),
        ([m.roughness for m in materials], 0.1, 1.0),
        ([m.height_scale for m in materials], 0.0, 2.0),
    ):
        assert stats.kstest(values, "uniform", (low, high - low)).pvalue > 1e-3
    queries = draw_queries(settings, 3, "reflection").astype(np.float64)
    # Each column is stratified: nearer to uniform than random numbers are.
    for column in (0, 1):
        assert stats.kstest(queries[:, column], "uniform").statistic < 2 / 4000
    sizes = queries[:, 2]
    assert np.mean(sizes < 1) == 0.5 and sizes.max() > 4.99
    assert stats.kstest(sizes[sizes < 1], "uniform").statistic < 1e-3
    assert stats.kstest(sizes[sizes > 1], "uniform", (1, 4)).statistic < 1e-3
    for x, y in ((3, 4), (6, 7)):
        radius2 = queries[:, x] ** 2 + queries[:, y] ** 2
        assert stats.kstest(radius2, "uniform").statistic < 2e-3 and radius2.max() < 1
        angle = np.arctan2(queries[:, y], queries[:, x])
        assert stats.kstest(angle, "uniform", (-np.pi, 2 * np.pi)).statistic < 2e-3
    assert np.allclose(np.sum(queries[:, 3:6] ** 2, axis=1), 1, atol=1e-6)
    assert abs(np.corrcoef(queries[:, 3], queries[:, 6])[0, 1]) < 0.06


def test_bytes_depend_on_settings_and_number_only() -> None:
    a, b = (make_material(SMALL, 4, 2, "reflection").content for _ in range(2))
    assert a == b != make_material(SMALL, 4, 2, "transmission").content


@pytest.mark.parametrize(
    "options,said",
    [
        (("--materials", -1), "--materials"), (("--queries", 0), "--queries"), (("--samples", 0), "--samples"),
        (("--weaves", "tartan"), "unknown weave"), (("--twist", "a"), "--twist"), (("--twist", "95"), "--twist"),
        (("--inclination", 40, 20), "--inclination"), (("--gap", 0, 0.2), "--gap"), (("--workers", 0), "--workers"),
        (("--roughness", 0.1, 2), "--roughness"), (("--kind", "both", "--seed", -1), "--seed"),
    ],
)  # fmt: skip
def test_bad_options_are_one_line(
    options: tuple, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(tmp_path / "set", *options) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not (tmp_path / "set").exists()


def test_damaged_files_are_named(whole: Path, tmp_path: Path) -> None:
    good = list_materials(whole, "reflection")[0].read_bytes()
    for name, data in (("short", good[:-5]), ("empty", b""), ("junk", b"\x08" + b"\0" * 40)):
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(data)
        with pytest.raises(UsdfabError, match=f"{name}.*damaged"):
            read_material(path)
    other = tmp_path / "other.safetensors"
    other.write_bytes(good.replace(b"usdfab-neural-material/1", b"usdfab-neural-material/9"))
    with pytest.raises(UsdfabError, match="format"):
        read_material(other)
    rough = tmp_path / "rough.safetensors"
    rough.write_bytes(good.replace(b'"gap":"0.2"', b'"gap":"7.2"'))
    with pytest.raises(UsdfabError, match=r"rough\.safetensors: gap: 7\.2"):
        read_material(rough)
    with pytest.raises(UsdfabError, match="no such file"):
        read_material(tmp_path / "none.safetensors")
    with pytest.raises(UsdfabError, match="no data set"):
        list_materials(tmp_path, "reflection")
    (tmp_path / "dataset.json").write_text(json.dumps({"schema": "usdfab-dataset/1"}))
    with pytest.raises(UsdfabError, match="no data set of surface materials"):
        list_materials(tmp_path, "reflection")
