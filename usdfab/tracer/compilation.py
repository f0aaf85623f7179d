"""Telling people why the first render of an installation takes so long to begin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event


@contextmanager
def announce_compilation(say: Callable[[str], None]) -> Iterator[None]:
    """While this is open, ``say`` one line when a kernel is compiled. Numba tells of compiling, not of its cache."""
    said = False

    class Listener(event.Listener):
        def on_start(self, event: object) -> None:
            nonlocal said
            if not said:
                said = True
                say("compiling the kernels, once; this takes up to a minute")

        def on_end(self, event: object) -> None:
            """Nothing is said of it."""

    with event.install_listener("numba:compile", Listener()):
        yield
