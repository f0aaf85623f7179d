"""The denoiser: less error than the noisy picture, guides kept, no dependency needed until it is used."""

from __future__ import annotations

import numpy as np
import pytest

from usdfab.errors import UsdfabError
from usdfab.imaging import denoise


def test_noise_goes_and_what_the_guides_show_stays() -> None:
    pytest.importorskip("mitsuba_oidn")
    rng = np.random.default_rng(0)
    # Thin stripes, as fibers are, in the albedo; lit evenly.
    x = np.arange(128)
    albedo = np.where((x // 3) % 2 == 0, 0.8, 0.2)[None, :, None] * np.ones((128, 1, 3))
    normal = np.broadcast_to([0.0, 0.0, 1.0], albedo.shape)
    noisy = albedo * rng.gamma(1.0, 1.0, albedo.shape[:2])[..., None]
    clean = denoise(noisy, albedo, normal)
    assert np.sqrt(np.mean((clean - albedo) ** 2)) < 0.35 * np.sqrt(np.mean((noisy - albedo) ** 2))
    assert clean[:, x // 3 % 2 == 0].mean() > 2.5 * clean[:, x // 3 % 2 == 1].mean()
    assert clean.mean() == pytest.approx(noisy.mean(), rel=0.05)


def test_a_missing_denoiser_is_said_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsdfabError, match=r"pip install 'usdfab\[denoise\]'"):
        denoise(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.zeros((4, 4, 3)))
