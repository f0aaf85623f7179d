"""Derivatives of pictures by the optics of the fabric: right, the same on every machine, and in the right place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import cloth_material, dome, fabric, look, plane, scene as scene_of, swatch

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import with_optics
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.differentiable import DifferentiableTracer
from usdfab.usd.scene import Camera, Scene, SphereLight

SIDE = 16


def two_yarns(**changes) -> FabricParameters:
    """Different warp and weft, rough and dark, so that single scattering is much of the light."""
    cloth = fabric(fibers=8, albedo=(0.5, 0.3, 0.15), roughness_azimuthal=0.45, roughness_primary=0.35, **changes)
    weft = replace(
        cloth.weft, albedo=(0.2, 0.35, 0.6), roughness_longitudinal=0.4, roughness_azimuthal=0.35, ior=1.45,
        roughness_primary=0.25,
    )  # fmt: skip
    return replace(cloth, weft=weft)


def striped() -> FabricParameters:
    cloth = two_yarns()
    weft = replace(cloth.weft, yarn_albedo=((0.6, 0.2, 0.1), (0.1, 0.2, 0.6)))
    return replace(cloth, weft=weft)


def sampled(cloth: FabricParameters, depth: int = 4, side: int = SIDE, lights=(), **changes) -> DifferentiableTracer:
    scene, camera = swatch(cloth, *lights)
    return DifferentiableTracer(scene, camera, (side, side), max_depth=depth, **changes)


@pytest.fixture(scope="module")
def tracer() -> DifferentiableTracer:
    return sampled(two_yarns())


def mean_and_error(values) -> tuple[np.ndarray, np.ndarray]:
    values = np.asarray(values)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


# --- pictures ---


def test_the_picture_is_the_tracers_for_these_optics(tracer):
    """Other optics in the same tiles give the very picture of a fabric made with them."""
    vector = tracer.optics.vector() * np.linspace(0.8, 1.1, tracer.optics.size)
    optics = tracer.optics.with_vector(vector)
    scene, camera = swatch(with_optics(tracer.fabric, optics))
    expected = Tracer(scene).render(camera, RenderSettings((SIDE, SIDE), spp=3, max_depth=4, seed=5)).pixels
    image = tracer.render(vector, 3, 5)
    np.testing.assert_array_equal(image.astype(np.float32), expected)
    # The kernel with derivatives takes the same paths.
    np.testing.assert_allclose(tracer.gradient_images(optics, 3, 5)[0], image, rtol=1e-9)
    assert abs(tracer.render(tracer.optics, 3, 5) - image).max() > 0.01


def test_guides_are_the_tracers_layers(tracer):
    scene, camera = swatch(tracer.fabric)
    render = Tracer(scene).render(camera, RenderSettings((SIDE, SIDE), spp=8, max_depth=1, seed=2))
    albedo, normal = tracer.guides(8, 2)
    np.testing.assert_array_equal(albedo, render.albedo)
    np.testing.assert_array_equal(normal, render.normal)
    assert albedo.shape == normal.shape == (SIDE, SIDE, 3) and albedo.max() > 0.1


def test_exposure_and_blocks(tracer):
    scene, camera = swatch(tracer.fabric)
    brighter = DifferentiableTracer(scene, replace(camera, exposure=1.0), (SIDE, SIDE), max_depth=4)
    (a, ga), (b, gb) = (t.gradient_images(t.optics, 2, 1) for t in (tracer, brighter))
    np.testing.assert_allclose(b, 2 * a, rtol=1e-12)
    np.testing.assert_allclose(gb, 2 * ga, rtol=1e-12)
    np.testing.assert_allclose(brighter.render(tracer.optics, 2, 1), b, rtol=1e-9)
    small, gs = tracer.gradient_images(tracer.optics, 2, 1, block=4)
    np.testing.assert_allclose(small, a.reshape(4, 4, 4, 4, 3).mean(axis=(1, 3)), rtol=1e-12)
    expected = ga.reshape(-1, 4, 4, 4, 4, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(gs, expected, rtol=1e-9, atol=1e-12 * abs(expected).max())


@pytest.mark.parametrize("lights", [(), (dome(),)], ids=["lamp", "dome"])
def test_gradient_is_the_adjoint_times_the_images(lights):
    tracer = sampled(striped(), lights=lights)
    adjoint = np.random.default_rng(0).normal(size=(SIDE, SIDE, 3))
    image, jacobian = tracer.gradient_images(tracer.optics, 4, 2)
    assert jacobian.shape == (tracer.optics.size, SIDE, SIDE, 3)
    gradient = tracer.gradient(tracer.optics, adjoint, 4, 2)
    expected = np.einsum("phwc,hwc->p", jacobian, adjoint)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9, atol=1e-12 * abs(expected).max())
    again, same = tracer.image_and_gradient(tracer.optics, adjoint, 4, 2)
    np.testing.assert_array_equal(same, gradient)
    np.testing.assert_allclose(again, image, rtol=1e-12)
    # A colour's red does nothing to green and blue; roughness does to all.
    for k, name in enumerate(tracer.optics.names()):
        channels = np.flatnonzero(abs(jacobian[k]).max(axis=(0, 1)))
        assert channels.tolist() == (["rgb".index(name[-1])] if "albedo" in name else [0, 1, 2]), name


def test_the_same_bits_for_any_number_of_threads():
    results = []
    for threads in (1, 2, 5):
        t = sampled(two_yarns(), side=40, threads=threads)
        results.append((t.render(t.optics, 1, 3), t.gradient(t.optics, np.ones((40, 40, 3)), 1, 3)))
    for image, gradient in results[1:]:
        np.testing.assert_array_equal(image, results[0][0])
        np.testing.assert_array_equal(gradient, results[0][1])
    assert np.all(gradient != 0.0)
    other = t.gradient(t.optics, np.ones((40, 40, 3)), 1, 4)
    assert np.all(other != gradient)


# --- derivatives against finite differences ---


def finite_difference(tracer: DifferentiableTracer, direction: np.ndarray, spp: int, runs: int) -> list[float]:
    """Differences of pictures' means between ``optics +- direction``, halved, of the same random numbers."""
    v = tracer.optics.vector()
    return [
        0.5 * (tracer.render(v + direction, spp, s).mean() - tracer.render(v - direction, spp, s).mean())
        for s in range(100, 100 + runs)
    ]


def gradients(tracer: DifferentiableTracer, spp: int, runs: int) -> list[np.ndarray]:
    adjoint = np.full((tracer.size[1], tracer.size[0], 3), 1.0 / (3 * tracer.size[0] * tracer.size[1]))
    return [tracer.gradient(tracer.optics, adjoint, spp, s) for s in range(runs)]


STEP = {"albedo": 0.05, "roughness": 0.05, "ior": 0.08}
LAMPS = {
    "lamp": (),
    "ball": (SphereLight("/S", np.array([0.012, 0.01, 0.03]), 8e-3, np.full(3, 6.0)),),
}


@pytest.mark.parametrize("lamp", LAMPS)
def test_all_parameters_together(lamp):
    """A step in all parameters at once, each in the direction that makes the picture brighter."""
    tracer = sampled(two_yarns(), lights=LAMPS[lamp])
    names = tracer.optics.names()
    rows = gradients(tracer, 64, 8)
    signs = np.sign(np.mean(rows, axis=0))
    direction = signs * [next(STEP[k] for k in STEP if k in name) for name in names]
    # The signs come from the gradient, but both sides of the comparison take them as they are.
    a, da = mean_and_error([g @ direction for g in gradients(tracer, 64, 40)[8:]])
    b, db = mean_and_error(finite_difference(tracer, direction, 64, 12))
    assert np.hypot(da, db) < 0.02 * abs(a), f"too noisy to tell: {a} +- {da}, {b} +- {db}"
    assert abs(a - b) < 4.0 * np.hypot(da, db) + 0.01 * abs(a), f"{a} +- {da}, {b} +- {db}"


@pytest.mark.slow
@pytest.mark.parametrize("lamp", LAMPS)
def test_each_parameter(lamp):
    """Within the errors, which are below 2 % of the value or of a hundredth of the picture's brightness."""
    tracer = sampled(two_yarns(), depth=3, side=32, lights=LAMPS[lamp])
    rows = gradients(tracer, 64, 24)
    mean, error = mean_and_error(rows)
    bright = tracer.render(tracer.optics, 16, 9).mean()
    for k, name in enumerate(tracer.optics.names()):
        step, runs = next(STEP[s] for s in STEP if s in name), 12
        if "ior" in name:
            # Light bends so strongly with the index that a difference over +-0.08 is 2 % below the derivative (and
            # over +-0.16, 7 %). Half the step leaves a quarter of that; more runs keep the noise where it was.
            step, runs = step / 2, 80
        d, dd = mean_and_error(finite_difference(tracer, step * np.eye(tracer.optics.size)[k], 64, runs))
        d, dd = d / step, dd / step
        both = np.hypot(error[k], dd)
        assert both < max(0.02 * abs(mean[k]), 0.02 * bright), (
            f"{name}: too noisy, {mean[k]} +- {error[k]}, {d} +- {dd}"
        )
        assert abs(mean[k] - d) < 4.0 * both + 0.01 * abs(mean[k]), f"{name}: {mean[k]} +- {error[k]}, {d} +- {dd}"


# --- cases with a known answer ---


def furnace(cloth: FabricParameters, depth: int = 2000) -> DifferentiableTracer:
    scene: Scene = scene_of([plane(10.0)], [cloth_material()], [dome()], [cloth])
    camera: Camera = look((0.02, -0.05, 0.1), (0, 0, 0), (0.02, 0.02))
    return DifferentiableTracer(scene, camera, (SIDE, SIDE), max_depth=depth)


def test_white_furnace():
    """White cloth in a white dome is as bright as the dome whatever its roughness and index."""
    tracer = furnace(fabric(fibers=8, albedo=(1, 1, 1)))
    rows = gradients(tracer, 32, 8)
    mean, error = mean_and_error(rows)
    assert np.all(mean[:6] == 0.0)  # sigma = (ln C / q)^2 is flat at C = 1
    assert np.all(error[6:] < 0.15), f"too noisy to tell: {error}"
    assert np.all(error[6:] > 0.0)
    assert np.all(abs(mean[6:]) < 5.0 * error[6:]), (mean, error)


def test_grey_furnace():
    """What absorbing cloth in a white dome takes away, by finite differences, for each channel's two albedos."""
    tracer = furnace(fabric(fibers=8, albedo=(0.8, 0.6, 0.3)), depth=40)
    mean, error = mean_and_error(gradients(tracer, 16, 8))
    assert np.all(mean[:6] > 10.0 * error[:6])
    v, step = tracer.optics.vector(), 0.05
    for channel in range(3):
        up = step * np.isin(np.arange(len(v)), (channel, channel + 3))
        d = [(tracer.render(v + up, 24, s) - tracer.render(v - up, 24, s))[..., channel].mean() for s in range(8)]
        expected, doubt = (x / (2.0 * step) / 3.0 for x in mean_and_error(d))
        both = np.hypot(doubt, np.hypot(error[channel], error[channel + 3]))
        got = mean[channel] + mean[channel + 3]
        assert both < 0.05 * got, f"too noisy to tell: {got}, {expected} +- {doubt}"
        assert abs(got - expected) < 4.0 * both + 0.02 * got, f"{got}, {expected} +- {doubt}"


# --- owners ---


def test_stripes_share_what_one_colour_has():
    """Two nearly equal colours in turn: their derivatives add up to those of the one colour, on the same paths."""
    plain = two_yarns()
    color = plain.weft.albedo
    almost = tuple(c + 1e-9 for c in color)
    stripes = replace(plain, weft=replace(plain.weft, yarn_albedo=(color, almost)))
    a, b = (t.gradient(t.optics, np.ones((SIDE, SIDE, 3)), 8, 1) for t in (sampled(plain), sampled(stripes)))
    assert len(b) == len(a) + 3
    np.testing.assert_allclose(b[3:6] + b[6:9], a[3:6], rtol=1e-5)
    np.testing.assert_allclose(np.r_[b[:3], b[9:]], np.r_[a[:3], a[6:]], rtol=1e-5)
    assert np.all(abs(b[3:9]) > 0.1 * abs(np.r_[a[3:6], a[3:6]]))


def test_flyaways_and_variants_belong_to_their_yarns():
    cloth = two_yarns(flyaway_density=3000.0)
    cloth = replace(cloth, variants=2)
    tracer = sampled(cloth)
    materials = len(tracer._owners)
    assert materials == 8  # two tiles, two systems, fibers and flyaways
    assert set(map(tuple, tracer._owners.tolist())) == {(0, 0), (1, 1)}


def test_another_fabric_has_no_derivatives():
    """Two fabrics: the derivatives are those of the one asked for, in its part of the picture and by light from it."""
    ours, other = two_yarns(), fabric("twill 2/2", fibers=8, albedo=(0.3, 0.6, 0.3))
    meshes = [plane(0.02, 0, center=(-0.01, 0.0)), plane(0.02, 1, center=(0.01, 0.0))]
    both = scene_of(meshes, [cloth_material(0), cloth_material(1)], [dome()], [ours, other])
    camera = look((0, 0, 0.1), (0, 0, 0), (0.05, 0.05))
    for index, half in ((0, slice(0, SIDE // 2)), (1, slice(SIDE // 2, SIDE))):
        tracer = DifferentiableTracer(both, camera, (SIDE, SIDE), max_depth=3, fabric=index)
        jacobian = abs(tracer.gradient_images(tracer.optics, 8, 0)[1]).sum(axis=(0, 1, 3))
        inside = jacobian[half].sum()
        assert inside > 50.0 * (jacobian.sum() - inside)


# --- less noise ---


def test_keep_takes_noise_and_leaves_attenuation_alone():
    narrow = fabric(fibers=8, roughness_azimuthal=0.1, roughness_primary=0.15, albedo=(0.9, 0.9, 0.9))
    tracer = sampled(narrow, depth=24)
    exact = gradients(tracer, 8, 8)
    tracer.keep = 0.5
    faded = gradients(tracer, 8, 8)
    np.testing.assert_array_equal(np.array(exact)[:, :6], np.array(faded)[:, :6])
    noise = np.std(faded, axis=0)[6:] / np.std(exact, axis=0)[6:]
    assert np.median(noise) < 0.7, noise


# --- bad input ---


def test_what_makes_no_sense_is_said(tracer):
    scene, camera = swatch(tracer.fabric)
    with pytest.raises(UsdfabError, match="adjoint: expected finite numbers"):
        tracer.gradient(tracer.optics, np.ones((SIDE, SIDE)), 1, 0)
    with pytest.raises(UsdfabError, match="adjoint: expected finite numbers"):
        tracer.gradient(tracer.optics, np.full((SIDE, SIDE, 3), np.nan), 1, 0)
    with pytest.raises(UsdfabError, match="0 samples"):
        tracer.gradient(tracer.optics, np.ones((SIDE, SIDE, 3)), 0, 0)
    with pytest.raises(UsdfabError, match="expected 14"):
        tracer.render(np.zeros(13), 1, 0)
    with pytest.raises(UsdfabError, match="roughness_longitudinal"):
        tracer.render(tracer.optics.with_vector(np.r_[np.full(6, 0.5), np.full(6, 2.0), 1.5, 1.5]), 1, 0)
    with pytest.raises(UsdfabError, match="block"):
        tracer.gradient_images(tracer.optics, 1, 0, block=5)
    with pytest.raises(UsdfabError, match="keep"):
        DifferentiableTracer(scene, camera, (4, 4), keep=1.5)
    with pytest.raises(UsdfabError, match="none is number 1"):
        DifferentiableTracer(scene, camera, (4, 4), fabric=1)
    with pytest.raises(UsdfabError, match="at least 1"):
        DifferentiableTracer(scene, camera, (0, 4))
