"""``usdfab train neural --asset``: a network of one fabric's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from usdfab.cli.options import print_json, progress_bar, say
from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    pass

KIND_LABELS = {"reflection": "lit from the front", "transmission": "lit from behind"}


@dataclass(frozen=True)
class AssetOptions:
    """What the command line says."""

    fabric: Path
    output: Path | None
    quality: str
    queries: int | None
    initial: Mapping[str, Path | None]
    resume: bool
    threads: int | None
    seed: int
    overwrite: bool
    json: bool
    quiet: bool


def train_fabric(options: AssetOptions) -> None:
    """Answer queries by the fabric's fibers, fine-tune both networks, write the file and name it in the fabric's."""
    from usdfab.files import checked_output
    from usdfab.neural.extra import require_neural_extra
    from usdfab.usd.fabric_io import read_fabric

    output = options.output or options.fabric.with_name(f"{options.fabric.stem}.neural.safetensors")
    checked_output(output, (".safetensors",), overwrite=options.overwrite, kind="weights")
    require_neural_extra("train neural --asset")
    if options.fabric.suffix.lower() == ".usdz":
        raise UsdfabError("a package cannot name a file beside it", place=str(options.fabric), remedy="unpack it")
    fabric = read_fabric(options.fabric)

    from contextlib import nullcontext

    from usdfab.neural.asset_file import fabric_digest, rounded_material, save_asset_network
    from usdfab.neural.asset_queries import produce_queries, remove_pieces
    from usdfab.neural.asset_training import QUALITIES, identity, judgement, lean, train_asset
    from usdfab.neural.fiber_answers import FiberAnswers
    from usdfab.neural.material_file import load_material_network
    from usdfab.tracer.compilation import announce_compilation

    settings = replace(QUALITIES[options.quality], seed=options.seed)
    if options.queries is not None:
        settings = replace(settings, queries=options.queries)
    shared = {kind: load_material_network(file, kind) for kind, file in options.initial.items()}
    for weights in shared.values():
        lean(weights)
    job = identity(fabric_digest(fabric), settings, shared)
    folder = output.with_name(f"{output.stem}.training")
    announce = nullcontext() if options.quiet else announce_compilation(say)
    with announce, progress_bar("asking the fibers", quiet=options.quiet) as update:
        learned, judges = produce_queries(
            FiberAnswers(fabric), folder, job, settings.queries, settings.samples, settings.seed,
            resume=options.resume, threads=options.threads, progress=update,
        )  # fmt: skip
    with progress_bar("training", quiet=options.quiet) as update:
        done = train_asset(
            fabric, learned, judges, shared, settings, folder=folder, job=job, resume=options.resume,
            progress=lambda k, total, text: update(k, total, f"training: {text}"),
        )  # fmt: skip
    errors = judgement(fabric, material := rounded_material(done.material), shared, judges)
    material = replace(material, about=_about(settings, errors))
    save_asset_network(material, fabric, output)
    _name_in(options.fabric, output)
    if done.interrupted:
        say(f"interrupted: {output} holds what was learned so far; --resume goes on from {folder}")
        raise KeyboardInterrupt
    for kind in errors:
        (folder / f"{kind}.training.safetensors").unlink(missing_ok=True)
    remove_pieces(folder)
    if options.json:
        print_json({"output": output, "fabric": options.fabric, "about": material.about})
    elif not options.quiet:
        for line in error_lines(errors):
            say(line)
        say(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB), and named it in {options.fabric}")


def _about(settings: Any, errors: Mapping[str, Any]) -> dict[str, Any]:
    from usdfab._version import __version__

    return {"usdfab": __version__, "settings": asdict(settings), "errors": dict(errors)}


def error_lines(errors: Mapping[str, Any]) -> list[str]:
    """A sentence for each kind: how far from the fibers the shared network was, and the fabric's own is."""
    lines = []
    for kind, row in errors.items():
        said = []
        for name in ("before", "after"):
            off = max((value - 1.0 for value in row[name]["mean"]), key=abs)
            said.append(f"{name} mean colour {100 * off:+.1f} %, error {100 * row[name]['error']:.0f} %")
        lines.append(f"{KIND_LABELS[kind]}: {'; '.join(said)}")
    return lines


def _name_in(fabric: Path, weights: Path) -> None:
    """Author the weights' path in the fabric's file, all else as it is."""
    from usdfab.usd.edit import change_fabric

    def named(before: Any) -> Any:
        return replace(before, neural_weights=str(weights.absolute()))

    change_fabric(str(fabric), named, fabric, overwrite=True)
