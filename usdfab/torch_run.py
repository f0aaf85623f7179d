"""Habits of everything that trains or optimises with torch, below the packages that do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from usdfab.errors import UsdfabError


@contextmanager
def deterministic() -> Iterator[None]:
    """Sums in the same order every time: threads that add as they come would round differently in every run."""
    before, warned = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before, warn_only=warned)


@contextmanager
def one_thread() -> Iterator[None]:
    """Small matrices: threads cost more than they bring, and where others compute too, thirteen times as much."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def checked_device(device: str) -> torch.device:
    """The device of a ``--device``, ``cpu`` or ``cuda``; ``UsdfabError`` where there is no such thing."""
    if device not in ("cpu", "cuda"):
        raise UsdfabError(f"there is no device '{device}'", place="--device", remedy="use cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise UsdfabError("this machine has no GPU that torch can use", place="--device cuda", remedy="use cpu")
    return torch.device(device)
