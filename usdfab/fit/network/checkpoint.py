"""Unfinished training as a safetensors file: whole or not at all, and only for the same run."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from usdfab.disk import refused
from usdfab.errors import UsdfabError
from usdfab.files import whole_file
from usdfab.fit.network.store import Drawn, Rows

if TYPE_CHECKING:
    from usdfab.fit.network.training import TrainSettings

FORMAT = "usdfab-network-training/1"
_REMEDY = "train without --resume to start again"


@dataclass(frozen=True, eq=False)
class State:
    """Where training stands after ``epoch`` epochs.

    ``history``: for each part the losses of training and validation; ``best_epoch`` and ``best``: when each part was
    best, counted from 1, and the network's state then.
    """

    history: dict[str, list[tuple[float, float]]]
    best_epoch: dict[str, int]
    best: dict[str, Tensor]
    epoch: int = 0


def identity_of(settings: TrainSettings, *parts: Rows | Drawn | None) -> str:
    """A checksum of everything that training depends on."""
    digest = hashlib.sha256(json.dumps(asdict(settings), sort_keys=True).encode())
    for part in parts:
        for name in part.__dataclass_fields__ if part is not None else ():
            digest.update(getattr(part, name).contiguous().numpy().tobytes())
    return digest.hexdigest()


def save_checkpoint(path: Path, job: str, network: nn.Module, optimizer: torch.optim.Optimizer, state: State) -> None:
    """Write a checkpoint; ``UsdfabError`` if the disk refuses, an older file stays then."""
    tensors = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    tensors |= {f"best.{name}": tensor for name, tensor in state.best.items()}
    for number, slots in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{number}.{name}": tensor for name, tensor in slots.items()}
    about = {
        "format": FORMAT, "job": job,
        "state": json.dumps({"history": state.history, "best_epoch": state.best_epoch, "epoch": state.epoch}),
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
            if about.get("format") != FORMAT:
                raise UsdfabError("no checkpoint of a training", place=str(path), remedy=_REMEDY)
            if about.get("job") != job:
                raise UsdfabError(
                    "the checkpoint belongs to other data, settings or another version", place=str(path), remedy=_REMEDY
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            said = json.loads(about["state"])
        network.load_state_dict(_under(tensors, "network."))
        moments: dict[int, dict[str, Tensor]] = {}
        for name, tensor in _under(tensors, "optimizer.").items():
            number, _, slot = name.partition(".")
            moments.setdefault(int(number), {})[slot] = tensor
        whole = optimizer.state_dict()
        optimizer.load_state_dict({**whole, "state": moments})
        history = {part: [(a, b) for a, b in losses] for part, losses in said["history"].items()}
        return State(history, said["best_epoch"], _under(tensors, "best."), said["epoch"])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, UsdfabError):
            raise
        raise UsdfabError("the checkpoint cannot be read", place=str(path), remedy=_REMEDY) from error


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
