"""Feature maps of a frozen VGG network (Simonyan and Zisserman 2014): what textures are compared by.

The network stage and the losses of the optimisation stages share it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.weights_file import Convolutions, read_convolutions

DEFAULT_TAPS = ("conv1_1", "conv2_1", "conv3_1", "conv4_1")
Pooling = Literal["average", "maximum"]


@dataclass(frozen=True, eq=False)
class FeatureNet:
    """A VGG network cut after its last tap; made by :func:`load_features`.

    Parameters
    ----------
    convolutions:
        Names, weights and biases of the 3x3 convolutions, zero-padded by one pixel, each followed by a ReLU.
    taps:
        Names of the convolutions whose maps, after the ReLU, are the features.
    pooling:
        How 2x2 pixels become one between blocks: ``average`` (smoother gradients) or ``maximum`` (as it was trained).
    """

    convolutions: Convolutions
    taps: tuple[str, ...] = DEFAULT_TAPS
    pooling: Pooling = "average"

    @property
    def dtype(self) -> torch.dtype:
        """In which the convolutions are computed."""
        return self.convolutions.layers["conv1_1"][0].dtype

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return self.convolutions.layers["conv1_1"][0].device

    @property
    def channels(self) -> tuple[int, ...]:
        """Feature channels at each tap."""
        return tuple(len(self.convolutions.layers[tap][1]) for tap in self.taps)

    @property
    def reduction(self) -> int:
        """Pixels of the image, along each side, under one pixel of the last tap's map."""
        return 2 ** (_block(self.taps[-1]) - 1)

    def __call__(self, image: Tensor) -> list[Tensor]:
        """Feature maps (B, C, h, w), one for each tap, of linear Rec. 709 images (B, 3, H, W); differentiable.

        H and W are at least :attr:`reduction`. Maps have the network's dtype and channels-last memory.
        """
        mean, scale = (image.new_tensor(v).view(1, 3, 1, 1) for v in (self.convolutions.mean, self.convolutions.scale))
        x = (encode_srgb(image) * 255.0 - mean) * scale
        # Channels last is what oneDNN computes in; it saves reordering each map (10 to 15 % on a CPU).
        x = x.to(device=self.device, dtype=self.dtype).contiguous(memory_format=torch.channels_last)
        maps, block = [], 1
        for name, (weight, bias) in self.convolutions.layers.items():
            if _block(name) != block:
                x, block = _pooled(x, self.pooling), _block(name)
            # In place: with frozen weights, the backward pass of a convolution does not need what it put out.
            x = F.conv2d(x, weight, bias, padding=1).relu_()
            if name in self.taps:
                maps.append(x)
        return maps


def load_features(
    name_or_path: str | Path = "vgg16",
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
    taps: Sequence[str] | None = None,
    pooling: Pooling = "average",
) -> FeatureNet:
    """The feature network, frozen.

    Parameters
    ----------
    name_or_path:
        ``vgg16`` ships with usdfab, to conv4_1. A path names a safetensors file, see :func:`read_convolutions`: the
        VGG-19 of the paper, for one, which ``weights_file.CONVERSION`` writes in torchvision's training.
    dtype:
        Of the convolutions; see :func:`fast_dtype`. float64 is for checks.
    taps:
        Names of convolutions in order; by default those of conv1_1, conv2_1, conv3_1, conv4_1 that the network has.

    Raises
    ------
    UsdfabError
        For weights that are missing or corrupt, and taps that the network does not have.
    """
    read = read_convolutions(name_or_path)
    names = list(read.layers)
    chosen = tuple(tap for tap in DEFAULT_TAPS if tap in names) if taps is None else tuple(taps)
    missing = [tap for tap in chosen if tap not in names]
    if not chosen or missing or list(chosen) != sorted(set(chosen), key=names.index):
        what = f"has no {', '.join(missing)}" if missing else f"cannot be tapped at {', '.join(chosen) or 'nothing'}"
        raise UsdfabError(
            f"the feature network {what}",
            place=str(name_or_path),
            remedy=f"choose in this order from {', '.join(names)}",
        )
    layers = {}
    for name in names[: names.index(chosen[-1]) + 1]:
        weight, bias = (t.to(device=device, dtype=dtype) for t in read.layers[name])
        layers[name] = (weight.contiguous(memory_format=torch.channels_last), bias)
    return FeatureNet(Convolutions(layers, read.mean, read.scale), chosen, pooling)


def fast_dtype() -> torch.dtype:
    """bfloat16 where this CPU multiplies it natively (AVX-512 BF16 or AMX), which halves the time; else float32.

    Measured by ``tests/benchmarks/bench_features.py``: the loss differs by 0.05 %, the gradient to the image by 2
    degrees; at a hundredth of the usual loss, where only noise differs, by 5 % and 10 degrees.
    """
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    return torch.bfloat16 if supported() else torch.float32


def encode_srgb(linear: Tensor) -> Tensor:
    """Linear light as sRGB values, any shape, as :func:`usdfab.srgb.linear_to_srgb`; differentiable everywhere."""
    size = linear.abs()
    # The power's slope at 0 is infinite, and 0 times that is no number: clamp first, choose then.
    curve = 1.055 * size.clamp(min=0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(size <= 0.0031308, 12.92 * linear, linear.sign() * curve)


def _block(name: str) -> int:
    return int(name[4])


def _pooled(x: Tensor, pooling: Pooling) -> Tensor:
    return F.avg_pool2d(x, 2) if pooling == "average" else F.max_pool2d(x, 2)
