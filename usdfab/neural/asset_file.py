"""A fabric's own network as a safetensors file beside the fabric, and whether it still belongs to it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from usdfab.disk import refused
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, as_table
from usdfab.files import whole_file
from usdfab.neural.asset_network import COLUMNS, DECODER, SIDES, AssetMaterial, AssetNetwork
from usdfab.neural.lean_network import FEATURES, TEXELS, LeanNetwork
from usdfab.neural.network import KINDS

FORMAT = "usdfab-neural-asset/1"
INTERFACE = f"query 8; g({') g('.join(COLUMNS)}); codes {TEXELS}x{FEATURES}"
"""What numbers in and out mean: files that say something else cannot be used."""

NOT_SEEN = ("name", "provenance", "albedo_map", "neural_weights")
"""Of ``as_table``: what fibers do not depend on. A print multiplies answers."""


def fabric_digest(fabric: FabricParameters) -> str:
    """A checksum of everything that a fabric's fibers depend on."""
    table = {name: value for name, value in as_table(fabric).items() if name not in NOT_SEEN}
    table["weave"] = table["weave"]["matrix"]
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()


def save_asset_network(material: AssetMaterial, fabric: FabricParameters, path: Path) -> None:
    """Write a fabric's network, whole or not at all.

    Raises
    ------
    UsdfabError
        If the disk refuses.
    """
    tensors = {
        f"{kind}.{name}": (tensor.half() if tensor.ndim > 1 else tensor.float()).detach().contiguous()
        for kind, network in material.networks.items()
        for name, tensor in network.learned().items()
    }
    tensors["scale"] = torch.from_numpy(material.scale).contiguous()
    about = {
        "format": FORMAT, "interface": INTERFACE, "fabric": fabric_digest(fabric), "fabric_name": fabric.name,
        "tile": json.dumps(material.tile), "about": json.dumps(material.about, sort_keys=True),
    }  # fmt: skip
    try:
        with whole_file(path) as temporary:
            save_file(tensors, temporary, about)
    except (OSError, SafetensorError) as error:
        raise refused(error, path) from error


def load_asset_network(path: str | Path, fabric: FabricParameters) -> AssetMaterial | None:
    """A fabric's network, or None where the fabric is another one than it was trained on.

    Raises
    ------
    UsdfabError
        For a file that is missing, damaged, of another version, or no such network.
    """
    file, again = Path(path), "train it anew: usdfab train neural --asset FABRIC"
    place = str(file)
    if not file.is_file():
        raise UsdfabError("the fabric's neural weights do not exist", place=place, remedy=again)
    try:
        with safe_open(file, "pt") as opened:
            said = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise UsdfabError("no whole file of a fabric's neural weights", place=place, remedy=again) from error
    if said.get("format") != FORMAT:
        raise UsdfabError(f"has format {said.get('format')!r}, not {FORMAT!r}", place=place, remedy=again)
    if said.get("interface") != INTERFACE:
        raise UsdfabError("the weights are of another version of usdfab", place=place, remedy=again)
    if said.get("fabric") != fabric_digest(fabric):
        return None
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise UsdfabError("the weights hold numbers that are not finite", place=place, remedy=again)
    try:
        networks = {kind: _network(kind, tensors) for kind in KINDS}
        scale = tensors["scale"].double().numpy()
        ends, picks = json.loads(said["tile"])
        about: dict[str, Any] = json.loads(said["about"])
        if scale.shape != (len(KINDS), len(COLUMNS)) or (picks, ends) != fabric.repeat():
            raise ValueError(scale.shape)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UsdfabError("the weights have other names or shapes", place=place, remedy=again) from error
    return AssetMaterial((ends, picks), networks, np.array(scale), about, said["fabric"])


def _network(kind: str, tensors: dict[str, torch.Tensor]) -> AssetNetwork:
    codes = tensors[f"{kind}.codes"].float()
    if codes.shape != (SIDES, TEXELS, FEATURES):
        raise ValueError(codes.shape)
    lean = LeanNetwork(kind, len(tensors[f"{kind}.first.bias"]), channels=1)
    for name in DECODER:
        parts = {part: tensors[f"{kind}.{name}.{part}"].float() for part in ("weight", "bias")}
        getattr(lean, name).load_state_dict(parts)
    return AssetNetwork(kind, codes, lean)


def rounded_material(material: AssetMaterial) -> AssetMaterial:
    """The same with the numbers that a file keeps."""
    with torch.no_grad():
        for network in material.networks.values():
            for tensor in network.learned().values():
                if tensor.ndim > 1:
                    tensor.copy_(tensor.half())
    return material
