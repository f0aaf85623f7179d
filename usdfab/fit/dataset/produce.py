"""Making many samples, here or elsewhere, and keeping what is finished."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Executor

from usdfab.fit.dataset.render import Rendered, render_sample
from usdfab.fit.dataset.store import Store
from usdfab.production import Produced, Progress, local_workers, produce_all, submitted

__all__ = ["Produced", "local_workers", "produce"]


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

    def keep(rendered: Rendered) -> float:
        store.commit(rendered.index, rendered.record, rendered.image)
        return rendered.seconds

    return produce_all(
        store, indices, lambda index: submitted(executor, render_sample, store.settings, index), keep, slots, progress
    )
