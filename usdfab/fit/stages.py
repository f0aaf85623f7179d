"""The stages of ``usdfab fit``: their names, what each found, how that is judged, and the raster stage as it is run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fit.albedo import LADDER, PATHS, REFINEMENTS, brightness_curves, with_inverted_albedo
from usdfab.fit.extra import require_fit_extra
from usdfab.fit.judge import Judge
from usdfab.usd.rig import Rig

if TYPE_CHECKING:
    from usdfab.fit.features import FeatureNet
    from usdfab.fit.raster_stage import StageSettings

STAGES = ("analysis", "network", "raster", "match", "path")
"""In the order in which they run."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class StageOutcome:
    """What one stage found.

    ``losses`` of its iterations, if it has any; ``seconds`` it took; ``distance`` of the path-traced swatch from the
    photo by the losses of the fit, where that was measured; ``notes`` are sentences for people; ``interrupted`` after
    Ctrl-C. ``halfway`` is the raster stage's fabric with the albedos (C + k_d) / 2 (Li et al. 2024, 7.3), another start
    for the path stage. ``exposure`` is how many times brighter the photo is than the analysis' picture under the rig's
    standard light, see ``albedo.photo_exposure``; ``rig`` is the rig of these pictures where a stage found that the
    paper's is not the photo's, whatever its sample size. ``uncertainty`` of parameters by name, where the stage knows
    any, in their own units.
    """

    name: str
    fabric: FabricParameters
    seconds: float
    losses: tuple[float, ...] = ()
    distance: float | None = None
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    halfway: FabricParameters | None = None
    exposure: float = 1.0
    rig: Rig | None = None
    uncertainty: Mapping[str, float] = field(default_factory=dict)


def checked_stages(stages: Sequence[str]) -> tuple[str, ...]:
    """Stage names in order.

    Raises
    ------
    UsdfabError
        For unknown names, a missing analysis, and a stage whose packages are missing.
    """
    names = tuple(stages)
    unknown = [name for name in names if name not in STAGES]
    if unknown or len(set(names)) != len(names):
        problem = f"there is no stage '{unknown[0]}'" if unknown else "a stage is named twice"
        raise UsdfabError(problem, place="--stages", remedy=f"choose from {','.join(STAGES)}")
    if "analysis" not in names:
        raise UsdfabError("the other stages start from the analysis", place="--stages", remedy="begin with analysis")
    for name in names:
        if name != "analysis":
            require_fit_extra(f"the {name} stage")
    return tuple(name for name in STAGES if name in names)


def run_raster(
    start: FabricParameters,
    shown: FabricParameters,
    photo: NDArray,
    rotation: float,
    settings: StageSettings,
    *,
    judge: StageSettings | None = None,
    seed: int = 0,
    exposure: float = 1.0,
    rig: Rig | None = None,
    albedo_paths: int = PATHS,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> tuple[StageOutcome, StageOutcome]:
    """Stage 2 on a photo, its colours made right under path tracing, and judged against the start.

    Parameters
    ----------
    start:
        What the stages before found.
    shown:
        The same with the colours that the photo shows as albedo, see ``albedo.with_inverted_albedo``.
    photo, rotation:
        (H, W, 3) linear, its whole width ``start.size[0]``; turn of the cloth in it, radians.
    judge:
        By which the result is judged; ``settings`` by default.
    exposure:
        How many times brighter the photo is than under the rig's standard light, to which albedos belong.
    rig:
        Camera and lights; None is the paper's.
    checkpoint, resume:
        As ``raster_stage.refine_by_raster``.

    Returns
    -------
    before, after:
        ``after.fabric`` is the better of the two by the distance of its path-traced picture; a note says so where that
        is the start.
    """
    from usdfab.fit.features import fast_dtype, load_features
    from usdfab.fit.path_stage import start_from_joint
    from usdfab.fit.raster.unconstrained import within_ranges
    from usdfab.fit.raster_stage import refine_by_raster, straightened

    say = progress or (lambda *_: None)
    begun = time.perf_counter()
    scale = settings.width / start.size[0]
    target = straightened(photo, rotation, photo.shape[1] / start.size[0], scale)
    net = load_features(dtype=fast_dtype())
    tame, outside = within_ranges(start)
    notes = [f"{name} was outside the raster stage's range and starts at its border" for name in outside]
    ladder, extra = len(LADDER), len(LADDER) + REFINEMENTS
    steps = settings.iterations + extra + 1
    result = refine_by_raster(
        tame, target / np.float32(exposure), settings, net=net, rig=rig, checkpoint=checkpoint, resume=resume,
        progress=lambda done, _, loss: say(f"raster, loss {loss:.3f}", done, steps),
    )  # fmt: skip
    notes += result.notes
    if result.interrupted:
        notes.append(f"the raster stage was interrupted after {len(result.losses)} iterations")
    found = result.fabric
    dyed = replace(
        found,
        warp=replace(found.warp, albedo=shown.warp.albedo, yarn_albedo=shown.warp.yarn_albedo),
        weft=replace(found.weft, albedo=shown.weft.albedo, yarn_albedo=shown.weft.yarn_albedo),
    )
    done = settings.iterations
    curves = brightness_curves(
        dyed, albedo_paths, seed=seed, rig=rig, progress=lambda k, _: say("measuring albedo", done + k, steps)
    )
    found, albedo_notes = with_inverted_albedo(
        dyed,
        curves,
        albedo_paths,
        seed=seed,
        rig=rig,
        progress=lambda k, _: say("measuring albedo", done + ladder + k, steps),
    )
    notes += albedo_notes
    # Where k_d is tied to C, that is C already: nothing lies halfway between them.
    halfway = None if settings.tied else start_from_joint(result.fabric, result.diffuse)
    say("judging the raster stage", steps - 1, steps)
    judge = judge or settings
    known = straightened(photo, rotation, photo.shape[1] / start.size[0], judge.width / start.size[0])
    before, after = (traced_distance(fabric, known, judge, net, seed, exposure, rig) for fabric in (start, found))
    if not after < before:
        notes.append(f"the raster stage did not come closer to the photo ({before:.3f}, then {after:.3f}): not used")
        found, halfway = start, None
    seconds = time.perf_counter() - begun
    return (
        StageOutcome("analysis", start, 0.0, distance=before, exposure=exposure, rig=rig),
        StageOutcome(
            "raster",
            found,
            seconds,
            result.losses,
            min(before, after),
            tuple(notes),
            result.interrupted,
            halfway,
            exposure,
            rig,
        ),
    )


def traced_distance(
    fabric: FabricParameters,
    target: NDArray,
    settings: StageSettings,
    net: FeatureNet,
    seed: int = 0,
    exposure: float = 1.0,
    rig: Rig | None = None,
) -> float:
    """Texture and colour loss of the path-traced, denoised swatch against a target at the scale of ``settings``.

    The swatch, under ``rig`` or the paper's, is multiplied by ``exposure`` and seen through the rig's camera.
    """
    judge = Judge(target, settings, net)
    return judge.distance(judge.picture(fabric, rig, seed), fabric.size[0], exposure, rig)
