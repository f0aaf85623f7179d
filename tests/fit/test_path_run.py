"""The path stage as the pipeline runs it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from path_pictures import cloth
from small_network import small_net

from usdfab.fit import features, path_stage
from usdfab.fit.path_run import run_path
from usdfab.fit.path_settings import settings_for
from usdfab.fit.raster_stage import StageSettings
from usdfab.imaging.lens import toned
from usdfab.usd.rig import Rig, rig_for


class Begun(Exception):
    """What the stage was to begin with."""


def test_a_cameras_contrast_is_taken_out_of_what_is_fitted(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Exposed, then toned, is how a camera works; backwards, the stage sees light."""
    net = small_net(tmp_path_factory.mktemp("net"), features.fast_dtype())
    monkeypatch.setattr(features, "load_features", lambda *_, **__: net)

    def begun(_: object, picture: np.ndarray, **__: object) -> None:
        raise Begun(picture)

    monkeypatch.setattr(path_stage, "refine_appearance", begun)
    fabric = cloth()
    light = np.random.default_rng(0).random((48, 48, 3)).astype(np.float32)
    judge = StageSettings(width=32, supersampling=1, levels=(1,), kind="gram")

    def fitted(photo: np.ndarray, rig: Rig | None, exposure: float) -> np.ndarray:
        with pytest.raises(Begun) as caught:
            run_path(
                fabric, photo, 0.0, settings_for("draft"), judge, exposure=exposure, rig=rig, distance=0.5
            )  # fmt: skip
        return caught.value.args[0]

    expected = fitted(light, None, 1.0)
    assert expected.std() > 0.05
    for contrast, exposure in ((1.0, 1.6), (1.4, 1.6), (0.7, 0.5)):
        photo = toned(np.float32(exposure) * light, contrast)
        rig = replace(rig_for(fabric.size), contrast=contrast)
        np.testing.assert_allclose(fitted(photo, rig, exposure), expected, rtol=1e-4, atol=1e-6)
