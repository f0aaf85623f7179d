"""What is said of compiling."""

from __future__ import annotations

from numba import njit

from usdfab.tracer.compilation import announce_compilation


def test_compiling_is_said_once_and_only_when_it_happens():
    @njit
    def double(x):
        return x + x

    said: list[str] = []
    with announce_compilation(said.append):
        assert not said
        double(1)
        double(1.0)
    assert len(said) == 1 and "compiling" in said[0]
    with announce_compilation(said.append):
        double(2)
    assert len(said) == 1
