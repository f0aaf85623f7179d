"""`usdfab fit`: from a photo to a fabric, stage by stage; each starts from the result of the one before."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab._version import __version__
from usdfab.fabric import FabricParameters, Provenance
from usdfab.fit.albedo import (
    LADDER,
    PATHS,
    REFINEMENTS,
    brightness_curves,
    dimmed,
    photo_exposure,
    with_inverted_albedo_and_light,
)
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.fit.analysis.known import NOTHING, Known
from usdfab.fit.course import Course, Progress
from usdfab.fit.doubts import Doubt, find_doubts
from usdfab.fit.fit_checkpoint import CheckpointFiles, FitCheckpoint
from usdfab.fit.later_stages import LaterStages
from usdfab.fit.photo_input import DEFAULT_WIDTH as DEFAULT_WIDTH, Crop, Photo, load_photo
from usdfab.fit.priors import assumed_notes, fabric_from_analysis
from usdfab.fit.stages import StageOutcome, checked_stages
from usdfab.imaging.lens import toned
from usdfab.tracer.checkpoint import fingerprint
from usdfab.usd.rig import Rig

ANALYSIS_SECONDS = 15.0
"""What the analysis takes, about, with the renders that find albedos."""


@dataclass(frozen=True)
class Fit:
    """A fitted fabric, what the photo showed, and what is uncertain.

    ``photo`` is the linear picture (H, W, 3), without the contrast of a camera that was given; ``size_source`` says
    where the physical size comes from; ``warnings`` are sentences for people; ``stages`` is what each stage found, in
    order; ``doubts`` are what in the photo makes the fit unsure, and about which parameters. A render of the fabric
    under ``rig`` (None: the paper's), times ``exposure``, through the rig's camera (``judge.through_camera``), is as
    bright as the photo.
    """

    fabric: FabricParameters
    analysis: PhotoAnalysis
    photo: NDArray[np.float32]
    size_source: str
    warnings: tuple[str, ...]
    stages: tuple[StageOutcome, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    exposure: float = 1.0
    rig: Rig | None = None


def fit_photo(
    path: str | Path,
    width: float | None = None,
    pixel_size: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    albedo_paths: int | None = None,
    *,
    stages: Sequence[str] = ("analysis",),
    quality: str = "draft",
    crop: Crop | None = None,
    checkpoint: CheckpointFiles | None = None,
    resume: bool = False,
    force: bool = False,
    rig: Rig | None = None,
    known: Known = NOTHING,
) -> Fit:
    """Estimate a fabric from one photo.

    Parameters
    ----------
    path:
        An image file of woven cloth seen straight from above, yarns roughly along the picture's sides.
    width, pixel_size:
        Physical width of the whole picture, before the crop, or of one pixel, in metres. Without both, the rig's field
        of view counts; without a rig, the file's resolution tags; without those, ``DEFAULT_WIDTH``, with a warning.
    seed:
        Fixes the fabric's random draws and those of the renders made on the way.
    progress:
        Called with steps of all stages together.
    albedo_paths:
        Paths in each render by which albedos are found; fewer are faster and noisier. By default ``PATHS``, and a
        third of these if the match stage moves the albedos afterwards.
    stages, quality:
        Which of ``stages.STAGES`` run; resolution and iterations of those after the analysis: draft, standard, paper.
    crop:
        The part of the photo to use.
    checkpoint, resume:
        Files in which finished stages are kept, and those at work every few iterations; and whether to go on from
        them, to the same result as without the break. They are left there at the end. Ctrl-C in a stage after the
        analysis ends the fit with the best so far, and that stage is marked as interrupted.
    force:
        Go on where the photo shows no woven cloth, with a warning.
    rig:
        Camera and lights of the photo, where they are known (``read_rig``). Otherwise the paper's, until the match
        stage finds that others explain the photo better.
    known:
        What people know of the cloth, which no stage changes then.

    Raises
    ------
    NoFabricError
        If the photo shows no woven cloth.
    UsdfabError
        For a file that is no image or too small; for stages and qualities that there are not;
        for a checkpoint of another fit.
    """
    wanted = checked_stages(stages)
    camera = fingerprint(rig) if rig else None
    if albedo_paths is None:
        albedo_paths = PATHS // 3 if "match" in wanted else PATHS
    later = LaterStages.of(wanted, quality, seed, albedo_paths, checkpoint, rig)
    if rig is not None and width is None and pixel_size is None:
        photo = replace(load_photo(path, rig.sample_size[0], None, crop), size_source="the rig")
    else:
        photo = load_photo(path, width, pixel_size, crop)
    if rig is not None and rig.contrast != 1.0:
        photo, rig = _linear(photo, rig)
    later.require_room(photo.pixels, str(path))
    if checkpoint is not None and not resume:
        checkpoint.remove()
    about = {
        "photo": photo.sha256, "size": photo.width, "crop": photo.box, "seed": seed, "paths": albedo_paths,
        "force": force, "rig": camera, "version": __version__,
        "known": [[weave.rows() for weave in known.weaves], known.counts and list(known.counts)],
    }  # fmt: skip
    kept = FitCheckpoint.begin(checkpoint.fit if checkpoint else None, about, resume, rig)
    first = kept.finished(0, "analysis", "")
    course = Course(progress, ({} if first else {"analysis": ANALYSIS_SECONDS}) | later.costs())
    if first is None:
        first = _analysed(photo, path, seed, albedo_paths, force, known, rig, kept, course.stage("analysis"))
        kept.add("", first)
    course.finish("analysis")
    assert kept.photo is not None
    analysis, shown, prior_notes = kept.photo
    doubts = find_doubts(photo, analysis)
    warnings = [*photo.warnings, *analysis.warnings, *(doubt.warning for doubt in doubts)]
    if photo.size_source == "default":
        warnings.insert(
            0, f"nothing says how large the photo is: its width is taken as {DEFAULT_WIDTH * 1e3:g} mm; use --size"
        )
    outcomes = later.run(first, shown, photo.pixels, analysis, kept, course)
    exposure, found_rig = outcomes[-1].exposure, outcomes[-1].rig
    warnings += dict.fromkeys(note for outcome in outcomes for note in outcome.notes)
    light = f"the photo is {exposure:.2f} times as bright as under the rig's standard light"
    notes = [
        f"size from {photo.size_source}",
        light,
        *_lamps(rig, found_rig),
        *_camera(rig, found_rig),
        *photo.notes,
        *known.sentences(),
        *_confidences(analysis),
        *warnings,
        *prior_notes,
        *assumed_notes(analysis, shown, outcomes[-1].fabric),
    ]
    provenance = Provenance(
        source=Path(path).name,
        source_sha256=photo.sha256,
        generator=f"usdfab {__version__}",
        stages=tuple(outcome.name for outcome in outcomes),
        notes=tuple(notes),
    )
    fabric = replace(outcomes[-1].fabric, provenance=provenance)
    return Fit(
        fabric, analysis, photo.pixels, photo.size_source, tuple(warnings), outcomes, doubts, exposure, found_rig
    )


def _analysed(
    photo: Photo, path: str | Path, seed: int, albedo_paths: int, force: bool, known: Known, rig: Rig | None,
    kept: FitCheckpoint, say: Progress,
) -> StageOutcome:  # fmt: skip
    """The first stage. What the photo showed goes into ``kept``."""
    begun = time.perf_counter()
    ladder, steps = len(LADDER), 2 + len(LADDER) + REFINEMENTS
    say("analysing", 1, steps)
    analysis = analyze_photo(photo.pixels.astype(np.float64), str(path), force=force, known=known)
    shown, prior_notes = fabric_from_analysis(analysis, photo.width, seed, _prim_name(Path(path).stem))
    curves = brightness_curves(
        shown, albedo_paths, seed=seed, rig=rig, progress=lambda done, _: say("measuring albedo", 2 + done, steps)
    )
    exposure = photo_exposure(shown, curves)
    fabric, light, notes = with_inverted_albedo_and_light(
        dimmed(shown, exposure),
        curves,
        albedo_paths,
        seed=seed,
        rig=rig,
        progress=lambda done, _: say("measuring albedo", 2 + ladder + done, steps),
    )
    exposure *= light
    kept.photo = analysis, dimmed(shown, exposure), prior_notes
    return StageOutcome("analysis", fabric, time.perf_counter() - begun, notes=tuple(notes), exposure=exposure, rig=rig)


def _lamps(given: Rig | None, found: Rig | None) -> list[str]:
    if given is not None:
        return ["camera and lights are those of the rig that was given"]
    if found is None:
        return []
    elevation = np.degrees(np.arctan2(found.light_height, found.light_side))
    if found.lamps > 1:
        return [f"the photo looks as if lit by a ring lamp {elevation:.0f} degrees above the cloth"]
    side = np.degrees(found.azimuth) % 360.0
    return [
        f"the photo looks as if lit by a lamp {elevation:.0f} degrees above the cloth, from {side:.0f} degrees "
        "(0 is right, 90 up)"
    ]


def _linear(photo: Photo, rig: Rig) -> tuple[Photo, Rig]:
    """A photo as a camera without contrast of its own would have made it, and the rig with that camera."""
    note = f"the camera's contrast of {rig.contrast:.3g} was taken out of the photo"
    pixels = toned(photo.pixels, 1.0 / rig.contrast)
    return replace(photo, pixels=pixels, notes=(*photo.notes, note)), replace(rig, contrast=1.0)


def _camera(given: Rig | None, found: Rig | None) -> list[str]:
    if given is not None or found is None:
        return []
    notes = []
    if found.blur != 0.0:
        how = "is blurred" if found.blur > 0.0 else "looks sharpened"
        notes.append(f"the photo {how} by about {1e6 * abs(found.blur):.0f} micrometres on the cloth")
    if found.contrast != 1.0:
        more = "more" if found.contrast > 1.0 else "less"
        notes.append(f"the photo shows {more} contrast than the light had: its power {found.contrast:.2f}")
    return notes


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
