"""Training: the same seed and inputs give the same weights, in one run or in several, on one kind of machine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import PAPER_WEAVES
from usdfab.fit.network.checkpoint import State, identity_of, load_checkpoint, save_checkpoint
from usdfab.fit.network.model import DETAIL_COMPONENTS, TEXTURE_COMPONENTS, Paper, Robust, bin_targets
from usdfab.fit.network.paper import NUMBERS, shares
from usdfab.fit.network.spectra import BIN_WIDTH, HIGH, LOW
from usdfab.fit.network.store import Drawn, Prepared, Rows, component_counts
from usdfab.torch_run import checked_device, deterministic, one_thread

MODELS = ("robust", "paper")
SAVE_EVERY = 10
"""Epochs between checkpoints."""

MAX_SHIFT = 8
"""Bins by which the spectra of a picture are moved at most: a fifth larger or smaller."""

HINT_NOISE = 0.03
"""Relative error of the counts that the numbers' part is given in training."""

BLIND = 0.3
"""Part of the renders whose texture the weave's part does not see in training: drawn cloth has none that is true."""

DRAWN_SHARE = 0.5
"""Weight of drawn cloth in the losses of counts and weave, if there is any."""

INPUT_NOISE = 0.03
LABEL_SMOOTHING = 0.05

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class TrainSettings:
    """How a network is trained.

    Parameters
    ----------
    model:
        One of ``MODELS``.
    rate, decay, batch:
        Of Adam with decoupled weight decay; by default the model's own (the paper's: 1e-4, none, 8).
    share:
        Part of the training samples that is used; for learning curves.
    """

    model: str = "robust"
    epochs: int = 60
    seed: int = 0
    rate: float = 0.0
    decay: float = -1.0
    batch: int = 0
    share: float = 1.0

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise UsdfabError(f"there is no model '{self.model}'", place="--model", remedy=f"use {', '.join(MODELS)}")
        if self.epochs < 1:
            raise UsdfabError(f"{self.epochs} epochs are none", place="--epochs", remedy="give 1 or more")
        if not 0 <= self.seed < 2**31:
            raise UsdfabError(f"{self.seed} is not between 0 and 2^31 - 1", place="--seed")
        if not 0.0 < self.share <= 1.0:
            raise UsdfabError(f"{self.share} is no part of the data", remedy="stay above 0 and up to 1")

    def filled(self) -> TrainSettings:
        """With the model's own rate, decay and batch where none is given."""
        rate, decay, batch = (1e-4, 0.0, 8) if self.model == "paper" else (2e-3, 0.05, 64)
        return replace(
            self,
            rate=self.rate or rate,
            decay=decay if self.decay < 0.0 else self.decay,
            batch=self.batch or batch,
        )


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained network. ``history``: for each part (epochs, 2) losses of training and validation; ``best``: epochs."""

    network: Robust | Paper
    history: dict[str, list[tuple[float, float]]]
    best: dict[str, int]
    training_samples: int
    interrupted: bool = False
    notes: tuple[str, ...] = field(default=())


def train(
    data: Prepared,
    settings: TrainSettings,
    *,
    device: str = "cpu",
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Trained:
    """Train a network on the training part of a data set; every part of it is kept as it was best on validation.

    Parameters
    ----------
    checkpoint, resume:
        A file that keeps the state every ``SAVE_EVERY`` epochs, at the end and after Ctrl-C; whether to go on from it.

    Raises
    ------
    UsdfabError
        If a part of the data is empty, the device is not there, the checkpoint belongs to another run, or a loss
        is not finite.
    """
    settings = settings.filled()
    where = checked_device(device)
    rows = chosen_rows(data.rows.of("train"), settings)
    judge = chosen_rows(data.rows.of("validation"), replace(settings, share=1.0))
    if not len(rows) or not len(judge):
        what = "learn from" if not len(rows) else "stop by"
        raise UsdfabError(
            f"there are no samples to {what}", place=data.place, remedy="make more: usdfab dataset fabrics --count"
        )
    torch.manual_seed(settings.seed)
    network = new_network(settings.model, data, rows)
    network.to(where)
    learned, judged = (_examples(network, r, where) for r in (rows, judge))
    drawn = _drawn_examples(network, data.drawn, where)
    optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay)
    job = identity_of(settings, rows, judge, data.drawn)
    state = State({part: [] for part in network.parts}, dict.fromkeys(network.parts, 0), _copy(network))
    if resume and checkpoint is not None and checkpoint.exists():
        state = load_checkpoint(checkpoint, job, network, optimizer)
    interrupted = False
    try:
        with deterministic(), one_thread():
            while state.epoch < settings.epochs:
                state = _epoch(network, optimizer, learned, judged, drawn, settings, state)
                if checkpoint and state.epoch % SAVE_EVERY == 0:
                    save_checkpoint(checkpoint, job, network, optimizer, state)
                if progress:
                    said = ", ".join(f"{part} {state.history[part][-1][1]:.3f}" for part in network.parts)
                    progress(state.epoch, settings.epochs, said)
    except KeyboardInterrupt:
        interrupted = True
    if checkpoint and state.epoch:
        save_checkpoint(checkpoint, job, network, optimizer, state)
    network.load_state_dict(state.best)
    network.eval().to("cpu")
    return Trained(network, state.history, state.best_epoch, len(rows.index.unique()), interrupted)


def chosen_rows(rows: Rows, settings: TrainSettings) -> Rows:
    """What a model learns from: the paper's from renders of Table 4's fabrics as they are, ``robust`` from all."""
    if settings.model == "paper":
        rows = rows.where(rows.table4 & (rows.number == 0))
    samples = rows.index.unique()
    if settings.share < 1.0 and len(samples):
        order = np.random.default_rng(settings.seed).permutation(len(samples))
        kept = samples[torch.from_numpy(order[: max(1, round(settings.share * len(samples)))])]
        rows = rows.where(torch.isin(rows.index, kept))
    return rows


def new_network(model: str, data: Prepared, rows: Rows) -> Robust | Paper:
    """An untrained network whose fixed parts are set from the examples ``rows``."""
    components = component_counts(data.basis)
    if model == "paper":
        paper = Paper(components, len(PAPER_WEAVES), 2 * len(NUMBERS))
        paper.fit_inputs(rows.whole)
        return paper
    robust = Robust(components, rows.texture.shape[1])
    robust.fit_inputs(rows.texture, rows.detail, rows.lattice, rows.values, rows.known)
    return robust


Examples = dict[str, Tensor]


def _examples(network: Robust | Paper, rows: Rows, where: torch.device) -> Examples:
    """What an epoch needs, computed once and brought to the device."""
    found: Examples = {"label": rows.label}
    if isinstance(network, Paper):
        found |= {"texture": rows.whole, "shares": shares(rows.values)}
    else:
        with torch.no_grad():
            x = torch.cat(
                [network.reduced(*(part.to(where) for part in parts)) for parts in
                 zip(rows.texture.split(1024), rows.detail.split(1024), rows.lattice.split(1024), strict=True)]
            )  # fmt: skip
        found |= {"x": x, **{name: getattr(rows, name) for name in ("spectra", "values", "known", "table4")}}
    return {name: tensor.to(where) for name, tensor in found.items()}


def _drawn_examples(network: Robust | Paper, drawn: Drawn | None, where: torch.device) -> Examples | None:
    if drawn is None or not len(drawn) or isinstance(network, Paper):
        return None
    with torch.no_grad():
        lattice = network.lattice(drawn.lattice.to(where))
        # The mean texture and the mean detail are 0 here.
        x = F.pad(lattice, (TEXTURE_COMPONENTS, DETAIL_COMPONENTS))
    return {"x": x, **{name: getattr(drawn, name).to(where) for name in ("spectra", "counts", "label")}}


def _epoch(
    network: Robust | Paper, optimizer: torch.optim.Optimizer, learned: Examples, judged: Examples,
    drawn: Examples | None, settings: TrainSettings, state: State,
) -> State:  # fmt: skip
    # Each epoch has random numbers of its own, so that it does not matter whether a run was interrupted before.
    torch.manual_seed(hash((settings.seed, state.epoch)) % 2**31)
    for group in optimizer.param_groups:
        group["lr"] = settings.rate * 0.5 * (1.0 + math.cos(math.pi * state.epoch / settings.epochs))
    network.train()
    sums = dict.fromkeys(network.parts, 0.0)
    order = torch.randperm(len(learned["label"]))
    batches = order.split(settings.batch)
    for batch in batches:
        losses = _losses(network, {name: t[batch.to(t.device)] for name, t in learned.items()}, training=True)
        if drawn is not None and isinstance(network, Robust):
            some = torch.randint(len(drawn["label"]), (settings.batch,))
            more = _lattice_losses(network, {name: t[some.to(t.device)] for name, t in drawn.items()}, training=True)
            losses = {
                part: (1.0 - DRAWN_SHARE) * loss + DRAWN_SHARE * more[part] if part in more else loss
                for part, loss in losses.items()
            }
        optimizer.zero_grad()
        sum(losses.values(), start=torch.zeros((), device=learned["label"].device)).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        for part, loss in losses.items():
            sums[part] += float(loss.detach()) / len(batches)
    network.eval()
    with torch.no_grad():
        judgement = {part: float(loss) for part, loss in _losses(network, judged, training=False).items()}
    bad = [part for part in network.parts if not math.isfinite(sums[part] + judgement[part])]
    if bad:
        raise UsdfabError(f"the loss of {bad[0]} is not finite in epoch {state.epoch + 1}", remedy="lower the rate")
    history = {part: [*state.history[part], (sums[part], judgement[part])] for part in network.parts}
    best, best_epoch = dict(state.best), dict(state.best_epoch)
    now = network.state_dict()
    for part in network.parts:
        if judgement[part] <= min(loss for _, loss in history[part]):
            best_epoch[part] = state.epoch + 1
            # The paper's one part is all of the network.
            mine = [name for name in now if part == "paper" or name.startswith(f"{part}.")]
            best |= {name: now[name].detach().cpu().clone() for name in mine}
    return State(history, best_epoch, best, state.epoch + 1)


def _losses(network: Robust | Paper, batch: Examples, *, training: bool) -> dict[str, Tensor]:
    if isinstance(network, Paper):
        logits, found = network(batch["texture"])
        # L1 of the numbers as in the paper; the cross entropy beside it is an order larger.
        return {"paper": 0.1 * F.cross_entropy(logits, batch["label"]) + (found - batch["shares"]).abs().mean()}
    counts = batch["values"][:, :, 0]
    losses = _lattice_losses(network, batch | {"counts": counts}, training=training)
    x, hint = batch["x"], counts
    if training:
        hint = counts + HINT_NOISE * torch.randn_like(counts)
        x = x + INPUT_NOISE * torch.randn_like(x)
    means, log_variances = network.number_outputs(x, hint, batch["table4"])
    wanted = network.standardised(batch["values"])
    nll = 0.5 * (log_variances + (means - wanted).square() * (-log_variances).exp())
    if training:
        # Seitzer et al. 2022, beta-NLL: without it, what is hard is called uncertain instead of being learned.
        nll = nll * (0.5 * log_variances).exp().detach()
    known = batch["known"].float().expand_as(nll)
    return losses | {"numbers": (nll * known).sum() / known.sum()}


def _lattice_losses(network: Robust, batch: Examples, *, training: bool) -> dict[str, Tensor]:
    """Of the parts that drawn cloth teaches, too: counts and weave."""
    x, spectra, counts = batch["x"], batch["spectra"], batch["counts"]
    if training:
        spectra, counts = shifted(spectra, counts)
        x = network.blinded(x, torch.rand(len(x), device=x.device) < BLIND)
        x = x + INPUT_NOISE * torch.randn_like(x)
    logits = network.counts(spectra)
    weave = network.weave_outputs(x)
    labels = batch["label"].expand(len(weave), -1).flatten()
    smoothing = LABEL_SMOOTHING if training else 0.0
    return {
        "counts": F.cross_entropy(logits.flatten(0, 1), bin_targets(counts).flatten(0, 1)),
        "weave": F.cross_entropy(weave.flatten(0, 1), labels, label_smoothing=smoothing),
    }


def shifted(spectra: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Spectra (B, 2, 3, BINS) and log counts (B, 2) at random other scales; where that leaves the range, unchanged."""
    shift = torch.randint(-MAX_SHIFT, MAX_SHIFT + 1, counts.shape, device=counts.device)
    moved = counts + shift * BIN_WIDTH
    inside = (moved > math.log(LOW) + 2 * BIN_WIDTH) & (moved < math.log(HIGH) - 2 * BIN_WIDTH)
    shift = torch.where(inside, shift, 0)
    bins = spectra.shape[-1]
    source = (torch.arange(bins, device=counts.device) - shift[..., None]).clamp(0, bins - 1)
    return spectra.gather(3, source[:, :, None].expand_as(spectra)), counts + shift * BIN_WIDTH


def _copy(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().cpu().clone() for name, tensor in network.state_dict().items()}
