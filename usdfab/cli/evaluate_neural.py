"""``usdfab evaluate neural``: the neural material against the surface model."""

from __future__ import annotations

import json as json_format
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from usdfab.cli.options import print_json, progress_bar, say
from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from numpy.typing import NDArray

NUMBERS, ZOOM = "neural.json", "zoom.png"


def neural(
    seed: int, quality: str, output: Path | None, overwrite: bool, json: bool, *, ablation: bool = False,
    pixels: int | None = None,
) -> None:  # fmt: skip
    """Render, compare, write pictures and numbers, print the tables."""
    from usdfab.files import checked_output
    from usdfab.neural.extra import require_neural_extra

    require_neural_extra("evaluate neural")
    from usdfab.files import whole_file
    from usdfab.imaging import grid, write_image
    from usdfab.neural.evaluation import SCALES, evaluate, format_evaluation, summary
    from usdfab.neural.evaluation_ablation import AblationScale, ablations, format_ablations, interpolations
    from usdfab.neural.evaluation_scenes import stages
    from usdfab.neural.material_file import load_material_network
    from usdfab.neural.network import KINDS

    if output is None:
        raise UsdfabError("evaluate neural needs a folder to write to", remedy="usdfab evaluate neural -o RESULTS")
    scale = replace(SCALES[quality], seed=seed)
    if pixels is not None:
        if not 8 <= pixels <= 4096:
            raise UsdfabError(f"{pixels} pixels are not between 8 and 4096", place="--count")
        scale = replace(scale, pixels=pixels, zoom_pixels=max(8, pixels // 2))
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"the folder cannot be made ({error.strerror or error})", place=str(output)) from error
    files = {stage.name: output / f"{_slug(stage.name)}.png" for stage in stages()}
    for file in (*files.values(), output / ZOOM):
        checked_output(file, (".png",), overwrite=overwrite, kind="pictures")
    checked_output(output / NUMBERS, (".json",), overwrite=overwrite)
    networks = {kind: load_material_network(None, kind) for kind in KINDS}
    with progress_bar("Neural material") as update:
        result = evaluate(networks, scale, update)
    ablated = []
    if ablation:
        small = AblationScale(scale.materials, scale.queries, scale.epochs, seed)
        with progress_bar("Ablations") as update:
            ablated = ablations(small, lambda name: update(0, 0, f"Ablations: {name}"))
    mixed = interpolations(networks, 2000, seed)
    for name, pictures in result.pictures.items():
        write_image(files[name], grid(_exposed(pictures), len(pictures)), overwrite=overwrite)
    flat = [picture for line in result.zoom_pictures for picture in _exposed(line)]
    write_image(output / ZOOM, grid(flat, len(result.zoom_pictures[0])), overwrite=overwrite)
    said = {"scale": asdict(scale), **summary(result), "ablations": ablated, "interpolations": mixed}
    with whole_file(output / NUMBERS) as temporary:
        temporary.write_text(json_format.dumps(said, indent=2) + "\n", encoding="utf-8")
    say(f"wrote {len(files) + 1} pictures and {NUMBERS} to {output}")
    if json:
        print_json(said)
    else:
        print(format_evaluation(result))
        print("\n" + format_ablations(ablated, mixed))


def _slug(name: str) -> str:
    return name.replace(",", "").replace(" ", "-")


def _exposed(pictures: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float32]]:
    """All of a row with the exposure at which the last one's brightest half percent is white."""
    white = float(np.percentile(pictures[-1], 99.5))
    return [(picture * (0.9 / max(white, 1e-6))).astype(np.float32) for picture in pictures]
