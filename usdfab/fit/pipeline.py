"""`usdfab fit`: from a photo to a fabric, stage by stage; each starts from the result of the one before."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, Provenance
from usdfab.fabric.fabric import SIZE_RANGE
from usdfab.fit.albedo import LADDER, PATHS, REFINEMENTS, brightness_curves, with_inverted_albedo
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.fit.priors import fabric_from_analysis
from usdfab.fit.stages import StageOutcome, checked_stages, run_raster
from usdfab.imaging import read_image

DEFAULT_WIDTH = 5e-3
"""Width in metres that a photo is taken to have when nothing says how large it is."""

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, steps done, steps to do)."""


@dataclass(frozen=True)
class Fit:
    """A fitted fabric, what the photo showed, and what is uncertain.

    ``photo`` is the linear picture (H, W, 3); ``size_source`` says where the physical size comes from; ``warnings``
    are sentences for people; ``stages`` is what each stage found, in order.
    """

    fabric: FabricParameters
    analysis: PhotoAnalysis
    photo: NDArray[np.float32]
    size_source: str
    warnings: tuple[str, ...]
    stages: tuple[StageOutcome, ...] = ()


def fit_photo(
    path: str | Path,
    width: float | None = None,
    pixel_size: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    albedo_paths: int = PATHS,
    *,
    stages: Sequence[str] = ("analysis",),
    quality: str = "draft",
    checkpoint: Path | None = None,
    resume: bool = False,
) -> Fit:
    """Estimate a fabric from one photo.

    Parameters
    ----------
    path:
        An image file of woven cloth seen straight from above, yarns roughly along the picture's sides.
    width, pixel_size:
        Physical width of the whole picture, or of one pixel, in metres. Without both, the file's resolution tags
        count; without those, ``DEFAULT_WIDTH``, with a warning.
    seed:
        Fixes the fabric's random draws and those of the renders made on the way.
    albedo_paths:
        Paths in each render by which albedos are found; fewer are faster and noisier.
    stages, quality:
        Which of ``stages.STAGES`` run; resolution and iterations of those after the analysis: draft, standard, paper.
    checkpoint, resume:
        A file in which the raster stage keeps its state every few iterations, and whether to go on from it. It is left
        there at the end.

    Raises
    ------
    UsdfabError
        For a file that is no image, too small, or shows no woven cloth; for stages and qualities that there are not.
    """
    say = progress or (lambda *_: None)
    wanted = checked_stages(stages)
    settings = None
    if "raster" in wanted:
        from usdfab.fit.raster_stage import checked_quality

        settings = checked_quality(quality)
    begun = time.perf_counter()
    say("reading", 0, 8)
    image = read_image(path)
    photo = image.pixels
    width, source = _physical_width(photo.shape[1], width, pixel_size, image.pixel_size)
    say("analysing", 1, 8)
    analysis = analyze_photo(photo.astype(np.float64), str(path))
    shown, prior_notes = fabric_from_analysis(analysis, width, seed, _prim_name(Path(path).stem))
    ladder, steps = len(LADDER), 2 + len(LADDER) + REFINEMENTS
    curves = brightness_curves(
        shown, albedo_paths, seed=seed, progress=lambda done, _: say("measuring albedo", 2 + done, steps)
    )
    fabric, albedo_notes = with_inverted_albedo(
        shown,
        curves,
        albedo_paths,
        seed=seed,
        progress=lambda done, _: say("measuring albedo", 2 + ladder + done, steps),
    )
    warnings = list(analysis.warnings) + list(albedo_notes)
    if source == "default":
        warnings.insert(
            0, f"nothing says how large the photo is: its width is taken as {DEFAULT_WIDTH * 1e3:g} mm; use --size"
        )
    outcomes: tuple[StageOutcome, ...] = (StageOutcome("analysis", fabric, time.perf_counter() - begun),)
    if settings is not None:
        before, after = run_raster(
            fabric, shown, photo, analysis.rotation, settings, seed=seed, albedo_paths=albedo_paths,
            checkpoint=checkpoint, resume=resume, progress=say,
        )  # fmt: skip
        outcomes = (replace(before, seconds=outcomes[0].seconds), after)
        fabric = after.fabric
        warnings += after.notes
    notes = [f"size from {source}", *_confidences(analysis), *warnings, *prior_notes]
    provenance = Provenance(
        source=Path(path).name,
        source_sha256=hashlib.sha256(Path(path).read_bytes()).hexdigest(),
        generator=f"usdfab {__version__}",
        stages=wanted,
        notes=tuple(notes),
    )
    return Fit(replace(fabric, provenance=provenance), analysis, photo, source, tuple(warnings), outcomes)


def _physical_width(
    columns: int, width: float | None, pixel_size: float | None, tagged: tuple[float, float] | None
) -> tuple[float, str]:
    if width is not None and pixel_size is not None:
        raise UsdfabError("--size and --pixel-size both say how large the photo is", remedy="use one of them")
    if width is not None:
        value, source = width, "--size"
    elif pixel_size is not None:
        value, source = pixel_size * columns, "--pixel-size"
    elif tagged is not None:
        value, source = tagged[0] * columns, "the file's resolution"
    else:
        value, source = DEFAULT_WIDTH, "default"
    if not SIZE_RANGE[0] <= value <= SIZE_RANGE[1]:
        raise UsdfabError(f"a photo {value:g} m wide (from {source}) is not plausible", remedy="use --size, e.g. 3.6mm")
    return value, source


def _confidences(analysis: PhotoAnalysis) -> list[str]:
    return [
        f"confidence: lattice {analysis.lattice_confidence:.2f}, weave {analysis.weave_confidence:.2f}, "
        f"warp count {analysis.warp.count_confidence:.2f}, weft count {analysis.weft.count_confidence:.2f}",
        f"rotation {np.degrees(analysis.rotation):.2f} degrees, straightened",
        f"gap cover {analysis.gap_cover:.3f}",
    ]


def _prim_name(stem: str) -> str:
    """A USD prim name from a file name: letters and digits, words joined in CamelCase."""
    words = "".join(c if c.isascii() and c.isalnum() else " " for c in stem).split()
    name = "".join(w[0].upper() + w[1:] for w in words) or "Fabric"
    return name if name[0].isalpha() else f"Fabric{name}"
