"""Training: the same seed and data give the same weights, in one run or in several, on one kind of machine.

A step takes a few materials, encodes each once, and decodes many queries of each, so that the decoder dominates. Each
material comes mirrored, turned and shifted at random (``symmetry``).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.neural.checkpoint import State, load_checkpoint, save_checkpoint
from usdfab.neural.examples import Examples, Split
from usdfab.neural.lean_network import LeanNetwork
from usdfab.neural.network import DIFFUSE_WEIGHT, KINDS, MaterialNetwork, loss
from usdfab.neural.paper_network import PaperNetwork
from usdfab.neural.symmetry import SYMMETRIES, transformed_components, transformed_queries, transformed_tile
from usdfab.torch_run import checked_device, deterministic, one_thread

ARCHITECTURES = ("lean", "paper")
MATERIALS_PER_STEP = 4
OPTIMIZERS = ("adam", "sgd")
SGD_DROPS, SGD_FACTOR = (0.5, 0.8), 0.2
"""After these parts of the epochs the rate of SGD drops by this factor: epochs 6 and 9 of 10 (paper B, 5.2)."""

WEIGHT_DECAY = 1e-4
WARM_UP = 100
"""Steps over which Adam's rate rises, or a tenth of all."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class TrainSettings:
    """How a network is trained.

    Parameters
    ----------
    batch:
        Queries of a step, of ``MATERIALS_PER_STEP`` materials together. Paper B: 512.
    rate:
        Learning rate; 0: 4e-3 for Adam, 5e-2 for SGD (paper B).
    optimizer:
        ``adam`` (cosine schedule; gets somewhere in minutes) or ``sgd`` (paper B's, for days).
    diffuse_weight:
        Of the diffuse components in the loss. Paper B's 0.1 leaves them badly learned in minutes: their squares are a
        hundred times smaller than those of the compressed specular ones.
    augment:
        Whether materials are mirrored, turned and shifted.
    """

    architecture: str = "lean"
    kind: str = "reflection"
    epochs: int = 40
    batch: int = 4096
    rate: float = 0.0
    optimizer: str = "adam"
    seed: int = 0
    diffuse_weight: float = 4.0
    augment: bool = True

    def __post_init__(self) -> None:
        for name, value, known in (
            ("--architecture", self.architecture, ARCHITECTURES), ("--kind", self.kind, KINDS),
            ("--optimizer", self.optimizer, OPTIMIZERS),
        ):  # fmt: skip
            if value not in known:
                raise UsdfabError(f"there is no '{value}'", place=name, remedy=f"use {', '.join(known)}")
        if self.epochs < 1:
            raise UsdfabError(f"{self.epochs} epochs are none", place="--epochs", remedy="give 1 or more")
        if self.batch < MATERIALS_PER_STEP:
            raise UsdfabError(
                f"{self.batch} queries are too few for a step", place="--batch",
                remedy=f"give {MATERIALS_PER_STEP} or more",
            )  # fmt: skip
        if not 0.0 <= self.rate < math.inf:
            raise UsdfabError(f"{self.rate} is no learning rate", place="--learning-rate", remedy="stay above 0")
        if not 0 <= self.seed < 2**31:
            raise UsdfabError(f"{self.seed} is not between 0 and 2^31 - 1", place="--seed")

    def filled(self) -> TrainSettings:
        """With the optimizer's own rate where none is given."""
        return replace(self, rate=self.rate or (4e-3 if self.optimizer == "adam" else 5e-2))


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained network. ``history``: (epochs, 2) losses of training and of the judging materials."""

    network: MaterialNetwork
    history: list[tuple[float, float]]
    interrupted: bool = False


def new_network(architecture: str, kind: str, **options: int) -> MaterialNetwork:
    """An untrained network of an architecture."""
    return PaperNetwork(kind) if architecture == "paper" else LeanNetwork(kind, **options)


def train(
    data: Split,
    settings: TrainSettings,
    *,
    device: str = "cpu",
    network: MaterialNetwork | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Trained:
    """Train a network on the learned part of a data set.

    Parameters
    ----------
    network:
        To go on with, for fine-tuning; by default a new one.
    checkpoint, resume:
        A file that keeps the state after each epoch; whether to go on from it.

    Raises
    ------
    UsdfabError
        If there is nothing to learn from, the device is not there, the checkpoint belongs to another run, or a loss
        is not finite.
    """
    settings = settings.filled()
    where = checked_device(device)
    if not len(data.learned) or not data.learned.queries.shape[1]:
        raise UsdfabError("there are no materials to learn from", remedy="make more: usdfab dataset neural")
    torch.manual_seed(settings.seed)
    network = (network or new_network(settings.architecture, settings.kind)).to(where)
    learned, judged = data.learned.to(where), _judges(data).to(where)
    optimizer: torch.optim.Optimizer
    if settings.optimizer == "adam":
        optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=WEIGHT_DECAY)
    else:
        optimizer = torch.optim.SGD(network.parameters(), settings.rate, weight_decay=WEIGHT_DECAY)
    job = _identity(settings, data, network)
    state = State()
    if resume and checkpoint is not None and checkpoint.exists():
        state = load_checkpoint(checkpoint, job, network, optimizer)
    interrupted = False
    try:
        with deterministic(), one_thread():
            while state.epoch < settings.epochs:
                said = _epoch(network, optimizer, learned, judged, settings, state, progress)
                state = State(state.epoch + 1, [*state.history, said])
                if checkpoint:
                    save_checkpoint(checkpoint, job, network, optimizer, state)
    except KeyboardInterrupt:
        interrupted = True
    return Trained(network.eval().to("cpu"), state.history, interrupted)


def _judges(data: Split) -> Examples:
    """What the losses shown beside those of training are of: unknown materials, else what is learned from."""
    return next((part for part in (data.materials, data.weaves) if len(part)), data.learned)


def _identity(settings: TrainSettings, data: Split, network: MaterialNetwork) -> str:
    about = json.dumps([asdict(settings), network.options(), __version__], sort_keys=True)
    digest = hashlib.sha256(about.encode())
    for part in (data.learned, data.materials, data.weaves):
        digest.update(part.digest().encode())
    for tensor in network.state_dict().values():
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _epoch(
    network: MaterialNetwork, optimizer: torch.optim.Optimizer, learned: Examples, judged: Examples,
    settings: TrainSettings, state: State, progress: Progress | None,
) -> tuple[float, float]:  # fmt: skip
    # Each epoch has random numbers of its own, so that it does not matter whether a run was interrupted before.
    rng = np.random.default_rng([settings.seed, state.epoch])
    chunk = min(max(1, settings.batch // MATERIALS_PER_STEP), learned.queries.shape[1])
    chunks = learned.queries.shape[1] // chunk
    steps = math.ceil(len(learned) * chunks / MATERIALS_PER_STEP)
    network.train()
    total = 0.0
    for step, (tiles, parameters, queries, targets) in enumerate(_batches(learned, chunk, chunks, settings, rng)):
        for group in optimizer.param_groups:
            group["lr"] = settings.rate * _factor(settings, state.epoch * steps + step, settings.epochs * steps)
        outputs = network.decode(network.encode(tiles, parameters), queries)
        found = loss(outputs, targets, network.curvature, settings.diffuse_weight)
        optimizer.zero_grad()
        found.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        total += float(found.detach()) / steps
        if progress:
            text = f"epoch {state.epoch + 1} of {settings.epochs}, loss {float(found.detach()):.4f}"
            progress(state.epoch * steps + step + 1, settings.epochs * steps, text)
    network.eval()
    judgement = mean_loss(network, judged, settings.diffuse_weight)
    if not math.isfinite(total + judgement):
        raise UsdfabError(f"the loss is not finite in epoch {state.epoch + 1}", remedy="lower the learning rate")
    return total, judgement


def _factor(settings: TrainSettings, step: int, steps: int) -> float:
    """Of the learning rate."""
    if settings.optimizer == "sgd":
        return SGD_FACTOR ** sum(step >= part * steps for part in SGD_DROPS)
    return min(1.0, (step + 1) / min(WARM_UP, 1 + steps // 10)) * 0.5 * (1.0 + math.cos(math.pi * step / steps))


def _batches(
    learned: Examples, chunk: int, chunks: int, settings: TrainSettings, rng: np.random.Generator
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Each query once: tiles, parameters, queries and targets of a few materials at a time."""
    count = learned.queries.shape[1]
    orders = [torch.from_numpy(rng.permutation(count)) for _ in range(len(learned))]
    pairs = rng.permutation(len(learned) * chunks)
    pixels = learned.tiles.shape[-1]
    for start in range(0, len(pairs), MATERIALS_PER_STEP):
        tiles, parameters, queries, targets = [], [], [], []
        for pair in pairs[start : start + MATERIALS_PER_STEP]:
            material, part = divmod(int(pair), chunks)
            rows = orders[material][part * chunk : (part + 1) * chunk].to(learned.queries.device)
            turn, *shift = (int(n) for n in rng.integers(0, (SYMMETRIES, pixels, pixels)))
            if not settings.augment:
                turn, shift = 0, [0, 0]
            tiles.append(transformed_tile(learned.tiles[material], turn, (shift[0], shift[1])))
            parameters.append(learned.parameters[material])
            moved = (shift[0] / pixels, shift[1] / pixels)
            queries.append(transformed_queries(learned.queries[material, rows], turn, moved))
            targets.append(transformed_components(learned.targets[material, rows], turn))
        yield torch.stack(tiles), torch.stack(parameters), torch.stack(queries), torch.stack(targets)


@torch.no_grad()
def outputs_of(network: MaterialNetwork, examples: Examples) -> Tensor:
    """Network outputs (N, Q, 4) of all queries, a few materials at a time."""
    found = []
    for start in range(0, len(examples), MATERIALS_PER_STEP):
        some = examples.of(torch.arange(start, min(start + MATERIALS_PER_STEP, len(examples))))
        found.append(network.decode(network.encode(some.tiles, some.parameters), some.queries))
    return torch.cat(found)


def mean_loss(network: MaterialNetwork, examples: Examples, diffuse_weight: float = DIFFUSE_WEIGHT) -> float:
    """Loss over all queries of some materials."""
    return float(loss(outputs_of(network, examples), examples.targets, network.curvature, diffuse_weight))
