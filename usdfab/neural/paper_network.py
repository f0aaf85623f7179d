"""Paper B's network: ResNet-18 without its last stage to a latent of 64 numbers, footprint fusion, angular decoder.

Figure 3 and section 4.2. Widths that the paper leaves open are 64. Batch normalisation is replaced by groups of 16
channels: a step of ours sees a handful of materials.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from usdfab.neural.encoding import BLOBS, encoded_footprint
from usdfab.neural.network import CHANNELS, SLOPE, MaterialNetwork

LATENT = 64
WIDTH = 64
_ANGLES = 5


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions and a shortcut (He et al. 2016, figure 5 left)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.first_norm = nn.GroupNorm(outputs // 16, outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.second_norm = nn.GroupNorm(outputs // 16, outputs)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.shortcut = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.GroupNorm(outputs // 16, outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.first_norm(self.first(x)))
        return F.relu(self.second_norm(self.second(y)) + self.shortcut(x))


class ResidualLayers(nn.Module):
    """Two full layers and a skip before the last leaky rectifier."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(inputs, width), nn.Linear(width, width)
        self.skip: nn.Module = nn.Identity() if inputs == width else nn.Linear(inputs, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        y = F.leaky_relu(self.first(x), SLOPE)
        return F.leaky_relu(self.second(y) + self.skip(x), SLOPE)


class PaperNetwork(MaterialNetwork):
    """Codes are latents (M, 64)."""

    architecture = "paper"

    def __init__(self, kind: str) -> None:
        super().__init__(kind)
        stages = [(64, 64, 1), (64, 64, 1), (64, 128, 2), (128, 128, 1), (128, 256, 2), (256, 256, 1)]
        self.stem = nn.Sequential(
            nn.Conv2d(CHANNELS, 64, 7, 2, 3, bias=False), nn.GroupNorm(4, 64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        )
        self.stages = nn.Sequential(*(BasicBlock(*stage) for stage in stages))
        self.parameters_block = ResidualLayers(256 + 2, 128)
        self.latent = nn.Linear(128, LATENT)
        self.fusion = nn.ModuleList([nn.Linear(LATENT + 3 * BLOBS, WIDTH), nn.Linear(WIDTH, WIDTH)])
        self.angular_in = nn.Linear(WIDTH + _ANGLES, WIDTH)
        self.angular_block = ResidualLayers(WIDTH, WIDTH)
        self.angular_hidden = nn.Linear(WIDTH, WIDTH)
        self.angular_out = nn.Linear(WIDTH, 4)

    def encode(self, tiles: Tensor, parameters: Tensor) -> Tensor:
        """Latents (M, 64)."""
        features = self.stages(self.stem(tiles)).mean(dim=(2, 3))
        return self.latent(self.parameters_block(torch.cat([features, parameters], dim=1)))

    def decode(self, codes: Tensor, queries: Tensor) -> Tensor:
        """Outputs (M, Q, 4): fusion of the latent with the footprint, then of both with the directions."""
        latents = codes[:, None].expand(-1, queries.shape[1], -1)
        x = torch.cat([latents, encoded_footprint(queries)], dim=-1)
        for layer in self.fusion:
            x = F.leaky_relu(layer(x), SLOPE)
        x = F.leaky_relu(self.angular_in(torch.cat([x, queries[..., 3:]], dim=-1)), SLOPE)
        x = self.angular_block(x)
        x = F.leaky_relu(self.angular_hidden(x), SLOPE)
        return self.angular_out(x)
