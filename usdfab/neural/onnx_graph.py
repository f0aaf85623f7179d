"""Decoders of one fabric as ONNX graphs, so that other engines can ask them. Needs the package ``onnx``.

Everything from a query to a colour is in the graph: the mip-mapped look-up of the lean network's pyramid or the
one-blobs of the paper's, directions and half vector, the layers, g^-1, and the albedos. An engine gives footprints and
directions in the cloth's frame, and multiplies colours with the light's irradiance.

One graph for light from the front, one for light from behind: an engine that lights from one side pays for one. Both
know both sides of the cloth.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from usdfab._version import __version__
from usdfab.disk import refused
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.files import whole_file
from usdfab.neural.asset_network import COLUMNS, AssetMaterial
from usdfab.neural.encoding import BLOBS, LARGEST
from usdfab.neural.examples import material_inputs
from usdfab.neural.lean_network import FEATURES, FIRST_TEXEL, LEVEL_BIAS, SIDES, TEXELS, LeanNetwork
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS, SLOPE, MaterialNetwork
from usdfab.neural.paper_network import PaperNetwork
from usdfab.neural.stage_scene import shared_dress

OPSET, IR_VERSION = 17, 8
"""Of 2022: what engines of today read."""

COMPONENTS = ("C_warp", "C_weft", "S_warp", "S_weft")

INPUTS = {
    "codes": "The fabric's latent codes, front and back; may be left out, then they are the exported fabric's.",
    "albedo": "Linear Rec. 709 by which each of the components is multiplied; may be left out as codes.",
    "side": "Which side of the cloth the viewer sees: 0 the front, 1 the back.",
    "footprint": "u, v of the pixel's middle and the side of its footprint, all in tiles; u runs along the weft, v "
    "along the warp, and repeat with period 1. Seen from the back, u runs the other way.",
    "incoming": "Unit vector towards the light in the frame of the side that is seen (x along u, y along v, z the "
    "normal towards the viewer); z > 0 in reflection.onnx, z < 0 in transmission.onnx.",
    "outgoing": "x, y of the unit vector towards the viewer in the same frame; its z is positive.",
}
OUTPUTS = {
    "color": "Radiance towards the viewer per irradiance across the light's direction, cosine included; linear "
    "Rec. 709, at least 0.",
    "components": "What color was made of: the components of the surface model, or columns of a network of its own.",
}


@dataclass(frozen=True, eq=False)
class Decoder:
    """A decoder with the codes of a fabric's two sides.

    Parameters
    ----------
    codes: (2, ...)
        Front and back.
    albedo: (4, 3)
    components:
        Names of the outputs.
    """

    network: MaterialNetwork
    codes: NDArray[np.float32]
    albedo: NDArray[np.float32]
    components: tuple[str, ...]


def require_onnx() -> None:
    """Raise one clear line where ``onnx`` is not installed. Imports nothing."""
    if find_spec("onnx") is None:
        raise UsdfabError("ONNX export needs the package onnx", remedy="pip install 'usdfab[onnx]'")


class _Graph:
    """Nodes and constants one after the other; values are names."""

    def __init__(self) -> None:
        from onnx import helper, numpy_helper

        self._make, self._tensor = helper.make_node, numpy_helper.from_array
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def constant(self, value: Any, dtype: Any = np.float32, name: str = "") -> str:
        """A tensor of the graph's own."""
        name = name or f"constant{len(self.constants)}"
        self.constants[name] = self._tensor(np.ascontiguousarray(value, dtype=dtype), name)
        return name

    def add(self, operator: str, *inputs: str | float, name: str = "", **attributes: Any) -> str:
        """A node with one output; numbers become constants."""
        given = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        name = name or f"{operator.lower()}{len(self.nodes)}"
        self.nodes.append(self._make(operator, given, [name], name=name, **attributes))
        return name

    def columns(self, value: str, first: int, last: int) -> str:
        """Columns of (N, K)."""
        bounds = [self.constant([k], np.int64) for k in (first, last, 1)]
        return self.add("Slice", value, *bounds)

    def total(self, value: str, axis: int = -1, keep: bool = True) -> str:
        """Sum along an axis."""
        return self.add("ReduceSum", value, self.constant([axis], np.int64), keepdims=int(keep))

    def layer(self, value: str, layer: nn.Module, add: str = "", activate: bool = True) -> str:
        """A full layer, after which ``add`` is added; then a leaky rectifier."""
        assert isinstance(layer, nn.Linear)
        weight, bias = (self.constant(t.detach().numpy()) for t in (layer.weight, layer.bias))
        found = self.add("Gemm", value, weight, bias, transB=1)
        if add:
            found = self.add("Add", found, add)
        return self.add("LeakyRelu", found, alpha=SLOPE) if activate else found


def graph_of(decoder: Decoder, about: Mapping[str, Any]) -> Any:
    """The ONNX model of a decoder; ``about`` goes into its metadata, values that are no texts as JSON."""
    from onnx import TensorProto, checker, helper

    graph = _Graph()
    codes = graph.constant(decoder.codes, name="codes")
    albedo = graph.constant(decoder.albedo, name="albedo")
    network = decoder.network
    last = _lean(graph, network, codes) if isinstance(network, LeanNetwork) else _paper(graph, network, codes)
    parts = [graph.columns(last, 0, network.linear)] if network.linear else []
    # g^-1 (MODEL 13): (exp(x) - 1) / k.
    compressed = graph.columns(last, network.linear, 4)
    parts.append(graph.add("Div", graph.add("Sub", graph.add("Exp", compressed), 1.0), float(network.curvature)))
    both = graph.add("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]
    components = graph.add("Relu", both, name="components")
    graph.add("Relu", graph.add("MatMul", components, albedo), name="color")

    kinds = {"side": TensorProto.INT64}
    shapes: dict[str, Sequence[int | str]] = {
        "codes": decoder.codes.shape, "albedo": (4, 3), "side": ("N",), "footprint": ("N", 3), "incoming": ("N", 3),
        "outgoing": ("N", 2), "color": ("N", 3), "components": ("N", 4),
    }  # fmt: skip

    def values(names: Mapping[str, str]) -> list[Any]:
        return [
            helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shapes[name], doc_string=text)
            for name, text in names.items()
        ]

    made = helper.make_graph(
        graph.nodes, "decoder", values(INPUTS), values(OUTPUTS), initializer=list(graph.constants.values())
    )
    model = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="usdfab",
        producer_version=__version__, doc_string=" ".join((__doc__ or "").split("\n\n")[1].split()),
    )  # fmt: skip
    said = {"kind": network.kind, "architecture": network.architecture, "components": decoder.components, **about}
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in said.items()}
    helper.set_model_props(model, texts | {f"input {n}": t for n, t in INPUTS.items()} | _outputs_said())
    checker.check_model(model, full_check=True)
    return model


def _outputs_said() -> dict[str, str]:
    return {f"output {name}": text for name, text in OUTPUTS.items()}


def write_graph(model: Any, path: Path) -> None:
    """Write a model, whole or not at all; ``UsdfabError`` if the disk refuses."""
    try:
        with whole_file(path) as temporary:
            temporary.write_bytes(model.SerializeToString())
    except OSError as error:
        raise refused(error, path) from error


def _place(graph: _Graph) -> str:
    """u, v (N, 2) in [0, 1)."""
    uv = graph.columns("footprint", 0, 2)
    return graph.add("Sub", uv, graph.add("Floor", uv))


def _angles(graph: _Graph) -> str:
    """``encoding.angles``."""
    square = graph.total(graph.add("Mul", "outgoing", "outgoing"))
    z = graph.add("Sqrt", graph.add("Relu", graph.add("Sub", 1.0, square)))
    half = graph.add("Add", "incoming", graph.add("Concat", "outgoing", z, axis=1))
    length = graph.add("Sqrt", graph.total(graph.add("Mul", half, half)))
    half = graph.add("Div", half, graph.add("Max", length, 1e-6))
    return graph.add("Concat", "incoming", "outgoing", half, axis=1)


def _lookup(graph: _Graph, codes: str) -> str:
    """``lean_network.lookup``: features (N, F), eight texels of each footprint's side of the cloth."""
    place = _place(graph)
    size = graph.add("Max", graph.columns("footprint", 2, 3), 1e-6)
    octaves = graph.add("Div", graph.add("Log", graph.add("Mul", size, float(SIDES[0]))), float(np.log(2.0)))
    top = len(SIDES) - 1.0
    level = graph.add("Clip", graph.add("Sub", octaves, LEVEL_BIAS), 0.0, top)
    lower = graph.add("Min", graph.add("Floor", level), top - 1.0)
    between = graph.add("Sub", level, lower)
    number = graph.add("Cast", lower, to=7)  # int64
    texels = graph.add("Reshape", codes, graph.constant([2 * TEXELS, FEATURES], np.int64))
    one = graph.constant([[1]], np.int64)
    base = graph.add("Mul", graph.add("Reshape", "side", graph.constant([-1, 1], np.int64)),
                     graph.constant([[TEXELS]], np.int64))  # fmt: skip
    sides, firsts = graph.constant(SIDES, np.int64), graph.constant(FIRST_TEXEL, np.int64)
    found, weights = [], []
    for k in range(2):
        at = graph.add("Add", number, one) if k else number
        share = between if k else graph.add("Sub", 1.0, between)
        side, first = graph.add("Gather", sides, at), graph.add("Gather", firsts, at)
        start = graph.add("Add", base, first)
        grid = graph.add("Sub", graph.add("Mul", place, graph.add("Cast", side, to=1)), 0.5)
        low = graph.add("Floor", grid)
        high_share = graph.add("Sub", grid, low)
        low_share = graph.add("Sub", 1.0, high_share)
        near = graph.add("Cast", low, to=7)
        corner = [graph.add("Mod", near, side), graph.add("Mod", graph.add("Add", near, one), side)]
        shares = [low_share, high_share]
        for row in range(2):
            line = graph.add("Add", start, graph.add("Mul", graph.columns(corner[row], 1, 2), side))
            part = graph.add("Mul", share, graph.columns(shares[row], 1, 2))
            for column in range(2):
                found.append(graph.add("Add", line, graph.columns(corner[column], 0, 1)))
                weights.append(graph.add("Mul", part, graph.columns(shares[column], 0, 1)))
    rows = graph.add("Gather", texels, graph.add("Concat", *found, axis=1))
    weighed = graph.add("Unsqueeze", graph.add("Concat", *weights, axis=1), graph.constant([2], np.int64))
    return graph.total(graph.add("Mul", rows, weighed), axis=1, keep=False)


def _lean(graph: _Graph, network: LeanNetwork, codes: str) -> str:
    """``LeanNetwork.decode``."""
    x = graph.add("Concat", _lookup(graph, codes), _angles(graph), axis=1)
    x = graph.layer(x, network.first)
    x = graph.layer(graph.layer(x, network.second), network.third, add=x)
    return graph.layer(x, network.last, activate=False)


def _blobs(graph: _Graph, value: str, periodic: bool) -> str:
    """``encoding.one_blob`` of a column."""
    away = graph.add("Sub", value, graph.constant([(np.arange(BLOBS) + 0.5) / BLOBS]))
    if periodic:
        away = graph.add("Sub", away, graph.add("Round", away))
    away = graph.add("Mul", away, float(BLOBS))
    return graph.add("Exp", graph.add("Mul", graph.add("Mul", away, away), -0.5))


def _paper(graph: _Graph, network: MaterialNetwork, codes: str) -> str:
    """``PaperNetwork.decode``."""
    assert isinstance(network, PaperNetwork)
    place = _place(graph)
    size = graph.add("Div", graph.add("Clip", graph.columns("footprint", 2, 3), 0.0, LARGEST), LARGEST)
    latents = graph.add("Gather", codes, "side")
    blobs = [_blobs(graph, graph.columns(place, k, k + 1), True) for k in (0, 1)]
    x = graph.add("Concat", latents, *blobs, _blobs(graph, graph.add("Sqrt", size), False), axis=1)
    for layer in network.fusion:
        x = graph.layer(x, layer)
    x = graph.layer(graph.add("Concat", x, "incoming", "outgoing", axis=1), network.angular_in)
    block = network.angular_block
    x = graph.layer(graph.layer(x, block.first), block.second, add=x)
    return graph.layer(graph.layer(x, network.angular_hidden), network.angular_out, activate=False)


def fabric_decoders(
    fabric: FabricParameters, networks: Mapping[str, Weights], asset: AssetMaterial | None, place: str
) -> tuple[dict[str, Decoder], tuple[int, int]]:
    """Decoders of a fabric by kind, and the ends and picks of what they call one tile.

    ``asset``: the fabric's own network, where it has one; ``place`` is named in errors.

    Raises
    ------
    UsdfabError
        If a weave is larger than the encoder takes.
    """
    if asset is not None:
        own = {
            kind: Decoder(asset.networks[kind].lean, _numbers(asset.networks[kind].codes), albedo, COLUMNS)
            for kind, albedo in zip(KINDS, asset.albedo.astype(np.float32), strict=True)
        }
        return own, asset.tile
    materials, albedos = shared_dress(fabric, place)
    decoders = {}
    for kind, albedo in zip(KINDS, albedos.astype(np.float32), strict=True):
        network = networks[kind].network
        with torch.inference_mode():
            codes = network.encode(*material_inputs(materials))
        decoders[kind] = Decoder(network, _numbers(codes), albedo, COMPONENTS)
    return decoders, (fabric.weave.ends, fabric.weave.picks)


def _numbers(codes: torch.Tensor) -> NDArray[np.float32]:
    return codes.detach().numpy().astype(np.float32)
