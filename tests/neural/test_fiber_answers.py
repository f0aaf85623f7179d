"""What fibers answer to queries, against the tracer's pictures and against energy."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent.parent / "tracer"))

from numpy.typing import NDArray
from scenes import fabric, look

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.neural.asset_queries import columns_of
from usdfab.neural.fiber_answers import FiberAnswers, colors_of
from usdfab.neural.fiber_kernel import GLOSS
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene
from usdfab.usd.scene import DistantLight

CLOTH = fabric("twill 2/1")


def dyed(albedo: float) -> FabricParameters:
    colors = {s: replace(CLOTH.system(s), albedo=(albedo,) * 3) for s in ("warp", "weft")}
    return CLOTH.with_systems(colors)  # type: ignore[arg-type]


def sphere(count: int, seed: int = 0) -> NDArray[np.float64]:
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize("light", [(0.7, 0.2, 0.7), (0.3, -0.5, -0.8)])
@pytest.mark.parametrize("side", [1, -1])
def test_answers_are_what_the_tracer_shows_of_a_flat_sheet(light: tuple, side: int) -> None:
    towards, eye = np.array(light) / np.linalg.norm(light), np.array([-0.4, 0.3, 0.9 * side])
    viewer = eye / np.linalg.norm(eye)
    camera = look(tuple(viewer), (0.0, 0.0, 0.0), (5e-4, 5e-4))
    sheet = replace(swatch_scene(CLOTH), lights=(DistantLight("/Sun", -towards, np.ones(3), 0.0),))
    shown = Tracer(sheet).render(camera, RenderSettings((12, 12), spp=128, threads=1)).pixels.reshape(-1, 3)
    turn = np.array([side, 1.0, side])
    footprint = [0.3, 0.7, 5.0, *(viewer * turn)[:2]]
    lights = np.tile(towards * turn, (150, 1, 1))
    answers = FiberAnswers(CLOTH).ask([footprint] * 150, lights, 128, back=side < 0, threads=1)
    found = colors_of(answers)[:, 0]
    error = np.sqrt(shown.var(axis=0) / len(shown) + found.var(axis=0) / len(found))
    assert np.all(np.abs(found.mean(axis=0) - shown.mean(axis=0)) < 4 * error)
    assert np.all(error < 0.1 * found.mean(axis=0))


def test_white_fibers_lose_nothing() -> None:
    """All light, from everywhere, is sent on to the viewer but for what is seen of the sky through gaps."""
    count = 600
    lights = sphere(count * 6, 1).reshape(count, 6, 3)
    rng = np.random.default_rng(2)
    footprints = np.column_stack([rng.random((count, 2)), np.zeros(count), np.full((count, 2), [0.2, -0.3])])
    dense = replace(dyed(1.0), variants=1)
    answers = colors_of(FiberAnswers(dense).ask(footprints, lights, 16, max_depth=400, threads=1))
    sent = 4 * np.pi * answers.mean(axis=1)
    camera = look((0.2, -0.3, 0.933), (0.0, 0.0, 0.0), (5e-4, 5e-4))
    covered = Tracer(swatch_scene(dense)).render(camera, RenderSettings((24, 24), spp=16, threads=1, max_depth=2)).alpha
    expected, error = covered.mean(), sent[:, 0].std() / np.sqrt(count)
    assert expected > 0.5 and error < 0.05
    assert abs(sent[:, 0].mean() - expected) < 4 * error + 0.01


def test_gloss_has_no_colour() -> None:
    footprints = np.tile([0.5, 0.5, 3.0, 0.3, 0.1], (40, 1))
    lights = np.tile(sphere(8, 3), (40, 1, 1))
    pale, black = (FiberAnswers(dyed(albedo)).ask(footprints, lights, 32, threads=1) for albedo in (0.9, 0.0))
    gloss = [a[..., GLOSS : GLOSS + 2].sum(axis=-1).mean(axis=0) for a in (pale, black)]
    noise = pale[..., GLOSS : GLOSS + 2].sum(axis=-1).std(axis=0) / np.sqrt(40)
    assert np.all(np.abs(gloss[0] - gloss[1]) < 5 * noise + 1e-4) and gloss[0].sum() > 0
    # Of black fibers next to nothing else is left.
    assert columns_of(black)[..., [0, 1, 3]].mean() < 0.02 * columns_of(pale)[..., [0, 1, 3]].mean()


def test_threads_do_not_change_answers() -> None:
    rng = np.random.default_rng(4)
    footprints = np.column_stack([rng.random((150, 3)), 0.5 * rng.random((150, 2))])
    lights = sphere(450, 5).reshape(150, 3, 3)
    fibers = FiberAnswers(CLOTH)
    one = fibers.ask(footprints, lights, 2, seed=9, threads=1)
    assert np.array_equal(one, fibers.ask(footprints, lights, 2, seed=9, threads=3))
    assert not np.array_equal(one, fibers.ask(footprints, lights, 2, seed=10, threads=1))
    for wrong in (footprints[:10], np.full_like(footprints, np.nan), footprints[:, :4]):
        with pytest.raises(UsdfabError):
            fibers.ask(wrong, lights, 2)
    with pytest.raises(UsdfabError):
        fibers.ask(footprints, 2 * lights, 2)
