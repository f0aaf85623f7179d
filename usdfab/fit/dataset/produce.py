"""Making many samples, here or elsewhere, and keeping what is finished."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait as wait_for

from usdfab.errors import UsdfabError
from usdfab.fit.dataset.render import Rendered, render_sample
from usdfab.fit.dataset.settings import Settings
from usdfab.fit.dataset.store import Store

Progress = Callable[[int, int], None]
"""Called with (samples that are there, samples asked for)."""


@dataclass(frozen=True)
class Produced:
    """What a run did: samples ``made`` by it, ``there`` before, and left to ``others`` that are making them.

    ``seconds`` on the clock and ``cpu_seconds`` of those made.
    """

    made: int
    there: int
    others: int
    seconds: float
    cpu_seconds: float

    @property
    def per_hour(self) -> float:
        """Images per hour of this run; 0 if it made none."""
        return 3600.0 * self.made / self.seconds if self.made and self.seconds > 0 else 0.0


def produce(
    store: Store, indices: Iterable[int], executor: Executor | None = None, slots: int = 1,
    progress: Progress | None = None,
) -> Produced:  # fmt: skip
    """Make all samples that are missing and that no other process is making.

    Parameters
    ----------
    executor, slots:
        Who renders, and how many samples at once; None: this thread.
    progress:
        Told after each sample.

    Raises
    ------
    UsdfabError
        If the disk refuses or a worker dies. Finished samples are kept; the same call goes on.
    """
    wanted = list(indices)
    missing = store.missing(wanted)
    there, made, others, cpu = len(wanted) - len(missing), 0, 0, 0.0
    begun = time.perf_counter()
    if progress:
        progress(there, len(wanted))
    waiting = iter(missing)
    running: dict[Future[Rendered], ExitStack] = {}
    try:
        while True:
            while len(running) < slots and (index := next(waiting, None)) is not None:
                stack = ExitStack()
                if not stack.enter_context(store.claim(index)):
                    stack.close()
                    # Somebody has it; if it is finished by now, it counts as there.
                    if store.is_finished(index):
                        there += 1
                    else:
                        others += 1
                    continue
                running[_submit(executor, store.settings, index)] = stack
            if not running:
                return Produced(made, there, others, time.perf_counter() - begun, cpu)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                with running.pop(future):
                    rendered = _result(future)
                    store.commit(rendered.index, rendered.record, rendered.image)
                made, cpu = made + 1, cpu + rendered.seconds
                if progress:
                    progress(there + made, len(wanted))
    finally:
        for future, stack in running.items():
            future.cancel()
            stack.close()


def _submit(executor: Executor | None, settings: Settings, index: int) -> Future[Rendered]:
    if executor is not None:
        return executor.submit(render_sample, settings, index)
    future: Future[Rendered] = Future()
    future.set_result(render_sample(settings, index))
    return future


def _result(future: Future[Rendered]) -> Rendered:
    try:
        return future.result()
    except (UsdfabError, MemoryError):
        raise
    except (BrokenExecutor, CancelledError, Exception) as error:
        # A cluster has exceptions of its own for workers that went away; all others are errors of ours.
        if not isinstance(error, BrokenExecutor | CancelledError) and "distributed" not in type(error).__module__:
            raise
        raise UsdfabError(
            "a worker died (killed, or out of memory)",
            remedy="run the same command again; finished samples are kept",
        ) from error


@contextmanager
def local_workers(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes of this machine that end with the block, and with this process if it is killed."""
    # Not forked: threads of compiled libraries do not survive that.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, initializer=_follow_parent)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _follow_parent() -> None:
    """Make this process end when its parent does, and leave Ctrl-C to the parent."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait_for([sentinel])
    os._exit(1)
