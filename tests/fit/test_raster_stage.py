"""Stage 2: what is moved comes back, and the same work gives the same numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_network import small_net

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fabric.optics import optics_of
from usdfab.fit import raster_stage
from usdfab.fit.features import FeatureNet
from usdfab.fit.path_stage import start_from_joint
from usdfab.fit.raster.renderer import RasterSettings, raster_renderer
from usdfab.fit.raster.unconstrained import FREE_NAMES, parameters_of, soft_range, within_ranges
from usdfab.fit.raster_multiple import measured_diffuse
from usdfab.fit.raster_stage import (
    QUALITIES,
    StageSettings,
    matching_diffuse,
    refine_by_raster,
    straightened,
)
from usdfab.imaging import denoise
from usdfab.imaging.lens import through_lens
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import rig_for, swatch_scene

YARN = YarnParameters(
    count=4, radius=2.4e-4, fiber_count=8, inclination=0.7, crimp=0.8, twist=0.1, flattening=1.2,
    roughness_longitudinal=0.4, roughness_azimuthal=0.2,
)  # fmt: skip
CLOTH = FabricParameters(
    weave_from_name("plain"), (2e-3, 2e-3),
    replace(YARN, albedo=(0.7, 0.4, 0.2)), replace(YARN, albedo=(0.2, 0.4, 0.6)), seed=3,
)  # fmt: skip
QUICK = StageSettings(width=48, supersampling=1, iterations=12, rate=0.08, levels=(1, 2, 4), prior=0.0)
ROUNDS = replace(QUICK, steps="newton", iterations=2, prior=1.0)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> FeatureNet:
    return small_net(tmp_path_factory.mktemp("net"), torch.float32)


def shown(fabric: FabricParameters, diffuse: float, width: int = 48) -> np.ndarray:
    """The raster image of a fabric."""
    renderer = raster_renderer(swatch_scene(fabric), RasterSettings((width, width), 1))
    with torch.no_grad():
        return renderer.image(renderer.model.shapes(), renderer.look_of(diffuse)).numpy()


@pytest.mark.parametrize(("name", "wrong"), [("flattening", 1.9), ("radius", 1.7e-4), ("crimp", 1.3)])
def test_a_wrong_shape_comes_back(net: FeatureNet, name: str, wrong: float) -> None:
    # The target has other random draws, so only statistics can tell.
    target = shown(replace(CLOTH, seed=8), 0.25)
    changed = {s: replace(CLOTH.system(s), **{name: wrong}) for s in ("warp", "weft")}  # type: ignore[arg-type]
    start = replace(CLOTH, **changed)  # type: ignore[arg-type]
    settings = replace(QUICK, free=(name,))
    found = refine_by_raster(start, target, settings, net=net, diffuse=0.25)
    true = getattr(YARN, name)
    errors = [abs(getattr(found.fabric.system(s), name) - true) for s in ("warp", "weft")]
    assert np.mean(errors) < 0.7 * abs(wrong - true)
    assert found.best_loss < found.losses[0]


@pytest.mark.parametrize(("name", "wrong"), [("flattening", 1.9), ("radius", 1.7e-4)])
def test_a_wrong_shape_comes_back_by_gauss_newton(net: FeatureNet, name: str, wrong: float) -> None:
    target = shown(replace(CLOTH, seed=8), 0.25)
    changed = {s: replace(CLOTH.system(s), **{name: wrong}) for s in ("warp", "weft")}  # type: ignore[arg-type]
    start = replace(CLOTH, **changed)  # type: ignore[arg-type]
    settings = replace(ROUNDS, free=(name,), iterations=5)
    found = refine_by_raster(start, target, settings, net=net, diffuse=0.25)
    errors = [abs(getattr(found.fabric.system(s), name) - getattr(YARN, name)) for s in ("warp", "weft")]
    assert np.mean(errors) < 0.7 * abs(wrong - getattr(YARN, name))
    assert found.best_loss < found.losses[0]


def test_resumed_rounds_are_the_undisturbed_ones(net: FeatureNet, tmp_path: Path) -> None:
    target = shown(replace(CLOTH, seed=8), 0.25)
    start = replace(CLOTH, warp=replace(CLOTH.warp, crimp=1.2))
    settings = replace(ROUNDS, free=("crimp", "albedo"))
    whole = refine_by_raster(start, target, settings, net=net)
    path = tmp_path / "raster.safetensors"
    refine_by_raster(start, target, replace(settings, iterations=1), net=net, checkpoint=path)
    rest = refine_by_raster(start, target, settings, net=net, checkpoint=path, resume=True)
    assert rest.losses == whole.losses
    assert rest.fabric == whole.fabric
    assert np.array_equal(rest.render, whole.render)


def test_rounds_beside_path_traced_pictures_count_their_loss_and_resume(
    net: FeatureNet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(raster_stage, "measured_diffuse", lambda *_: measured_diffuse(*_, paths=4000))

    def traced(fabric: FabricParameters) -> np.ndarray:
        scene = swatch_scene(fabric)
        render = Tracer(scene).render(scene.cameras[0], RenderSettings((48, 48), spp=64, seed=1))
        return denoise(render.pixels, render.albedo, render.normal)

    # The same draws: others tell more of themselves in so small a picture than the crimp does.
    target = traced(CLOTH)
    start = replace(CLOTH, warp=replace(CLOTH.warp, crimp=1.3), weft=replace(CLOTH.weft, crimp=1.3))
    settings = replace(ROUNDS, free=("crimp",), tied=True, traced=32)
    path = tmp_path / "raster.safetensors"
    refine_by_raster(start, target, replace(settings, iterations=1), net=net, checkpoint=path)
    rest = refine_by_raster(start, target, settings, net=net, checkpoint=path, resume=True)
    whole = refine_by_raster(start, target, settings, net=net)
    assert rest.losses == whole.losses
    assert rest.fabric == whole.fabric
    assert whole.best_loss < whole.losses[0]
    alone = refine_by_raster(start, target, replace(settings, traced=0), net=net)
    near, far = (
        np.mean([abs(r.fabric.system(s).crimp - 0.8) for s in ("warp", "weft")]) for r in (whole, alone)
    )  # fmt: skip
    assert near < 0.7 * 0.5
    assert near < far
    with pytest.raises(UsdfabError, match="belongs to another"):
        refine_by_raster(start, target, replace(settings, traced=8), net=net, checkpoint=path, resume=True)


def test_wrong_colours_and_exposure_come_back(net: FeatureNet) -> None:
    target = shown(replace(CLOTH, seed=8), 0.25)
    start = replace(
        CLOTH, warp=replace(CLOTH.warp, albedo=(0.4, 0.4, 0.4)), weft=replace(CLOTH.weft, albedo=(0.4, 0.4, 0.4))
    )
    found = refine_by_raster(start, target, replace(QUICK, free=("albedo", "diffuse")), net=net, diffuse=0.4)
    assert found.best_loss < 0.5 * found.losses[0]
    assert found.render.mean(axis=(0, 1)) == pytest.approx(target.mean(axis=(0, 1)), rel=0.05)
    found = refine_by_raster(CLOTH, 1.5 * target, replace(QUICK, free=("gain",)), net=net, diffuse=0.25)
    assert found.gain == pytest.approx(1.5, rel=0.1)


def test_resumed_work_is_the_undisturbed_work(net: FeatureNet, tmp_path: Path) -> None:
    target = shown(replace(CLOTH, seed=8), 0.25)
    start = replace(CLOTH, warp=replace(CLOTH.warp, crimp=1.2))
    whole = refine_by_raster(start, target, replace(QUICK, iterations=6), net=net)
    path = tmp_path / "raster.safetensors"

    def stop(done: int, total: int, loss: float) -> None:
        if done == 3:
            raise KeyboardInterrupt

    first = refine_by_raster(start, target, replace(QUICK, iterations=6), net=net, checkpoint=path, progress=stop)
    assert first.interrupted
    rest = refine_by_raster(start, target, replace(QUICK, iterations=6), net=net, checkpoint=path, resume=True)
    assert len(first.losses) == 3
    assert rest.losses == whole.losses
    assert rest.fabric == whole.fabric
    assert rest.gain == whole.gain
    assert np.array_equal(rest.diffuse, whole.diffuse)
    assert np.array_equal(rest.render, whole.render)
    with pytest.raises(UsdfabError, match="belongs to another"):
        refine_by_raster(start, target[:-2], QUICK, net=net, checkpoint=path, resume=True)


def test_the_map_without_bounds_and_back() -> None:
    parameters = parameters_of(CLOTH, 0.25, 1.3)
    assert torch.allclose(parameters.natural(parameters.vector()), parameters.start, rtol=1e-12)
    assert len(parameters.names) == 2 * 6 + 2 * 2 * 3 + 2 * 3 + 1
    assert parameters.fabric_of(parameters.start) == CLOTH
    shapes, look = parameters.of(parameters.start)
    assert float(shapes[1].crimp) == 0.8
    assert torch.equal(look.albedo, torch.from_numpy(optics_of(CLOTH).albedo))
    assert float(look.gain) == 1.3
    for far in (-40.0, 40.0):
        moved = parameters.natural(torch.full_like(parameters.vector(), far))
        for name, value in zip(parameters.names, moved.tolist(), strict=True):
            low, high = soft_range(name.removeprefix("warp.").removeprefix("weft.").split("[")[0])
            rounding = 1e-12 * max(abs(low), 1.0)
            assert low - rounding <= value <= high + rounding, name


def test_every_free_number_has_its_own_slope() -> None:
    parameters = parameters_of(CLOTH, 0.25)
    slopes = torch.autograd.functional.jacobian(parameters.natural, parameters.vector())
    assert torch.equal(slopes != 0.0, torch.eye(len(parameters.names), dtype=torch.bool))
    assert slopes.isfinite().all()


def test_only_what_is_free_moves() -> None:
    parameters = parameters_of(CLOTH, 0.25, free=("crimp", "gain"))
    assert parameters.free_names == ("warp.crimp", "weft.crimp", "gain")
    moved = parameters.natural(parameters.vector() + 0.1)
    changed = {n for n, a, b in zip(parameters.names, moved, parameters.start, strict=True) if not torch.isclose(a, b)}
    assert changed == {"warp.crimp", "weft.crimp", "gain"}


def test_starts_outside_the_ranges_are_one_line() -> None:
    wild = replace(CLOTH, weft=replace(CLOTH.weft, crimp=3.0))
    with pytest.raises(UsdfabError, match=r"weft\.crimp starts at 3, outside its range"):
        parameters_of(wild)
    parameters_of(wild, free=("twist",))
    tame, outside = within_ranges(wild)
    assert outside == ("weft.crimp",)
    assert tame.weft.crimp == soft_range("crimp")[1]
    assert within_ranges(CLOTH) == (CLOTH, ())
    with pytest.raises(UsdfabError, match="cannot move 'colour'"):
        parameters_of(CLOTH, free=("colour",))
    assert set(FREE_NAMES) >= {"diffuse", "gain"}


def test_diffuse_starts_at_the_targets_colour() -> None:
    target = shown(CLOTH, 0.3)
    renderer = raster_renderer(swatch_scene(CLOTH), RasterSettings((48, 48), 1))
    with torch.no_grad():
        image = renderer.image(
            renderer.model.shapes(), renderer.look_of(matching_diffuse(renderer, target.mean(axis=(0, 1))))
        )
    assert image.mean(dim=(0, 1)).numpy() == pytest.approx(target.mean(axis=(0, 1)), rel=1e-3)


def test_tracing_starts_halfway_between_albedo_and_diffuse(net: FeatureNet) -> None:
    target = shown(CLOTH, 0.3)
    found = refine_by_raster(CLOTH, target, replace(QUICK, iterations=1), net=net, diffuse=0.3)
    assert optics_of(start_from_joint(found.fabric, found.diffuse)).albedo == pytest.approx(
        0.5 * (optics_of(CLOTH).albedo + 0.3)
    )


def test_a_turned_photo_is_straightened() -> None:
    # Stripes that stand upright in cloth which lies turned counter-clockwise in the photo.
    angle, pitch = math.radians(12), 12.0
    y, x = np.mgrid[:160, :200].astype(float)
    across = x * math.cos(angle) - y * math.sin(angle)
    photo = np.repeat(0.5 + 0.4 * np.sin(2 * math.pi * across / pitch)[..., None], 3, axis=2)
    straight = straightened(photo, angle, 1e5, 1e5)
    assert straight.std(axis=0).mean() < 0.02
    assert straight.std(axis=1).mean() > 0.2
    frequency = np.abs(np.fft.rfft(straight.mean(axis=0)[:, 0] - straight.mean()))
    assert straight.shape[1] / np.argmax(frequency) == pytest.approx(pitch, rel=0.1)
    half = straightened(photo, 0.0, 1e5, 5e4)
    assert half.shape == (80, 100, 3)
    assert half.mean() == pytest.approx(photo.mean(), rel=0.01)


def test_a_small_target_is_refused(net: FeatureNet) -> None:
    with pytest.raises(UsdfabError, match="too few to be reduced"):
        refine_by_raster(CLOTH, np.full((4, 4, 3), 0.5), QUICK, net=net)
    assert set(QUALITIES) == {"draft", "standard", "paper"}


def test_a_rig_whose_camera_is_not_sharp_blurs_the_pictures(net: FeatureNet) -> None:
    """Known blur goes with every picture, and does not become a property of the cloth."""
    target = through_lens(shown(CLOTH, 0.25), 1.0)
    settings = replace(QUICK, iterations=1, free=("flattening",))
    rig = rig_for(CLOTH.size)
    soft = replace(rig, blur=1.0 * CLOTH.size[0] / settings.width)
    sharp, blurred = (refine_by_raster(CLOTH, target, settings, net=net, rig=r, diffuse=0.25) for r in (rig, soft))
    assert blurred.best_loss < 1e-3 < 0.1 * sharp.best_loss
    np.testing.assert_allclose(blurred.render, through_lens(sharp.render, 1.0), atol=1e-5)
