"""How near fits of photos come to them: ``usdfab evaluate fits``, a picture and a distance for each photo and stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fit.fit_checkpoint import CheckpointFiles
from usdfab.fit.judge import clear_picture, through_camera
from usdfab.fit.pipeline import Fit, fit_photo
from usdfab.fit.result_folder import made_folder, no_result, read_result, write_result
from usdfab.fit.stages import StageOutcome
from usdfab.fit.straighten import straightened
from usdfab.imaging import linear_to_srgb, side_by_side, srgb_to_linear, write_image
from usdfab.usd.fabric_io import write_fabric

if TYPE_CHECKING:
    from usdfab.fit.features import FeatureNet

SIDE = 240
"""Pixels along the side of what is compared."""

LEVELS = (1, 2, 4)
SAMPLES, LEARNED = 48, 24
"""Per pixel of the pictures compared, before the denoiser, and of half as large ones from which their radiance cache
learns. What the denoiser makes of 24 whole paths is smoother than the cloth, and may be nearer to a smooth photo:
bright satin was 0.35 from its photo then, 0.45 with 400."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr")

SAME_CLOTH = 0.36
"""Distance that 90 % of crops of one photo stay under, two crops of a quarter each, over 15 photos of real cloth.
Another fabric's photo is 0.83 away or more in 90 %."""


@dataclass(frozen=True)
class FitRow:
    """One photo: distance after each stage by name, exposure, and seconds; ``problem`` where it was refused."""

    name: str
    distances: dict[str, float]
    exposure: float
    seconds: float
    problem: str = ""

    @property
    def last(self) -> float | None:
        """Distance of the result."""
        return list(self.distances.values())[-1] if self.distances else None


def gram_distance(first: NDArray, second: NDArray, net: FeatureNet, levels: Sequence[int] = LEVELS) -> float:
    """How far two textures are apart: 0 for the same picture, about 1 for other fabrics.

    Mean over levels and layers of ``|A - B| / ((|A| + |B|) / 2)``, means of absolute entries of the Gram matrices A and
    B (Li et al. 2024, eq. 12), which is symmetric. (H, W, 3) linear pictures, at one scale; shown as a file of 8 bits
    would be.
    """
    import torch

    from usdfab.fit.texture import texture_statistics

    found = []
    with torch.inference_mode():
        for picture in (first, second):
            shown = srgb_to_linear(np.round(255.0 * np.clip(linear_to_srgb(np.clip(picture, 0, 1)), 0, 1)) / 255.0)
            image = torch.from_numpy(np.ascontiguousarray(shown, dtype=np.float32)).permute(2, 0, 1)[None]
            found.append(texture_statistics(image, net, levels, "gram"))
        terms = [
            float((a - b).abs().mean() / (0.5 * (a.abs().mean() + b.abs().mean())).clamp(min=1e-12))
            for a, b in zip(*found, strict=True)
        ]
    return float(np.mean(terms))


def evaluate_fits(
    folder: str | Path,
    output: str | Path,
    *,
    stages: Sequence[str] = ("analysis", "match"),
    quality: str = "draft",
    width: float = 5e-3,
    seed: int = 0,
    names: Sequence[str] = (),
    progress: Callable[[str, int, int], None] | None = None,
) -> list[FitRow]:
    """Fit every photo of a folder.

    Parameters
    ----------
    folder:
        Of photos.
    output:
        A folder, made if it is missing, that gets for each photo ``NAME.usda``, ``NAME.png`` (photo, then each stage)
        and ``NAME.json``. Photos whose JSON is there are not fitted again, unfinished ones are gone on with.
    stages, quality, seed:
        As ``fit_photo``.
    width:
        What each photo is taken to be wide, metres.
    names:
        Only these files.
    progress:
        Called with (photo, photos done, photos).

    Raises
    ------
    UsdfabError
        If there is no photo, or the output cannot be written. A photo that is refused is a row with a ``problem``.
    """
    from usdfab.fit.extra import require_fit_extra

    require_fit_extra("evaluate fits")
    from usdfab.fit.features import load_features

    source, target = Path(folder), Path(output)
    photos = sorted(p for p in source.glob("*") if p.suffix.lower() in SUFFIXES and (not names or p.name in names))
    if not photos:
        raise UsdfabError("no photos are there", place=str(source), remedy=f"name a folder of {', '.join(SUFFIXES)}")
    about = {"stages": list(stages), "quality": quality, "width": width, "seed": seed}
    made_folder(target)
    net = load_features()
    rows = []
    for k, photo in enumerate(photos):
        if progress:
            progress(photo.stem, k, len(photos))
        record = target / f"{photo.stem}.json"
        row = _read_row(record, about)
        if row is None:
            row = _fitted(photo, target, net, stages, quality, width, seed)
            write_result(record, about, asdict(row))
        rows.append(row)
    return rows


def format_fits(rows: Sequence[FitRow]) -> str:
    """The table as text, with how many are as near as another crop of the photo would be."""
    stages = list(dict.fromkeys(name for row in rows for name in row.distances))
    lines = [f"{'photo':<32}" + "".join(f"{name:>10}" for name in stages) + f"{'exposure':>10}{'s':>7}"]
    for row in rows:
        if row.problem:
            lines.append(f"{row.name:<32}refused: {row.problem}")
            continue
        cells = "".join(f"{row.distances[n]:10.3f}" if n in row.distances else f"{'-':>10}" for n in stages)
        lines.append(f"{row.name:<32}{cells}{row.exposure:10.2f}{row.seconds:7.0f}")
    known = [row.last for row in rows if row.last is not None]
    if known:
        near = sum(value <= SAME_CLOTH for value in known)
        lines.append(f"median {np.median(known):.3f}; within {SAME_CLOTH} of the photo: {near} of {len(rows)}")
    return "\n".join(lines)


def _fitted(
    photo: Path, folder: Path, net: FeatureNet, stages: Sequence[str], quality: str, width: float, seed: int
) -> FitRow:
    asset = folder / f"{photo.stem}.usda"
    files = CheckpointFiles(asset)
    try:
        fit = fit_photo(photo, width, None, seed, stages=stages, quality=quality, checkpoint=files, resume=True)
    except UsdfabError as error:
        return FitRow(photo.stem, {}, 1.0, 0.0, str(error))
    # Ctrl-C within a stage gives what was found so far. Its checkpoint stays, and the same command goes on from there.
    if fit.stages[-1].interrupted:
        raise KeyboardInterrupt
    write_fabric(fit.fabric, asset, overwrite=True)
    goal = photo_middle(fit)
    pictures = {stage.name: swatch(stage, seed) for stage in fit.stages}
    write_image(folder / f"{photo.stem}.png", side_by_side([goal, *pictures.values()]), overwrite=True)
    distances = {name: gram_distance(goal, picture, net) for name, picture in pictures.items()}
    files.remove()
    return FitRow(photo.stem, distances, fit.exposure, sum(stage.seconds for stage in fit.stages))


def photo_middle(fit: Fit) -> NDArray[np.float32]:
    """The middle square of the photo, as large in pixels as the picture of that much cloth."""
    height, width = fit.photo.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return straightened(fit.photo[top : top + side, left : left + side], 0.0, 1.0, SIDE / side)


def swatch(stage: StageOutcome, seed: int = 0) -> NDArray[np.float32]:
    """What a stage found, as the photo's camera shows it: the whole fabric, ``SIDE`` pixels along its shorter side."""
    fabric = stage.fabric
    scale = SIDE / min(fabric.size)
    size = (round(scale * fabric.size[0]), round(scale * fabric.size[1]))
    clear = clear_picture(fabric, stage.rig, size, SAMPLES, LEARNED, seed=seed + 1)
    return through_camera(clear, stage.rig, scale, stage.exposure)


def _read_row(record: Path, about: dict[str, Any]) -> FitRow | None:
    data = read_result(record, about)
    try:
        return None if data is None else FitRow(**data)
    except TypeError as error:
        raise no_result(record) from error
