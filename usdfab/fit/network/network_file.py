"""Trained networks as safetensors files: half floats, what they were trained on, and what they are good for."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from usdfab.disk import refused
from usdfab.errors import UsdfabError
from usdfab.fabric.weave import PAPER_WEAVES
from usdfab.files import whole_file
from usdfab.fit.network.detail import DETAIL_SIZE, REVISION as DETAIL_REVISION
from usdfab.fit.network.inputs import LEVELS, REVISION, SIZE, Basis
from usdfab.fit.network.labels import LABELS
from usdfab.fit.network.model import Paper, Robust
from usdfab.fit.network.paper import NUMBERS
from usdfab.fit.network.spectra import BINS, LATTICE_SHAPE
from usdfab.fit.network.targets import targets_hash

FORMAT = "usdfab-network/2"
SHIPPED = Path(__file__).parent.parent / "weights" / "network_robust.safetensors"
SHIPPED_SHA256 = "c3a1fedd19d4723579fde8fddb5c4d7379779c68c4bcf3886d0fa58d8fc44f00"
"""Of the shipped weights, checked at each load."""

LARGE = 1000
"""Matrices of so many numbers are kept as half floats; means and scales, whose range is wide, are not."""

_AGAIN = "train it anew: usdfab train fit-network"


@dataclass(frozen=True, eq=False)
class Weights:
    """A network that can be used.

    Parameters
    ----------
    network, basis:
        The trained network, and what its inputs are reduced by.
    about:
        ``model``; ``data`` (samples, spp, size, ...) and ``settings`` of training; ``skill``: for each target its error
        over that of the prior's mean on the validation part; whatever else is told. Plain JSON.
    """

    network: Robust | Paper
    basis: Basis
    about: dict[str, Any]

    @property
    def skill(self) -> dict[str, float]:
        """Error over the prior mean's, by target name; 1 is no better."""
        return dict(self.about.get("skill", {}))


def interface() -> dict[str, str]:
    """What numbers in a weights file mean, as its metadata says it: files that differ cannot be used."""
    return {
        "format": FORMAT,
        "targets": targets_hash(),
        "labels": json.dumps(LABELS),
        "inputs": json.dumps([REVISION, SIZE, list(LEVELS), BINS, list(LATTICE_SHAPE), DETAIL_REVISION, DETAIL_SIZE]),
    }


def save_network(weights: Weights, path: Path) -> None:
    """Write a network, whole or not at all.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    tensors = {f"network.{name}": tensor for name, tensor in weights.network.state_dict().items()}
    tensors |= weights.basis.tensors()
    stored = {name: t.half() if t.numel() >= LARGE and t.ndim > 1 else t.float() for name, t in tensors.items()}
    about = interface() | {"about": json.dumps(weights.about, sort_keys=True)}
    try:
        with whole_file(path) as temporary:
            save_file({name: t.contiguous() for name, t in stored.items()}, temporary, about)
    except (OSError, SafetensorError) as error:
        raise refused(error, path) from error


def load_network(path: str | Path | None = None) -> Weights:
    """A network from its file, ready for use on the CPU; ``None``: the one that ships with usdfab.

    Raises
    ------
    UsdfabError
        For a file that is missing, damaged, of another version or shape, or no network.
    """
    file = SHIPPED if path is None else Path(path)
    place = str(file)
    if not file.is_file():
        remedy = "train one: usdfab train fit-network" if path is None else ""
        raise UsdfabError("no such file", place=place, remedy=remedy)
    try:
        if path is None and hashlib.sha256(file.read_bytes()).hexdigest() != SHIPPED_SHA256:
            raise UsdfabError(
                "the network's weights are damaged (wrong checksum)", place=place, remedy="install usdfab again"
            )
        with safe_open(file, "pt") as opened:
            said = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise UsdfabError("no whole weights file of a network", place=place, remedy=_AGAIN) from error
    if said.get("format") != FORMAT:
        raise UsdfabError(f"has format {said.get('format')!r}, not {FORMAT!r}", place=place, remedy=_AGAIN)
    differ = [name for name, value in interface().items() if said.get(name) != value]
    if differ:
        raise UsdfabError(
            f"the weights are of another version of usdfab ({', '.join(differ)} differ)", place=place, remedy=_AGAIN
        )
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise UsdfabError("the weights hold numbers that are not finite", place=place, remedy=_AGAIN)
    try:
        about = json.loads(said["about"])
        basis = Basis.from_tensors({name: t for name, t in tensors.items() if name.startswith("basis.")})
        network = _empty(about["model"], basis)
        state = {n.removeprefix("network."): t.float() for n, t in tensors.items() if n.startswith("network.")}
        network.load_state_dict(state)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
        raise UsdfabError("the weights have other names or shapes", place=place, remedy=_AGAIN) from error
    return Weights(network.eval(), basis, about)


def _empty(model: str, basis: Basis) -> Robust | Paper:
    components = tuple(d.shape[1] for d in basis.directions) * len(LEVELS)
    if model == "paper":
        return Paper(components, len(PAPER_WEAVES), 2 * len(NUMBERS))
    if model != "robust":
        raise ValueError(model)
    return Robust(components, basis.texture_size)


def rounded(weights: Weights) -> Weights:
    """The same with the numbers that a file keeps."""
    with torch.no_grad():
        for tensor in weights.network.state_dict().values():
            if tensor.numel() >= LARGE and tensor.ndim > 1:
                tensor.copy_(tensor.half())
    return weights
