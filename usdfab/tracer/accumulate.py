"""Passes over a picture until samples, noise or time say that it is done, whoever does the work."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from usdfab.tracer.schedule import Window, Work, next_count

Sums = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with (work done, work to do), in tiles times samples per pixel."""
Save = Callable[[Work, bool], None]
"""Called after every tile, with False: may save; and with True when the render is about to end early: must save."""
Sample = Callable[[Window, int, int, Sums], Sums]
"""``sample(window, first, samples, sums)``: a tile's sums (h, w, LAYERS) with further samples added."""
_Running = dict[Future[Sums], int]


class Runner(Protocol):
    """Does ``Sample`` somewhere. ``slots`` is how many tiles keep all its workers busy."""

    slots: int

    def submit(self, window: Window, first: int, samples: int, sums: Sums) -> Future[Sums]:
        """Begin a tile."""
        ...

    def result(self, future: Future[Sums]) -> Sums:
        """What became of a tile; ``UsdfabError`` where its worker is to blame."""
        ...

    def stop(self) -> None:
        """Drop what waits; return when nothing runs any more."""
        ...


class ThreadRunner:
    """Threads of this process. The kernel lets go of Python's lock."""

    def __init__(self, sample: Sample, threads: int) -> None:
        self.slots = 2 * threads + 2
        self._pool = ThreadPoolExecutor(threads)
        self._sample = sample

    def submit(self, window: Window, first: int, samples: int, sums: Sums) -> Future[Sums]:
        return self._pool.submit(self._sample, window, first, samples, sums)

    def result(self, future: Future[Sums]) -> Sums:
        return future.result()

    def stop(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> ThreadRunner:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def accumulate(
    work: Work,
    runner: Runner,
    spp: int,
    *,
    noise: float | None = None,
    gain: float = 1.0,
    time_limit: float | None = None,
    progress: Progress | None = None,
    save: Save | None = None,
) -> float:
    """Add samples to ``work`` until every tile has what it needs. Returns the seconds it took.

    After an exception, Ctrl-C included, ``work`` holds whole tiles only and can be continued.

    Parameters
    ----------
    noise:
        Stop tiles whose ``relative_error`` is at most this; None: all get ``spp``.
    gain:
        2^exposure, for ``relative_error``.
    time_limit:
        Seconds; the pass that exceeds it is finished.
    """
    running: _Running = {}
    try:
        return _passes(work, runner, running, spp, noise, gain, time_limit, progress, save)
    except BaseException:  # Ctrl-C above all: what is finished is kept, what has begun is awaited, the rest dropped
        runner.stop()
        for future, k in running.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                work.part(work.tiles[k].window)[...] = future.result()
        if save:
            save(work, True)
        raise


def _passes(
    work: Work,
    runner: Runner,
    running: _Running,
    spp: int,
    noise: float | None,
    gain: float,
    time_limit: float | None,
    progress: Progress | None,
    save: Save | None,
) -> float:
    start = time.perf_counter()
    pace = 0.0  # seconds per sample of the last pass
    while True:
        if noise is not None:
            work.settle(noise, gain)
        counts, limits = work.counts(), work.limits(spp)
        active = np.flatnonzero(counts < limits)
        done, total = int(counts.sum()), int(np.maximum(counts, limits).sum())
        elapsed = time.perf_counter() - start
        if len(active) == 0 or (time_limit is not None and pace > 0.0 and elapsed > time_limit):
            if progress:
                progress(total, total)
            return elapsed
        lowest = int(counts[active].min())
        target = next_count(lowest, spp)
        if time_limit is not None and pace > 0.0:  # a short pass at the end rather than a long one past it
            target = min(target, lowest + max(1, int((time_limit - elapsed) / pace)))
        waiting = iter([int(k) for k in active if counts[k] < target])
        begun = time.perf_counter()
        while True:
            for k in islice(waiting, max(0, runner.slots - len(running))):
                window, first = work.tiles[k].window, int(counts[k])
                running[runner.submit(window, first, target - first, work.part(window).copy())] = k
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                k = running[future]
                # One assignment: an interrupt comes before or after it, never in the middle of a tile.
                work.part(work.tiles[k].window)[...] = runner.result(future)
                del running[future]
                done += target - int(counts[k])
                if save:
                    save(work, False)
                if progress:
                    progress(_shown(done, total, time.perf_counter() - start, time_limit), total)
        pace = (time.perf_counter() - begun) / (target - lowest)


def _shown(done: int, total: int, elapsed: float, time_limit: float | None) -> int:
    """Work done, or the time gone where that is the nearer end."""
    if not time_limit:
        return done
    return min(total, max(done, int(total * elapsed / time_limit)))
