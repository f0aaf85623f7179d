"""Unfinished training as a safetensors file: whole or not at all, and only for the same run."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from usdfab.disk import refused
from usdfab.errors import UsdfabError
from usdfab.files import whole_file

FORMAT = "usdfab-neural-training/1"
_REMEDY = "train without --resume to start again"


@dataclass(frozen=True)
class State:
    """Where training stands after ``epoch`` epochs: losses of training and of the judging materials of each."""

    epoch: int = 0
    history: list[tuple[float, float]] = field(default_factory=list)


def save_checkpoint(path: Path, job: str, network: nn.Module, optimizer: torch.optim.Optimizer, state: State) -> None:
    """Write a checkpoint; ``UsdfabError`` if the disk refuses, an older file stays then."""
    tensors = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    for number, slots in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{number}.{name}": t for name, t in slots.items() if isinstance(t, Tensor)}
    about = {
        "format": FORMAT, "job": job,
        "state": json.dumps({"epoch": state.epoch, "history": state.history}),
    }  # fmt: skip
    try:
        with whole_file(path) as temporary:
            save_file({name: t.detach().cpu().clone().contiguous() for name, t in tensors.items()}, temporary, about)
    except (OSError, SafetensorError) as error:
        raise refused(error, path) from error


def load_checkpoint(path: Path, job: str, network: nn.Module, optimizer: torch.optim.Optimizer) -> State:
    """Bring network and optimizer to where the same run was.

    Raises
    ------
    UsdfabError
        For a file that is no checkpoint, is damaged, or belongs to another run.
    """
    try:
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise UsdfabError("the checkpoint cannot be read", place=str(path), remedy=_REMEDY) from error
    if about.get("format") != FORMAT:
        raise UsdfabError("no checkpoint of a neural material's training", place=str(path), remedy=_REMEDY)
    if about.get("job") != job:
        raise UsdfabError(
            "the checkpoint belongs to other data, settings or another version", place=str(path), remedy=_REMEDY
        )
    try:
        said = json.loads(about["state"])
        network.load_state_dict(_under(tensors, "network."))
        slots: dict[int, dict[str, Tensor]] = {}
        for name, tensor in _under(tensors, "optimizer.").items():
            number, _, slot = name.partition(".")
            slots.setdefault(int(number), {})[slot] = tensor
        optimizer.load_state_dict({**optimizer.state_dict(), "state": slots})
        return State(said["epoch"], [(a, b) for a, b in said["history"]])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UsdfabError("the checkpoint cannot be read", place=str(path), remedy=_REMEDY) from error


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
