"""A material ready to be asked: the decoder's weights with what depends on the material alone worked into them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from usdfab.neural.decoder_kernels import BIASES, BLOCK, LEAN, PAPER, WEIGHTS, decode_range
from usdfab.neural.encoding import QUERY_COLUMNS
from usdfab.neural.examples import material_inputs
from usdfab.neural.lean_network import ANGLES, FEATURES, LeanNetwork
from usdfab.neural.network import MaterialNetwork
from usdfab.neural.paper_network import LATENT, PaperNetwork
from usdfab.neural.strips import Decoders
from usdfab.neural.surface_material import SurfaceMaterial

PIECE = 512 * BLOCK
"""Queries that a thread takes at a time."""

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Plan:
    """A decoder for one material as the kernel reads it.

    Parameters
    ----------
    layers: (L, 8) int64
        One row per layer, see ``decoder_kernels``.
    weights, biases:
        Of all layers, flat, float32.
    code: (T, F)
        The pyramid of the lean network; empty for the paper's, whose latent is in the first biases.
    rows, angle_row:
        Of a block's array; where the paper's directions are.
    linear:
        How many of the four results are taken as they are; the others go through g^-1.
    """

    architecture: int
    layers: NDArray[np.int64]
    weights: Floats
    biases: Floats
    code: Floats
    rows: int
    angle_row: int
    linear: int
    curvature: float

    @property
    def multiplications(self) -> int:
        """Of a query in the layers."""
        return int((self.layers[:, 1] * self.layers[:, 3]).sum())

    def decode(self, queries: NDArray, threads: int = 1) -> Floats:
        """C_warp, C_weft, S_warp, S_weft (N, 4) of queries (N, 8); the same on any number of threads."""
        count = len(queries)
        out = np.empty((count, 4), dtype=np.float32)
        order = np.arange(min(count, PIECE), dtype=np.int32)

        def piece(first: int) -> None:
            columns = np.asarray(queries[first : first + PIECE], dtype=np.float32).T.ravel()
            some = len(columns) // QUERY_COLUMNS
            self.decode_columns(columns, some, order[:some], out[first : first + some])

        starts = range(0, count, PIECE)
        if threads == 1 or len(starts) < 2:
            for first in starts:
                piece(first)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(piece, starts))
        return out

    def decode_columns(self, queries: Floats, stride: int, order: NDArray[np.int32], out: Floats) -> None:
        """Components of some queries in columns (8 ``stride``,) flat: those of ``order`` (N,), into ``out`` (N, 4)."""
        decode_range(
            self.architecture, self.layers, self.weights, self.biases, self.code.reshape(-1), self.rows,
            self.angle_row, self.linear, self.curvature, queries, stride, order, 0, len(order), out,
        )  # fmt: skip


def plans_of(network: MaterialNetwork, materials: Sequence[SurfaceMaterial]) -> list[Plan]:
    """Materials ready to be asked; the encoder runs here, once."""
    tiles, parameters = material_inputs(materials)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so little work is done before other threads have woken
    try:
        with torch.inference_mode():
            codes = network.encode(tiles, parameters)
    finally:
        torch.set_num_threads(threads)
    return [plan_of(network, code) for code in codes]


def plan_of(network: MaterialNetwork, code: Tensor) -> Plan:
    """A material ready to be asked, from its code."""
    if isinstance(network, LeanNetwork):
        return _lean_plan(network, code)
    assert isinstance(network, PaperNetwork)
    return _paper_plan(network, code)


def pack_plans(plans: Sequence[Plan]) -> Decoders:
    """Plans one after the other, for kernels that ask several."""
    if not plans:
        nothing = np.zeros(4, dtype=np.float32)
        plans = [Plan(LEAN, np.zeros((1, 8), dtype=np.int64), nothing, nothing, nothing, 4, 0, 2, 1.0)]
    table, layers = [], []
    ends = [0, 0, 0, 0]
    for plan in plans:
        sizes = (len(plan.layers), plan.code.size, plan.weights.size, plan.biases.size)
        table.append([plan.architecture, ends[0], ends[0] + sizes[0], plan.rows, plan.angle_row, ends[1], plan.linear])
        moved = plan.layers.copy()
        moved[:, WEIGHTS] += ends[2]
        moved[:, BIASES] += ends[3]
        layers.append(moved)
        ends = [end + size for end, size in zip(ends, sizes, strict=True)]
    return Decoders(
        np.array(table, dtype=np.int64), np.array([plan.curvature for plan in plans]), np.concatenate(layers),
        np.concatenate([plan.weights for plan in plans]), np.concatenate([plan.biases for plan in plans]),
        np.concatenate([plan.code.ravel() for plan in plans]),
    )  # fmt: skip


class _Builder:
    """Layers one after the other."""

    def __init__(self) -> None:
        self.rows: list[list[int]] = []
        self.weights: list[Floats] = []
        self.biases: list[Floats] = []

    def add(
        self, first: int, start: int, layer: nn.Linear, *, bias: Floats | None = None, columns: slice = slice(None),
        add: bool = False, activate: bool = True,
    ) -> None:  # fmt: skip
        """A layer that reads rows from ``first`` on and writes from ``start`` on; inputs are filled up to fours."""
        matrix = layer.weight.detach().numpy()[:, columns].astype(np.float32)
        matrix = np.pad(matrix, ((0, 0), (0, -matrix.shape[1] % 4)))
        at = (sum(w.size for w in self.weights), sum(b.size for b in self.biases))
        self.rows.append([first, matrix.shape[1], start, matrix.shape[0], *at, int(add), int(activate)])
        self.weights.append(matrix.reshape(-1, 4, matrix.shape[1]).transpose(0, 2, 1).ravel())
        self.biases.append(layer.bias.detach().numpy().astype(np.float32) if bias is None else bias)

    def plan(self, architecture: int, code: Floats, rows: int, angle_row: int, network: MaterialNetwork) -> Plan:
        table = np.array(self.rows, dtype=np.int64)
        weights, biases = np.concatenate(self.weights), np.concatenate(self.biases)
        return Plan(
            architecture, table, weights, biases, code, rows, angle_row, network.linear, network.curvature,
        )  # fmt: skip


def _lean_plan(network: LeanNetwork, code: Tensor) -> Plan:
    width, builder = network.width, _Builder()
    one = FEATURES + ANGLES
    two, out = one + width, one + 2 * width
    builder.add(0, one, network.first)
    builder.add(one, two, network.second)
    builder.add(two, one, network.third, add=True)
    builder.add(one, out, network.last, activate=False)
    pyramid = np.ascontiguousarray(code.detach().numpy(), dtype=np.float32)
    return builder.plan(LEAN, pyramid, out + 4, FEATURES, network)


def _paper_plan(network: PaperNetwork, code: Tensor) -> Plan:
    builder = _Builder()
    fusion, second = network.fusion
    block = network.angular_block
    assert isinstance(fusion, nn.Linear) and isinstance(second, nn.Linear)
    latent = fusion.weight[:, :LATENT].detach() @ code.detach() + fusion.bias.detach()
    # Rows: one-blobs, fusion, fused and directions (69, filled up to 72), two hidden layers in turn, four results.
    builder.add(0, 24, fusion, bias=latent.numpy().astype(np.float32), columns=slice(LATENT, None))
    builder.add(24, 88, second)
    builder.add(88, 160, network.angular_in)
    builder.add(160, 224, block.first)
    builder.add(224, 160, block.second, add=True)
    builder.add(160, 224, network.angular_hidden)
    builder.add(224, 288, network.angular_out, activate=False)
    return builder.plan(PAPER, np.zeros((1, FEATURES), dtype=np.float32), 292, 152, network)
