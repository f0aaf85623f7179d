"""What each part of stage 2 is good for: figures 15, 17 and 18 of Li et al. 2024, on random fabrics.

The paper shows photos; here the targets are path-traced fabrics of Table 4 with known parameters, of the weaves of its
photos, so that errors can be given, too. All ways of a fabric have the same start, target and number of iterations. How
close each way's picture comes is judged alike, by both losses, whatever the way itself looked at. All ways do without
the path-traced pictures of ``StageSettings.traced``, which would make up for what is left out of the shading.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.files import whole_file
from usdfab.fit.features import FeatureNet, fast_dtype, load_features
from usdfab.fit.raster_evaluation import JUDGED, Recovery, evaluate_raster
from usdfab.fit.raster_stage import StageResult, StageSettings
from usdfab.fit.table2 import SYMBOLS
from usdfab.fit.texture import Target, color_loss, texture_loss
from usdfab.imaging import side_by_side, write_image


@dataclass(frozen=True)
class Figure:
    """One comparison: its number in the paper, what it compares, the weaves and the names in ``ABLATIONS``."""

    number: int
    title: str
    weaves: tuple[str, ...]
    ways: tuple[str, ...]


FIGURES = (
    Figure(15, "shading", ("twill0",), ("full", "single", "diffuse")),
    Figure(17, "losses", ("twill0", "plain"), ("full", "texture only", "colour only")),
    Figure(18, "prior", ("satin",), ("full", "no prior")),
)
"""The weaves are those of the paper's photos; the prior counts for satin only."""


@dataclass(frozen=True, eq=False)
class Way:
    """One fabric fitted in one way.

    ``texture`` and ``color`` are the losses of its raster picture ``render`` (H, W, 3), both of them for every way.
    """

    recovery: Recovery
    texture: float
    color: float
    target: NDArray[np.float32]
    render: NDArray[np.float32]

    def summary(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self.recovery) | {"texture": self.texture, "color": self.color}


def evaluate_ablation(
    count: int = 1,
    seed: int = 0,
    settings: StageSettings | None = None,
    *,
    fibers: int | None = None,
    figures: Sequence[Figure] = FIGURES,
    net: FeatureNet | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Way]:
    """Fit ``count`` fabrics of each figure's weaves in each of its ways; what figures share is fitted once.

    Parameters
    ----------
    settings, fibers:
        As of ``evaluate_raster``.

    Raises
    ------
    UsdfabError
        As ``evaluate_raster``.
    """
    settings = replace(settings or StageSettings(), traced=0)
    net = net or load_features(dtype=fast_dtype())
    # Weave by weave, each way once, in the order in which the figures name them.
    jobs: dict[str, dict[str, None]] = {}
    for figure in figures:
        for weave in figure.weaves:
            jobs.setdefault(weave, {}).update(dict.fromkeys(figure.ways))
    steps = count * settings.iterations * sum(len(ways) for ways in jobs.values())
    done, found = 0, []

    def watch(recovery: Recovery, target: NDArray, result: StageResult) -> None:
        found.append(Way(recovery, *_losses(result.render, target, settings, net), target, result.render))

    for weave, ways in jobs.items():

        def say(k: int, _: int, text: str, base: int = done) -> None:
            if progress:
                progress(base + k, steps, text)

        finished = evaluate_raster(
            count, seed, settings,
            weaves=(weave,), ablations=tuple(ways), fibers=fibers, progress=say, watch=watch, net=net,
        )  # fmt: skip
        done += len(finished) * settings.iterations
        if len(finished) < count * len(ways):  # interrupted
            break
    return found


def _losses(
    render: NDArray[np.float32], target: NDArray, settings: StageSettings, net: FeatureNet
) -> tuple[float, float]:
    goal, image = (
        torch.from_numpy(np.ascontiguousarray(p, dtype=np.float32)).permute(2, 0, 1) for p in (target, render)
    )
    known = Target.from_image(goal, net, settings.levels, settings.kind)
    with torch.no_grad():
        return float(texture_loss(image, known)), float(color_loss(image, known))


def of_figure(results: Sequence[Way], figure: Figure) -> dict[str, list[Way]]:
    """The results that a figure compares, by way; those of a way are of the same fabrics in the same order."""
    return {
        way: [r for r in results if r.recovery.weave in figure.weaves and r.recovery.ablation == way]
        for way in figure.ways
    }


def format_ablation(results: Sequence[Way], figures: Sequence[Figure] = FIGURES) -> str:
    """A table for each figure: losses of the pictures, and errors in percent of the range, means over its fabrics."""
    tables = []
    for figure in figures:
        ways = {way: rows for way, rows in of_figure(results, figure).items() if rows}
        if not ways:
            continue
        some = next(iter(ways.values()))
        names = ", ".join(f"{r.recovery.weave} {r.recovery.number + 1}" for r in some)
        head = "".join(f"{SYMBOLS[key]:>9}" for key in JUDGED)
        lines = [f"figure {figure.number}, {figure.title}: {names}", f"{'':<14}{'texture':>9}{'colour':>9}{head}"]
        start = "".join(f"{100.0 * _mean(r.recovery.before[key] for r in some):9.1f}" for key in JUDGED)
        lines.append(f"{'start':<14}{'':>18}{start}")
        for way, rows in ways.items():
            errors = "".join(f"{100.0 * _mean(r.recovery.after[key] for r in rows):9.1f}" for key in JUDGED)
            losses = f"{_mean(r.texture for r in rows):9.3f}{_mean(r.color for r in rows):9.3f}"
            lines.append(f"{way:<14}{losses}{errors}")
        tables.append("\n".join(lines))
    note = "texture, colour: losses of the raster picture; the others: error of the parameter in % of its range"
    return "\n\n".join([*tables, note])


def _mean(values: object) -> float:
    return float(np.mean(list(values)))  # type: ignore[call-overload]


def planned_files(
    folder: str | Path, count: int, figures: Sequence[Figure] = FIGURES, *, overwrite: bool = False
) -> dict[str, Path]:
    """Where ``write_ablation`` writes, by name; before the work begins.

    Raises
    ------
    UsdfabError
        If the folder cannot be made, or a file is there and may not be replaced.
    """
    place = Path(folder)
    names = [_name(figure, weave, k) for figure in figures for weave in figure.weaves for k in range(count)]
    paths = {name: place / f"{name}.png" for name in names} | {"ablation": place / "ablation.json"}
    existing = [path for path in paths.values() if path.exists()]
    if existing and not overwrite:
        raise UsdfabError("the file exists", place=str(existing[0]), remedy="choose another folder or use --overwrite")
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror})", place=str(place)) from error
    return paths


def write_ablation(
    results: Sequence[Way], paths: dict[str, Path], figures: Sequence[Figure] = FIGURES, *, overwrite: bool = False
) -> None:
    """Write a picture for each figure and fabric, the target and then each way side by side, and ``ablation.json``."""
    pictures: dict[str, list[str]] = {}
    for figure in figures:
        rows: dict[str, list[Way]] = {}
        for ways in of_figure(results, figure).values():
            for result in ways:
                rows.setdefault(_name(figure, result.recovery.weave, result.recovery.number), []).append(result)
        for name, shown in rows.items():
            write_image(paths[name], side_by_side([shown[0].target, *(r.render for r in shown)]), overwrite=overwrite)
            pictures[f"{name}.png"] = ["target", *(r.recovery.ablation for r in shown)]
    document = {"pictures": pictures, "results": [r.summary() for r in results]}
    with whole_file(paths["ablation"]) as temporary:
        Path(temporary).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _name(figure: Figure, weave: str, number: int) -> str:
    return f"figure{figure.number}_{weave}_{number + 1}"


__all__ = [
    "FIGURES",
    "Figure",
    "Way",
    "evaluate_ablation",
    "format_ablation",
    "of_figure",
    "planned_files",
    "write_ablation",
]
