"""The whole fit: stages one after another, broken off and gone on with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw
from small_network import small_net

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, weave_from_name
from usdfab.fit import features, later_stages, path_run, path_settings, path_stage, pipeline, raster_stage
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.fit.analysis.known import Known
from usdfab.fit.course import TICKS, Course
from usdfab.fit.fit_checkpoint import CheckpointFiles
from usdfab.fit.path_settings import PathSettings
from usdfab.fit.pipeline import Fit, fit_photo
from usdfab.fit.raster_stage import StageSettings
from usdfab.fit.stages import StageOutcome
from usdfab.imaging import write_image

ALL = ("analysis", "raster", "path")
DRAWN = Cloth(weave_from_name("plain").matrix, 6, 6, size=160, rotation=0.03)
RASTER = StageSettings(width=32, supersampling=1, iterations=2, rate=0.05, levels=(1,), kind="gram")
PATH = PathSettings(side=16, iterations=3, spp=1, gradient_spp=1, levels=(1,), noise="match", threads=1)
FEW = 300


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photo") / "cloth.png"
    write_image(path, draw(DRAWN))
    return path


def make_small(folder: Path, put: object) -> None:
    """The stages at a tiny scale; ``put(object, name, value)`` sets an attribute."""
    net = small_net(folder, features.fast_dtype())
    for module in (features, raster_stage, path_stage):
        put(module, "load_features", lambda *_, **__: net)  # type: ignore[operator]
    put(raster_stage, "QUALITIES", {"draft": RASTER, "standard": replace(RASTER, iterations=3)})  # type: ignore[operator]
    put(path_settings, "QUALITIES", {"draft": PATH, "standard": PATH})  # type: ignore[operator]
    put(path_stage, "SAVE_SECONDS", 0.0)  # type: ignore[operator]


@pytest.fixture
def small(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    make_small(tmp_path_factory.mktemp("net"), monkeypatch.setattr)


def fitted(photo: Path, **more: object) -> Fit:
    # Small cloth has few fibers.
    return fit_photo(photo, 1e-3, albedo_paths=FEW, **({"stages": ALL} | more))  # type: ignore[arg-type]


# --- the order of things, with stages that only pretend ---


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch, small: None) -> Iterator[dict[str, int]]:
    """Stages that change one number each; how often each ran. Albedos are what the photo shows."""
    ran = {"analysis": 0, "raster": 0, "path": 0}

    def analysed(pixels: np.ndarray, place: str, **_: object) -> PhotoAnalysis:
        ran["analysis"] += 1
        return real_analysis()

    def moved(name: str, fabric: FabricParameters, twist: float, distance: float) -> StageOutcome:
        ran[name] += 1
        warp = replace(fabric.warp, twist=fabric.warp.twist + twist)
        return StageOutcome(
            name, replace(fabric, warp=warp), 1.0, (2.0, float("nan"), 1.0), distance, (f"{name} ran",),
            halfway=fabric if name == "raster" else None, uncertainty={"warp.ior": 0.1},
        )  # fmt: skip

    def raster(start: FabricParameters, *_: object, **how: object) -> tuple[StageOutcome, StageOutcome]:
        return StageOutcome("analysis", start, 0.0, distance=0.9), moved("raster", start, 0.01, 0.7)

    def path(start: FabricParameters, *_: object, **how: object) -> tuple[float, StageOutcome]:
        return float(how["distance"] or 0.9), moved("path", start, 0.02, 0.5)  # type: ignore[arg-type]

    monkeypatch.setattr(pipeline, "analyze_photo", analysed)
    monkeypatch.setattr(pipeline, "brightness_curves", lambda *_, **__: {})
    monkeypatch.setattr(pipeline, "photo_exposure", lambda *_: 1.0)
    monkeypatch.setattr(pipeline, "with_inverted_albedo_and_light", lambda shown, *_, **__: (shown, 1.0, ("dyed",)))
    monkeypatch.setattr(later_stages, "run_raster", raster)
    monkeypatch.setattr(path_run, "run_path", path)
    yield ran


@cache
def real_analysis() -> PhotoAnalysis:
    return analyze_photo(draw(DRAWN))


def test_each_stage_starts_from_the_one_before(pretended: dict[str, int], photo: Path) -> None:
    fit = fitted(photo)
    assert [stage.name for stage in fit.stages] == list(ALL)
    assert [stage.distance for stage in fit.stages] == [0.9, 0.7, 0.5]
    twists = [stage.fabric.warp.twist for stage in fit.stages]
    np.testing.assert_allclose(np.diff(twists), [0.01, 0.02])
    assert fit.fabric.warp == fit.stages[-1].fabric.warp
    assert fit.fabric.provenance.stages == ALL
    assert {"raster ran", "path ran"} <= set(fit.warnings)
    alone = fitted(photo, stages=("analysis", "path"))
    assert [stage.name for stage in alone.stages] == ["analysis", "path"]
    assert alone.fabric.warp.twist == pytest.approx(twists[0] + 0.02)


def test_finished_stages_are_taken_over_bit_for_bit(pretended: dict[str, int], photo: Path, tmp_path: Path) -> None:
    files = CheckpointFiles(tmp_path / "out.usda")
    whole = fitted(photo, checkpoint=files)
    assert [file.name for file in files.existing()] == ["out.usda.fit.json"]
    again = fitted(photo, checkpoint=files, resume=True)
    assert pretended == {"analysis": 1, "raster": 1, "path": 1}
    assert again.fabric == whole.fabric
    assert again.warnings == whole.warnings
    for a, b in zip(again.stages, whole.stages, strict=True):
        assert replace(a, losses=()) == replace(b, losses=())
        np.testing.assert_array_equal(a.losses, b.losses)
    assert again.analysis.weave == whole.analysis.weave
    np.testing.assert_array_equal(again.analysis.warp.yarn_colours, whole.analysis.warp.yarn_colours)
    # One more iteration of the raster stage: that stage and what follows from it run again, the analysis does not.
    longer = fitted(photo, checkpoint=files, resume=True, quality="standard")
    assert pretended == {"analysis": 1, "raster": 2, "path": 2}
    assert longer.fabric.warp == whole.fabric.warp
    # Without --resume all is done again.
    fitted(photo, checkpoint=files)
    assert pretended == {"analysis": 2, "raster": 3, "path": 3}


@pytest.mark.parametrize("stage", ["raster", "path"])
def test_a_stage_that_breaks_leaves_those_before_it(
    stage: str, pretended: dict[str, int], photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fitted(photo)
    files = CheckpointFiles(tmp_path / "out.usda")
    module, name = (later_stages, "run_raster") if stage == "raster" else (path_run, "run_path")
    works = getattr(module, name)

    def breaks(*_: object, **__: object) -> None:
        raise MemoryError("broken")

    monkeypatch.setattr(module, name, breaks)
    with pytest.raises(MemoryError):
        fitted(photo, checkpoint=files)
    monkeypatch.setattr(module, name, works)
    before = dict(pretended)
    again = fitted(photo, checkpoint=files, resume=True)
    assert again.fabric == whole.fabric
    assert pretended["analysis"] == before["analysis"]
    assert pretended["raster"] == before["raster"] + (stage == "raster")


def test_a_stage_added_before_an_unfinished_one(pretended: dict[str, int], photo: Path, tmp_path: Path) -> None:
    """What is left of the path stage belongs to another start then: it is not looked at."""
    files = CheckpointFiles(tmp_path / "out.usda")
    fitted(photo, checkpoint=files, stages=("analysis",))
    files.of("path").write_bytes(b"left over")
    assert fitted(photo, checkpoint=files, resume=True).fabric == fitted(photo).fabric
    assert pretended["raster"] == 2 and not files.of("path").exists()


@pytest.mark.parametrize("stage", ["raster", "path"])
def test_ctrl_c_keeps_the_best_so_far(
    stage: str, pretended: dict[str, int], photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    module, name = (later_stages, "run_raster") if stage == "raster" else (path_run, "run_path")
    works = getattr(module, name)
    monkeypatch.setattr(module, name, stopped)
    files = CheckpointFiles(tmp_path / "out.usda")
    fit = fitted(photo, checkpoint=files)
    assert [s.interrupted for s in fit.stages] == [False] * (len(fit.stages) - 1) + [True]
    assert fit.stages[-1].name == stage
    assert fit.fabric.warp == fit.stages[-2].fabric.warp
    assert any(f"{stage} stage was interrupted" in warning for warning in fit.warnings)
    monkeypatch.setattr(module, name, works)
    assert fitted(photo, checkpoint=files, resume=True).fabric == fitted(photo).fabric


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seed": 1}, "seed"),
        ({"pixel_size": 2e-5}, "size"),
        ({"crop": lambda w, h: (0, 0, w, h - 20)}, "crop"),
        ({"known": Known(counts=(9.0, 9.0))}, "known"),
    ],
)
def test_a_foreign_checkpoint_is_refused(
    changes: dict, named: str, pretended: dict[str, int], photo: Path, tmp_path: Path
) -> None:
    files = CheckpointFiles(tmp_path / "out.usda")
    fit_photo(photo, 3e-3, albedo_paths=FEW, checkpoint=files)
    options: dict = {"width": None if "pixel_size" in changes else 3e-3} | changes
    with pytest.raises(UsdfabError, match=f"differs in: .*{named}") as caught:
        fit_photo(photo, albedo_paths=FEW, checkpoint=files, resume=True, **options)
    assert caught.value.place == str(files.fit)
    other = tmp_path / "other.png"
    write_image(other, draw(replace(DRAWN, seed=1)))
    with pytest.raises(UsdfabError, match="differs in: photo"):
        fit_photo(other, 3e-3, albedo_paths=FEW, checkpoint=files, resume=True)


def test_a_damaged_checkpoint_is_one_line(pretended: dict[str, int], photo: Path, tmp_path: Path) -> None:
    files = CheckpointFiles(tmp_path / "out.usda")
    fitted(photo, checkpoint=files, stages=("analysis",))
    whole = json.loads(files.fit.read_text())
    broken = [
        "", "{", "[]", "null", json.dumps(whole | {"format": "other/1"}), json.dumps(whole | {"stages": [3]}),
        json.dumps(whole | {"analysis": {}}), json.dumps(whole | {"shown": whole["shown"] | {"size_m": [-1, 1]}}),
    ]  # fmt: skip
    for text in broken:
        files.fit.write_text(text)
        with pytest.raises(UsdfabError, match="this is no unfinished fit of this version, or it is damaged") as caught:
            fitted(photo, checkpoint=files, resume=True)
        assert "\n" not in str(caught.value)


def test_progress_is_one_count_that_only_rises(pretended: dict[str, int], photo: Path) -> None:
    seen: list[int] = []
    course = Course(lambda _, done, total: seen.append(done) or seen.append(total), {"a": 1.0, "b": 3.0})  # type: ignore[func-returns-value]
    first = course.stage("a")
    for done in (1, 2):
        first("x", done, 2)
    course.finish("a")
    second = course.stage("b")
    for done in (6, 7, 8, 10):  # gone on with after five
        second("y", done, 10)
    assert set(seen[1::2]) == {TICKS}
    assert seen[::2] == [125 * k for k in (1, 2)] + [250 + 750 * k // 5 for k in (1, 2, 3, 5)]
    told: list[tuple[str, int, int]] = []
    fit_photo(photo, 3e-3, 0 or None, 0, lambda *step: told.append(step), FEW, stages=ALL)
    counts = [done for _, done, _ in told]
    assert counts == sorted(counts) and counts[-1] <= TICKS


# --- the stages themselves, at a tiny scale ---


@pytest.fixture(scope="module")
def undisturbed(photo: Path, tmp_path_factory: pytest.TempPathFactory) -> Fit:
    with pytest.MonkeyPatch.context() as patch:
        make_small(tmp_path_factory.mktemp("net"), patch.setattr)
        return fitted(photo)


@pytest.mark.slow
def test_all_stages_run_and_none_makes_it_worse(undisturbed: Fit) -> None:
    distances = [stage.distance for stage in undisturbed.stages]
    assert None not in distances and distances == sorted(distances, reverse=True)
    assert [len(stage.losses) for stage in undisturbed.stages] == [0, RASTER.iterations, PATH.iterations]
    assert undisturbed.fabric.provenance.stages == ALL


@pytest.mark.slow
@pytest.mark.parametrize("when", ["measuring albedo", "raster, loss", "judging the raster", "path, loss"])
def test_killed_in_any_stage(
    when: str, undisturbed: Fit, photo: Path, small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = textwrap.dedent("""
        import os, signal, sys
        sys.path.insert(0, sys.argv[1])
        from pathlib import Path
        from test_fit_resume import CheckpointFiles, fitted, make_small

        photo, folder, when = Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4]
        make_small(folder, setattr)
        seen = []
        def kill(text, done, of):
            if text.startswith(when):
                seen.append(text)
            if len(seen) == 2 or when.startswith("judging") and seen:
                os.kill(os.getpid(), signal.SIGKILL)
        fitted(photo, checkpoint=CheckpointFiles(folder / "out.usda"), progress=kill)
    """)
    command = [sys.executable, "-c", script, str(Path(__file__).parent), str(photo), str(tmp_path), when]
    done = subprocess.run(command, capture_output=True, check=False, env=os.environ)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    files = CheckpointFiles(tmp_path / "out.usda")
    assert files.fit.exists() == (when != "measuring albedo")
    if files.fit.exists():
        monkeypatch.setattr(pipeline, "analyze_photo", lambda *_, **__: pytest.fail("the analysis is finished"))
    again = fitted(photo, checkpoint=files, resume=True)
    assert again.fabric == undisturbed.fabric
    assert again.warnings == undisturbed.warnings
    for a, b in zip(again.stages, undisturbed.stages, strict=True):
        np.testing.assert_array_equal(a.losses, b.losses)
        assert a.distance == b.distance


@pytest.mark.slow
def test_ctrl_c_between_iterations_of_the_path_stage(photo: Path, small: None, tmp_path: Path) -> None:
    def stop(text: str, done: int, of: int) -> None:
        if text.startswith("path, loss"):
            raise KeyboardInterrupt

    files = CheckpointFiles(tmp_path / "out.usda")
    fit = fitted(photo, checkpoint=files, progress=stop)
    assert fit.stages[-1].interrupted and len(fit.stages[-1].losses) == 1
    assert any("interrupted after 1 iterations" in warning for warning in fit.warnings)
    assert fitted(photo, checkpoint=files, resume=True).stages[-1].interrupted is False
