"""``usdfab train neural``: networks of surface materials."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from usdfab.cli.options import Json, OptionalOutput, Overwrite, Quiet, Seed, print_json, progress_bar, say
from usdfab.errors import UsdfabError


@dataclass(frozen=True)
class NeuralOptions:
    """What every network that one command trains has in common."""

    architecture: str
    kind: str
    hold_out_weaves: int
    initial: Path | None
    curves: Path | None
    resume: bool
    device: str
    overwrite: bool
    json: bool
    quiet: bool


def neural(
    dataset: Path | None = None,
    /,
    *,
    output: OptionalOutput = None,
    asset: Annotated[
        Path | None, Parameter(help="A fabric file: fine-tune the shipped networks to its fibers, in minutes.")
    ] = None,
    quality: Annotated[
        Literal["draft", "standard", "high"], Parameter(help="With --asset: how many queries, paths and epochs.")
    ] = "standard",
    queries: Annotated[
        int | None, Parameter(help="With --asset: footprints of each side of the cloth, 16 lights each.")
    ] = None,
    architecture: Annotated[
        Literal["lean", "paper", "both"], Parameter(help="lean, paper (Chen et al. 2024), or a file of each.")
    ] = "lean",
    kind: Annotated[
        Literal["reflection", "transmission", "both"],
        Parameter(help="Light from the front, from behind, or a file of each."),
    ] = "reflection",
    epochs: Annotated[int, Parameter(help="Times that each query is seen.")] = 40,
    batch: Annotated[int, Parameter(help="Queries of a step.")] = 4096,
    learning_rate: Annotated[float | None, Parameter(help="4e-3 for adam, 5e-2 for sgd by default.")] = None,
    optimizer: Annotated[
        Literal["adam", "sgd"], Parameter(help="adam, or sgd with the rates of Chen et al. 2024.")
    ] = "adam",
    hold_out_weaves: Annotated[int, Parameter(help="Whole weaves that judge instead of being learned.")] = 1,
    initial: Annotated[Path | None, Parameter(help="Weights of the same architecture to begin with.")] = None,
    curves: Annotated[Path | None, Parameter(help="Folder for pictures of the losses.")] = None,
    resume: Annotated[bool, Parameter(negative="", help="Go on from the state that an interrupted run left.")] = False,
    device: Annotated[str, Parameter(help="cpu or cuda.")] = "cpu",
    seed: Seed = 0,
    threads: Annotated[int | None, Parameter(help="With --asset: threads to trace with; all by default.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Train the neural material: what ``usdfab render --backend neural`` asks instead of fibers (Chen et al. 2024).

    An encoder makes a code of a surface material, a decoder answers queries (footprint, directions) with the code. A
    tenth of the materials and some weaves are held out; the errors on them are told and kept in the file. The state is
    saved after each epoch, and the same seed gives the same weights, in one run or in several.

    With --asset the material of one fabric: the shipped networks are fine-tuned to what its own fibers answer, path
    traced, all orders of scattering, for both sides and light from either. The file (FABRIC.neural.safetensors by
    default) is named in the fabric's file and used by the neural backend as long as the fabric stays the same.
    Interrupted it keeps what was learned, and --resume goes on.

    Usage examples:

        usdfab train neural surfaces -o material.safetensors --epochs 60 --curves curves
        usdfab train neural surfaces -o material.safetensors --architecture both --kind both
        usdfab train neural surfaces -o material.safetensors --epochs 60 --resume
        usdfab train neural --asset fabric.usda

    Parameters
    ----------
    dataset:
        A folder of ``usdfab dataset neural``; left out with --asset.
    """
    if (dataset is None) == (asset is None):
        raise UsdfabError("a data set or --asset is needed, one of them", remedy="usdfab train neural --asset FABRIC")
    if asset is not None:
        for name, given in (
            ("--architecture", architecture != "lean"), ("--kind", kind != "reflection"), ("--curves", curves),
            ("--initial", initial), ("--learning-rate", learning_rate), ("--device", device != "cpu"),
            ("--optimizer", optimizer != "adam"), ("--hold-out-weaves", hold_out_weaves != 1),
            ("--epochs", epochs != 40), ("--batch", batch != 4096),
        ):  # fmt: skip
            if given:
                raise UsdfabError("does not go with --asset", place=name, remedy="use --quality")
        from usdfab.cli.train_asset import AssetOptions, train_fabric

        shipped: dict[str, Path | None] = {"reflection": None, "transmission": None}
        train_fabric(
            AssetOptions(asset, output, quality, queries, shipped, resume, threads, seed, overwrite, json, quiet)
        )
        return
    for name, given in (("--quality", quality != "standard"), ("--queries", queries), ("--threads", threads)):
        if given:
            raise UsdfabError("is for --asset", place=name)
    if output is None:
        raise UsdfabError("a file to write is needed", place="--output", remedy="usdfab train neural DATASET -o FILE")
    assert dataset is not None
    from usdfab.files import checked_output
    from usdfab.neural.extra import require_neural_extra

    options = NeuralOptions(
        architecture, kind, hold_out_weaves, initial, curves, resume, device, overwrite, json, quiet
    )
    architectures = ["lean", "paper"] if architecture == "both" else [architecture]
    kinds = ["reflection", "transmission"] if kind == "both" else [kind]
    files = {(a, k): _file(output, a, k, options) for a in architectures for k in kinds}
    for file in (output, *files.values()):
        checked_output(file, (".safetensors",), overwrite=overwrite, kind="weights")
    require_neural_extra("train neural")
    _check_curves(options)

    from usdfab.neural.training import TrainSettings
    from usdfab.torch_run import checked_device

    if learning_rate is not None and not learning_rate > 0.0:
        raise UsdfabError(f"{learning_rate} is no learning rate", place="--learning-rate", remedy="stay above 0")
    settings = TrainSettings(
        epochs=epochs, batch=batch, rate=learning_rate or 0.0, optimizer=optimizer, seed=seed
    )  # fmt: skip
    checked_device(device)
    if hold_out_weaves < 0:
        raise UsdfabError(
            f"{hold_out_weaves} is no number of weaves", place="--hold-out-weaves", remedy="give 0 or more"
        )
    results = [
        _train(dataset, file, replace(settings, architecture=one, kind=of), options)
        for (one, of), file in files.items()
    ]
    if json:
        print_json({"networks": results})


def _file(output: Path, architecture: str, kind: str, options: NeuralOptions) -> Path:
    """``output``, with what tells several files apart."""
    more = f"-{architecture}" if options.architecture == "both" else ""
    more += f"-{kind}" if options.kind == "both" else ""
    return output.with_name(f"{output.stem}{more}{output.suffix}")


def _check_curves(options: NeuralOptions) -> None:
    curves = options.curves
    if curves is None or not curves.exists():
        return
    if not curves.is_dir() or (any(curves.iterdir()) and not options.overwrite):
        raise UsdfabError("there is something in the way", place=str(curves), remedy="give a new folder or --overwrite")


def _train(dataset: Path, file: Path, settings: Any, options: NeuralOptions) -> dict[str, Any]:
    from usdfab._version import __version__
    from usdfab.imaging.curves import write_curves
    from usdfab.neural.examples import load_examples, split
    from usdfab.neural.material_file import Weights, load_material_network, rounded, save_material_network
    from usdfab.neural.measures import table
    from usdfab.neural.network import parameter_count
    from usdfab.neural.training import train

    network = None
    if options.initial is not None:
        network = load_material_network(options.initial, settings.kind).network
        if network.architecture != settings.architecture:
            said = f"the weights are of the architecture {network.architecture}, not {settings.architecture}"
            raise UsdfabError(said, place=str(options.initial), remedy="give --architecture")
    state = file.with_name(f"{file.stem}.training.safetensors")
    with progress_bar(f"reading {settings.kind}", quiet=options.quiet) as update:
        examples = load_examples(dataset, settings.kind, progress=update)
    data = split(examples, settings.seed, options.hold_out_weaves)
    label = f"training {settings.architecture}, {settings.kind}"
    with progress_bar(label, quiet=options.quiet) as update:
        found = train(
            data, settings, device=options.device, network=network, checkpoint=state, resume=options.resume,
            progress=lambda done, total, text: update(done, total, f"{label}: {text}"),
        )  # fmt: skip
    if found.interrupted:
        say(f"interrupted: --resume goes on from {state}")
        raise KeyboardInterrupt
    errors = table(rounded(found.network), data)
    about = {
        "usdfab": __version__,
        "settings": asdict(settings.filled()),
        "trained_numbers": parameter_count(found.network),
        "data": {"materials": len(data.learned), "queries_of_each": int(data.learned.queries.shape[1])},
        "errors": errors,
    }
    save_material_network(Weights(found.network, about), file)
    pictures = {}
    if options.curves is not None:
        part = f"{settings.architecture}-{settings.kind}"
        pictures = write_curves({part: found.history}, options.curves, overwrite=options.overwrite)
    state.unlink(missing_ok=True)
    if not (options.json or options.quiet):
        for name, row in errors.items():
            what = name.replace("_", " ")
            say(
                f"{what} ({row['materials']}): loss {row['loss']:.4f}, error of diffuse {100 * row['diffuse']:.1f} %, "
                f"specular {100 * row['specular']:.1f} %, all {100 * row['value']:.1f} %"
            )
        say(f"wrote {file}: {file.stat().st_size / 1e6:.2f} MB, {about['trained_numbers']} numbers")
    return {"output": file, "about": about, "pictures": pictures}
