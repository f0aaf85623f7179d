"""Rendering one sample: what runs in workers, a pure function of settings and index."""

from __future__ import annotations

import hashlib
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.fit.dataset.records import sample_record
from usdfab.fit.dataset.samples import draw_sample
from usdfab.fit.dataset.settings import MAX_DEPTH, Settings
from usdfab.fit.dataset.views import view_scene
from usdfab.imaging import denoise, write_image
from usdfab.imaging.image_output import HALF_MAX
from usdfab.tracer import RenderSettings, Tracer

MANTISSA_BITS = 8
"""Bits of a half float's ten that are kept: 0.2 %, far below the renders' noise, and files are a quarter smaller."""


@dataclass(frozen=True)
class Rendered:
    """A finished sample: its record, its image file's bytes, and the CPU seconds that it took."""

    index: int
    record: dict[str, Any]
    image: bytes
    seconds: float


def render_sample(settings: Settings, index: int) -> Rendered:
    """Sample ``index``, on one thread. The bytes are the same wherever it is done by the same versions."""
    begun = time.process_time()
    sample = draw_sample(settings.prior, settings.seed, index)
    scene = view_scene(sample.fabric, sample.view)
    seed = int.from_bytes(hashlib.sha256(f"{settings.seed} {index}".encode()).digest()[:4], "little")
    how = RenderSettings((settings.size, settings.size), settings.spp, MAX_DEPTH, seed, threads=1)
    render = Tracer(scene).render(scene.cameras[0], how)
    pixels = render.pixels
    if settings.denoised:
        pixels = with_mean(denoise(pixels, render.albedo, render.normal), pixels)
    image = encode_image(pixels)
    return Rendered(index, sample_record(sample, settings.rendering(), image), image, time.process_time() - begun)


def with_mean(pixels: NDArray[np.float32], unbiased: NDArray[np.float32]) -> NDArray[np.float32]:
    """``pixels`` scaled, each channel by itself, to the mean of ``unbiased``; both (H, W, 3).

    Rare bright samples hold a good part of the light of pale cloth. The denoiser takes them for errors and drops them;
    over the whole picture their sum is known well.
    """
    have, want = (np.asarray(p, dtype=np.float64).mean(axis=(0, 1)) for p in (pixels, unbiased))
    return (pixels * np.where(have > 0, want / np.maximum(have, 1e-12), 1.0)).astype(np.float32)


def encode_image(pixels: NDArray[np.float32]) -> bytes:
    """Linear pixels (H, W, 3) as an EXR file of half floats rounded to ``MANTISSA_BITS``."""
    step = 1 << (10 - MANTISSA_BITS)
    codes = np.clip(pixels, 0.0, HALF_MAX / 2).astype(np.float16).view(np.uint16).astype(np.uint32)
    rounded = ((codes + step // 2) // step * step).astype(np.uint16).view(np.float16)
    with tempfile.TemporaryDirectory(prefix="usdfab-") as folder:
        # The date would make the bytes differ.
        dated = {"DateTime": "1970:01:01 00:00:00"}
        path = write_image(Path(folder) / "image.exr", rounded.astype(np.float32), metadata=dated)
        return path.read_bytes()
