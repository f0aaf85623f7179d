"""Tiles in other processes and on other machines: pure tasks over ``concurrent.futures.Executor``.

A task carries the names of the files to read, not their contents: workers see the same paths. Each process reads the
scene once and keeps it. What it read must have the same fingerprint as here, so that no tile shows another scene.

``dask.distributed`` (the ``cluster`` extra) is loaded only when it is asked for.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from usdfab.cli.scene_source import SceneSource, read_textures, scene_fingerprint
from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from usdfab.tracer import Tracer
    from usdfab.tracer.accumulate import Sums
    from usdfab.tracer.render import Shot
    from usdfab.tracer.schedule import Window

RETRIES = 3
"""Times that a tile is given to another worker after its worker died."""

_lock = threading.Lock()
_kept: tuple[str, Tracer] | None = None


@dataclass(frozen=True, eq=False)
class TileJob:
    """Samples ``first`` to ``first + samples`` of a window, to be added to ``sums`` (h, w, LAYERS)."""

    source: SceneSource
    fingerprint: str
    shot: Shot
    window: Window
    first: int
    samples: int
    sums: Sums


def render_tile_task(job: TileJob) -> Sums:
    """A tile's sums with its samples added; nothing else depends on it or changes.

    Raises
    ------
    UsdfabError
        If this process reads another scene than the one that was asked for.
    """
    tracer = _tracer(job.source, job.fingerprint)
    return tracer.sample(job.shot, job.window, job.first, job.samples, job.sums)


def _tracer(source: SceneSource, wanted: str) -> Tracer:
    """The tracer of a scene, from the last call if it is the same scene. Only one is kept: scenes are large."""
    global _kept
    from usdfab.tracer import Tracer

    with _lock:  # a worker's threads ask at the same time
        if _kept is None or _kept[0] != wanted:
            _kept = None
            scene, textures = read_textures(source.read()[0], source.strict)
            if scene_fingerprint(scene, textures) != wanted:
                raise UsdfabError(
                    "a worker reads another scene here than this process does",
                    place=source.stage,
                    remedy="let all machines see the same files and run the same version of usdfab",
                )
            _kept = (wanted, Tracer(scene, textures, source.strict))
        return _kept[1]


def tracer_task(source: SceneSource, fingerprint: str) -> tuple[int, tuple[str, ...]]:
    """Fiber segments of a scene's patches and the tracer's warnings; raises early what any tile would raise."""
    tracer = _tracer(source, fingerprint)
    return tracer.segments, tracer.warnings


class ExecutorRunner:
    """``accumulate.Runner`` over any executor; ``workers`` is how many tiles it does at once."""

    def __init__(self, executor: Executor, workers: int, source: SceneSource, fingerprint: str, shot: Shot) -> None:
        self.slots = 2 * workers + 2
        self._executor, self._source, self._fingerprint, self._shot = executor, source, fingerprint, shot
        self._futures: set[Future[Sums]] = set()

    def submit(self, window: Window, first: int, samples: int, sums: Sums) -> Future[Sums]:
        job = TileJob(self._source, self._fingerprint, self._shot, window, first, samples, sums)
        future = self._executor.submit(render_tile_task, job)
        self._futures.add(future)
        return future

    def result(self, future: Future[Sums]) -> Sums:
        self._futures.discard(future)
        return self._told(future)

    def _told(self, future: Future[Any]) -> Any:
        try:
            return future.result()
        except (UsdfabError, MemoryError):
            raise
        except (CancelledError, Exception) as error:
            reason = type(error).__name__ if not str(error) else f"{type(error).__name__}: {str(error).splitlines()[0]}"
            raise UsdfabError(
                f"a tile was lost with its worker ({reason[:160]})",
                place="--scheduler",
                remedy="look at the workers' logs; --resume goes on from here",
            ) from error

    def about(self) -> tuple[int, tuple[str, ...]]:
        """Fiber segments that a worker found, and its tracer's warnings."""
        segments, warnings = self._told(self._executor.submit(tracer_task, self._source, self._fingerprint))
        return int(segments), tuple(warnings)

    def stop(self) -> None:
        for future in self._futures:
            future.cancel()
        self._futures.clear()


@contextmanager
def dask_executor(scheduler: str, workers: int | None, threads: int) -> Iterator[tuple[Executor, int]]:
    """(executor, tiles it does at once) of a Dask cluster.

    Parameters
    ----------
    scheduler:
        Its address, such as ``tcp://host:8786``, or ``local`` for processes of this machine that end with the block.
    workers:
        Processes for ``local``; two or more by default, so that one may die.
    threads:
        Threads that these processes have together.

    Raises
    ------
    UsdfabError
        If ``distributed`` is not installed or the scheduler does not answer.
    """
    try:
        import distributed
        from dask import config
    except ImportError as error:
        raise UsdfabError(
            "Dask is not installed", place="--scheduler", remedy="run: pip install 'usdfab[cluster]'"
        ) from error
    # Dask's own talk would come between ours; what goes wrong is told by results.
    with ExitStack() as stack, config.set({"distributed.scheduler.allowed-failures": RETRIES}):
        try:
            client = _client(distributed, stack, scheduler, workers, threads)
        except (OSError, TimeoutError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UsdfabError(f"cannot be reached ({reason[:160]})", place=scheduler) from error
        yield client.get_executor(pure=False), max(1, sum(client.nthreads().values()))


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """What starts in this block inherits it: Ctrl-C at a terminal goes to all its processes, and one is to answer."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _client(distributed: Any, stack: ExitStack, scheduler: str, workers: int | None, threads: int) -> Any:
    if scheduler != "local":
        client = stack.enter_context(distributed.Client(scheduler, set_as_default=False, timeout="10s"))
        client.wait_for_workers(1, timeout="60s")
        return client
    count = workers or max(2, threads // 8)
    with _interrupts_ignored():
        cluster = distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=max(1, threads // count),
            processes=True,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        )
    return stack.enter_context(distributed.Client(stack.enter_context(cluster), set_as_default=False))
