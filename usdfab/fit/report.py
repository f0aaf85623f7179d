"""Pictures of a fit: the photo, the fitted swatch under the capture rig, and both side by side at the same scale."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.errors import UsdfabError
from usdfab.fit.pipeline import Fit
from usdfab.imaging import denoise, side_by_side, write_image
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.rig import swatch_scene

HEIGHT = 480
"""Rows of the report's pictures."""


def write_report(
    fit: Fit,
    folder: str | Path,
    *,
    spp: int = 24,
    seed: int = 0,
    denoised: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Path]:
    """Write ``photo.png``, ``swatch.png`` and ``comparison.png`` (photo left, swatch right) into ``folder``.

    ``denoised`` cleans the swatch with the denoiser. The folder is made if it is missing. Returns the paths by name.
    """
    target = Path(folder)
    paths = {name: target / f"{name}.png" for name in ("photo", "swatch", "comparison")}
    if target.exists() and not target.is_dir():
        raise UsdfabError("a file is in the folder's place", place=str(target), remedy="choose another folder")
    existing = [p for p in paths.values() if p.exists()]
    if existing and not overwrite:
        raise UsdfabError("the file exists", place=str(existing[0]), remedy="choose another folder or use --overwrite")
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror})", place=str(target)) from error
    photo = resized(fit.photo, HEIGHT)
    scene = swatch_scene(fit.fabric)
    settings = RenderSettings((photo.shape[1], photo.shape[0]), spp=spp, seed=seed)
    render = Tracer(scene).render(scene.cameras[0], settings, progress)
    swatch = denoise(render.pixels, render.albedo, render.normal) if denoised else render.pixels
    write_image(paths["photo"], photo, overwrite=overwrite)
    write_image(paths["swatch"], swatch, overwrite=overwrite)
    write_image(paths["comparison"], side_by_side([photo, swatch]), overwrite=overwrite)
    return paths


def resized(pixels: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """A linear picture (H, W, 3) at another height, aspect kept: filtered when shrunk, cubic when enlarged."""
    factor = height / pixels.shape[0]
    if factor < 1.0:
        sigma = 0.5 * (1.0 / factor - 1.0)
        pixels = ndimage.gaussian_filter(pixels, (sigma, sigma, 0.0))
    width = max(1, round(pixels.shape[1] * factor))
    zoom = (height / pixels.shape[0], width / pixels.shape[1], 1.0)
    return np.clip(ndimage.zoom(pixels, zoom, order=3, mode="nearest", grid_mode=True), 0.0, None).astype(np.float32)
