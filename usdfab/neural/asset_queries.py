"""Queries of one fabric with what its fibers answer, made in pieces that are kept: an interrupted run goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from usdfab.disk import refused
from usdfab.files import whole_file
from usdfab.neural.dataset_draws import EDGE
from usdfab.neural.dataset_store import encode
from usdfab.neural.fiber_answers import FiberAnswers, colors_of
from usdfab.neural.fiber_kernel import GLOSS

Floats = NDArray[np.float32]
Piece = tuple[Floats, Floats, Floats]

SMALL, LARGE = (0.0, 1.0), (1.0, 5.0)
"""Sides of footprints in tiles: half of the queries each (Table 2 of Chen et al. 2024)."""

PIECES = 12
"""Of each side of the cloth."""

LIGHTS = 8
"""Directions of light of each kind that a query's paths look at."""

JUDGES, JUDGE_SAMPLES = 160, 384
"""Queries of each side that judge, and their paths, with two sets of random numbers."""


@dataclass(frozen=True, eq=False)
class AssetQueries:
    """What the front and the back of a fabric answered.

    Parameters
    ----------
    footprints: (2, Q, 5)
        As ``FiberAnswers.ask`` takes them.
    lights: (2, Q, 2, L, 3)
        For each of ``KINDS`` L directions.
    answers: (R, 2, Q, 2, L, 4)
        R times with other random numbers: red, green, gloss, blue.
    """

    footprints: Floats
    lights: Floats
    answers: Floats

    def of_kind(self, kind: int) -> tuple[Floats, Floats]:
        """Queries (2, Q L, 8) as networks take them, and answers (R, 2, Q L, 4): 0 reflection, 1 transmission."""
        lights = self.lights[:, :, kind]
        sides, count, each, _ = lights.shape
        seen = np.broadcast_to(self.footprints[:, :, None], (sides, count, each, 5))
        rows = np.concatenate([seen[..., :3], lights, seen[..., 3:]], axis=-1).reshape(sides, -1, 8)
        rows[..., :2] %= 1.0  # rounding may have led to 1, which is 0
        return rows, self.answers[:, :, :, kind].reshape(len(self.answers), sides, -1, 4)


def draw_asset_queries(count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Footprints (count, 5) and lights (count, 2, LIGHTS, 3), from the front and from behind.

    Each column is stratified over all rows, and the lights of one row over the disk; directions are uniform over it.
    """
    rng = np.random.default_rng([seed, 0xF1BE])
    u = (np.stack([rng.permutation(count) for _ in range(5)], axis=1) + rng.random((count, 5))) / max(count, 1)
    half = np.where(u[:, 2] < 0.5, 2.0 * u[:, 2], 2.0 * u[:, 2] - 1.0)
    size = np.where(u[:, 2] < 0.5, SMALL[0] + (SMALL[1] - SMALL[0]) * half, LARGE[0] + (LARGE[1] - LARGE[0]) * half)
    radius, angle = EDGE * np.sqrt(u[:, 3]), 2.0 * np.pi * u[:, 4]
    footprints = np.stack([u[:, 0], u[:, 1], size, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    # The golden angle's spiral over the disk, turned and pushed outwards at random.
    turn, out = rng.random((2, count, 2, 1))
    area = (np.arange(LIGHTS) + out) / LIGHTS
    angle = 2.0 * np.pi * (0.6180339887498949 * np.arange(LIGHTS) + turn)
    radius = EDGE * np.sqrt(area)
    z = np.sqrt(1.0 - radius**2) * np.array([[1.0], [-1.0]])
    return footprints, np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def columns_of(answers: NDArray[np.float64]) -> Floats:
    """Red, green, gloss, blue (..., 4) of the fibers' answers (..., 8); colours without the gloss."""
    gloss = answers[..., GLOSS : GLOSS + 2].sum(axis=-1)
    rgb = colors_of(answers) - gloss[..., None]
    return np.stack([rgb[..., 0], rgb[..., 1], gloss, rgb[..., 2]], axis=-1).astype(np.float32)


def produce_queries(
    fibers: FiberAnswers, folder: Path, job: str, queries: int, samples: int, seed: int, *, resume: bool = False,
    threads: int | None = None, progress: Callable[[int, int], None] | None = None,
) -> tuple[AssetQueries, AssetQueries]:  # fmt: skip
    """What is learned from, and what judges; ``queries`` of each side, ``samples`` paths each.

    Finished pieces are files of ``folder``; with ``resume`` those of the same ``job`` are taken as they are.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    counts = [len(part) for part in np.array_split(np.arange(queries), min(PIECES, queries))]
    plan = [(JUDGES, JUDGE_SAMPLES, 2), *((count, samples, 1) for count in counts)]
    made: list[list[Piece]] = [[], []]
    for number, (count, paths, times) in enumerate(plan):
        for back in range(2):
            file = piece_path(folder, back, number)
            found = _read(file, job) if resume else None
            if found is None:
                own = (seed * 4096 + 2 * number + back) % 2**62
                seen, lights = draw_asset_queries(count, own)
                answers = [
                    columns_of(
                        fibers.ask(
                            seen, lights.reshape(count, -1, 3), paths, back=bool(back), seed=2 * own + k,
                            threads=threads,
                        )
                    ).reshape(*lights.shape[:3], 4)
                    for k in range(times)
                ]  # fmt: skip
                found = seen.astype(np.float32), lights.astype(np.float32), np.stack(answers)
                _write(file, job, found)
            made[back].append(found)
            if progress:
                progress(2 * number + back + 1, 2 * len(plan))

    def joined(pieces: slice) -> AssetQueries:
        seen, lights = (np.stack([np.concatenate([p[k] for p in side[pieces]]) for side in made]) for k in (0, 1))
        answers = np.stack([np.concatenate([p[2] for p in side[pieces]], axis=1) for side in made], axis=1)
        return AssetQueries(seen, lights, answers)

    return joined(slice(1, None)), joined(slice(0, 1))


def piece_path(folder: Path, back: int, number: int) -> Path:
    """File of a piece; number 0 are the judges."""
    return folder / f"{'back' if back else 'front'}-{number:02d}.safetensors"


def remove_pieces(folder: Path) -> None:
    """Delete the pieces, and the folder if nothing else is in it."""
    for number in range(PIECES + 1):
        for back in range(2):
            piece_path(folder, back, number).unlink(missing_ok=True)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


_TENSORS = ("footprints", "lights", "answers")


def _write(file: Path, job: str, made: Piece) -> None:
    try:
        file.parent.mkdir(exist_ok=True)
        with whole_file(file) as temporary:
            temporary.write_bytes(encode(dict(zip(_TENSORS, made, strict=True)), {"job": job}))
    except OSError as error:
        raise refused(error, file) from error


def _read(file: Path, job: str) -> Piece | None:
    """A piece of the same job, or None: one that is missing, damaged or another run's is made again."""
    try:
        with safe_open(file, "np") as opened:
            if (opened.metadata() or {}).get("job") != job:
                return None
            return tuple(opened.get_tensor(name) for name in _TENSORS)
    except (OSError, SafetensorError):
        return None
