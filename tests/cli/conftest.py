"""A fabric that renders fast, and the command line within this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.usd.fabric_io import write_fabric


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tiny") / "tiny.usda"
    yarn = YarnParameters(count=6, radius=2e-4, fiber_count=4)
    write_fabric(FabricParameters(weave_from_name("plain"), (3e-3, 3e-3), yarn, yarn), path)
    return path


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """``run("render", ...)``: (exit code, stdout, stderr)."""
    from usdfab.cli.main import _run

    def call(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        code = _run([str(a) for a in arguments])
        out, err = capfd.readouterr()
        return code, out, err

    return call
