"""Small data sets of the surface model, and networks whose weights are random but not small."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save_file

from usdfab.neural.aggregation import aggregate
from usdfab.neural.dataset_draws import DatasetSettings, draw_material, draw_queries
from usdfab.neural.dataset_reader import SCHEMA, material_metadata, material_path
from usdfab.neural.network import MaterialNetwork
from usdfab.neural.training import new_network

SMALL = DatasetSettings(queries=64, samples=16)


def small_dataset(folder: Path, materials: int = 8, settings: DatasetSettings = SMALL) -> Path:
    """A data set as ``usdfab dataset neural`` writes it."""
    folder.mkdir(exist_ok=True)
    (folder / "dataset.json").write_text(json.dumps(settings.manifest(materials)))
    for kind in settings.kinds:
        for index in range(materials):
            material, queries = draw_material(settings, index), draw_queries(settings, index, kind)
            targets = aggregate(
                material, queries, transmission=kind == "transmission", samples=settings.samples, threads=1
            )
            tensors = {"queries": queries, "targets": np.ascontiguousarray(targets)}
            save_file(tensors, material_path(folder, kind, index), {"schema": SCHEMA} | material_metadata(material))
    return folder


def random_queries(count: int, seed: int = 0, *, below: bool = False) -> NDArray[np.float32]:
    """Queries with every size from a point to beyond the largest, and directions over the hemispheres."""
    rng = np.random.default_rng(seed)
    incoming, outgoing = rng.normal(size=(2, count, 3))
    incoming /= np.linalg.norm(incoming, axis=1)[:, None]
    incoming[:, 2] = np.abs(incoming[:, 2]) * (-1 if below else 1)
    outgoing /= np.linalg.norm(outgoing, axis=1)[:, None]
    size = rng.choice([0.03, 0.3, 1.0, 7.0], count) * rng.random(count)
    size[: min(4, count)] = [0.0, 1 / 32, 5.0, 1e3][: min(4, count)]
    place = rng.random((count, 2))
    place[: min(2, count)] = [[0.0, 0.0], [0.99999994, 0.5]][: min(2, count)]
    return np.concatenate([place, size[:, None], incoming, outgoing[:, :2]], axis=1).astype(np.float32)


def lively(architecture: str, kind: str = "reflection", seed: int = 0) -> MaterialNetwork:
    """An untrained network whose answers differ from query to query: its matrices are larger than at the start."""
    torch.manual_seed(seed)
    network = new_network(architecture, kind)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if parameter.ndim == 2 and not name.startswith("latent"):
                parameter.mul_(1.5)
    return network.eval()
