"""The stages after the analysis one after another: what is finished is taken over, what is interrupted ends the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fit.course import Course
from usdfab.fit.fit_checkpoint import CheckpointFiles, FitCheckpoint
from usdfab.fit.stages import StageOutcome, run_raster

if TYPE_CHECKING:
    from usdfab.fit.path_settings import PathSettings
    from usdfab.fit.raster_stage import StageSettings

SECONDS_PER_SAMPLE, SECONDS_PER_ITERATION = 2e-4, 4.0
"""Of the raster stage, about."""

SECONDS_PER_MILLION_PATHS, SECONDS_PER_STEP = 10.0, 2.0
"""Of the path stage, about."""

JUDGING_SECONDS = 15.0
"""What it takes, about, to find albedos and to judge a stage."""


@dataclass(frozen=True)
class LaterStages:
    """Which stages follow the analysis, and how they work.

    Parameters
    ----------
    names:
        In order; empty where the fit ends with the analysis.
    raster, path:
        Settings of the stages; the raster stage's also say how all are judged. None where ``names`` is empty.
    """

    names: tuple[str, ...]
    raster: StageSettings | None = None
    path: PathSettings | None = None
    seed: int = 0
    albedo_paths: int = 0
    files: CheckpointFiles | None = None

    @classmethod
    def of(
        cls, wanted: tuple[str, ...], quality: str, seed: int, albedo_paths: int, files: CheckpointFiles | None
    ) -> LaterStages:
        """The stages of ``wanted`` after the analysis, in a quality.

        Raises
        ------
        UsdfabError
            For an unknown quality.
        """
        names = tuple(name for name in wanted if name != "analysis")
        if not names:
            return cls(())
        from usdfab.fit.path_settings import settings_for
        from usdfab.fit.raster_stage import checked_quality

        raster = checked_quality(quality)
        # The asset has no exposure, and pictures are judged without: the path stage is to do without as well.
        path = settings_for(quality, seed=seed, gain=False)  # type: ignore[arg-type]
        return cls(names, raster, path, seed, albedo_paths, files)

    def costs(self) -> dict[str, float]:
        """Seconds that each stage takes, about."""
        result = {}
        for name in self.names:
            if name == "raster" and self.raster is not None:
                samples = (self.raster.width * self.raster.supersampling) ** 2
                work = self.raster.iterations * (SECONDS_PER_ITERATION + SECONDS_PER_SAMPLE * samples)
            elif self.path is not None:
                work = SECONDS_PER_MILLION_PATHS * self.path.paths + SECONDS_PER_STEP * self.path.iterations
            result[name] = work + JUDGING_SECONDS
        return result

    def run(
        self,
        first: StageOutcome,
        shown: FabricParameters,
        photo: NDArray,
        rotation: float,
        kept: FitCheckpoint,
        course: Course,
    ) -> tuple[StageOutcome, ...]:
        """All stages, ``first`` (the analysis) included; finished ones go into ``kept``.

        Parameters
        ----------
        shown:
            The analysis' fabric with the colours that the photo shows as albedo.
        photo, rotation:
            (H, W, 3) linear; turn of the cloth in it, radians.
        """
        outcomes, ran = [first], False
        for name in self.names:
            last = outcomes[-1]
            job = self._job(name, last)
            done = kept.finished(len(outcomes), name, job)
            if done is None:
                if ran and self.files is not None:
                    # Only the first stage that is not finished can have been left unfinished from the same start.
                    self.files.of(name).unlink(missing_ok=True)
                ran = True
                try:
                    before, done = self._run(name, last, shown, photo, rotation, course)
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
        settings = (self.raster, replace(self.path, threads=None)) if name == "path" else (self.raster,)
        return fingerprint(last.fabric, last.halfway, *settings)

    def _run(
        self, name: str, last: StageOutcome, shown: FabricParameters, photo: NDArray, rotation: float, course: Course
    ) -> tuple[float | None, StageOutcome]:
        assert self.raster is not None and self.path is not None
        if name == "raster":
            before, after = run_raster(
                last.fabric, shown, photo, rotation, self.raster, seed=self.seed, albedo_paths=self.albedo_paths,
                checkpoint=self.files.of(name) if self.files else None, resume=True, progress=course.stage(name),
            )  # fmt: skip
            return before.distance, after
        from usdfab.fit.path_run import run_path

        return run_path(
            last.fabric, photo, rotation, self.path, self.raster, halfway=last.halfway, distance=last.distance,
            checkpoint=self.files.of(name) if self.files else None, progress=course.stage(name),
        )  # fmt: skip


def _interrupted(name: str, last: StageOutcome) -> StageOutcome:
    return StageOutcome(
        name, last.fabric, 0.0, distance=last.distance, notes=(f"the {name} stage was interrupted: not used",),
        interrupted=True,
    )  # fmt: skip
