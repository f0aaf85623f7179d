"""Unfinished fits as files: the results of finished stages, so that they are not run again.

A checkpoint is one JSON file; numbers are written so that they come back bit for bit. It belongs to one photo, one set
of options and one version (``about``). Within it each stage has a ``job``, a checksum of what it started from and how
it was to work: a stage with another job is run again, and so are all after it. Beside it the stages keep their own
unfinished work (``CheckpointFiles``).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, Weave, as_table
from usdfab.files import whole_file
from usdfab.fit.analysis import PhotoAnalysis, YarnSystem
from usdfab.fit.dataset.records import fabric_from_table
from usdfab.fit.stages import StageOutcome
from usdfab.usd.rig import Rig

FORMAT = "usdfab-fit/1"
STATE_SUFFIXES = {"raster": "safetensors", "match": "npz", "path": "npz"}


@dataclass(frozen=True)
class CheckpointFiles:
    """Where a fit keeps its unfinished work: beside ``output``, in files whose names begin with its name."""

    output: Path

    @property
    def fit(self) -> Path:
        """Finished stages."""
        return self.output.with_name(f"{self.output.name}.fit.json")

    def of(self, stage: str) -> Path:
        """The state of a stage after the analysis."""
        return self.output.with_name(f"{self.output.name}.{stage}.{STATE_SUFFIXES[stage]}")

    def existing(self) -> list[Path]:
        """Those that are there."""
        return [file for file in (self.fit, *map(self.of, STATE_SUFFIXES)) if file.exists()]

    def remove(self) -> None:
        """Nothing is left to resume."""
        for file in self.existing():
            file.unlink(missing_ok=True)


@dataclass
class FitCheckpoint:
    """Finished stages of one fit, in memory and, where ``file`` is given, on disk.

    Parameters
    ----------
    file:
        None: nothing is kept.
    about:
        What the fit depends on, by name: texts and numbers.
    photo:
        What the photo showed: the analysis and its fabric before albedos were inverted; None before that.
    stages:
        (job, outcome) of each finished stage, in order.
    """

    file: Path | None
    about: dict[str, Any]
    photo: tuple[PhotoAnalysis, FabricParameters, tuple[str, ...]] | None = None
    stages: list[tuple[str, StageOutcome]] = field(default_factory=list)

    @classmethod
    def begin(cls, file: Path | None, about: Mapping[str, Any], resume: bool, rig: Rig | None = None) -> FitCheckpoint:
        """The checkpoint in ``file`` if it is to be resumed and is there, else an empty one.

        ``rig`` is the photo's, where that is known: all stages have it then, and ``about`` says which it is.

        Raises
        ------
        UsdfabError
            For a file that is damaged, no checkpoint, or of another photo, other options or another version.
        """
        if not (resume and file is not None and file.exists()):
            return cls(file, dict(about))
        return _load(file, dict(about), rig)

    def finished(self, number: int, name: str, job: str) -> StageOutcome | None:
        """The outcome of the stage at this place in the order, or None where it has to be run (again)."""
        if number < len(self.stages):
            found, outcome = self.stages[number]
            if outcome.name == name and found == job:
                return outcome
            del self.stages[number:]
        return None

    def replace_last(self, outcome: StageOutcome) -> None:
        """Note what became known of the last stage, its distance, once the next was judged."""
        if self.stages:
            self.stages[-1] = (self.stages[-1][0], outcome)

    def add(self, job: str, outcome: StageOutcome) -> None:
        """Keep one more finished stage.

        Raises
        ------
        UsdfabError
            If the disk refuses.
        """
        self.stages.append((job, outcome))
        if self.file is None:
            return
        assert self.photo is not None
        analysis, shown, notes = self.photo
        data = {
            "format": FORMAT,
            "about": self.about,
            "analysis": _plain(analysis),
            "shown": as_table(shown),
            "notes": list(notes),
            "stages": [{"job": job} | _stage_table(stage) for job, stage in self.stages],
        }
        try:
            with whole_file(self.file) as temporary:
                temporary.write_text(json.dumps(data), encoding="utf-8")
        except OSError as error:
            raise UsdfabError(
                f"cannot be written ({error.strerror or error})",
                place=str(self.file),
                remedy="make room or choose another disk",
            ) from error


def _load(file: Path, about: dict[str, Any], rig: Rig | None) -> FitCheckpoint:
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise ValueError
        found = data["about"]
        names = list(dict.fromkeys([*about, *found]))
        differences = [name for name in names if found.get(name) != json.loads(json.dumps(about.get(name)))]
        if differences:
            raise UsdfabError(
                f"the unfinished fit is another one (it differs in: {', '.join(differences)})",
                place=str(file),
                remedy="give the same options, or start anew with --overwrite",
            )
        photo = (_analysis(data["analysis"]), fabric_from_table(data["shown"]), tuple(data["notes"]))
        return FitCheckpoint(file, about, photo, [(stage["job"], _stage(stage, rig)) for stage in data["stages"]])
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(file)) from error
    except UsdfabError as error:
        if error.place == str(file):
            raise
        raise _damaged(file) from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise _damaged(file) from error


def _damaged(file: Path) -> UsdfabError:
    return UsdfabError(
        "this is no unfinished fit of this version, or it is damaged",
        place=str(file),
        remedy="start anew with --overwrite",
    )


# --- JSON and back ---


def _plain(value: Any) -> Any:
    if isinstance(value, Weave):
        return {"matrix": value.matrix.astype(int).tolist(), "name": value.name}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _analysis(table: dict[str, Any]) -> PhotoAnalysis:
    values = {f.name: table[f.name] for f in fields(PhotoAnalysis)}
    values["shape"] = (int(values["shape"][0]), int(values["shape"][1]))
    values["weave"] = Weave.from_rows(values["weave"]["matrix"], values["weave"]["name"])
    for name in ("warp", "weft"):
        system = {f.name: values[name][f.name] for f in fields(YarnSystem)}
        for key in ("colour", "yarn_colours", "colour_sequence"):
            system[key] = np.asarray(system[key], dtype=np.float64).reshape(-1, 3)
        system["colour"] = system["colour"].reshape(3)
        values[name] = YarnSystem(**system)
    values["warnings"] = tuple(values["warnings"])
    values["detail"] = None if values["detail"] is None else tuple(values["detail"])
    return PhotoAnalysis(**values)


def _stage_table(stage: StageOutcome) -> dict[str, Any]:
    return {
        "name": stage.name,
        "fabric": as_table(stage.fabric),
        "halfway": None if stage.halfway is None else as_table(stage.halfway),
        "seconds": stage.seconds,
        "losses": [loss if math.isfinite(loss) else None for loss in stage.losses],
        "distance": stage.distance,
        "exposure": stage.exposure,
        "rig": None if stage.rig is None or stage.rig.lights is not None else asdict(stage.rig),
        "notes": list(stage.notes),
        "uncertainty": dict(stage.uncertainty),
    }


def _stage(table: dict[str, Any], rig: Rig | None) -> StageOutcome:
    own = table["rig"]
    return StageOutcome(
        table["name"],
        fabric_from_table(table["fabric"]),
        float(table["seconds"]),
        tuple(math.nan if loss is None else float(loss) for loss in table["losses"]),
        table["distance"],
        tuple(table["notes"]),
        halfway=None if table["halfway"] is None else fabric_from_table(table["halfway"]),
        exposure=float(table["exposure"]),
        rig=rig if own is None else Rig(**own | {"sample_size": tuple(own["sample_size"])}),
        uncertainty=dict(table["uncertainty"]),
    )
