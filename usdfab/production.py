"""Making many numbered things, here or elsewhere, by any number of processes at once, and keeping what is finished.

Shared by the data sets of ``usdfab.fit`` and ``usdfab.neural``: who makes what (claims), with whom (workers), and how
files appear whole.
"""

from __future__ import annotations

import errno
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
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any, Protocol, TypeVar

from usdfab.errors import UsdfabError
from usdfab.files import whole_file

if os.name == "posix":
    import fcntl

Progress = Callable[[int, int], None]
"""Called with (things that are there, things asked for)."""

Made = TypeVar("Made")


class Places(Protocol):
    """Where numbered things are kept."""

    def missing(self, indices: Iterable[int]) -> list[int]:
        """Those that are not finished, in order."""

    def is_finished(self, index: int) -> bool:
        """Whether one is there."""

    def claim(self, index: int) -> AbstractContextManager[bool]:
        """Whether this process may make it; until the block ends no other may."""


@dataclass(frozen=True)
class Produced:
    """What a run did: things ``made`` by it, ``there`` before, and left to ``others`` that are making them.

    ``seconds`` on the clock and ``cpu_seconds`` of those made.
    """

    made: int
    there: int
    others: int
    seconds: float
    cpu_seconds: float

    @property
    def per_hour(self) -> float:
        """Things per hour of this run; 0 if it made none."""
        return 3600.0 * self.made / self.seconds if self.made and self.seconds > 0 else 0.0


def produce_all(
    places: Places,
    indices: Iterable[int],
    start: Callable[[int], Future[Made]],
    keep: Callable[[Made], float],
    slots: int = 1,
    progress: Progress | None = None,
) -> Produced:
    """Make all things that are missing and that no other process is making.

    Parameters
    ----------
    start:
        Begins to make one, see ``submitted``.
    keep:
        Writes a finished one; returns the CPU seconds that it took.
    slots:
        How many at once.
    progress:
        Told after each.

    Raises
    ------
    UsdfabError
        If the disk refuses or a worker dies. Finished things are kept; the same call goes on.
    """
    wanted = list(indices)
    missing = places.missing(wanted)
    there, made, others, cpu = len(wanted) - len(missing), 0, 0, 0.0
    begun = time.perf_counter()
    if progress:
        progress(there, len(wanted))
    waiting = iter(missing)
    running: dict[Future[Made], ExitStack] = {}
    try:
        while True:
            while len(running) < slots and (index := next(waiting, None)) is not None:
                stack = ExitStack()
                if not stack.enter_context(places.claim(index)):
                    stack.close()
                    # Somebody has it; if it is finished by now, it counts as there.
                    if places.is_finished(index):
                        there += 1
                    else:
                        others += 1
                    continue
                running[start(index)] = stack
            if not running:
                return Produced(made, there, others, time.perf_counter() - begun, cpu)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                with running.pop(future):
                    cpu += keep(_result(future))
                made += 1
                if progress:
                    progress(there + made, len(wanted))
    finally:
        for future, stack in running.items():
            future.cancel()
            stack.close()


def submitted(executor: Executor | None, task: Callable[..., Made], *arguments: Any) -> Future[Made]:
    """The task in the executor, or done here and now where there is none."""
    if executor is not None:
        return executor.submit(task, *arguments)
    future: Future[Made] = Future()
    future.set_result(task(*arguments))
    return future


def _result(future: Future[Made]) -> Made:
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


# --- files -----------------------------------------------------------------------------------------------------------


@contextmanager
def claimed(path: Path, is_finished: Callable[[], bool]) -> Iterator[bool]:
    """Whether this process may make the thing that the lock file ``path`` stands for; a dead process holds no lock.

    Where the system knows no file locks every claim is granted: two processes may then make a thing twice, which
    costs time and nothing else.
    """
    if os.name != "posix":
        yield not is_finished()
        return
    try:
        lock = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
    except OSError as error:
        raise disk_refused(error, path) from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # Others than "somebody has it" mean a file system without locks.
            yield error.errno not in (errno.EWOULDBLOCK, errno.EACCES) and not is_finished()
            return
        # Whoever had the lock before may have finished and taken the file's name away.
        yield not is_finished()
        path.unlink(missing_ok=True)
    finally:
        os.close(lock)


def write_whole(target: Path, content: bytes) -> None:
    """A file that is there with all its bytes, on the disk, or not at all; OSError as the disk says it."""
    with whole_file(target) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def name_first(temporary: Path, target: Path) -> None:
    """Give a file its name unless somebody was faster."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        return
    except OSError:  # a file system without hard links
        if not target.exists():
            temporary.replace(target)


def disk_refused(error: OSError, path: Path) -> UsdfabError:
    """What to say where a disk does not take a file."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UsdfabError(
            "the disk is full", place=str(path),
            remedy="make room and run the same command again; finished samples are kept",
        )  # fmt: skip
    return UsdfabError(f"cannot be written ({error.strerror or error})", place=str(path))
