"""The network as a stage of ``usdfab fit``, between the analysis and the optimisation."""

from __future__ import annotations

import time
from collections.abc import Callable

from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fit.albedo import LADDER, PATHS, REFINEMENTS, brightness_curves, with_inverted_albedo
from usdfab.fit.analysis import PhotoAnalysis
from usdfab.fit.network.combine import combine, fabric_of, speaks
from usdfab.fit.network.labels import family_of
from usdfab.fit.network.network_file import Weights, load_network
from usdfab.fit.network.predict import predict
from usdfab.fit.network.targets import NAMES
from usdfab.fit.stages import StageOutcome
from usdfab.usd.rig import Rig

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, steps done, steps to do)."""


def guessed_fabric(
    analysis: PhotoAnalysis, shown: FabricParameters, photo: NDArray, weights: Weights | None = None
) -> tuple[FabricParameters, tuple[str, ...]]:
    """``shown`` with what the network sees in the photo, and sentences for people on it. Takes one or two seconds.

    Parameters
    ----------
    shown:
        ``priors.fabric_from_analysis``: its albedos are the colours that the photo shows, not yet inverted; so are the
        result's.
    photo: (H, W, 3)
        Linear.
    weights:
        By default those that ship with usdfab.
    """
    weights = weights or load_network()
    guess = predict(photo, weights)
    both = combine(guess, analysis, shown, weights.skill)
    heard = speaks(weights.skill)
    notes = [
        f"network: weave {family_of(both.label)} with probability {both.weave_confidence:.2f}, counts with "
        f"{both.count_confidence[0]:.2f} (warp) and {both.count_confidence[1]:.2f} (weft)",
        *both.notes,
    ]
    names = [name for name, is_heard in zip(NAMES, heard, strict=True) if is_heard and name != "count"]
    if names:
        notes.append(f"from the network: {', '.join(names)}")
    return fabric_of(shown, both, heard), tuple(notes)


def run_network(
    analysis: PhotoAnalysis,
    shown: FabricParameters,
    photo: NDArray,
    *,
    weights: Weights | None = None,
    seed: int = 0,
    albedo_paths: int = PATHS,
    rig: Rig | None = None,
    progress: Progress | None = None,
) -> tuple[StageOutcome, FabricParameters]:
    """The network stage as the pipeline runs it: the guess, then albedos such that it shows the photo's colours.

    Parameters as ``guessed_fabric`` and ``albedo.brightness_curves``.

    Returns
    -------
    outcome, shown:
        ``outcome.fabric`` has fiber albedos; ``shown`` is the same with the colours that the photo shows, which the
        raster stage wants.
    """
    say = progress or (lambda *_: None)
    begun = time.perf_counter()
    steps = 1 + len(LADDER) + REFINEMENTS
    say("network", 0, steps)
    guessed, notes = guessed_fabric(analysis, shown, photo, weights)
    curves = brightness_curves(
        guessed, albedo_paths, seed=seed, rig=rig, progress=lambda done, _: say("measuring albedo", 1 + done, steps)
    )
    found, more = with_inverted_albedo(
        guessed, curves, albedo_paths, seed=seed, rig=rig,
        progress=lambda done, _: say("measuring albedo", 1 + len(LADDER) + done, steps),
    )  # fmt: skip
    seconds = time.perf_counter() - begun
    return StageOutcome("network", found, seconds, notes=(*notes, *more)), guessed
