"""Tiles in other threads, processes and machines: the same picture, also when a worker dies."""

from __future__ import annotations

import builtins
import os
import pickle
import signal
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from usdfab.cli import cluster
from usdfab.cli.cluster import ExecutorRunner, TileJob, dask_executor, render_tile_task
from usdfab.cli.scene_source import SceneSource, scene_fingerprint
from usdfab.errors import UsdfabError
from usdfab.imaging import read_layers
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.accumulate import accumulate
from usdfab.tracer.render import develop, start
from usdfab.tracer.schedule import LAYERS

SETTINGS = RenderSettings((64, 50), spp=5, max_depth=4)


@pytest.fixture(scope="module")
def shot(tiny: Path):
    source = SceneSource(str(tiny))
    scene, _ = source.read()
    return source, scene, scene_fingerprint(scene, {})


def same_as_threads(scene, work) -> bool:
    camera = scene.cameras[0]
    alone = Tracer(scene).render(camera, SETTINGS)
    render = develop(work, alone.region, alone.size, camera.exposure, 0.0, alone.patch_segments)
    arrays = [name for name, value in vars(alone).items() if isinstance(value, np.ndarray)]
    return all(np.array_equal(getattr(alone, name), getattr(render, name)) for name in arrays)


def test_tasks_make_the_same_picture_and_read_the_scene_once(shot, monkeypatch) -> None:
    source, scene, wanted = shot
    made = []

    class Counted(Tracer):
        def __init__(self, *arguments) -> None:
            made.append(threading.get_ident())
            super().__init__(*arguments)

    monkeypatch.setattr("usdfab.tracer.Tracer", Counted)
    monkeypatch.setattr(cluster, "_kept", None)
    about, work = start(scene.cameras[0], SETTINGS)
    with ThreadPoolExecutor(3) as executor:
        runner = ExecutorRunner(executor, 3, source, wanted, about)
        accumulate(work, runner, SETTINGS.spp)
        segments, warnings = runner.about()
        assert segments > 0 and warnings == ()
    assert len(made) == 1
    assert same_as_threads(scene, work)


def test_jobs_and_errors_survive_the_journey(shot) -> None:
    source, scene, wanted = shot
    about, _ = start(scene.cameras[0], SETTINGS)
    job = TileJob(source, wanted, about, (0, 0, 4, 4), 0, 1, np.zeros((4, 4, LAYERS)))
    again = pickle.loads(pickle.dumps(job))
    np.testing.assert_array_equal(render_tile_task(again), render_tile_task(job))
    assert not job.sums.any()
    error = pickle.loads(pickle.dumps(UsdfabError("bad", place="a", remedy="b")))
    assert (str(error), error.place) == ("a: bad; b", "a")


def test_a_worker_that_reads_another_scene_is_refused(shot) -> None:
    source, scene, _ = shot
    about, work = start(scene.cameras[0], SETTINGS)
    with ThreadPoolExecutor(1) as executor, pytest.raises(UsdfabError, match="a worker reads another scene"):
        accumulate(work, ExecutorRunner(executor, 1, source, "something else", about), 1)


def test_what_goes_wrong_in_a_worker_is_one_line(shot) -> None:
    source, scene, wanted = shot
    about, work = start(scene.cameras[0], SETTINGS)

    class Broken(ThreadPoolExecutor):
        def submit(self, *_):
            future: Future = Future()
            future.set_exception(RuntimeError("the worker\nwent away"))
            return future

    with pytest.raises(UsdfabError, match=r"lost with its worker \(RuntimeError: the worker\)") as caught:
        accumulate(work, ExecutorRunner(Broken(1), 1, source, wanted, about), 1)
    assert "\n" not in str(caught.value)


def test_missing_dask_and_absent_schedulers_are_said(monkeypatch) -> None:
    with pytest.raises(UsdfabError, match="nonsense: cannot be reached"), dask_executor("nonsense", None, 1):
        raise AssertionError
    real = builtins.__import__

    def without(name, *rest):
        if name == "distributed":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UsdfabError, match=r"pip install 'usdfab\[cluster\]'"), dask_executor("local", None, 1):
        raise AssertionError


@pytest.mark.slow
def test_embedded_workers_make_the_same_picture_also_when_one_dies(shot) -> None:
    source, scene, wanted = shot
    about, work = start(scene.cameras[0], SETTINGS)
    with dask_executor("local", 2, 2) as (executor, slots):
        assert slots == 2
        victim = next(iter(executor._client.run(os.getpid).values()))
        runner = ExecutorRunner(executor, slots, source, wanted, about)
        calls = []

        def kill(done: int, total: int) -> None:
            calls.append(done)
            if len(calls) == 20:
                os.kill(victim, signal.SIGKILL)

        accumulate(work, runner, SETTINGS.spp, progress=kill)
        assert victim not in executor._client.run(os.getpid).values()
    assert len(calls) > 20
    assert same_as_threads(scene, work)


@pytest.mark.slow
def test_the_command_with_workers(run, tiny: Path, tmp_path: Path) -> None:
    common = ("--resolution", "40", "--spp", "3", "-q", "--aov", "--noise", "0.1")
    for name, extra in (("a.exr", ()), ("b.exr", ("--workers", "2")), ("c.exr", ("--scheduler", "local"))):
        code, _, err = run("render", tiny, "-o", tmp_path / name, *common, *extra)
        assert code == 0 and err == "", err
    first, *others = (read_layers(tmp_path / f"{name}.exr") for name in "abc")
    for other in others:
        for name, values in first.items():
            np.testing.assert_array_equal(values, other[name], err_msg=name)
