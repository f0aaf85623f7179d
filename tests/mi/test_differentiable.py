"""Gradients of path-traced fibers against differences of pictures, with other integrators and with themselves."""

from __future__ import annotations

import sys
import tempfile
from copy import copy
from dataclasses import replace
from pathlib import Path

import mitsuba_variant
import numpy as np
import pytest

if mitsuba_variant.why_not():
    pytest.skip(mitsuba_variant.why_not(), allow_module_level=True)

sys.path.append(str(Path(__file__).parents[1] / "tracer"))

import drjit as dr
from scenes import dome, fabric, plane, swatch

from usdfab.errors import UsdfabError
from usdfab.fabric.optics import optics_of
from usdfab.mi import differentiable
from usdfab.mi.differentiable import DifferentiableRenderer
from usdfab.mi.fiber_tables import OpticsTables
from usdfab.mi.render import MitsubaSettings, render
from usdfab.usd.scene import Material, SphereLight, Texture

SIDE = 8
TARGET = np.linspace(-0.2, 0.3, SIDE * SIDE * 3).reshape(SIDE, SIDE, 3)
"""Of the loss: its adjoint has both signs, and is another in each pixel and channel."""


def make(cloth=None, lights=(), **more) -> DifferentiableRenderer:
    scene, camera = swatch(cloth or fabric(fibers=8), *lights, zoom=0.12)
    return DifferentiableRenderer(scene, camera, (SIDE, SIDE), margin=1.0, device="llvm", **more)


@pytest.fixture(scope="module")
def renderer() -> DifferentiableRenderer:
    return make()


def directions(names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Unit steps: the colours of each system, and each other parameter."""
    groups = dict.fromkeys(name.split("[")[0] for name in names)
    return {g: np.array([float(name.split("[")[0] == g) for name in names]) for g in groups}


def compare(renderer, ways: dict[str, np.ndarray], spp: int, runs: int, bar: float) -> None:
    """Gradients of the mean and of a squared difference against central differences, within 4 standard errors.

    The loss of a noisy picture is too large by its variance: the differences are of products of independent pictures,
    (a - target) (b - target), whose expectation is the loss of the expected picture. ``bar`` is the largest standard
    error for the test to tell anything, relative to the derivative or to 0.02.
    """
    vector = renderer.optics.vector()
    count = TARGET.size
    by_difference: dict[str, list] = {name: [] for name in ways}
    gradients = []
    for run in range(runs):
        for name, way in ways.items():
            # Pictures are nearly linear in roughness; in dark colours they are not.
            step = 0.08 if "roughness" in name else 0.04
            # The same seeds on both sides: much of the noise is common.
            seeds = 2 * run, 2 * run + 1
            more, less = ([renderer.render(vector + s * way, spp, seed) for seed in seeds] for s in (step, -step))
            means = [np.mean(pair) for pair in (more, less)]
            losses = [np.mean((a - TARGET) * (b - TARGET)) for a, b in (more, less)]
            by_difference[name].append([(values[0] - values[1]) / (2 * step) for values in (means, losses)])
        image = renderer.render(vector, spp, 1000 + run)
        adjoints = np.full(TARGET.shape, 1.0 / count), 2.0 * (image - TARGET) / count
        gradients.append([renderer.gradient(vector, a, spp, 2000 + run) for a in adjoints])
    for name, way in ways.items():
        ours = np.array(gradients) @ way
        theirs = np.array(by_difference[name])
        error = np.hypot(*(np.std(found, axis=0, ddof=1) / np.sqrt(runs) for found in (ours, theirs)))
        difference = ours.mean(axis=0) - theirs.mean(axis=0)
        print(f"{name}: {ours.mean(axis=0)} differences {theirs.mean(axis=0)} +- {error}")
        assert np.all(error < bar * np.maximum(np.abs(ours.mean(axis=0)), 0.02)), f"{name}: too noisy, {error}"
        assert np.all(np.abs(difference) < 4.0 * error), f"{name}: {ours.mean(axis=0)} is not {theirs.mean(axis=0)}"


def test_gradient_is_that_of_differences(renderer):
    """Along one way that changes every parameter."""
    compare(renderer, {"all": np.linspace(0.6, 1.4, renderer.optics.size)}, spp=256, runs=8, bar=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("name", directions(optics_of(fabric()).names()))
def test_gradient_of_each_parameter_is_that_of_differences(renderer, name):
    compare(renderer, {name: directions(renderer.optics.names())[name]}, spp=1024, runs=8, bar=0.3)


@pytest.mark.slow
def test_gradients_under_lamps_with_a_surface_are_those_of_differences():
    """Light that paths run into, with its weight, is part of the gradient."""
    lamp = SphereLight("/Lamp", np.array([0.002, 0.0, 0.003]), 0.0015, np.full(3, 2.0))
    lit = make(lights=(dome(0.5), lamp))
    compare(lit, {"all": np.linspace(0.6, 1.4, lit.optics.size)}, spp=512, runs=8, bar=0.08)


def test_gradients_of_few_samples_are_right_on_average(renderer):
    adjoint = TARGET - 0.2
    few = np.array([renderer.gradient(renderer.optics, adjoint, 8, k) for k in range(64)])
    many = np.array([renderer.gradient(renderer.optics, adjoint, 256, 100 + k) for k in range(8)])
    error = np.hypot(*(np.std(found, axis=0, ddof=1) / np.sqrt(len(found)) for found in (few, many)))
    assert np.all(np.abs(few.mean(axis=0) - many.mean(axis=0)) < 4.5 * error)
    # Noise falls with the samples: they are not the same ones again.
    ratio = few.std(axis=0, ddof=1) / many.std(axis=0, ddof=1)
    assert 3.0 < np.median(ratio) < 10.0, ratio


def test_passes_change_noise_only(renderer, monkeypatch):
    adjoint = TARGET - 0.2
    whole = np.array([renderer.gradient(renderer.optics, adjoint, 96, k) for k in range(8)])
    image = np.mean([renderer.render(renderer.optics, 96, k).mean() for k in range(8)])
    monkeypatch.setattr(differentiable, "PATHS_AT_ONCE", 20 * SIDE * SIDE)
    assert [count for _, count in renderer._passes(96)] == [19, 19, 19, 19, 20]
    split = np.array([renderer.gradient(renderer.optics, adjoint, 96, 50 + k) for k in range(8)])
    error = np.hypot(whole.std(axis=0, ddof=1), split.std(axis=0, ddof=1)) / np.sqrt(8)
    assert np.all(np.abs(whole.mean(axis=0) - split.mean(axis=0)) < 5.0 * error)
    assert np.mean([renderer.render(renderer.optics, 96, 50 + k).mean() for k in range(8)]) == pytest.approx(
        image, rel=0.05
    )


def test_same_seed_same_numbers(renderer):
    first, again = (renderer.render(renderer.optics, 8, 3) for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, renderer.render(renderer.optics, 8, 4))
    gradients = [renderer.gradient(renderer.optics, TARGET, 8, 3) for _ in range(2)]
    assert np.allclose(*gradients, rtol=1e-5)


def test_gradient_is_linear_in_the_adjoint(renderer):
    """Also for adjoints so small that float32 has few digits left of them."""
    whole = renderer.gradient(renderer.optics, TARGET, 8, 3)
    assert np.allclose(renderer.gradient(renderer.optics, 1e-42 * TARGET, 8, 3), 1e-42 * whole, rtol=1e-4, atol=0.0)
    assert not renderer.gradient(renderer.optics, 0.0 * TARGET, 8, 3).any()


def test_new_values_compile_nothing(renderer):
    vector = renderer.optics.vector()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for k in range(2):
            dr.kernel_history_clear()
            image = renderer.render(vector * (1.0 - 0.01 * k), 8 + k, k)
            renderer.gradient(vector * (1.0 - 0.01 * k), image, 8 + k, 10 + k)
        entries = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert entries
    assert all(entry["cache_hit"] for entry in entries)


def test_picture_is_that_of_the_backend():
    """Mitsuba's own path integrator with the fiber plugin, all cloth, both with a dome: every part of a path counts."""
    cloth = replace(fabric(fibers=6), size=(1.5e-3, 1.5e-3))
    scene, camera = swatch(cloth, dome(0.5), zoom=0.3)
    ours = DifferentiableRenderer(scene, camera, (SIDE, SIDE), device="llvm", max_depth=16)
    settings = MitsubaSettings((SIDE, SIDE), (0, 0, SIDE, SIDE), spp=96, max_depth=16, device="llvm")
    theirs = [render(scene, camera, replace(settings, seed=k)).pixels.mean() for k in range(4)]
    means = [ours.render(ours.optics, 96, k).mean() for k in range(4)]
    error = np.hypot(np.std(means, ddof=1), np.std(theirs, ddof=1)) / 2.0
    assert error < 0.015 * np.mean(theirs)
    assert np.mean(means) == pytest.approx(np.mean(theirs), abs=4.0 * error)


@pytest.mark.slow
def test_gradient_is_that_of_path_replay(renderer):
    """Mitsuba's `prb` with the fiber plugin: another integrator, and derivatives by another way through the BSDF."""
    import mitsuba as mi

    from usdfab.mi.fiber_bsdf import register_fiber_bsdf
    from usdfab.mi.fiber_stage import seen_fibers
    from usdfab.mi.fibers import MAX_POINTS, plugin_bsdf
    from usdfab.mi.scene import translate

    register_fiber_bsdf()
    scene, camera = swatch(fabric(fibers=8), zoom=0.12)
    from usdfab.mi import scene as mi_scene

    cloth = seen_fibers(scene, camera, 1.0, MAX_POINTS)
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(mi_scene, "make_cloth", lambda *_: cloth)
        size, window = (SIDE, SIDE), (0, 0, SIDE, SIDE)
        description = translate(mi, scene, camera, size, window, Path(folder), fiber_bsdf=plugin_bsdf).description
        loaded = mi.load_dict(description, parallel=False, optimize=False)
    prb = mi.load_dict({"type": "prb", "max_depth": 64, "rr_depth": 5})
    params = mi.traverse(loaded)
    names = [f"fibers{k}.bsdf.{name}" for k in range(2) for name in ("albedo", "gamma_m", "gamma_n", "gamma_m0", "eta")]
    found = []
    for seed in range(16):
        for name in names:
            params[name] = type(params[name])(dr.detach(params[name]))
            dr.enable_grad(params[name])
        params.update()
        prb.render_backward(loaded, params, mi.TensorXf(TARGET.astype(np.float32) - 0.2), spp=512, seed=seed)
        one = [np.array(dr.grad(params[name])).ravel() for name in names]
        found.append(np.concatenate([one[0], one[5], *one[1:4], *one[6:9], one[4], one[9]]))
    theirs = np.array(found)
    ours = np.array([renderer.gradient(renderer.optics, TARGET - 0.2, 512, k) for k in range(16)])
    error = np.hypot(ours.std(axis=0, ddof=1), theirs.std(axis=0, ddof=1)) / 4.0
    print(f"ours {ours.mean(axis=0)}\nprb {theirs.mean(axis=0)}\n+- {error}")
    assert np.all(np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 4.0 * error)


def test_stripes():
    """Yarns of nearly the same colours: the derivatives of their colours add up to that of one."""
    color = np.array(fabric().warp.albedo)
    cloth = fabric(fibers=8)
    stripes = tuple(tuple((color * (1.0 - 1e-9 * k)).tolist()) for k in range(3))
    striped = make(replace(cloth, warp=replace(cloth.warp, yarn_albedo=stripes)))
    assert striped.optics.names()[3] == "warp.albedo[1].r"
    # The same curves with one color for each system.
    plain, stage = copy(striped), copy(striped._stage)
    stage.color_of_segment = dr.maximum(stage.color_of_segment, 2) - 2
    stage.colors, stage.warp_colors = 2, 1
    plain._stage, plain.optics = stage, optics_of(cloth)
    plain._tables = OpticsTables(plain.optics.system, 0.0)
    one, three = (r.gradient(r.optics, TARGET, 64, 5) for r in (plain, striped))
    assert np.allclose(three[:9].reshape(3, 3).sum(axis=0), one[:3], rtol=1e-3)
    assert np.allclose(three[9:], one[3:], rtol=1e-3, atol=1e-3 * np.abs(one).max())
    assert np.all(np.abs(three[:9].reshape(3, 3)).sum(axis=1) > 0.0)


def test_torch(renderer):
    torch = pytest.importorskip("torch")
    from usdfab.fit.torch_image import torch_image

    optics = torch.tensor(renderer.optics.vector(), requires_grad=True)
    image = torch_image(renderer, optics, spp=16, gradient_spp=8, seed=7)
    assert np.array_equal(image.detach().numpy(), renderer.render(renderer.optics, 16, 14))
    (image - torch.tensor(TARGET)).square().mean().backward()
    adjoint = 2.0 * (image.detach().numpy() - TARGET) / TARGET.size
    assert np.allclose(optics.grad.numpy(), renderer.gradient(renderer.optics, adjoint, 8, 15), rtol=1e-5)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [(np.ones(13), "expected 14 optical parameters"), (np.full(14, np.nan), "not a finite number: warp.albedo")],
)
def test_wrong_optics(renderer, wrong, said):
    with pytest.raises(UsdfabError, match=said):
        renderer.render(wrong, 1, 0)
    with pytest.raises(UsdfabError, match=said):
        renderer.gradient(wrong, TARGET, 1, 0)


def test_wrong_calls(renderer):
    with pytest.raises(UsdfabError, match="adjoint"):
        renderer.gradient(renderer.optics, TARGET[1:], 1, 0)
    with pytest.raises(UsdfabError, match="finite"):
        renderer.gradient(renderer.optics, np.full_like(TARGET, np.inf), 1, 0)
    with pytest.raises(UsdfabError, match="colours are not those"):
        renderer.render(replace(renderer.optics, system=np.array([0, 0])), 1, 0)
    with pytest.raises(UsdfabError, match="0 samples"):
        renderer.render(renderer.optics, 0, 0)


def test_wrong_scenes():
    scene, camera = swatch(fabric(fibers=8), zoom=0.12)

    def fails(said: str, scene=scene, camera=camera, size=(8, 8), **more) -> None:
        with pytest.raises(UsdfabError, match=said):
            DifferentiableRenderer(scene, camera, size, **more)

    fails("scalar", device="scalar")
    fails("no 'gpu'", device="gpu")
    fails("depth 1 between", max_depth=1)
    fails("a pixel or more", size=(0, 8))
    mapped = replace(
        scene.fabrics[0],
        albedo_map=Texture("map.png", "rgb", ("repeat", "repeat"), False, np.ones(4), np.zeros(4), np.eye(2, 3)),
    )
    fails("albedo map", replace(scene, fabrics=(mapped,)))
    tilted = replace(fabric(fibers=8), warp=replace(fabric(fibers=8).warp, cuticle_tilt=0.1))
    fails("cuticle tilt", swatch(tilted)[0])
    fails("one fabric, got 0", replace(scene, fabrics=()))
    away = np.diag([1.0, -1.0, -1.0, 1.0])
    away[2, 3] = 1.0
    fails("sees no fibers", camera=replace(camera, to_world=away), margin=1.0)
    fails("no light", replace(scene, lights=()), margin=1.0)
    bare = Material("/Bare", -1, np.full(3, 0.5), 0.5, 0.0, 1.0)
    table = plane(0.01, material=len(scene.materials), z=-1e-3)
    fails("leave this mesh out", replace(scene, meshes=(*scene.meshes, table), materials=(*scene.materials, bare)))
    fails("square", size=(8, 4), margin=1.0)


def test_rows_of_colors():
    """Each curve has the row of its yarn's colour."""
    from usdfab.mi.fiber_stage import color_rows, seen_fibers

    cloth = fabric(fibers=4)
    colors = ((0.9, 0.1, 0.2), (0.1, 0.8, 0.3))
    cloth = replace(cloth, weft=replace(cloth.weft, yarn_albedo=colors))
    optics = optics_of(cloth)
    scene, camera = swatch(cloth, zoom=0.12)
    for fibers in seen_fibers(scene, camera, 1.0, 10**6).fibers:
        rows = color_rows(fibers, optics)
        expected = 1 + fibers.curves.yarn % 2 if fibers.curves.system == "weft" else np.zeros(len(rows))
        assert np.array_equal(rows, expected)
