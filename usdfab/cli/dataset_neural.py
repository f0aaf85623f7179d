"""``usdfab dataset neural``: surface materials with their answers, to train the neural material on."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from usdfab.cli.options import Json, Quiet, Seed, print_json, progress_bar, say

Two = tuple[float, float]


def neural(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Folder of the data set, new or to go on with.")],
    materials: Annotated[int, Parameter(help="Materials to have in the end; Chen et al. 2024: 465.")] = 60,
    queries: Annotated[int, Parameter(help="Queries of each material and kind; the paper: 3.2 million.")] = 20_000,
    samples: Annotated[int, Parameter(help="Samples of each query; the paper: 2048.")] = 512,
    kind: Annotated[Literal["reflection", "transmission", "both"], Parameter(help="Light from above, below.")] = "both",
    weaves: Annotated[
        str | None, Parameter(help="Names of weaves, or rows such as 10/01, with commas; the paper's seven by default.")
    ] = None,
    twist: Annotated[str, Parameter(help="Degrees, with commas: one is drawn for warp and weft each.")] = "-30,0,30",
    inclination: Annotated[
        Two, Parameter(negative_iterable=(), help="Degrees, from and to; for warp and weft each.")
    ] = (15.0, 45.0),
    roughness: Annotated[Two, Parameter(negative_iterable=(), help="From and to.")] = (0.1, 1.0),
    height_scale: Annotated[Two, Parameter(negative_iterable=(), help="From and to.")] = (0.0, 2.0),
    small: Annotated[
        Two, Parameter(negative_iterable=(), help="Footprints of half of the queries, in tiles, from and to.")
    ] = (
        0.0,
        1.0,
    ),
    large: Annotated[Two, Parameter(negative_iterable=(), help="Those of the other half.")] = (1.0, 5.0),
    gap: Annotated[
        Two, Parameter(negative_iterable=(), help="Part of a cell's width that yarns leave open, from and to.")
    ] = (0.2, 0.2),
    seed: Seed = 0,
    workers: Annotated[int | None, Parameter(help="Processes, one thread each; as many as cores by default.")] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Draw surface materials (Chen et al. 2024, Table 2) and compute what they answer to light.

    Each file FOLDER/KIND-NNNNN.safetensors holds a material, queries (footprint and directions) and their four
    components: diffuse and specular light of warp and weft. File i is the same whatever process or run makes it.
    Whatever stops a run, finished files are kept and the same command goes on, also with more materials.
    FOLDER/dataset.json says how the set was made: a run with other settings is refused.

    Usage examples:

        usdfab dataset neural -o materials
        usdfab dataset neural -o small --materials 14 --queries 2000 --samples 128 --kind reflection
        usdfab dataset neural -o paper --materials 465 --queries 3200000 --samples 2048 --workers 32
    """
    from importlib.util import find_spec

    from usdfab.errors import UsdfabError

    if find_spec("safetensors") is None:
        raise UsdfabError("dataset neural needs safetensors", remedy="pip install 'usdfab[fit]'")

    from usdfab.neural.dataset_draws import MAX_MATERIALS, PAPER_WEAVES, DatasetSettings

    if not 0 <= materials <= MAX_MATERIALS:
        raise UsdfabError(f"{materials} is not between 0 and {MAX_MATERIALS}", place="--materials")
    if workers is not None and workers < 1:
        raise UsdfabError(f"{workers} processes can do nothing", place="--workers", remedy="give 1 or more")
    try:
        twists = tuple(float(part) for part in twist.split(",") if part.strip())
    except ValueError:
        raise UsdfabError(f"'{twist}' are no angles", place="--twist", remedy="write e.g. -30,0,30") from None
    names = PAPER_WEAVES if weaves is None else tuple(part.strip() for part in weaves.split(",") if part.strip())
    settings = DatasetSettings(
        kind, queries, samples, seed, names, twists, inclination, roughness, height_scale, small, large, gap
    )

    from usdfab.neural.dataset_store import MaterialStore, produce_materials
    from usdfab.production import local_workers
    from usdfab.tracer.compilation import announce_compilation
    from usdfab.tracer.render import thread_count

    store = MaterialStore(output, settings, materials)
    files = materials * len(settings.kinds)
    slots = min(thread_count(workers), max(1, len(store.missing(range(files)))))
    announce = nullcontext() if quiet else announce_compilation(say)
    with announce, progress_bar(f"computing {output.name}", quiet=quiet) as update:
        if slots > 1:
            with local_workers(slots) as pool:
                made = produce_materials(store, materials, pool, slots, update)
        else:
            made = produce_materials(store, materials, progress=update)
    rate = made.made * queries * samples / made.cpu_seconds if made.cpu_seconds > 0 else 0.0
    if json:
        print_json(
            {
                "output": output, "files": made.there + made.made, "made": made.made, "left_to_others": made.others,
                "asked": files, "seconds": round(made.seconds, 3), "cpu_seconds": round(made.cpu_seconds, 3),
                "samples_per_cpu_second": round(rate), "settings": settings.manifest(materials),
            }
        )  # fmt: skip
    elif not quiet:
        each = f", {made.cpu_seconds / made.made:.1f} CPU seconds each" if made.made else ""
        left = f", {made.others} are being made by other processes" if made.others else ""
        say(f"{output}: {made.there + made.made} of {files} files, {made.made} made now{each}{left}")
