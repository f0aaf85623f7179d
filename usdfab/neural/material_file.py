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
from usdfab.files import whole_file
from usdfab.neural.network import KINDS, MaterialNetwork
from usdfab.neural.training import ARCHITECTURES, new_network

FORMAT = "usdfab-neural-material/1"
INTERFACE = "tile 64 normal orientation; roughness, height scale; query 8; C_warp C_weft g(S_warp) g(S_weft)"
"""What numbers in and out mean: files that say something else cannot be used."""

FOLDER = Path(__file__).parent / "weights"
SHIPPED = {
    "reflection": "f77bea81835f40a6f424cebb5a1726fabea72ae1e88abed9431502745351d84d",
    "transmission": "0e2cb4d2ecdce59765deceaf79ef6ad6ec51779ea98ff46d911644153960b278",
}
"""SHA-256 of the shipped weights by kind, checked at each load."""

LARGE = 256
"""Matrices of so many numbers are kept as half floats."""

_AGAIN = "train it anew: usdfab train neural"


@dataclass(frozen=True, eq=False)
class Weights:
    """A network that can be used. ``about``: settings and data of training, errors on held-out data; plain JSON."""

    network: MaterialNetwork
    about: dict[str, Any]


def shipped_path(kind: str) -> Path:
    """Where the shipped weights of a kind are."""
    return FOLDER / f"neural_lean_{kind}.safetensors"


def save_material_network(weights: Weights, path: Path) -> None:
    """Write a network, whole or not at all.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    network = weights.network
    stored = {
        name: t.half() if t.numel() >= LARGE and t.ndim > 1 else t.float() for name, t in network.state_dict().items()
    }
    about = {
        "format": FORMAT, "interface": INTERFACE, "architecture": network.architecture, "kind": network.kind,
        "options": json.dumps(network.options(), sort_keys=True), "about": json.dumps(weights.about, sort_keys=True),
    }  # fmt: skip
    try:
        with whole_file(path) as temporary:
            save_file({name: t.detach().contiguous() for name, t in stored.items()}, temporary, about)
    except (OSError, SafetensorError) as error:
        raise refused(error, path) from error


def load_material_network(path: str | Path | None, kind: str) -> Weights:
    """A network from its file, ready for use on the CPU; ``None``: the one of this kind that ships with usdfab.

    Raises
    ------
    UsdfabError
        For a file that is missing, damaged, of another version or kind, or no network.
    """
    file = shipped_path(kind) if path is None else Path(path)
    place = str(file)
    if not file.is_file():
        remedy = "install usdfab again" if path is None else "train one: usdfab train neural"
        raise UsdfabError("no such file", place=place, remedy=remedy)
    try:
        if path is None and hashlib.sha256(file.read_bytes()).hexdigest() != SHIPPED.get(kind):
            raise UsdfabError(
                "the network's weights are damaged (wrong checksum)", place=place, remedy="install usdfab again"
            )
        with safe_open(file, "pt") as opened:
            said = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise UsdfabError("no whole weights file of a neural material", place=place, remedy=_AGAIN) from error
    if said.get("format") != FORMAT:
        raise UsdfabError(f"has format {said.get('format')!r}, not {FORMAT!r}", place=place, remedy=_AGAIN)
    if said.get("interface") != INTERFACE:
        raise UsdfabError("the weights are of another version of usdfab", place=place, remedy=_AGAIN)
    if said.get("kind") != kind and said.get("kind") in KINDS:
        raise UsdfabError(f"the weights are for {said['kind']}, not {kind}", place=place, remedy="give the other file")
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise UsdfabError("the weights hold numbers that are not finite", place=place, remedy=_AGAIN)
    try:
        if said["architecture"] not in ARCHITECTURES:
            raise ValueError(said["architecture"])
        network = new_network(said["architecture"], said["kind"], **json.loads(said["options"]))
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        about = json.loads(said["about"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UsdfabError("the weights have other names or shapes", place=place, remedy=_AGAIN) from error
    return Weights(network.eval(), about)


def rounded(network: MaterialNetwork) -> MaterialNetwork:
    """The same network with the numbers that a file keeps."""
    with torch.no_grad():
        for tensor in network.state_dict().values():
            if tensor.numel() >= LARGE and tensor.ndim > 1:
                tensor.copy_(tensor.half())
    return network
