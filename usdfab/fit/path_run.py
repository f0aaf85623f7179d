"""The path stage as the pipeline runs it: on a turned photo, from the better of two starts, judged against what was."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fit import stages
from usdfab.fit.stages import StageOutcome
from usdfab.fit.straighten import straightened
from usdfab.imaging.lens import toned
from usdfab.usd.rig import Rig, blur_in_pixels, contrast_of, rig_for, swatch_scene

if TYPE_CHECKING:
    from usdfab.fit.path_result import PathResult
    from usdfab.fit.path_settings import PathSettings
    from usdfab.fit.raster_stage import StageSettings

Progress = Callable[[str, int, int], None]

OVERSAMPLING = 4
"""Pixels of the straightened photo along one of the stage's renders, at most: it averages them."""


def run_path(
    start: FabricParameters,
    photo: NDArray,
    rotation: float,
    settings: PathSettings,
    judge: StageSettings,
    *,
    halfway: FabricParameters | None = None,
    exposure: float = 1.0,
    rig: Rig | None = None,
    distance: float | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> tuple[float, StageOutcome]:
    """Stage 3 on a photo, judged against its start.

    Parameters
    ----------
    start:
        The best fabric so far.
    photo, rotation:
        (H, W, 3) linear, its whole width ``start.size[0]``; turn of the cloth in it, radians.
    settings, judge:
        Of the stage, and how its result is judged (``raster_stage.JUDGE``).
    halfway:
        ``StageOutcome.halfway``: the stage starts from it where its picture is closer to the photo.
    exposure:
        How many times brighter the photo is than under the rig's standard light, to which albedos belong.
    rig:
        Camera and lights; None is the paper's.
    distance:
        That of ``start``, where it is known.
    checkpoint:
        As ``path_stage.refine_appearance``.

    Returns
    -------
    distance, outcome:
        Of ``start``. ``outcome.fabric`` is the better of the two by the distance of its path-traced picture; a note
        says so where that is the start.
    """
    from usdfab.fit.features import fast_dtype, load_features
    from usdfab.fit.path_stage import refine_appearance

    say = progress or (lambda *_: None)
    begun = time.perf_counter()
    net = load_features(dtype=fast_dtype())
    goal = straightened(photo, rotation, photo.shape[1] / start.size[0], judge.width / start.size[0])
    steps = settings.iterations + 2

    def judged(fabric: FabricParameters) -> float:
        return stages.traced_distance(fabric, goal, judge, net, settings.seed, exposure, rig)

    say("judging the start of the path stage", 0, steps)
    before = judged(start) if distance is None else distance
    begin, notes = start, []
    if halfway is not None and judged(halfway) < before:
        begin = halfway
        notes.append("the path stage starts from the albedos (C + k_d) / 2")
    # The camera sees as much cloth as the straightened photo shows, which is less than all of a turned one.
    fine = photo.shape[1] / start.size[0]
    scale = min(fine, OVERSAMPLING * settings.side / max(start.size))
    target = straightened(photo, rotation, fine, scale)
    seen = (target.shape[1] / scale, target.shape[0] / scale)
    light = toned(target, 1.0 / contrast_of(rig)) / np.float32(exposure)
    result = refine_appearance(
        begin, light, settings=settings,
        scene=swatch_scene(begin, (rig or rig_for(start.size)).with_sample(seen)), blur=blur_in_pixels(rig, scale),
        checkpoint=checkpoint, progress=lambda done, _, loss: say(f"path, loss {loss:.3f}", 1 + done, steps),
        keep_interrupted=True,
    )  # fmt: skip
    if result.interrupted:
        notes.append(f"the path stage was interrupted after {len(result.losses)} iterations")
    say("judging the path stage", steps - 1, steps)
    after = judged(result.fabric)
    found, unsure = result.fabric, uncertain(result)
    if not after < before:
        notes.append(f"the path stage did not come closer to the photo ({before:.3f}, then {after:.3f}): not used")
        found, unsure = start, {}
    outcome = StageOutcome(
        "path", found, time.perf_counter() - begun, tuple(float(x) for x in result.losses[:, 0]), min(before, after),
        tuple(notes), result.interrupted, exposure=exposure, rig=rig, uncertainty=unsure,
    )  # fmt: skip
    return before, outcome


def uncertain(result: PathResult) -> dict[str, float]:
    """``PathResult.uncertainty`` by name, without what is not estimated or not known."""
    return {
        name: float(value)
        for name, value in zip(result.names, result.uncertainty, strict=True)
        if np.isfinite(value) and value > 0.0
    }
