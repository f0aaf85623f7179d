"""What the networks share: inputs, outputs and the loss (paper B, sections 4.1 and 4.2)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

PIXELS = 64
"""Side of the tile's image that encoders take."""

CHANNELS = 6
"""Of the tile's image: normal and orientation, without the height scale."""

KINDS = ("reflection", "transmission")
CURVATURE = {"reflection": 100.0, "transmission": 1000.0}
"""k of g(x) = ln(k x + 1), by which specular values are compressed (paper B, below eq. 9)."""

SPECULAR_WEIGHT, DIFFUSE_WEIGHT = 0.4, 0.1
"""Of the losses of each yarn system (paper B, eq. 11)."""

SLOPE = 0.01
"""Of the leaky rectifiers on their negative side."""


class MaterialNetwork(nn.Module):
    """An encoder of materials and a decoder of queries. Sub-classes differ in what the code between them is.

    ``kind`` is one of ``KINDS``; outputs are (C_warp, C_weft, g(S_warp), g(S_weft)) with the kind's g: the first
    ``linear`` as they are.
    """

    architecture = ""
    linear = 2

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind
        self.curvature = CURVATURE[kind]

    def options(self) -> dict[str, Any]:
        """Keyword arguments that make the same network again; plain JSON."""
        return {}

    def encode(self, tiles: Tensor, parameters: Tensor) -> Tensor:
        """Codes (M, ...) of tiles (M, 6, P, P), rows along v, with parameters (M, 2): roughness and height scale."""
        raise NotImplementedError

    def decode(self, codes: Tensor, queries: Tensor) -> Tensor:
        """Outputs (M, Q, 4) of queries (M, Q, 8) with their materials' codes."""
        raise NotImplementedError

    def components(self, outputs: Tensor) -> Tensor:
        """C_warp, C_weft, S_warp, S_weft (..., 4) of outputs (..., 4); none below 0."""
        return self.expanded(outputs).clamp(min=0.0)

    def expanded(self, outputs: Tensor) -> Tensor:
        """The same, maybe a little below 0."""
        specular = torch.expm1(outputs[..., self.linear :]) / self.curvature
        return torch.cat([outputs[..., : self.linear], specular], dim=-1)

    def forward(self, tiles: Tensor, parameters: Tensor, queries: Tensor) -> Tensor:
        """C_warp, C_weft, S_warp, S_weft (M, Q, 4)."""
        return self.components(self.decode(self.encode(tiles, parameters), queries))


def compressed(targets: Tensor, curvature: float) -> Tensor:
    """Targets (..., 4) as the network's outputs are: g of the specular ones."""
    return torch.cat([targets[..., :2], torch.log1p(curvature * targets[..., 2:])], dim=-1)


def loss(outputs: Tensor, targets: Tensor, curvature: float, diffuse_weight: float = DIFFUSE_WEIGHT) -> Tensor:
    """Paper B, eq. 9 to 11, of outputs and true components (..., 4)."""
    square = (outputs - compressed(targets, curvature)).square().flatten(0, -2).mean(dim=0)
    return diffuse_weight * square[:2].sum() + SPECULAR_WEIGHT * square[2:].sum()


def parameter_count(network: nn.Module) -> int:
    """Trained numbers."""
    return sum(p.numel() for p in network.parameters())
