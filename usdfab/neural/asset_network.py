"""One fabric's own network: the lean decoder, fine-tuned, and the fabric's pyramids of features.

There is no encoder: pyramids are learned as they are, one for each side of the cloth. Answers are colours, since the
fabric's are fixed: what fibers do to white light is not a product of an albedo and a number, it is deeper in colour
the more fibers light went through. Columns (``COLUMNS``): red, green, gloss, blue, all through g^-1 from the last
layer, so that dark answers keep their hue; gloss is light that was only mirrored and has no colour, which prints
therefore do not colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from usdfab.fabric import FabricParameters
from usdfab.neural.decoder import Plan, plan_of
from usdfab.neural.examples import material_inputs
from usdfab.neural.lean_network import FEATURES, TEXELS, LeanNetwork
from usdfab.neural.network import KINDS
from usdfab.neural.rendered_material import learned_material, reversed_material
from usdfab.neural.surface_from_fabric import surface_from_fabric

COLUMNS = ("red", "green", "gloss", "blue")
TINTED = (1.0, 1.0, 0.0, 1.0)
"""Columns that a print multiplies."""

TO_RGB = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
"""From columns to colours."""

SIDES = 2
"""Of a cloth: codes are of the front, then of the back."""

DECODER = ("first", "second", "third", "last")


class AssetNetwork(nn.Module):
    """The decoder of a kind for one fabric.

    Parameters
    ----------
    kind:
        ``reflection`` or ``transmission``.
    codes: (SIDES, TEXELS, FEATURES)
        Pyramids to begin with; the front's, the back's.
    decoder:
        Weights to begin with.
    """

    def __init__(self, kind: str, codes: Tensor, decoder: LeanNetwork) -> None:
        super().__init__()
        self.kind = kind
        # The encoder stays out: only what is asked at run time is learned and kept.
        self.lean = LeanNetwork(kind, decoder.width, channels=1)
        self.lean.linear = 0
        for name in DECODER:
            self.layer(name).load_state_dict(getattr(decoder, name).state_dict())
        for name, parameter in self.lean.named_parameters():
            parameter.requires_grad_(name.split(".")[0] in DECODER)
        self.codes = nn.Parameter(codes.detach().clone())

    @property
    def curvature(self) -> float:
        """k of g."""
        return self.lean.curvature

    def layer(self, name: str) -> nn.Linear:
        """One of ``DECODER``."""
        found = getattr(self.lean, name)
        assert isinstance(found, nn.Linear)
        return found

    def learned(self) -> dict[str, Tensor]:
        """What training changes and files keep: codes, weights and biases."""
        layers = {f"{name}.{part}": getattr(self.layer(name), part) for name in DECODER for part in ("weight", "bias")}
        return {"codes": self.codes, **layers}

    def forward(self, queries: Tensor) -> Tensor:
        """Columns (SIDES, Q, 4) of queries (SIDES, Q, 8); they may be a little below 0."""
        return self.lean.expanded(self.lean.decode(self.codes, queries))

    def plans(self) -> list[Plan]:
        """Ready to be asked: the front, the back."""
        return [plan_of(self.lean, code) for code in self.codes.detach()]


@dataclass(frozen=True, eq=False)
class AssetMaterial:
    """All that the renderer needs of a fabric that was fine-tuned.

    Parameters
    ----------
    tile: (2,)
        Ends and picks that queries call one tile.
    networks:
        By kind.
    scale: (2, 4)
        Factors of the columns for each of ``KINDS``: with them mean colours are the fibers'.
    about:
        How it was trained, and errors; plain JSON.
    digest:
        Checksum of the fabric that it was trained on, see ``asset_file.fabric_digest``.
    """

    tile: tuple[int, int]
    networks: Mapping[str, AssetNetwork]
    scale: NDArray[np.float64]
    about: dict[str, Any] = field(default_factory=dict)
    digest: str = ""

    def plans(self) -> list[Plan]:
        """Front lit from the front, from behind; back lit from its own front, from behind."""
        both = [self.networks[kind].plans() for kind in KINDS]
        return [both[kind][side] for side in range(SIDES) for kind in range(len(KINDS))]

    @property
    def albedo(self) -> NDArray[np.float64]:
        """(2, 4, 3) by which answers are multiplied to be colours, for light from the front and from behind."""
        return self.scale[:, :, None] * TO_RGB


def first_network(fabric: FabricParameters, shared: LeanNetwork) -> AssetNetwork:
    """What training begins with: the shared decoder with the codes that its encoder gives the fabric's two sides.

    A weave that is larger than the encoder takes has codes all the same: they are only a beginning.
    """
    material, _ = learned_material(surface_from_fabric(fabric)[0])
    picks, ends = fabric.repeat()
    rows, columns = material.weave.shape
    tiled = np.tile(material.weave, (picks // rows, ends // columns))
    front = replace(material, weave=tiled)
    with torch.no_grad():
        codes = shared.encode(*material_inputs([front, reversed_material(front)]))
    assert codes.shape == (SIDES, TEXELS, FEATURES)
    return AssetNetwork(shared.kind, codes, shared)
