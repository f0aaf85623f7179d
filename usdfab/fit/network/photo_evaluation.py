"""The network on labelled photos of real cloth, beside the analysis and together with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from usdfab.fit.evaluation import TOLERANCE, Row, evaluate_photos, read_photo
from usdfab.fit.features import FeatureNet, fast_dtype
from usdfab.fit.network.combine import Combined, combine
from usdfab.fit.network.inputs import feature_net
from usdfab.fit.network.labels import family_of
from usdfab.fit.network.network_file import Weights
from usdfab.fit.network.predict import Guess, predict
from usdfab.fit.priors import fabric_from_analysis

PHOTO_WAYS = ("analysis", "network", "combined")


@dataclass(frozen=True, eq=False)
class PhotoJudged:
    """One photo: label and analysis, the network's guess, and both together (``None`` if the analysis refused)."""

    row: Row
    guess: Guess
    both: Combined | None

    def family(self, way: str) -> str | None:
        """The weave family that a way finds; ``None`` where it refused."""
        if way == "network" or (way == "combined" and self.both is None):
            return family_of(self.guess.label)
        if way == "combined":
            assert self.both is not None
            return family_of(self.both.label)
        return self.row.analysis.weave_class if self.row.analysis else None

    def counts(self, way: str) -> tuple[float, float] | None:
        """Warp and weft count that a way finds."""
        if way == "analysis":
            return (self.row.analysis.warp_count, self.row.analysis.weft_count) if self.row.analysis else None
        found = self.both.counts if way == "combined" and self.both is not None else self.guess.counts
        return float(found[0]), float(found[1])

    def count_errors(self, way: str) -> list[float | None]:
        """Relative errors of both counts: -1 after a refusal, ``None`` without a label."""
        found = self.counts(way)
        wanted = (self.row.warp_count, self.row.weft_count)
        return [None if t is None else -1.0 if found is None else found[k] / t - 1.0 for k, t in enumerate(wanted)]


def evaluate_network_photos(
    weights: Weights, folder: str | Path, net: FeatureNet | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[PhotoJudged]:  # fmt: skip
    """Judge a network on a folder of photos with ``SOURCES.csv``, as ``evaluation.evaluate_photos`` does the analysis.

    Raises
    ------
    UsdfabError
        For a missing table or picture, and weights that do not know photos.
    """
    net = net or feature_net(fast_dtype())
    rows = evaluate_photos(folder)
    judged = []
    for done, row in enumerate(rows):
        if progress:
            progress(done, len(rows))
        photo = read_photo(Path(folder) / row.file)
        guess = predict(photo, weights, net)
        both = None
        if row.analysis is not None:
            both = combine(guess, row.analysis, fabric_from_analysis(row.analysis, 5e-3)[0], weights.skill)
        judged.append(PhotoJudged(row, guess, both))
    return judged


def photo_totals(judged: Sequence[PhotoJudged]) -> dict[str, Any]:
    """Right classes and right counts (within ``TOLERANCE``) by way, and how many there are."""
    result: dict[str, Any] = {"photos": len(judged)}
    for way in PHOTO_WAYS:
        errors = [e for one in judged for e in one.count_errors(way) if e is not None]
        result[way] = {
            "classes_right": sum(one.family(way) == one.row.weave for one in judged),
            "counts_right": sum(abs(e) <= TOLERANCE for e in errors),
        }
        result["counts"] = len(errors)
    return result


def format_photos(judged: Sequence[PhotoJudged]) -> str:
    """The table as text; * marks what is wrong."""
    head = "".join(f"{way:<27}" for way in PHOTO_WAYS)
    lines = [f"{'file':<34}{'class':<8}{'counts':<10}{head}"]
    for one in judged:
        wanted = (one.row.warp_count, one.row.weft_count)
        known = " x ".join("-" if t is None else f"{t:.0f}" for t in wanted)
        text = f"{one.row.file:<34}{one.row.weave:<8}{known:<10}"
        for way in PHOTO_WAYS:
            found = one.counts(way)
            if found is None:
                text += f"{'refused':<27}"
                continue
            marks = ["" if e is None or abs(e) <= TOLERANCE else "*" for e in one.count_errors(way)]
            family = f"{one.family(way)}{'' if one.family(way) == one.row.weave else '*'}"
            cell = f"{family:<8}{found[0]:.1f}{marks[0]} x {found[1]:.1f}{marks[1]}"
            text += f"{cell:<27}"
        lines.append(text.rstrip())
    said = photo_totals(judged)
    for way in PHOTO_WAYS:
        lines.append(
            f"{way}: classes right {said[way]['classes_right']} of {said['photos']}, counts within 10 % "
            f"{said[way]['counts_right']} of {said['counts']}"
        )
    return "\n".join(lines)


def photo_json(judged: Sequence[PhotoJudged]) -> dict[str, Any]:
    """The table as plain JSON data."""
    rows = [
        {
            "file": one.row.file, "weave": one.row.weave, "warp_count": one.row.warp_count,
            "weft_count": one.row.weft_count, "problem": one.row.problem,
        } | {way: {"weave": one.family(way), "counts": one.counts(way)} for way in PHOTO_WAYS}
        for one in judged
    ]  # fmt: skip
    return {"summary": photo_totals(judged), "rows": rows}
