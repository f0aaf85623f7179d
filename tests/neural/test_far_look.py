"""Where the neural cloth may stand for fibers, and in which colours."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path += [str(Path(__file__).parent), str(Path(__file__).parent.parent / "tracer")]

from neural_examples import lively
from scenes import cloth_material, dome, fabric, lambert, look, plane, scene

from usdfab.neural.far_look import FAR, NEAR, far_share, fitted_albedo, matched_scene
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS
from usdfab.neural.render import render
from usdfab.neural.stage_scene import build
from usdfab.tracer import RenderSettings, Tracer

CLOTH = fabric("plain")
NETWORKS = {kind: Weights(lively("lean", kind), {}) for kind in KINDS}
SIZE = (24, 16)


def test_the_share_follows_the_footprint() -> None:
    world = scene([plane(0.5)], [cloth_material()], [dome(1.0)], [CLOTH])
    ready, cell = build(world, NETWORKS, {}), CLOTH.cell[0]
    for yarns, low, high in ((0.9 * NEAR, 0, 0), (np.sqrt(NEAR * FAR), 0.45, 0.55), (1.1 * FAR, 1, 1)):
        # Straight above: a pixel is so many yarns wide everywhere.
        camera = look((0, 0, 1.0), (0, 0, 0), (0.5 * yarns * cell * 24, 0.5 * yarns * cell * 16))
        share = far_share(ready, world, camera, SIZE, (0, 0, *SIZE))
        assert share.shape == (16, 24) and low <= share.min() and share.max() <= high
    # A card before the cloth is no cloth, nor is what is beside it.
    card = plane(0.004, material=1, z=0.1)
    world = scene([plane(0.5), card], [cloth_material(), lambert()], [dome(1.0)], [CLOTH])
    share = far_share(build(world, NETWORKS, {}), world, camera, SIZE, (0, 0, *SIZE))
    assert share[8, 12] == 0 and share[0, 0] == 1 and set(np.unique(share)) == {0, 1}
    part = far_share(build(world, NETWORKS, {}), world, camera, SIZE, (10, 0, 24, 16))
    assert np.array_equal(part[:, 1:], share[:, 11:])


def test_albedos_are_found_and_the_mean_is_kept() -> None:
    rng = np.random.default_rng(0)
    parts, true = rng.random((400, 8)), np.array([0.5, 0.2, 0.01, 0.0, 0.1, 0.3, 0.0, 0.02])
    seen = parts @ true
    assert np.allclose(fitted_albedo(parts, seen, true), true, atol=1e-9)
    noisy = seen + rng.normal(0, 0.2, 400)
    found = fitted_albedo(parts, noisy, 0.5 * true)
    assert found.min() >= 0 and (parts @ found).mean() == pytest.approx(noisy.mean(), rel=2e-3)
    parts[:, 3] = 0.0  # never lit: the first guess cannot be told from any other, and no number is lost
    assert np.isfinite(fitted_albedo(parts, seen, true)).all()


def test_matched_cloth_is_as_bright_as_its_fibers() -> None:
    world = scene([plane(0.2)], [cloth_material()], [dome(1.0)], [CLOTH])
    ready, tracer = build(world, NETWORKS, {}), Tracer(world)
    camera = look((0, -0.4, 0.6), (0, 0, 0), (0.1, 0.07))
    matched = matched_scene(ready, world, camera, (12, 8), tracer, threads=2)
    fibers = tracer.render(camera, RenderSettings((12, 8), spp=256, seed=7, threads=2)).pixels.mean(axis=(0, 1))
    drawn = render(matched, camera, (12, 8), (0, 0, 12, 8), 4).pixels.mean(axis=(0, 1))
    before = render(ready, camera, (12, 8), (0, 0, 12, 8), 4).pixels.mean(axis=(0, 1))
    assert np.allclose(drawn, fibers, rtol=0.03) and not np.allclose(before, fibers, rtol=0.1)
