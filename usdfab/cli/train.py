"""``usdfab train``: networks from data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, Seed, print_json, progress_bar, say


def _refuse(options: dict[str, bool], why: str) -> None:
    from usdfab.errors import UsdfabError

    wrong = next((name for name, given in options.items() if given), None)
    if wrong:
        raise UsdfabError(why, place=wrong)


def run(
    what: Literal["fit-network", "neural"],
    dataset: Path,
    /,
    *,
    output: Output,
    model: Annotated[
        Literal["robust", "paper"],
        Parameter(help="robust (also for real photos) or paper (the baseline of Li et al. 2024)."),
    ] = "robust",
    epochs: Annotated[
        int | None, Parameter(help="60 for robust, 400 for paper by default; 40 for a neural material.")
    ] = None,
    views: Annotated[int, Parameter(help="Of each sample: the render, and turned, cropped and photographed.")] = 8,
    drawn: Annotated[int, Parameter(help="Drawn cloths that robust also learns counts and weaves from.")] = 1500,
    inputs: Annotated[Path | None, Parameter(help="Folder that keeps what is computed of each view.")] = None,
    learning_curve: Annotated[
        bool, Parameter(negative="", help="Also train on a quarter and on half of the samples, and compare.")
    ] = False,
    architecture: Annotated[
        Literal["lean", "paper", "both"] | None,
        Parameter(help="neural: lean (the default), paper (Chen et al. 2024), or a file of each."),
    ] = None,
    kind: Annotated[
        Literal["reflection", "transmission", "both"] | None,
        Parameter(help="neural: light from the front (the default), from behind, or a file of each."),
    ] = None,
    batch: Annotated[int | None, Parameter(help="neural: queries of a step, 4096 by default.")] = None,
    learning_rate: Annotated[float | None, Parameter(help="neural: 4e-3 for adam, 5e-2 for sgd by default.")] = None,
    optimizer: Annotated[
        Literal["adam", "sgd"] | None, Parameter(help="neural: adam (the default), or sgd as Chen et al. 2024.")
    ] = None,
    hold_out_weaves: Annotated[
        int | None, Parameter(help="neural: whole weaves that judge instead of being learned, 1 by default.")
    ] = None,
    curves: Annotated[Path | None, Parameter(help="Folder for pictures of the losses.")] = None,
    resume: Annotated[bool, Parameter(negative="", help="Go on from the state that an interrupted run left.")] = False,
    device: Annotated[str, Parameter(help="cpu or cuda.")] = "cpu",
    seed: Seed = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Train the network that guesses a fabric from one picture, or the neural material of ``--backend neural``.

    fit-network: first the numbers that the network takes are computed for each sample, once: they are kept in a folder
    (beside OUTPUT by default), so that a data set may grow and an interrupted run goes on. Of ten pairs of samples
    seven are learned from, one decides when to stop, two are left for usdfab evaluate network.

    neural: an encoder of surface materials and a decoder of queries (Chen et al. 2024). A tenth of the materials and
    one weave are held out; the errors on them are told and kept in the file. The state is saved after each epoch.

    Usage examples:

        usdfab train fit-network fabrics -o network.safetensors
        usdfab train fit-network fabrics -o network.safetensors --epochs 80 --curves curves --learning-curve
        usdfab train fit-network fabrics -o paper.safetensors --model paper --inputs network.inputs
        usdfab train neural surfaces -o material.safetensors --kind reflection --epochs 60 --curves curves
        usdfab train neural surfaces -o material.safetensors --architecture both --kind both --resume

    Parameters
    ----------
    what:
        fit-network: stage 1 of ``usdfab fit``. neural: what ``usdfab render --backend neural`` asks.
    dataset:
        A folder of ``usdfab dataset fabrics``, or of ``usdfab dataset neural``.
    """
    if what == "neural":
        from usdfab.cli.train_neural import NeuralOptions, train_neural

        others = {
            "--model": model != "robust", "--views": views != 8, "--drawn": drawn != 1500,
            "--inputs": inputs is not None, "--learning-curve": learning_curve,
        }  # fmt: skip
        _refuse(others, "is for fit-network")
        train_neural(
            dataset, output,
            NeuralOptions(
                architecture or "lean", kind or "reflection", epochs, batch, learning_rate, optimizer or "adam",
                hold_out_weaves, curves, resume, device, seed, overwrite, json, quiet,
            ),
        )  # fmt: skip
        return
    neural = {
        "--architecture": architecture, "--kind": kind, "--batch": batch, "--learning-rate": learning_rate,
        "--optimizer": optimizer, "--hold-out-weaves": hold_out_weaves,
    }  # fmt: skip
    _refuse({name: value is not None for name, value in neural.items()}, "is for neural")
    from dataclasses import replace

    from usdfab.errors import UsdfabError
    from usdfab.files import checked_output
    from usdfab.fit.extra import require_fit_extra

    checked_output(output, (".safetensors",), overwrite=overwrite, kind="weights")
    require_fit_extra("train")
    from usdfab.fit.features import fast_dtype
    from usdfab.fit.network.fit import DEFAULT_EPOCHS, fit_network
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
        fitted = fit_network(
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
