"""A data set of queries in memory, with its materials divided into those that are learned and those that judge."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.neural.dataset_reader import Kind, list_materials, read_material
from usdfab.neural.network import PIXELS
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.neural.surface_tile import surface_tile

HELD_OUT = 0.1
"""Part of the materials that has no part in training."""

FEWEST_WEAVES = 3
"""Below, no weave is held out whole."""


@dataclass(frozen=True, eq=False)
class Examples:
    """Materials with their queries and what the surface model answers.

    Parameters
    ----------
    tiles: (N, 6, P, P)
        Normal and orientation, rows along v.
    parameters: (N, 2)
        Roughness and height scale.
    queries, targets: (N, Q, 8), (N, Q, 4)
    weaves: (N,)
        A number for each weave.
    """

    tiles: Tensor
    parameters: Tensor
    queries: Tensor
    targets: Tensor
    weaves: Tensor

    def __len__(self) -> int:
        return len(self.tiles)

    def of(self, which: Tensor) -> Examples:
        """Some of the materials, by a mask or by numbers."""
        return replace(self, **{name: getattr(self, name)[which] for name in self.__dataclass_fields__})

    def to(self, device: torch.device) -> Examples:
        """On a device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in self.__dataclass_fields__})

    def digest(self) -> str:
        """A checksum of all numbers."""
        found = hashlib.sha256()
        for name in self.__dataclass_fields__:
            found.update(np.ascontiguousarray(getattr(self, name).cpu().numpy()).tobytes())
        return found.hexdigest()


def material_inputs(materials: Sequence[SurfaceMaterial]) -> tuple[Tensor, Tensor]:
    """What encoders take of materials: tiles (M, 6, P, P), and roughness and height scale (M, 2)."""
    tiles = torch.from_numpy(np.stack([surface_tile(material, PIXELS).channels() for material in materials]))
    return tiles, torch.tensor([[m.roughness, m.height_scale] for m in materials], dtype=torch.float32)


def load_examples(
    folder: Path, kind: Kind, most: int | None = None, progress: Callable[[int, int], None] | None = None
) -> Examples:
    """All materials of a data set; ``most`` queries of each.

    Where materials have different numbers of queries, all get as many as the one with the fewest.

    Raises
    ------
    UsdfabError
        If there is no data set, it holds no material of the kind, or a file is damaged.
    """
    paths = list_materials(folder, kind)
    if not paths:
        raise UsdfabError(
            f"holds no materials for {kind}", place=str(folder), remedy="make some: usdfab dataset neural"
        )
    materials, queries, targets = [], [], []
    for number, path in enumerate(paths):
        material, asked, answered = read_material(path)
        materials.append(material)
        queries.append(torch.from_numpy(np.array(asked[:most], dtype=np.float32)))
        targets.append(torch.from_numpy(np.array(answered[:most], dtype=np.float32)))
        if progress:
            progress(number + 1, len(paths))
    count = min(len(q) for q in queries)
    tiles, parameters = material_inputs(materials)
    known: dict[tuple[tuple[int, ...], bytes], int] = {}
    weaves = [known.setdefault((m.weave.shape, np.ascontiguousarray(m.weave).tobytes()), len(known)) for m in materials]
    return Examples(
        tiles,
        parameters,
        torch.stack([q[:count] for q in queries]),
        torch.stack([t[:count] for t in targets]),
        torch.tensor(weaves),
    )


@dataclass(frozen=True, eq=False)
class Split:
    """``learned`` from; ``materials`` of learned weaves and of other ``weaves`` that judge (either may be empty)."""

    learned: Examples
    materials: Examples
    weaves: Examples


def split(examples: Examples, seed: int, held_out_weaves: int = 1) -> Split:
    """Hold out whole weaves, then a part of the materials of the others; the same for the same seed."""
    rng = np.random.default_rng([seed, 0x5EA])
    weaves = rng.permutation(int(examples.weaves.max()) + 1)
    away = torch.from_numpy(weaves[:held_out_weaves].copy() if len(weaves) >= FEWEST_WEAVES else weaves[:0].copy())
    unknown = torch.isin(examples.weaves, away)
    known = torch.nonzero(~unknown)[:, 0]
    order = torch.from_numpy(rng.permutation(len(known)))
    judges = known[order[: round(HELD_OUT * len(known))]].sort().values
    learned = known[order[round(HELD_OUT * len(known)) :]].sort().values
    return Split(examples.of(learned), examples.of(judges), examples.of(torch.nonzero(unknown)[:, 0]))
