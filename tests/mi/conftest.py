"""Probes are remembered in a folder of the test's own."""

from __future__ import annotations

import pytest

from usdfab.mi import llvm, variant


@pytest.fixture
def fresh_probes(tmp_path, monkeypatch):
    """Nothing is remembered, on disk or in this process."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "cache"))
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    llvm.choose.cache_clear()
    variant.cuda_verdict.cache_clear()
    yield tmp_path / "cache"
    llvm.choose.cache_clear()
    variant.cuda_verdict.cache_clear()
