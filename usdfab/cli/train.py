"""``usdfab train``: networks from data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, Seed, print_json, progress_bar, say

HELP = """Train networks on data sets.

Usage examples:

    usdfab train fit-network fabrics -o network.safetensors
    usdfab train neural surfaces -o material.safetensors --kind reflection
    usdfab train neural --asset fabric.usda
"""

run = App(name="train", help=HELP, help_format="markdown")
run.command("usdfab.cli.train_neural:neural", name="neural")


@run.command(name="fit-network")
def fit_network(
    dataset: Path,
    /,
    *,
    output: Output,
    model: Annotated[
        Literal["robust", "paper"],
        Parameter(help="robust (also for real photos) or paper (the baseline of Li et al. 2024)."),
    ] = "robust",
    epochs: Annotated[int | None, Parameter(help="60 for robust, 400 for paper by default.")] = None,
    views: Annotated[int, Parameter(help="Of each sample: the render, and turned, cropped and photographed.")] = 8,
    drawn: Annotated[int, Parameter(help="Drawn cloths that robust also learns counts and weaves from.")] = 1500,
    inputs: Annotated[Path | None, Parameter(help="Folder that keeps what is computed of each view.")] = None,
    learning_curve: Annotated[
        bool, Parameter(negative="", help="Also train on a quarter and on half of the samples, and compare.")
    ] = False,
    curves: Annotated[Path | None, Parameter(help="Folder for pictures of the losses.")] = None,
    resume: Annotated[bool, Parameter(negative="", help="Go on from the state that an interrupted run left.")] = False,
    device: Annotated[str, Parameter(help="cpu or cuda.")] = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Train stage 1 of ``usdfab fit``: it guesses a fabric's weave, counts and parameters from one picture.

    First the numbers that the network takes are computed for each sample, once: they are kept in a folder (beside
    OUTPUT by default), so that a data set may grow and an interrupted run goes on. Of ten pairs of samples seven are
    learned from, one decides when to stop, two are left for usdfab evaluate network.

    Usage examples:

        usdfab train fit-network fabrics -o network.safetensors
        usdfab train fit-network fabrics -o network.safetensors --epochs 80 --curves curves --learning-curve
        usdfab train fit-network fabrics -o paper.safetensors --model paper --inputs network.inputs

    Parameters
    ----------
    dataset:
        A folder of ``usdfab dataset fabrics``.
    """
    from dataclasses import replace

    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.fit.extra import require_fit_extra

    checked_output(output, (".safetensors",), overwrite=overwrite, kind="weights")
    require_fit_extra("train")
    from usdfab.fit.features import fast_dtype
    from usdfab.fit.network.fit import DEFAULT_EPOCHS, fit_network as fit
    from usdfab.fit.network.inputs import feature_net
    from usdfab.fit.network.network_file import save_network
    from usdfab.fit.network.store import draw_inputs, prepare
    from usdfab.fit.network.training import TrainSettings
    from usdfab.imaging.curves import write_curves
    from usdfab.torch_run import checked_device

    settings = TrainSettings(model, DEFAULT_EPOCHS[model] if epochs is None else epochs, seed)
    where = checked_device(device)
    if curves is not None and curves.exists() and (not curves.is_dir() or (any(curves.iterdir()) and not overwrite)):
        raise UsdfabError("there is something in the way", place=str(curves), remedy="give a new folder or --overwrite")
    state = output.with_name(f"{output.stem}.training.safetensors")
    folder = inputs or output.with_name(f"{output.stem}.inputs")
    with progress_bar("computing inputs", quiet=quiet) as update:
        data = prepare(dataset, folder, feature_net(fast_dtype()), views, progress=update)
    if model == "robust" and drawn:
        with progress_bar("drawing cloth", quiet=quiet) as update:
            data = replace(data, drawn=draw_inputs(folder, drawn, update))
    with progress_bar("training", quiet=quiet) as update:
        fitted = fit(
            data, settings, device=str(where), checkpoint=state, resume=resume, learning_curve=learning_curve,
            progress=lambda done, total, text: update(done, total, f"training: {text}"),
        )  # fmt: skip
    if fitted.interrupted:
        say(f"interrupted: --resume goes on from {state}")
        raise KeyboardInterrupt
    save_network(fitted.weights, output)
    pictures = write_curves(fitted.history, curves, overwrite=overwrite) if curves is not None else {}
    state.unlink(missing_ok=True)
    about: dict[str, Any] = fitted.weights.about
    if json:
        print_json({"output": output, "inputs": folder, "about": about, "pictures": pictures})
    elif not quiet:
        for part, losses in fitted.history.items():
            best = fitted.best[part]
            say(f"{part}: best in epoch {best} of {len(losses)}, validation loss {losses[best - 1][1]:.3f}")
        for size, row in about.get("learning_curve", {}).items():
            said = ", ".join(f"{name} {value:.3f}" for name, value in row.items())
            say(f"with {size} samples: {said}")
        say(f"wrote {output}: {output.stat().st_size / 1e6:.1f} MB, from {about['data']['training_samples']} samples")
