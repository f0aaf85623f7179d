"""``usdfab dataset``: rendered fabrics and surface materials with their parameters, to train networks on."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from usdfab.cli.options import Json, Overwrite, Quiet, Seed, parse_tile, print_json, progress_bar, say

HELP = """Make data sets that networks learn from.

Usage examples:

    usdfab dataset fabrics -o fabrics --count 5000
    usdfab dataset neural -o materials --materials 60 --kind both
"""

run = App(name="dataset", help=HELP, help_format="markdown")
run.command("usdfab.cli.dataset_neural:neural", name="neural")


@run.command
def fabrics(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Folder of the data set, new or to go on with.")],
    count: Annotated[int, Parameter(help="Samples to have in the end, from --start on.")] = 1000,
    start: Annotated[int, Parameter(help="Number of the first sample.")] = 0,
    prior: Annotated[
        str, Parameter(help="paper (Table 4 of Li et al. 2024), wide (as real photos show cloth) or both in turn.")
    ] = "both",
    size: Annotated[int, Parameter(help="Pixels on a side.")] = 320,
    spp: Annotated[int, Parameter(help="Samples per pixel. One at more pixels tells more than several at few.")] = 1,
    denoise: Annotated[bool, Parameter(help="Remove the noise; the picture's mean is kept.")] = True,
    shard: Annotated[int, Parameter(help="Samples in each tar file.")] = 256,
    seed: Seed = 0,
    part: Annotated[str | None, Parameter(help="i/n: only every n-th sample, from the i-th on.")] = None,
    workers: Annotated[int | None, Parameter(help="Processes, one thread each; as many as cores by default.")] = None,
    scheduler: Annotated[
        str | None, Parameter(help="A Dask cluster's address, e.g. tcp://host:8786 (needs the cluster extra).")
    ] = None,
    picture: Annotated[Path | None, Parameter(help="Also draw the first samples in one picture.")] = None,
    picture_count: Annotated[int, Parameter(help="Samples in that picture.")] = 25,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render random fabrics under the capture rig and write images and parameters.

    Sample i is the same whatever process, machine or run makes it. Any number of runs may work on one folder at a
    time; each takes samples that nobody has. Whatever stops a run, finished samples are kept and the same command goes
    on. FOLDER/dataset.json says how the set was made: a run with other settings is refused. Full shards are tar files
    of NNNNNN.exr (linear) and NNNNNN.json in FOLDER/shards, the rest lies in FOLDER/loose.

    Usage examples:

        usdfab dataset fabrics -o fabrics --count 5000
        usdfab dataset fabrics -o wide --prior wide --count 64 --size 128 --picture sheet.png
        usdfab dataset fabrics -o fabrics --count 5000 --part 2/8 --workers 16
        usdfab dataset fabrics -o fabrics --count 5000 --scheduler tcp://farm:8786
    """
    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.fit.dataset.samples import MAX_INDEX
    from usdfab.fit.dataset.settings import Settings

    if count < 0 or start < 0 or start + count > MAX_INDEX:
        raise UsdfabError(f"{count} from {start} on are no samples", place="--count", remedy=f"stay below {MAX_INDEX}")
    if workers is not None and workers < 1:
        raise UsdfabError(f"{workers} processes can do nothing", place="--workers", remedy="give 1 or more")
    if picture_count < 1:
        raise UsdfabError(f"{picture_count} samples are no picture", place="--picture-count", remedy="give 1 or more")
    try:
        i, n = parse_tile(part) or (1, 1)
    except UsdfabError as error:
        raise UsdfabError(f"'{part}' is no part", place="--part", remedy="write i/n, e.g. 2/8") from error
    settings = Settings(prior, seed, size, spp, denoise, shard)
    if denoise:
        from usdfab.imaging import check_denoiser

        check_denoiser()
    if picture is not None:
        checked_output(picture, (".png", ".jpg", ".jpeg", ".tif", ".tiff"), overwrite=overwrite, kind="pictures")

    from usdfab.cli.cluster import dask_executor
    from usdfab.fit.dataset.produce import local_workers, produce
    from usdfab.fit.dataset.store import Store
    from usdfab.tracer.compilation import announce_compilation
    from usdfab.tracer.render import thread_count

    store = Store(output, settings)
    indices = [k for k in range(start, start + count) if k % n == i - 1]
    missing = len(store.missing(indices))
    slots = min(thread_count(workers), max(1, missing))
    announce = nullcontext() if quiet else announce_compilation(say)
    with announce, progress_bar(f"rendering {output.name}", quiet=quiet) as update:
        if scheduler is not None and missing:
            with dask_executor(scheduler, workers, thread_count(None)) as (executor, places):
                made = produce(store, indices, executor, places + 1, update)
        elif slots > 1:
            with local_workers(slots) as pool:
                made = produce(store, indices, pool, slots, update)
        else:
            made = produce(store, indices, progress=update)
    if picture is not None:
        from usdfab.fit.dataset.sheet import write_sheet

        write_sheet(output, picture, picture_count, overwrite=overwrite)
    each = made.cpu_seconds / made.made if made.made else 0.0
    if json:
        print_json(
            {
                "output": output, "samples": made.there + made.made, "made": made.made, "left_to_others": made.others,
                "asked": len(indices), "seconds": round(made.seconds, 3), "cpu_seconds_per_image": round(each, 3),
                "images_per_hour": round(made.per_hour, 1), "picture": picture,
                "settings": settings.manifest(),
            }
        )  # fmt: skip
    elif not quiet:
        rate = f", {each:.1f} CPU seconds each, {made.per_hour:.0f} images an hour" if made.made else ""
        left = f", {made.others} are being made by other processes" if made.others else ""
        say(f"{output}: {made.there + made.made} of {len(indices)} samples, {made.made} made now{rate}{left}")
