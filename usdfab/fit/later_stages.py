"""The stages after the analysis one after another: what is finished is taken over, what is interrupted ends the fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.fit.analysis import PhotoAnalysis
from usdfab.fit.course import Course
from usdfab.fit.fit_checkpoint import STATE_SUFFIXES, CheckpointFiles, FitCheckpoint
from usdfab.fit.stages import StageOutcome, run_raster

if TYPE_CHECKING:
    from usdfab.fit.match_stage import MatchSettings
    from usdfab.fit.path_settings import PathSettings
    from usdfab.fit.raster_stage import StageSettings
    from usdfab.usd.rig import Rig

SECONDS_PER_SAMPLE, SECONDS_PER_ITERATION = 2e-4, 4.0
"""Of the raster stage, about."""

ITERATIONS_PER_STEP = 10
"""A step of Gauss-Newton renders some 35 pictures without derivatives: as long as so many of Adam's iterations. A round
has two where it also traces paths."""

SECONDS_PER_TRACED_SAMPLE = 1.6e-5
"""Of the path-traced pictures beside the raster stage's, about."""

SECONDS_PER_MILLION_PATHS, SECONDS_PER_STEP = 10.0, 2.0
"""Of the path stage, about."""

SECONDS_PER_MATCH_SAMPLE = 1.2e-5
"""Of the match stage, about, features included."""

NETWORK_SECONDS = 5.0

JUDGING_SECONDS = 15.0
"""What it takes, about, to find albedos and to judge a stage."""


@dataclass(frozen=True)
class LaterStages:
    """Which stages follow the analysis, and how they work.

    Parameters
    ----------
    names:
        In order; empty where the fit ends with the analysis.
    raster, path, match:
        Settings of the stages. None where ``names`` is empty.
    judge:
        How the results of all are judged.
    widest:
        Greatest width of a photo, relative to its height, whose pictures have rows enough for the texture statistics.
    rig:
        The photo's, where it is known; None leaves it to the stages to find.
    """

    names: tuple[str, ...]
    raster: StageSettings | None = None
    path: PathSettings | None = None
    match: MatchSettings | None = None
    seed: int = 0
    albedo_paths: int = 0
    files: CheckpointFiles | None = None
    rig: Rig | None = None
    judge: StageSettings | None = None
    widest: float = math.inf

    @classmethod
    def of(
        cls,
        wanted: tuple[str, ...],
        quality: str,
        seed: int,
        albedo_paths: int,
        files: CheckpointFiles | None,
        rig: Rig | None = None,
    ) -> LaterStages:
        """The stages of ``wanted`` after the analysis, in a quality.

        Raises
        ------
        UsdfabError
            For an unknown quality; where the weights of the features, by which all stages are judged, are missing or
            damaged.
        """
        names = tuple(name for name in wanted if name != "analysis")
        if not names:
            return cls(())
        from usdfab.fit.features import load_features
        from usdfab.fit.match_stage import checked_match_quality
        from usdfab.fit.path_settings import settings_for
        from usdfab.fit.raster_stage import JUDGE, checked_quality
        from usdfab.fit.texture import smallest_side

        net = load_features()
        raster = checked_quality(quality)
        # The exposure is found before: the path stage is to leave it as it is.
        path = settings_for(quality, seed=seed, gain=False)  # type: ignore[arg-type]
        match = checked_match_quality(quality, seed)
        looking = (JUDGE, raster) if "raster" in names else (JUDGE,)
        widest = min(s.width / smallest_side(net, s.levels) for s in looking)
        return cls(names, raster, path, match, seed, albedo_paths, files, rig, JUDGE, widest)

    def require_room(self, photo: NDArray, place: str) -> None:
        """Refuse a photo (H, W, 3) so wide that its pictures have too few rows for the texture statistics.

        Raises
        ------
        UsdfabError
            Before any work: else the analysis would be done for nothing.
        """
        height, width = photo.shape[:2]
        if width > self.widest * height:
            raise UsdfabError(
                f"the photo has {width} x {height} pixels, too wide for the stages after the analysis",
                place=place,
                remedy=f"--crop it to at most {self.widest:.3g} times as wide as high, or use --stages analysis",
            )

    def costs(self) -> dict[str, float]:
        """Seconds that each stage takes, about."""
        result = {}
        for name in self.names:
            if name == "raster" and self.raster is not None:
                samples = (self.raster.width * self.raster.supersampling) ** 2
                each = ITERATIONS_PER_STEP if self.raster.steps == "newton" else 1
                each *= 2 if self.raster.traced else 1
                work = self.raster.iterations * each * (SECONDS_PER_ITERATION + SECONDS_PER_SAMPLE * samples)
                work += (
                    SECONDS_PER_TRACED_SAMPLE * (1 + self.raster.iterations) * self.raster.traced * self.raster.width**2
                )
            elif name == "network":
                work = NETWORK_SECONDS
            elif name == "match" and self.match is not None:
                work = SECONDS_PER_MATCH_SAMPLE * self.match.pictures * self.match.width**2 * self.match.samples
            elif self.path is not None:
                work = SECONDS_PER_MILLION_PATHS * self.path.paths + SECONDS_PER_STEP * self.path.iterations
            result[name] = work + JUDGING_SECONDS
        return result

    def run(
        self,
        first: StageOutcome,
        shown: FabricParameters,
        photo: NDArray,
        analysis: PhotoAnalysis,
        kept: FitCheckpoint,
        course: Course,
    ) -> tuple[StageOutcome, ...]:
        """All stages, ``first`` (the analysis) included; finished ones go into ``kept``.

        Parameters
        ----------
        shown:
            The analysis' fabric with the colours that the photo shows as albedo.
        photo, analysis:
            (H, W, 3) linear, and what it shows.
        """
        outcomes, ran = [first], False
        for name in self.names:
            last = outcomes[-1]
            job = self._job(name, last)
            done = kept.finished(len(outcomes), name, job)
            if done is None:
                if ran and self.files is not None and name in STATE_SUFFIXES:
                    # Only the first stage that is not finished can have been left unfinished from the same start.
                    self.files.of(name).unlink(missing_ok=True)
                ran = True
                try:
                    before, done = self._run(name, last, shown, photo, analysis, course)
                except KeyboardInterrupt:
                    # Outside the iterations, which end by themselves.
                    before, done = last.distance, _interrupted(name, last)
                outcomes[-1] = last if before is None else replace(last, distance=before)
                if not done.interrupted:
                    kept.replace_last(outcomes[-1])
                    kept.add(job, done)
            course.finish(name)
            outcomes.append(done)
            if done.interrupted:
                break
        return tuple(outcomes)

    def _job(self, name: str, last: StageOutcome) -> str:
        from usdfab.tracer.checkpoint import fingerprint

        assert self.path is not None
        own = {"path": replace(self.path, threads=None), "match": self.match}.get(name)
        return fingerprint(last.fabric, last.halfway, last.exposure, last.rig, self.raster, self.judge, own)

    def _run(
        self,
        name: str,
        last: StageOutcome,
        shown: FabricParameters,
        photo: NDArray,
        analysis: PhotoAnalysis,
        course: Course,
    ) -> tuple[float | None, StageOutcome]:
        assert self.raster is not None and self.path is not None and self.judge is not None
        rotation = analysis.rotation
        if name == "network":
            from usdfab.fit.network.stage import run_network

            guess, _ = run_network(
                analysis, shown, photo, seed=self.seed, albedo_paths=self.albedo_paths, rig=self.rig,
                progress=course.stage(name),
            )  # fmt: skip
            return last.distance, replace(guess, exposure=last.exposure, rig=last.rig)
        if name == "raster":
            before, after = run_raster(
                last.fabric, shown, photo, rotation, self.raster, judge=self.judge, seed=self.seed,
                exposure=last.exposure, rig=last.rig, albedo_paths=self.albedo_paths,
                checkpoint=self.files.of(name) if self.files else None,
                resume=True, progress=course.stage(name),
            )  # fmt: skip
            return before.distance, after
        if name == "match":
            from usdfab.fit.match_run import run_match

            assert self.match is not None
            return run_match(
                last.fabric, photo, rotation, self.match, self.judge, exposure=last.exposure, rig=last.rig,
                rig_known=self.rig is not None, distance=last.distance,
                checkpoint=self.files.of(name) if self.files else None, progress=course.stage(name),
            )  # fmt: skip
        if any(last.fabric.system(system).albedo_variation > 0.0 for system in SYSTEMS):
            note = "the path stage was left out: it knows one albedo for all fibers of a yarn, and these differ"
            return last.distance, replace(last, name=name, seconds=0.0, losses=(), notes=(note,), halfway=None)
        from usdfab.fit.path_run import run_path

        return run_path(
            last.fabric, photo, rotation, self.path, self.judge, halfway=last.halfway, exposure=last.exposure,
            rig=last.rig, distance=last.distance, checkpoint=self.files.of(name) if self.files else None,
            progress=course.stage(name),
        )  # fmt: skip


def _interrupted(name: str, last: StageOutcome) -> StageOutcome:
    return StageOutcome(
        name, last.fabric, 0.0, distance=last.distance, exposure=last.exposure, rig=last.rig,
        notes=(f"the {name} stage was interrupted: not used",), interrupted=True,
    )  # fmt: skip
