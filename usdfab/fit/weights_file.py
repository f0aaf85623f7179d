"""Pretrained VGG convolutions from safetensors files: the VGG-16 that ships with usdfab, or a user's (VGG-19)."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from torch import Tensor

from usdfab.errors import UsdfabError

SHIPPED = Path(__file__).parent / "weights" / "vgg16_conv4_1_fp16.safetensors"
SHIPPED_SHA256 = "457417af17ba46527f3e36f50da37516d0e564468f5ececa11b572c2826974fc"

CAFFE_MEAN = (123.68, 116.779, 103.939)
"""Red, green, blue of 0 to 255 that the networks of Simonyan and Zisserman 2014 subtract; they take B, G, R."""

CONVERSION = (
    'python -c "from safetensors.torch import save_file; from torchvision.models import vgg19; '
    "save_file(vgg19(weights='DEFAULT').features.state_dict(prefix='features.'), 'vgg19.safetensors')\""
)
"""Command that writes torchvision's VGG-19 as a file that ``read_convolutions`` takes; it downloads 0.5 GB."""

TORCHVISION_MEAN, TORCHVISION_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Red, green, blue of 0 to 1 by which torchvision's networks were trained."""

LAST = "conv4_1"
"""Where torchvision's networks are cut: deeper layers see more than a texture's repeat."""

_KEY = re.compile(r"conv([1-9])_([1-9])\.(weight|bias)")
_TORCHVISION_KEY = re.compile(r"features\.([0-9]{1,3})\.(weight|bias)")


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
    """Weights by name (``vgg16``, which ships with usdfab) or from a safetensors file.

    A file has keys ``convB_C.weight`` (O, I, 3, 3) and ``convB_C.bias`` from conv1_1 on without gaps, for B, G, R of 0
    to 255 less the mean of Simonyan and Zisserman 2014; or torchvision's ``features.N.weight``, see
    :func:`torchvision_convolutions`. Files that are unpacked by running code (pickle) are not read.

    Raises
    ------
    UsdfabError
        If the file is missing, corrupt or not such a network; for ``vgg19``, with the command that makes its file.
    """
    if str(name_or_path) == "vgg16":
        return _caffe(_checked_safetensors(_checked_bytes(SHIPPED, SHIPPED_SHA256), SHIPPED), SHIPPED)
    if str(name_or_path) == "vgg19":
        raise UsdfabError(
            "VGG-19 does not ship with usdfab, and nothing is downloaded unasked",
            remedy=f"with torchvision installed run {CONVERSION} and name vgg19.safetensors",
        )
    path = Path(name_or_path)
    if not path.is_file():
        raise UsdfabError("no such file", place=str(path), remedy="name vgg16 or a safetensors file")
    tensors = _checked_safetensors(_read(path), path)
    if any(_TORCHVISION_KEY.fullmatch(key) for key in tensors):
        return torchvision_convolutions(tensors, path)
    return _caffe(tensors, path)


def torchvision_convolutions(state: dict[str, Tensor], path: str | Path = "torchvision") -> Convolutions:
    """The convolutions to conv4_1 from the state of ``torchvision.models.vgg19`` or its relatives without batch norm.

    Parameters
    ----------
    state:
        Keys ``features.N.weight`` and ``features.N.bias``, where N counts convolutions, ReLUs and poolings; those of
        ``classifier`` do not matter.
    path:
        For messages.

    Raises
    ------
    UsdfabError
        For keys and shapes of other networks.
    """
    parts: dict[int, dict[str, Tensor]] = {}
    for key, tensor in state.items():
        match = _TORCHVISION_KEY.fullmatch(key)
        if match:
            parts.setdefault(int(match[1]), {})[match[2]] = tensor
        elif not key.startswith("classifier."):
            raise UsdfabError(f"'{key}' belongs to no VGG network of torchvision's", place=str(path))
    named: dict[str, Tensor] = {}
    block, index, last = 1, 0, -2
    for position in sorted(parts):
        # A ReLU lies between two convolutions, a pooling as well where a block ends.
        if position - last not in (2, 3):
            raise UsdfabError(f"a convolution is missing before features.{position}", place=str(path))
        block, index = (block, index + 1) if position - last == 2 else (block + 1, 1)
        named |= {f"conv{block}_{index}.{key}": tensor for key, tensor in parts[position].items()}
        last = position
        if f"conv{block}_{index}" == LAST:
            break
    red, green, blue = (255.0 * v for v in TORCHVISION_MEAN)
    return Convolutions(
        _checked_layers(named, Path(path)),
        (red, green, blue),
        (1.0 / (255.0 * TORCHVISION_DEVIATION[0]), 1.0 / (255.0 * TORCHVISION_DEVIATION[1]),
         1.0 / (255.0 * TORCHVISION_DEVIATION[2])),
    )  # fmt: skip


def _caffe(tensors: dict[str, Tensor], path: Path) -> Convolutions:
    layers = _checked_layers(tensors, path)
    weight, bias = layers["conv1_1"]
    layers["conv1_1"] = (weight.flip(1), bias)  # from B, G, R to R, G, B
    return Convolutions(layers, CAFFE_MEAN, (1.0, 1.0, 1.0))


def _checked_layers(tensors: dict[str, Tensor], path: Path) -> dict[str, tuple[Tensor, Tensor]]:
    """Weight and bias of each layer, in order; complains of what is no VGG network."""

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
    return layers


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
        raise UsdfabError(
            "the feature network's weights are damaged (wrong checksum)",
            place=str(path),
            remedy="install usdfab again",
        )
    return data


def _checked_safetensors(data: bytes, path: Path) -> dict[str, Tensor]:
    try:
        return load_safetensors(data)
    except SafetensorError as error:
        raise UsdfabError(f"no whole safetensors file ({error})", place=str(path)) from error
