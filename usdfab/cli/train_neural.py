"""``usdfab train neural``: networks of surface materials."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from usdfab.cli.options import print_json, progress_bar, say
from usdfab.errors import UsdfabError


@dataclass(frozen=True)
class NeuralOptions:
    """What the command line said, unchanged."""

    architecture: str
    kind: str
    epochs: int | None
    batch: int | None
    learning_rate: float | None
    optimizer: str
    hold_out_weaves: int | None
    curves: Path | None
    resume: bool
    device: str
    seed: int
    overwrite: bool
    json: bool
    quiet: bool


def train_neural(dataset: Path, output: Path, options: NeuralOptions) -> None:
    """Train, and write one weights file for each architecture and kind that is asked for."""
    from usdfab.files import checked_output
    from usdfab.neural.extra import require_neural_extra

    architectures = ["lean", "paper"] if options.architecture == "both" else [options.architecture]
    kinds = ["reflection", "transmission"] if options.kind == "both" else [options.kind]
    files = {(a, k): _file(output, a, k, options) for a in architectures for k in kinds}
    for file in (output, *files.values()):
        checked_output(file, (".safetensors",), overwrite=options.overwrite, kind="weights")
    require_neural_extra("train neural")
    _check_curves(options)

    from usdfab.neural.training import TrainSettings
    from usdfab.torch_run import checked_device

    given = {"epochs": options.epochs, "batch": options.batch, "rate": options.learning_rate}
    settings = TrainSettings(
        optimizer=options.optimizer, seed=options.seed, **{n: v for n, v in given.items() if v is not None}
    )  # type: ignore[arg-type]
    checked_device(options.device)
    if options.hold_out_weaves is not None and options.hold_out_weaves < 0:
        raise UsdfabError(f"{options.hold_out_weaves} is no number of weaves", place="--hold-out-weaves")
    results = []
    for (architecture, kind), file in files.items():
        results.append(_train(dataset, file, replace(settings, architecture=architecture, kind=kind), options))
    if options.json:
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
    from usdfab.neural.material_file import Weights, rounded, save_material_network
    from usdfab.neural.measures import table
    from usdfab.neural.network import parameter_count
    from usdfab.neural.training import train

    state = file.with_name(f"{file.stem}.training.safetensors")
    with progress_bar(f"reading {settings.kind}", quiet=options.quiet) as update:
        examples = load_examples(dataset, settings.kind, progress=update)
    held = 1 if options.hold_out_weaves is None else options.hold_out_weaves
    data = split(examples, settings.seed, held)
    label = f"training {settings.architecture}, {settings.kind}"
    with progress_bar(label, quiet=options.quiet) as update:
        found = train(
            data, settings, device=options.device, checkpoint=state, resume=options.resume,
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
