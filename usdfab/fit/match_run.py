"""The match stage as the pipeline runs it: on a turned photo, judged against what was."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fit.judge import Judge
from usdfab.fit.stages import StageOutcome
from usdfab.fit.straighten import straightened
from usdfab.imaging import check_denoiser

if TYPE_CHECKING:
    from usdfab.fit.match_stage import MatchSettings
    from usdfab.fit.raster_stage import StageSettings
    from usdfab.usd.rig import Rig

Progress = Callable[[str, int, int], None]

MOST_JUDGED = 5
"""Of the points that the stage took, the last ones, one of which is the result."""


def run_match(
    start: FabricParameters,
    photo: NDArray,
    rotation: float,
    settings: MatchSettings,
    judge: StageSettings,
    *,
    exposure: float = 1.0,
    rig: Rig | None = None,
    rig_known: bool = False,
    distance: float | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> tuple[float, StageOutcome]:
    """The match stage on a photo, judged against its start.

    Parameters
    ----------
    start:
        The best fabric so far.
    photo, rotation:
        (H, W, 3) linear, its whole width ``start.size[0]``; turn of the cloth in it, radians.
    settings, judge:
        Of the stage, and how its result is judged (``raster_stage.JUDGE``).
    exposure:
        How many times brighter the photo is than the start under the rig's standard light.
    rig, rig_known:
        Camera and lamps so far, None for the paper's, and whether the photo's are known.
    distance:
        That of ``start``, where it is known.
    checkpoint:
        As ``match_stage.match_photo``.

    Returns
    -------
    distance, outcome:
        Of ``start``. ``outcome.fabric`` and ``outcome.exposure`` are the better of the two by the distance of the
        path-traced picture; a note says so where that is the start.
    """
    from usdfab.fit.features import fast_dtype, load_features
    from usdfab.fit.match_stage import match_photo

    check_denoiser()
    say = progress or (lambda *_: None)
    begun = time.perf_counter()
    net = load_features(dtype=fast_dtype())
    fine = photo.shape[1] / start.size[0]
    goal, judged = (straightened(photo, rotation, fine, s.width / start.size[0]) for s in (settings, judge))
    jury = Judge(judged, judge, net)
    steps = settings.pictures + 2
    say("judging the start of the match stage", 0, steps)
    before = distance
    if before is None:
        picture = jury.picture(start, rig, settings.seed)
        before = jury.distance(picture, start.size[0], exposure, rig)
    result = match_photo(
        start, goal, settings, net=net, exposure=exposure, rig=rig, rig_known=rig_known, checkpoint=checkpoint,
        progress=lambda done, _, loss: say(f"match, loss {loss:.3f}", done, steps),
    )  # fmt: skip
    notes = []
    if result.interrupted:
        notes.append(f"the match stage was interrupted after {max(0, len(result.losses) - 1)} steps")
    say("judging the match stage", steps - 1, steps)
    # Other draws than those that were matched, and more of them: what came closer there by its noise does not here.
    way = result.way[-MOST_JUDGED:]
    pictures = [jury.picture(p.fabric, p.rig, settings.seed + 2) for p in way]
    distances = [
        jury.distance(picture, p.fabric.size[0], p.exposure, p.rig) for picture, p in zip(pictures, way, strict=True)
    ]
    after = min(distances)
    best = distances.index(after)
    found, light, lamps, unsure = way[best].fabric, way[best].exposure, way[best].rig, result.uncertainty
    if not rig_known:
        light, lamps, after = jury.settled(pictures[best], found, light, lamps)
    if not after < before:
        notes.append(f"the match stage did not come closer to the photo ({before:.3f}, then {after:.3f}): not used")
        found, light, lamps, unsure = start, exposure, rig, {}
    outcome = StageOutcome(
        "match", found, time.perf_counter() - begun, result.losses, min(before, after), tuple(notes),
        result.interrupted, exposure=light, rig=lamps, uncertainty=unsure,
    )  # fmt: skip
    return before, outcome
