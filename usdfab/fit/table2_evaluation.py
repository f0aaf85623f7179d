"""Random fabrics photographed by rendering, fitted blind and compared with the truth: ``usdfab evaluate table2``.

As in figure 13 and Table 2 of Li et al. 2024: fabrics are drawn from Table 4 and path traced under the capture rig. The
fit gets the picture and its physical width, nothing else: it has to find the exposure too, which is known in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from usdfab.errors import NoFabricError, UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.sampling import sample_fabric
from usdfab.fit.extra import require_fit_extra
from usdfab.fit.fit_checkpoint import CheckpointFiles
from usdfab.fit.fit_evaluation import photo_middle, swatch
from usdfab.fit.pipeline import Fit, fit_photo
from usdfab.fit.priors import MIN_CONFIDENCE
from usdfab.fit.result_folder import made_folder, no_result, read_result, write_result
from usdfab.fit.stages import checked_stages
from usdfab.fit.table2 import never_estimated, range_errors
from usdfab.imaging import denoise, side_by_side, write_image
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.fabric_io import write_fabric
from usdfab.usd.rig import swatch_scene

FAMILIES: dict[str, tuple[str, ...]] = {
    "plain": ("plain",),
    "twill": ("twill0", "twill1", "twill0_rot90", "twill1_rot90"),
    "satin": ("satin", "satin_rot90"),
}
"""Weaves of Table 4, taken in turn: with those turned by 90 degrees, else half of the classes would never be right."""

PHOTO_STREAM = 2**31
"""Added to the seed of the photo's noise: another one than that of any render of the fit."""

TICKS, PHOTO_TICKS = 1000, 200
"""Steps of progress for each fabric, and those of them for its photo."""

RUN_FILE = "table2.json"
"""Says which options all results of a folder are of."""

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, steps done, steps to do)."""


@dataclass(frozen=True)
class PhotoQuality:
    """Pixels along the photo's sides, samples of each, and whether it is denoised."""

    side: int
    spp: int
    denoised: bool


QUALITIES = {
    "draft": PhotoQuality(240, 64, True),
    "standard": PhotoQuality(480, 256, False),
    "paper": PhotoQuality(720, 1024, False),
}
"""``paper`` is the paper's setting."""


@dataclass(frozen=True)
class Table2Row:
    """One fabric, fitted blind.

    Parameters
    ----------
    name, weave:
        ``plain1``, ...; its weave, one of ``PAPER_WEAVES``.
    errors:
        After each stage by name: fractions of the range by parameter, see ``table2.range_errors``.
    priors:
        After each stage: the parameters that no stage has estimated so far, where the error is the prior's.
    found, right:
        After each stage: the weave's rows, bottom row first, and whether it is the truth's, wherever its repeat begins.
    distances:
        After each stage: from the photo by the losses of the fit, where that was measured.
    seconds:
        Of each stage.
    exposure:
        Times as bright as under the rig's light the photo was taken to be; the truth is 1.
    problem:
        Why the photo was refused.
    """

    name: str
    weave: str
    errors: dict[str, dict[str, float]] = field(default_factory=dict)
    priors: dict[str, list[str]] = field(default_factory=dict)
    found: dict[str, str] = field(default_factory=dict)
    right: dict[str, bool] = field(default_factory=dict)
    distances: dict[str, float | None] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    exposure: float = 1.0
    problem: str = ""


def evaluate_table2(
    output: str | Path,
    *,
    stages: Sequence[str] = ("analysis", "match"),
    quality: str = "draft",
    count: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Table2Row]:
    """Fit ``count`` fabrics of each family of weaves blind.

    Parameters
    ----------
    output:
        A folder, made if it is missing, that gets for each fabric ``NAME_truth.usda``, ``NAME_photo.exr``,
        ``NAME.usda`` (the fit), ``NAME.png`` (the photo, then each stage) and ``NAME.json``. What is there is not done
        again; an unfinished fit is gone on with.
    stages:
        As ``fit_photo``.
    quality:
        Of the photo, see ``QUALITIES``, and of the fit.
    seed:
        Fixes the fabrics and all else.

    Raises
    ------
    UsdfabError
        For options that make no sense, a folder with results of others, and a folder that cannot be written. A photo in
        which the fit finds no fabric is a row with a ``problem``.
    KeyboardInterrupt
        After Ctrl-C, within a fit's stages too.
    """
    require_fit_extra("evaluate table2")
    wanted = checked_stages(stages)
    if quality not in QUALITIES:
        raise UsdfabError(f"there is no quality '{quality}'", place="--quality", remedy=f"use {', '.join(QUALITIES)}")
    if count < 1:
        raise UsdfabError(f"{count} fabrics are none", place="--count", remedy="give 1 or more of each weave")
    if not 0 <= seed < 2**31:
        raise UsdfabError(f"{seed} is not between 0 and 2^31 - 1", place="--seed")
    photo = QUALITIES[quality]
    about = {"stages": list(wanted), "quality": quality, "seed": seed, "photo": asdict(photo)}
    folder = made_folder(output)
    if read_result(folder / RUN_FILE, about) is None:
        write_result(folder / RUN_FILE, about, {})
    rows: list[Table2Row] = []
    jobs = [(family, number) for family in FAMILIES for number in range(count)]
    for family, number in jobs:
        job = _Job(folder, f"{family}{number + 1}", wanted, quality, seed, photo, progress, len(rows), len(jobs))
        row = _read_row(job.file(".json"), about)
        if row is None:
            row = _fitted(job, *drawn_fabric(family, number, seed))
            write_result(job.file(".json"), about, asdict(row))
            CheckpointFiles(job.file(".usda")).remove()
        rows.append(row)
    return rows


def drawn_fabric(family: str, number: int, seed: int = 0) -> tuple[str, FabricParameters]:
    """The fabric of a family of weaves with this number, from 0, and which of ``PAPER_WEAVES`` it is."""
    weaves = FAMILIES[family]
    weave = weaves[number % len(weaves)]
    return weave, sample_fabric(weave, np.random.default_rng([seed, list(FAMILIES).index(family), number]))


def take_photo(
    truth: FabricParameters,
    path: Path,
    quality: PhotoQuality,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Path trace the fabric under the capture rig and write the linear picture, highlights not cut off, as EXR."""
    scene = swatch_scene(truth)
    factor = quality.side / max(truth.size)
    size = (max(1, round(factor * truth.size[0])), max(1, round(factor * truth.size[1])))
    how = RenderSettings(size, spp=quality.spp, seed=PHOTO_STREAM + seed)
    render = Tracer(scene).render(scene.cameras[0], how, progress)
    pixels = denoise(render.pixels, render.albedo, render.normal) if quality.denoised else render.pixels
    write_image(path, pixels, overwrite=True)


@dataclass(frozen=True)
class _Job:
    """What one fabric's work needs to know besides the fabric."""

    folder: Path
    name: str
    stages: tuple[str, ...]
    quality: str
    seed: int
    photo: PhotoQuality
    progress: Progress | None
    number: int
    count: int

    def file(self, suffix: str) -> Path:
        """One of the fabric's files."""
        return self.folder / f"{self.name}{suffix}"

    def say_photo(self, done: int, total: int) -> None:
        """Pass on steps of this fabric's photo."""
        self._say("taking the photo", PHOTO_TICKS * done / max(total, 1))

    def say_fit(self, text: str, done: int, total: int) -> None:
        """Pass on steps of this fabric's fit."""
        self._say(text, PHOTO_TICKS + (TICKS - PHOTO_TICKS) * done / max(total, 1))

    def _say(self, text: str, ticks: float) -> None:
        if self.progress:
            self.progress(f"{self.name}: {text}", TICKS * self.number + round(ticks), TICKS * self.count)


def _fitted(job: _Job, weave: str, truth: FabricParameters) -> Table2Row:
    photo, asset = job.file("_photo.exr"), job.file(".usda")
    if not photo.exists():
        write_fabric(truth, job.file("_truth.usda"), overwrite=True)
        take_photo(truth, photo, job.photo, job.seed, job.say_photo)
    try:
        fit = fit_photo(
            photo, truth.size[0], None, job.seed, job.say_fit, stages=job.stages, quality=job.quality,
            checkpoint=CheckpointFiles(asset), resume=True,
        )  # fmt: skip
    except NoFabricError as error:
        return Table2Row(job.name, weave, problem=error.problem)
    # Ctrl-C within a stage gives what was found so far. Its checkpoint stays, and the same command goes on from there.
    if fit.stages[-1].interrupted:
        raise KeyboardInterrupt
    write_fabric(fit.fabric, asset, overwrite=True)
    job.say_fit("its pictures", 1, 1)
    pictures = [swatch(stage, job.seed) for stage in fit.stages]
    write_image(job.file(".png"), side_by_side([photo_middle(fit), *pictures]), overwrite=True)
    return judged(job.name, weave, truth, fit)


def judged(name: str, weave: str, truth: FabricParameters, fit: Fit) -> Table2Row:
    """A fit beside the truth, which is of ``weave``, one of ``PAPER_WEAVES``."""
    outcomes = fit.stages
    names = [stage.name for stage in outcomes]
    twist_seen = max(fit.analysis.warp.twist_confidence, fit.analysis.weft.twist_confidence) >= MIN_CONFIDENCE
    return Table2Row(
        name,
        weave,
        errors={stage.name: range_errors(stage.fabric, truth, weave) for stage in outcomes},
        priors={names[k]: list(never_estimated(names[: k + 1], twist_seen)) for k in range(len(names))},
        found={stage.name: stage.fabric.weave.rows() for stage in outcomes},
        right={stage.name: stage.fabric.weave.equivalent(truth.weave) for stage in outcomes},
        distances={stage.name: stage.distance for stage in outcomes},
        seconds={stage.name: stage.seconds for stage in outcomes},
        exposure=fit.exposure,
    )


def _read_row(record: Path, about: dict[str, Any]) -> Table2Row | None:
    data = read_result(record, about)
    try:
        return None if data is None else Table2Row(**data)
    except TypeError as error:
        raise no_result(record) from error
