"""How pictures are judged, and the camera that is settled when the cloth is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_network import small_net

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fit import features, judge as judge_module, match_space
from usdfab.fit.features import FeatureNet
from usdfab.fit.judge import Judge, clear_picture, through_camera
from usdfab.fit.raster_stage import StageSettings
from usdfab.imaging import denoise
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.cached_tracer import LEARNED_FROM, OTHER_PATHS, CachedTracer
from usdfab.usd.rig import Rig, rig_for, sample_scene

YARN = YarnParameters(count=3, radius=3e-4, fiber_count=6, albedo=(0.6, 0.4, 0.3), roughness_azimuthal=0.3)
CLOTH = FabricParameters(weave_from_name("plain"), (2e-3, 2e-3), YARN, replace(YARN, albedo=(0.3, 0.5, 0.7)))
SIDE = 48
SETTINGS = StageSettings(width=SIDE, supersampling=1, levels=(1, 2), kind="gram")
SCALE = SIDE / CLOTH.size[0]
CAMERA = replace(rig_for(CLOTH.size), blur=0.9 / SCALE, contrast=1.3)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> FeatureNet:
    return small_net(tmp_path_factory.mktemp("net"), features.fast_dtype())


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return clear_picture(CLOTH, None, (SIDE, SIDE), 8)


def judge_of(picture: np.ndarray, net: FeatureNet, rig: Rig | None, exposure: float) -> Judge:
    return Judge(through_camera(picture, rig, SCALE, exposure), SETTINGS, net)


def test_the_camera_is_found_from_a_picture_of_the_cloth(
    picture: np.ndarray, net: FeatureNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In pixels as large as those of the pictures that judge photos.
    monkeypatch.setattr(match_space, "BLUR_UNIT", 1.0 / SIDE)
    # The first camera is far off here.
    monkeypatch.setattr(judge_module, "SETTLING", 80)
    judge = judge_of(picture, net, CAMERA, 1.3)
    before = judge.distance(picture, CLOTH.size[0], 1.0)
    exposure, rig, distance = judge.settled(picture, CLOTH, 1.0, None)
    assert distance < 0.02 * before
    assert distance == judge.distance(picture, CLOTH.size[0], exposure, rig)
    assert rig is not None
    assert exposure == pytest.approx(1.3, rel=0.02)
    assert rig.blur * SCALE == pytest.approx(0.9, rel=0.02)
    assert rig.contrast == pytest.approx(1.3, rel=0.02)
    assert rig.light_positions == CAMERA.light_positions


def test_a_camera_that_fits_stays(picture: np.ndarray, net: FeatureNet) -> None:
    for rig, exposure in ((None, 1.0), (CAMERA, 0.8)):
        judge = judge_of(picture, net, rig, exposure)
        assert judge.settled(picture, CLOTH, exposure, rig) == (exposure, rig, judge.distance(
            picture, CLOTH.size[0], exposure, rig
        ))  # fmt: skip


def test_pictures_end_at_a_cache_learned_from_other_paths(picture: np.ndarray) -> None:
    scene = sample_scene(CLOTH)
    tracer, camera, settings = Tracer(scene), scene.cameras[0], RenderSettings((SIDE, SIDE), spp=8)
    small = replace(settings, resolution=(SIDE // LEARNED_FROM,) * 2, seed=OTHER_PATHS)
    render = CachedTracer(tracer, camera, small).render(camera, settings)
    np.testing.assert_array_equal(picture, denoise(render.pixels, render.albedo, render.normal))
