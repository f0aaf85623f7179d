"""Pictures of a fit: the photo and the swatches after each stage under the capture rig, side by side at one scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    """Write ``photo.png``, ``swatch.png`` and ``comparison.png`` (photo, then a swatch for each stage) into ``folder``.

    After several stages there is also ``after_STAGE.png`` for each but the last, and for a stage with iterations its
    ``STAGE_loss.png``. ``denoised`` cleans the swatches with the denoiser. The folder is made if it is missing. Returns
    the paths by name.
    """
    target = Path(folder)
    earlier, curves = fit.stages[:-1], [stage for stage in fit.stages if len(stage.losses) > 1]
    names = ["photo", *(f"after_{stage.name}" for stage in earlier), "swatch", "comparison"]
    paths = {name: target / f"{name}.png" for name in (*names, *(f"{stage.name}_loss" for stage in curves))}
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
    settings = RenderSettings((photo.shape[1], photo.shape[0]), spp=spp, seed=seed)
    pictures = {"photo": photo}
    shown = {f"after_{stage.name}": stage.fabric for stage in earlier} | {"swatch": fit.fabric}
    for name, fabric in shown.items():
        scene = swatch_scene(fabric)
        render = Tracer(scene).render(scene.cameras[0], settings, progress)
        pictures[name] = denoise(render.pixels, render.albedo, render.normal) if denoised else render.pixels
    pictures["comparison"] = side_by_side(list(pictures.values()))
    pictures |= {f"{stage.name}_loss": loss_curve(stage.losses) for stage in curves}
    for name, path in paths.items():
        write_image(path, pictures[name], overwrite=overwrite)
    return paths


def loss_curve(losses: Sequence[float], size: tuple[int, int] = (480, 240)) -> NDArray[np.float32]:
    """Losses (N,), N > 1, as a picture (H, W, 3): iterations to the right, loss upwards from 0; grey lines at tenths.

    Where a loss is not finite the curve has a gap.
    """
    width, height = size
    values = np.asarray(losses, dtype=np.float64)
    # Between neighbours; an infinity beside a gap would be 0 times infinity.
    at = np.interp(
        np.linspace(0, len(values) - 1, width), np.arange(len(values)), np.where(values < 1e9, values, np.nan)
    )
    top = 1.05 * np.nanmax(at) if np.isfinite(at).any() else 1.0
    level = (height - 1) * (1.0 - at / max(top, 1e-12))
    picture = np.ones((height, width, 3), dtype=np.float32)
    picture[np.linspace(0, height - 1, 11).astype(int)] = 0.8
    row = np.arange(height)[:, None]
    # As thick as the step to the neighbouring column, so that a steep curve is no row of dots.
    reach = 1.0 + np.abs(np.gradient(level))
    picture[np.abs(row - level) <= reach] = (0.05, 0.1, 0.4)
    return picture


def resized(pixels: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """A linear picture (H, W, 3) at another height, aspect kept: filtered when shrunk, cubic when enlarged."""
    factor = height / pixels.shape[0]
    if factor < 1.0:
        sigma = 0.5 * (1.0 / factor - 1.0)
        pixels = ndimage.gaussian_filter(pixels, (sigma, sigma, 0.0))
    width = max(1, round(pixels.shape[1] * factor))
    zoom = (height / pixels.shape[0], width / pixels.shape[1], 1.0)
    return np.clip(ndimage.zoom(pixels, zoom, order=3, mode="nearest", grid_mode=True), 0.0, None).astype(np.float32)
