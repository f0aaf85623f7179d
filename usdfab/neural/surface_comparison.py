"""Figure 11 of Li et al. 2024: two surface models beside the fibers, close up and at a distance.

Both surface models get the geometry of ``surface_from_fabric`` and albedos fitted to small renders of the fibers under
three lamps (``surface_albedos``), so that mean colours agree there; where highlights lie, and all of the distant view,
is prediction. The fibers are path traced (and denoised where the denoiser is installed).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.presets import preset
from usdfab.files import checked_output, whole_file
from usdfab.imaging import denoise, flip, grid, mse, write_image
from usdfab.neural.aggregation import aggregate
from usdfab.neural.cylinder import Cylinder
from usdfab.neural.irawan import irawan_components
from usdfab.neural.surface_albedos import fit_reflection, observe
from usdfab.neural.surface_from_fabric import SurfaceAlbedos, surface_from_fabric
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.neural.surface_swatch import View, swatch_view
from usdfab.tracer import Render, RenderSettings, Tracer
from usdfab.usd.rig import rig_for, swatch_scene
from usdfab.usd.scene import Scene

Floats = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

FABRICS = {"plain": "linen", "twill": "denim", "satin": "silk-satin"}
"""Weaves of the figure, and the presets that stand for them."""

IRAWAN, JIN, FIBERS = "irawan_marschner_2012", "jin_2022", "fibers"
VIEWS = ("close", "distant")

CELLS_PER_PIXEL = 6.0
"""Of the distant view: a pixel sees more than the repeat of any of the weaves, and no moire appears."""

PICTURE, NUMBERS = "surface.png", "surface.json"


@dataclass(frozen=True)
class Scale:
    """How large and how long. ``close`` and ``distant`` are pixels on a side, ``spp`` those of the fibers."""

    close: int = 160
    distant: int = 128
    spp: int = 128
    samples: int = 256
    threads: int | None = None
    seed: int = 0


SCALES = {"draft": Scale(96, 80, 32), "standard": Scale(240, 160, 256), "paper": Scale(512, 384, 1024)}
"""By the names of ``--quality``."""


@dataclass(frozen=True)
class Difference:
    """How far a model's picture is from the fibers', and both mean luminances' ratio."""

    weave: str
    view: str
    model: str
    mse: float
    flip: float
    brightness: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """Pictures (H, W, 3) by (weave, view, model), and the numbers."""

    pictures: dict[tuple[str, str, str], Floats]
    rows: list[Difference]


def compare_surfaces(scale: Scale, progress: Progress | None = None, weaves: Sequence[str] | None = None) -> Comparison:
    """All weaves of ``FABRICS``, or some; both views, all models."""
    weaves = tuple(FABRICS) if weaves is None else weaves
    pictures: dict[tuple[str, str, str], Floats] = {}
    rows: list[Difference] = []
    for index, weave in enumerate(weaves):
        for (view, model), picture in _of_fabric(preset(FABRICS[weave]), scale).items():
            pictures[weave, view, model] = picture
        for view in VIEWS:
            truth = pictures[weave, view, FIBERS]
            for model in (IRAWAN, JIN):
                shown = pictures[weave, view, model]
                rows.append(
                    Difference(
                        weave, view, model, mse(shown, truth), flip(shown, truth), float(shown.mean() / truth.mean())
                    )
                )
        if progress:
            progress(index + 1, len(weaves), weave)
    return Comparison(pictures, rows)


def _of_fabric(fabric: FabricParameters, scale: Scale) -> dict[tuple[str, str], Floats]:
    """Pictures of one fabric by (view, model)."""
    material, albedos = surface_from_fabric(fabric)
    width = scale.close
    height = max(1, round(width * fabric.size[1] / fabric.size[0]))
    close = swatch_view(fabric, rig_for(fabric.size), (width, height))
    cylinder = Cylinder(fabric, CELLS_PER_PIXEL * scale.distant)
    distant = cylinder.view(scale.distant)
    traced = {
        "close": _traced(swatch_scene(fabric), (width, height), scale),
        "distant": _traced(cylinder.scene(), (scale.distant, scale.distant), scale),
    }
    found: dict[tuple[str, str], Floats] = {}
    lamps = observe(fabric, seed=scale.seed + 1, threads=scale.threads)
    for model in (IRAWAN, JIN):
        matrix = fit_reflection(lambda view, model=model: _components(model, material, view, scale), lamps)  # type: ignore[misc]
        colors = SurfaceAlbedos(matrix, albedos.transmission)
        for name, view in (("close", close), ("distant", distant)):
            found[name, model] = _shown(model, material, colors, view, scale)
    for name, picture in traced.items():
        found[name, FIBERS] = picture
    return found


def _shown(model: str, material: SurfaceMaterial, albedos: SurfaceAlbedos, view: View, scale: Scale) -> Floats:
    colors = _components(model, material, view, scale) @ albedos.reflection
    if model == JIN:
        below = aggregate(
            material, view.queries, transmission=True, samples=scale.samples, seed=scale.seed, threads=scale.threads
        )
        colors = colors + below.astype(np.float64) @ albedos.transmission
    return view.picture(colors)


def _components(model: str, material: SurfaceMaterial, view: View, scale: Scale) -> Floats:
    if model == IRAWAN:
        parts = irawan_components(material, view.queries, samples=scale.samples, seed=scale.seed)
    else:
        parts = aggregate(material, view.queries, samples=scale.samples, seed=scale.seed, threads=scale.threads)
    return parts.astype(np.float64)


def _traced(scene: Scene, resolution: tuple[int, int], scale: Scale) -> Floats:
    settings = RenderSettings(resolution, spp=scale.spp, seed=scale.seed, threads=scale.threads)
    render: Render = Tracer(scene).render(scene.cameras[0], settings)
    pixels = render.pixels
    if find_spec("mitsuba_oidn") is not None:
        pixels = denoise(pixels, render.albedo, render.normal)
    return pixels.astype(np.float64)


def planned_files(folder: Path, *, overwrite: bool) -> tuple[Path, Path]:
    """Picture and numbers in ``folder``, which is made; ``UsdfabError`` where they may not be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"the folder cannot be made ({error.strerror or error})", place=str(folder)) from error
    return (
        checked_output(folder / PICTURE, (".png",), overwrite=overwrite, kind="pictures"),
        checked_output(folder / NUMBERS, (".json",), overwrite=overwrite),
    )


def write_comparison(result: Comparison, scale: Scale, paths: tuple[Path, Path], *, overwrite: bool) -> None:
    """The picture (a row for each weave and view; columns Irawan and Marschner, Jin et al., fibers) and the numbers."""
    order = [(weave, view, model) for weave, view in _rows(result) for model in (IRAWAN, JIN, FIBERS)]
    # The same exposure for all of a row: the fibers' brightest percent is white.
    images = []
    for weave, view, model in order:
        white = float(np.percentile(result.pictures[weave, view, FIBERS], 99.5))
        images.append((result.pictures[weave, view, model] * 0.9 / max(white, 1e-6)).astype(np.float32))
    write_image(paths[0], grid(images, 3), overwrite=overwrite)
    with whole_file(paths[1]) as temporary:
        temporary.write_text(json.dumps(summary(result, scale), indent=2) + "\n", encoding="utf-8")


def _rows(result: Comparison) -> list[tuple[str, str]]:
    return list(dict.fromkeys((weave, view) for weave, view, _ in result.pictures))


def summary(result: Comparison, scale: Scale) -> dict[str, object]:
    """For ``--json`` and the file."""
    shown = {name: value for name, value in asdict(replace(scale)).items() if name != "threads"}
    weaves = dict.fromkeys(row.weave for row in result.rows)
    return {"scale": shown, "fabrics": {w: FABRICS[w] for w in weaves}, "rows": [asdict(row) for row in result.rows]}


def format_comparison(result: Comparison) -> str:
    """The table as text."""
    lines = [f"{'weave':<8}{'view':<10}{'model':<24}{'MSE':>10}{'FLIP':>8}{'brightness':>12}"]
    lines += [
        f"{r.weave:<8}{r.view:<10}{r.model:<24}{r.mse:10.5f}{r.flip:8.3f}{r.brightness:12.3f}" for r in result.rows
    ]
    return "\n".join([*lines, "against the path-traced fibers; brightness: mean over theirs"])
