"""Pretrained VGG convolutions from files: the VGG-16 that ships with usdfab, a user's file, torchvision's VGG-19."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from torch import Tensor

from usdfab.errors import UsdfabError

SHIPPED = Path(__file__).parent / "weights" / "vgg16_conv4_1_fp16.safetensors"
SHIPPED_SHA256 = "457417af17ba46527f3e36f50da37516d0e564468f5ececa11b572c2826974fc"

CAFFE_MEAN = (123.68, 116.779, 103.939)
"""Red, green, blue of 0 to 255 that the networks of Simonyan and Zisserman 2014 subtract; they take B, G, R."""

TORCHVISION_FILE, TORCHVISION_SHA256 = "vgg19-dcbb9e9d.pth", "dcbb9e9d"
"""torchvision's VGG-19 in torch.hub's cache, and how the checksum of its contents begins."""

VGG19_CONVOLUTIONS = (2, 2, 4, 4, 4)
"""Convolutions in each block."""

_KEY = re.compile(r"conv([1-9])_([1-9])\.(weight|bias)")


@dataclass(frozen=True, eq=False)
class Convolutions:
    """The 3x3 convolutions of a VGG network in order, and the colours it expects.

    Parameters
    ----------
    layers:
        By name, ``convB_C``: weight (O, I, 3, 3), with the input channels of the first in the order R, G, B, and bias
        (O,). Pooling follows the last of each block B.
    mean, scale:
        The first layer takes ``(c - mean) * scale`` of sRGB-encoded c in 0 to 255, for each of R, G, B.
    """

    layers: dict[str, tuple[Tensor, Tensor]]
    mean: tuple[float, float, float]
    scale: tuple[float, float, float]


def read_convolutions(name_or_path: str | Path) -> Convolutions:
    """Weights by name (``vgg16``, which ships with usdfab, or ``vgg19``) or from a safetensors file.

    A file has keys ``convB_C.weight`` (O, I, 3, 3) and ``convB_C.bias`` from conv1_1 on without gaps, for B, G, R of 0
    to 255 less the mean of Simonyan and Zisserman 2014.

    Raises
    ------
    UsdfabError
        If the file is missing, corrupt or not such a network, or torchvision's VGG-19 is not on this machine (nothing
        is downloaded).
    """
    if str(name_or_path) == "vgg16":
        return _caffe(_checked_safetensors(_checked_bytes(SHIPPED, SHIPPED_SHA256), SHIPPED), SHIPPED)
    if str(name_or_path) == "vgg19":
        return _cached_vgg19()
    path = Path(name_or_path)
    if not path.is_file():
        raise UsdfabError("no such file", place=str(path), remedy="name vgg16, vgg19 or a safetensors file")
    return _caffe(_checked_safetensors(_read(path), path), path)


def torchvision_convolutions(state: dict[str, Tensor]) -> Convolutions:
    """The convolutions to conv4_1 from the state of ``torchvision.models.vgg19`` (keys ``features.N.weight``)."""
    layers, position = {}, 0
    for block, count in enumerate(VGG19_CONVOLUTIONS[:4], start=1):
        for index in range(1, (count if block < 4 else 1) + 1):
            layers[f"conv{block}_{index}"] = (state[f"features.{position}.weight"], state[f"features.{position}.bias"])
            position += 2  # the ReLU
        position += 1  # the pooling
    deviation = (0.229, 0.224, 0.225)
    red, green, blue = (1.0 / (255.0 * d) for d in deviation)
    return Convolutions(layers, (0.485 * 255.0, 0.456 * 255.0, 0.406 * 255.0), (red, green, blue))


def _caffe(tensors: dict[str, Tensor], path: Path) -> Convolutions:
    def problem(text: str) -> UsdfabError:
        return UsdfabError(
            text, place=str(path), remedy="it needs keys convB_C.weight and convB_C.bias from conv1_1 on"
        )

    found: dict[tuple[int, int], dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        match = _KEY.fullmatch(key)
        if not match:
            raise problem(f"'{key}' belongs to no VGG convolution")
        found.setdefault((int(match[1]), int(match[2])), {})[match[3]] = tensor
    layers: dict[str, tuple[Tensor, Tensor]] = {}
    channels, block, index = 3, 1, 0
    for where in sorted(found):
        name = "conv{}_{}".format(*where)
        if where not in ((block, index + 1), (block + 1, 1)) or (not layers and where != (1, 1)):
            raise problem(f"a convolution is missing before {name}")
        block, index = where
        weight, bias = found[where].get("weight"), found[where].get("bias")
        if weight is None or bias is None:
            raise problem(f"{name} has no {'weight' if weight is None else 'bias'}")
        if weight.ndim != 4 or weight.shape[1:] != (channels, 3, 3) or bias.shape != weight.shape[:1]:
            raise problem(f"{name} has the shapes {tuple(weight.shape)} and {tuple(bias.shape)}")
        if not (weight.isfinite().all() and bias.isfinite().all()):
            raise problem(f"{name} holds numbers that are not finite")
        channels = len(bias)
        layers[name] = (weight, bias)
    if not layers:
        raise problem("it holds no convolution")
    weight, bias = layers["conv1_1"]
    layers["conv1_1"] = (weight.flip(1), bias)  # from B, G, R to R, G, B
    return Convolutions(layers, CAFFE_MEAN, (1.0, 1.0, 1.0))


def _cached_vgg19() -> Convolutions:
    path = Path(torch.hub.get_dir()) / "checkpoints" / TORCHVISION_FILE
    if not path.is_file():
        raise UsdfabError(
            "torchvision's VGG-19 is not on this machine, and nothing is downloaded unasked",
            place=str(path),
            remedy="install torchvision and run "
            "python -c \"from torchvision.models import vgg19; vgg19(weights='DEFAULT')\"",
        )
    _checked_bytes(path, TORCHVISION_SHA256)
    # torch's own file format; only tensors are unpacked, no code can run.
    return torchvision_convolutions(torch.load(path, map_location="cpu", weights_only=True))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        reason = (error.strerror or "no reason given").lower()
        raise UsdfabError(f"the feature network's weights cannot be read ({reason})", place=str(path)) from error


def _checked_bytes(path: Path, sha256: str) -> bytes:
    if not path.is_file():
        raise UsdfabError("the feature network's weights are missing", place=str(path), remedy="install usdfab again")
    data = _read(path)
    if not hashlib.sha256(data).hexdigest().startswith(sha256):
        remedy = "install usdfab again" if path == SHIPPED else "delete it and fetch it again"
        raise UsdfabError("the feature network's weights are damaged (wrong checksum)", place=str(path), remedy=remedy)
    return data


def _checked_safetensors(data: bytes, path: Path) -> dict[str, Tensor]:
    try:
        return load_safetensors(data)
    except SafetensorError as error:
        raise UsdfabError(f"no whole safetensors file ({error})", place=str(path)) from error
