"""Fine-tuning the shared networks to one fabric's fibers.

Answers of few paths are noisy but right in the mean, and so are the gradients of squared errors: many queries with few
paths each teach more than few with many. Squares are weighed by what the network itself says, held constant, so that
dark answers count as much as bright ones (Lehtinen et al. 2018, section 3; Müller et al. 2021, eq. 5); errors are
those of the columns themselves, not of their logarithms, in which noise would have a mean. What is left of an error of
the means over all queries is taken out at the end by one factor for each column (``AssetMaterial.scale``).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.neural.asset_network import COLUMNS, TO_RGB, AssetMaterial, AssetNetwork, first_network
from usdfab.neural.asset_queries import AssetQueries
from usdfab.neural.checkpoint import State, load_checkpoint, save_checkpoint
from usdfab.neural.decoder import plans_of
from usdfab.neural.lean_network import LeanNetwork
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS
from usdfab.neural.rendered_material import learned_material, reversed_material
from usdfab.neural.surface_from_fabric import surface_from_fabric
from usdfab.torch_run import deterministic, one_thread

FLOOR = 0.25
"""Of the weights of squares, in means of a column: what is darker counts no more."""

GLOSS_WEIGHT = 0.25
"""Of the gloss among the columns: it is noisy, and little light."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class AssetSettings:
    """How a fabric is fine-tuned.

    Parameters
    ----------
    queries, samples:
        Of each side of the cloth, and paths of each query.
    epochs, batch:
        Times that each query is seen; queries of a step, half of each side.
    code_rate, decoder_rate:
        Adam's, at the start; they fall as a cosine.
    """

    queries: int = 100_000
    samples: int = 20
    epochs: int = 5
    batch: int = 2048
    code_rate: float = 1e-3
    decoder_rate: float = 1e-2
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("queries", "samples", "epochs"):
            if getattr(self, name) < 1:
                raise UsdfabError(f"{getattr(self, name)} {name} are none", place=f"--{name}", remedy="give 1 or more")
        if not 0 <= self.seed < 2**31:
            raise UsdfabError(f"{self.seed} is not between 0 and 2^31 - 1", place="--seed")


QUALITIES = {
    "draft": AssetSettings(queries=8_000, samples=8, epochs=8),
    "standard": AssetSettings(),
    "high": AssetSettings(queries=400_000, samples=24, epochs=6),
}
"""By the names of ``--quality``."""


@dataclass(frozen=True, eq=False)
class TrainedAsset:
    """A fine-tuned fabric; ``interrupted``: what had been learned until then, where anything had."""

    material: AssetMaterial
    interrupted: bool = False
    history: Mapping[str, list[tuple[float, float]]] = field(default_factory=dict)


def identity(fabric_digest: str, settings: AssetSettings, shared: Mapping[str, Weights]) -> str:
    """What a run depends on, as a checksum."""
    digest = hashlib.sha256(json.dumps([fabric_digest, asdict(settings), __version__], sort_keys=True).encode())
    for kind in KINDS:
        for tensor in shared[kind].network.state_dict().values():
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def train_asset(
    fabric: FabricParameters, learned: AssetQueries, judges: AssetQueries, shared: Mapping[str, Weights],
    settings: AssetSettings, *, folder: Path | None = None, job: str = "", resume: bool = False,
    progress: Progress | None = None,
) -> TrainedAsset:  # fmt: skip
    """Both kinds, one after the other; the same numbers give the same weights.

    Parameters
    ----------
    folder, job, resume:
        Where states are kept after each epoch, of which run they are, whether to go on from them.

    Raises
    ------
    UsdfabError
        If the shared networks are not lean ones, or a loss is not finite.
    """
    networks: dict[str, AssetNetwork] = {}
    history: dict[str, list[tuple[float, float]]] = {}
    interrupted = False
    for number, kind in enumerate(KINDS):
        network = first_network(fabric, lean(shared[kind]))
        data = learned.of_kind(number)
        prepare_outputs(network, data[1][0])
        networks[kind] = network
        if interrupted:
            continue
        file = folder / f"{kind}.training.safetensors" if folder else None

        def tell(done: int, total: int, text: str, number: int = number, kind: str = kind) -> None:
            if progress:
                progress(number * total + done, len(KINDS) * total, f"{kind}, {text}")

        history[kind], interrupted = _train(
            network, data, judges.of_kind(number), settings, file, f"{job} {kind}", resume, tell
        )
    scale = np.stack([_scale(networks[kind], *learned.of_kind(k)) for k, kind in enumerate(KINDS)])
    picks, ends = fabric.repeat()
    material = AssetMaterial((ends, picks), networks, scale, {})
    return TrainedAsset(material, interrupted, history)


def lean(weights: Weights) -> LeanNetwork:
    """The network to begin with; ``UsdfabError`` where it is of another architecture."""
    if not isinstance(weights.network, LeanNetwork):
        raise UsdfabError(
            f"networks of the architecture {weights.network.architecture} cannot be fine-tuned to a fabric",
            remedy="give weights of the architecture lean",
        )
    return weights.network


def prepare_outputs(network: AssetNetwork, answers: NDArray[np.float32]) -> None:
    """Make the last layer answer colours: the mean ones at first, differing as warp and weft together did."""
    last = network.layer("last")
    mean = torch.from_numpy(answers.reshape(-1, len(COLUMNS)).mean(axis=0, dtype=np.float64)).float().clamp(min=1e-6)
    with torch.no_grad():
        # The shared networks' diffuse rows, whose mean is about 0.2 for white cloth.
        diffuse = last.weight[:2].mean(dim=0)
        gloss = last.weight[2:].mean(dim=0)
        bias_c, bias_g = last.bias[:2].mean(), last.bias[2:].mean()
        slope = network.curvature * mean / (1.0 + network.curvature * mean)
        for row, column in enumerate(COLUMNS):
            if column == "gloss":
                last.weight[row], last.bias[row] = gloss, bias_g
            else:
                last.weight[row] = 5.0 * slope[row] * diffuse
                last.bias[row] = torch.log1p(network.curvature * mean[row]) + slope[row] * (5.0 * bias_c - 1.0)


def relative_loss(found: Tensor, true: Tensor, means: Tensor) -> Tensor:
    """Weighed squared errors of columns (..., 4); ``means`` (4,) of the columns over all queries."""
    weights = torch.ones_like(means)
    weights[COLUMNS.index("gloss")] = GLOSS_WEIGHT
    scale = found.detach().square() + (FLOOR * means).square()
    return (weights * (found - true).square() / scale).mean()


def _train(
    network: AssetNetwork, data: tuple[NDArray, NDArray], judges: tuple[NDArray, NDArray], settings: AssetSettings,
    file: Path | None, job: str, resume: bool, progress: Progress,
) -> tuple[list[tuple[float, float]], bool]:  # fmt: skip
    queries, answers = torch.from_numpy(data[0]), torch.from_numpy(data[1][0])
    means = answers.flatten(0, 1).mean(dim=0).clamp(min=1e-6)
    codes = [network.codes]
    rest = [parameter for name, parameter in network.learned().items() if name != "codes"]
    groups: list[dict[str, Any]] = [{"params": codes}, {"params": rest}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    rates = (settings.code_rate, settings.decoder_rate)
    state = State()
    if resume and file is not None and file.exists():
        state = load_checkpoint(file, job, network, optimizer)
    count = queries.shape[1]
    chunk = min(max(1, settings.batch // 2), count)
    steps = math.ceil(count / chunk)
    try:
        with deterministic(), one_thread():
            while state.epoch < settings.epochs:
                # Each epoch has random numbers of its own: it does not matter whether a run was interrupted before.
                rng = np.random.default_rng([settings.seed, state.epoch])
                order, total = torch.from_numpy(rng.permutation(count)), 0.0
                for step in range(steps):
                    number = state.epoch * steps + step
                    factor = _factor(number, settings.epochs * steps)
                    for group, rate in zip(optimizer.param_groups, rates, strict=True):
                        group["lr"] = rate * factor
                    rows = order[step * chunk : (step + 1) * chunk]
                    value = relative_loss(network(queries[:, rows]), answers[:, rows], means)
                    optimizer.zero_grad()
                    value.backward()
                    optimizer.step()
                    total += float(value.detach()) / steps
                    text = f"epoch {state.epoch + 1} of {settings.epochs}"
                    progress(number + 1, settings.epochs * steps, text)
                if not math.isfinite(total):
                    raise UsdfabError(f"the loss is not finite in epoch {state.epoch + 1}", remedy="use more --queries")
                state = State(state.epoch + 1, [*state.history, (total, column_error(network, judges))])
                if file:
                    save_checkpoint(file, job, network, optimizer, state)
    except KeyboardInterrupt:
        return state.history, True
    return state.history, False


def _factor(step: int, steps: int) -> float:
    warm = min(1.0, (step + 1) / min(50, 1 + steps // 10))
    return warm * 0.5 * (1.0 + math.cos(math.pi * step / steps))


@torch.no_grad()
def answers_of(network: AssetNetwork, queries: NDArray[np.float32]) -> NDArray[np.float32]:
    """Columns (2, Q, 4) of queries (2, Q, 8), none below 0 as the renderer has them."""
    parts = [network(part) for part in torch.from_numpy(queries).split(8192, dim=1)]
    return torch.cat(parts, dim=1).clamp(min=0.0).numpy()


def _scale(network: AssetNetwork, queries: NDArray[np.float32], answers: NDArray[np.float32]) -> NDArray[np.float64]:
    """(4,) true means over the network's."""
    found = answers_of(network, queries).mean(axis=(0, 1), dtype=np.float64)
    true = answers.mean(axis=(0, 1, 2), dtype=np.float64)
    return np.where(found > 0.0, true / np.maximum(found, 1e-12), 1.0)


def column_error(network: AssetNetwork, judges: tuple[NDArray, NDArray]) -> float:
    """Relative error of colours on the judges, see ``relative_error``."""
    found = answers_of(network, judges[0]).astype(np.float64) @ TO_RGB
    return relative_error(found, judges[1].astype(np.float64) @ TO_RGB)


def relative_error(found: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Root mean square error of colours (..., 3) over the root mean square of the true ones, without their noise.

    ``true`` (2, ..., 3): two independent unbiased estimates a, b of the truth t: the mean of (f - a)(f - b) is that of
    (f - t)^2, and of a b that of t^2.
    """
    error = float(((found - true[0]) * (found - true[1])).mean())
    return math.sqrt(max(error, 0.0) / max(float((true[0] * true[1]).mean()), 1e-20))


def judgement(
    fabric: FabricParameters, material: AssetMaterial, shared: Mapping[str, Weights], judges: AssetQueries
) -> dict[str, Any]:
    """Errors on the judges by kind: of the fabric's own network, and of the shared one before.

    ``mean``: mean colour over the fibers', of each channel; ``error``: ``relative_error``.
    """
    cloth, colors = surface_from_fabric(fabric)
    cloth, cover = learned_material(cloth)
    picks, ends = fabric.repeat()
    repeats = np.array([ends // cloth.columns, picks // cloth.rows])
    said: dict[str, Any] = {}
    for number, kind in enumerate(KINDS):
        queries, answers = judges.of_kind(number)
        true = answers.astype(np.float64) @ TO_RGB
        own = np.stack([
            plan.decode(queries[side]).astype(np.float64) @ material.albedo[number]
            for side, plan in enumerate(material.networks[kind].plans())
        ])  # fmt: skip
        plans = plans_of(shared[kind].network, [cloth, reversed_material(cloth)])
        # Their tile is the weave's alone.
        asked = queries.copy()
        asked[..., :2] = asked[..., :2] * repeats % 1.0
        asked[..., 2] *= math.sqrt(repeats[0] * repeats[1])
        albedo = cover * np.stack([colors.reflection, colors.transmission])[number]
        before = np.stack([plan.decode(asked[side]).astype(np.float64) @ albedo for side, plan in enumerate(plans)])
        said[kind] = {
            name: {
                "mean": [round(float(v), 4) for v in found.mean(axis=(0, 1)) / true.mean(axis=(0, 1, 2))],
                "error": round(relative_error(found, true), 4),
            }
            for name, found in (("before", before), ("after", own))
        }  # fmt: skip
    return said
