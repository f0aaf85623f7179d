"""A small random network of VGG's kind, written as a weights file; small enough for checks by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

from usdfab.fit.features import FeatureNet, load_features

LAYERS = {"conv1_1": (3, 4), "conv1_2": (4, 4), "conv2_1": (4, 6)}
"""Input and output channels."""


def tensors(seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights and biases, by key."""
    rng = np.random.default_rng(seed)
    result = {}
    for name, (inside, outside) in LAYERS.items():
        scale = (0.01 if name == "conv1_1" else 1.0) / np.sqrt(9 * inside)
        result[f"{name}.weight"] = rng.normal(0.0, scale, (outside, inside, 3, 3))
        result[f"{name}.bias"] = rng.normal(0.2, 0.1, outside)
    return result


def small_net(folder: Path, dtype: torch.dtype = torch.float64, seed: int = 0, **options: object) -> FeatureNet:
    """The network, tapped at conv1_1 and conv2_1, read from a file in ``folder``."""
    save_file(tensors(seed), folder / "net.safetensors")
    return load_features(folder / "net.safetensors", dtype=dtype, **options)  # type: ignore[arg-type]


def picture(seed: int, height: int = 32, width: int = 32, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """(1, 3, H, W) of smooth random colours in (0.05, 0.95)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 16.0
    waves = rng.uniform(-4, 4, (3, 6, 2)).round()
    phases = rng.uniform(0, 6.3, (3, 6))
    shape = np.sin(
        2 * np.pi * (waves[..., 0, None, None] * x + waves[..., 1, None, None] * y) + phases[..., None, None]
    )
    return torch.tensor(0.5 + 0.45 * shape.mean(axis=1), dtype=dtype)[None]
