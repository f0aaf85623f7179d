"""Exported maps, read back as another program reads them, beside the fibers they were baked from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_export import compare, compared, exported_look, mapped, views

from usdfab.fabric import FabricParameters, YarnParameters, preset, weave_from_name

YARN = YarnParameters(count=8, radius=2.4e-4, fiber_count=16, albedo=(0.6, 0.3, 0.15), flattening=1.2)
SMALL = FabricParameters(weave_from_name("twill 2/2"), (4e-3, 4e-3), YARN, replace(YARN, albedo=(0.2, 0.3, 0.5)))


def test_a_flat_sample_is_as_bright_as_its_fibers(tmp_path: Path) -> None:
    """Under the capture rig and under a uniform sky, through files and the reader, within a few per cent."""
    look = exported_look(SMALL, tmp_path, 96)
    for view, scene, camera in views(SMALL):
        if view in ("rig", "sky"):
            row = compared(view, scene, mapped(scene, look), camera, 32)
            assert row.ratio == pytest.approx(np.ones(3), abs=0.08), view


@pytest.mark.slow
@pytest.mark.parametrize("name", ["denim", "linen", "silk-satin", "woollen-twill"])
def test_presets_are_as_bright_as_their_fibers(name: str) -> None:
    rows = {row.view: row for row in compare(preset(name), 256, 64)}
    for view in ("rig", "sky"):
        assert rows[view].ratio == pytest.approx(np.ones(3), abs=0.06), view
    # Where one diffuse colour cannot follow the fibers (README, limits) it stays in their neighbourhood.
    for view in ("sun 45, mean", "sky, seen at 60", "drape"):
        assert rows[view].ratio == pytest.approx(np.ones(3), abs=0.35), view
