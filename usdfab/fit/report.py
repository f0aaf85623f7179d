"""The report of a fit: an HTML page, and its pictures beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from usdfab.errors import UsdfabError
from usdfab.files import whole_file
from usdfab.fit.comparison import difference
from usdfab.fit.course import Course
from usdfab.fit.judge import through_camera
from usdfab.fit.pipeline import Fit
from usdfab.fit.report_page import report_page
from usdfab.fit.straighten import straightened
from usdfab.imaging import denoise, side_by_side, write_image
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.drape import drape_scene
from usdfab.usd.rig import sample_scene

HEIGHT = 480
"""Rows of the report's pictures."""

DRAPE_SIZE = (640, 480)
PAGE = "report"
"""The page's name among the report's files."""


def check_report_folder(folder: str | Path, *, overwrite: bool = False) -> None:
    """Refuse, before any work, a folder that a report may not be written into.

    Raises
    ------
    UsdfabError
        For a file in its place, and for a report in it unless ``overwrite``.
    """
    target = Path(folder)
    if target.exists() and not target.is_dir():
        raise UsdfabError("a file is in the folder's place", place=str(target), remedy="choose another folder")
    there = [file for file in (target / f"{PAGE}.html", target / "photo.png") if file.exists()]
    if there and not overwrite:
        raise UsdfabError("the file exists", place=str(there[0]), remedy="choose another folder or use --overwrite")


def write_report(
    fit: Fit,
    folder: str | Path,
    *,
    spp: int = 24,
    seed: int = 0,
    denoised: bool = False,
    overwrite: bool = False,
    asset: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Path]:
    """Write ``report.html`` into ``folder``, a page that needs nothing else, and its pictures as PNG beside it.

    Swatches are as bright as the photo (``fit.exposure``).
    These are ``photo``, ``swatch``, ``comparison`` (photo, then a swatch for each stage), ``difference`` (fit minus
    photo), ``drape``; after several stages ``after_STAGE`` for each but the last, and for a stage with iterations
    ``STAGE_loss``.

    Parameters
    ----------
    folder:
        Made if it is missing.
    spp, seed, denoised:
        Of the pictures; ``denoised`` cleans them with the denoiser.
    asset:
        The USD file that the fit was written to, for the page to name.
    progress:
        Called with (steps done, steps to do) of all pictures together.

    Returns
    -------
    The paths by name, the page as ``report``.

    Raises
    ------
    UsdfabError
        If a file is there already (unless ``overwrite``) or cannot be written.
    """
    target = Path(folder)
    earlier, curves = fit.stages[:-1], [stage for stage in fit.stages if len(stage.losses) > 1]
    shown = {f"after_{stage.name}": (stage.fabric, stage.rig, stage.exposure) for stage in earlier}
    shown["swatch"] = fit.fabric, fit.rig, fit.exposure
    names = ["photo", *shown, "comparison", "difference", "drape", *(f"{stage.name}_loss" for stage in curves)]
    paths = {name: target / f"{name}.png" for name in names} | {PAGE: target / f"{PAGE}.html"}
    check_report_folder(target, overwrite=overwrite)
    existing = [p for p in paths.values() if p.exists()]
    if existing and not overwrite:
        raise UsdfabError("the file exists", place=str(existing[0]), remedy="choose another folder or use --overwrite")
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror})", place=str(target)) from error
    photo = resized(fit.photo, HEIGHT)
    size = (photo.shape[1], photo.shape[0])
    scenes = {name: (sample_scene(fabric, rig), size) for name, (fabric, rig, _) in shown.items()}
    scenes["drape"] = (drape_scene(fit.fabric, DRAPE_SIZE[0] / DRAPE_SIZE[1]), DRAPE_SIZE)
    course = Course(lambda _, done, total: progress(done, total) if progress else None, dict.fromkeys(scenes, 1.0))
    pictures = {"photo": photo}
    for name, (scene, resolution) in scenes.items():
        within = course.stage(name)
        settings = RenderSettings(resolution, spp=spp, seed=seed)
        render = Tracer(scene).render(
            scene.cameras[0], settings, lambda done, total, within=within: within("", done, total)  # type: ignore[misc]
        )  # fmt: skip
        course.finish(name)
        clean = denoise(render.pixels, render.albedo, render.normal) if denoised else render.pixels
        if name == "drape":
            pictures[name] = clean
        else:
            fabric, rig, exposure = shown[name]
            pictures[name] = through_camera(clean, rig, resolution[0] / fabric.size[0], exposure)
    pictures["comparison"] = side_by_side([pictures["photo"], *(pictures[name] for name in shown)])
    scale = photo.shape[1] / fit.fabric.size[0]
    upright = straightened(fit.photo, fit.analysis.rotation, fit.photo.shape[1] / fit.fabric.size[0], scale)
    pictures["difference"], correlation = difference(upright, pictures["swatch"], fit.fabric)
    pictures |= {f"{stage.name}_loss": loss_curve(stage.losses) for stage in curves}
    for name in names:
        write_image(paths[name], pictures[name], overwrite=overwrite)
    page = report_page(fit, {name: paths[name] for name in names}, asset=asset, correlation=correlation)
    try:
        with whole_file(paths[PAGE]) as temporary:
            temporary.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UsdfabError(f"cannot be written ({error.strerror})", place=str(paths[PAGE])) from error
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
