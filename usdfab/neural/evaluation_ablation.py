"""What parts of the paper's network are worth, and whether its latents can be mixed (Chen et al. 2024, 6.3).

Ablations train the paper's architecture on few materials for a short time: differences between them are what such a
training shows, not what the paper's four days would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from usdfab.neural.aggregation import aggregate
from usdfab.neural.dataset_draws import DatasetSettings, draw_material, draw_queries
from usdfab.neural.encoding import BLOBS, encoded_footprint, size_coordinate
from usdfab.neural.evaluation_scenes import unseen_twill
from usdfab.neural.examples import Examples, Split, material_inputs
from usdfab.neural.material_file import Weights
from usdfab.neural.measures import measures
from usdfab.neural.network import SLOPE
from usdfab.neural.paper_network import LATENT, WIDTH, PaperNetwork
from usdfab.neural.training import TrainSettings, train

SAMPLES = 64
"""Of the targets."""

VARIANTS = {"full": (True, True), "without one-blob": (False, True), "without fusion": (True, False)}
"""Names and (one-blob encoding, spatial fusion)."""


class AblatedNetwork(PaperNetwork):
    """The paper's network, with or without the footprint's encoding and its fusion with the latent.

    Without the encoding the fusion takes u, v and size as they are. Without fusion the angular decoder takes the latent
    and the encoded footprint side by side.
    """

    def __init__(self, kind: str, one_blob: bool, fusion: bool) -> None:
        super().__init__(kind)
        self.one_blob, self.fused = one_blob, fusion
        footprint = 3 * BLOBS if one_blob else 3
        if fusion:
            self.fusion = nn.ModuleList([nn.Linear(LATENT + footprint, WIDTH), nn.Linear(WIDTH, WIDTH)])
        else:
            self.fusion = nn.ModuleList()
            self.angular_in = nn.Linear(LATENT + footprint + 5, WIDTH)

    def options(self) -> dict[str, Any]:
        """What was left out."""
        return {"one_blob": self.one_blob, "fusion": self.fused}

    def decode(self, codes: Tensor, queries: Tensor) -> Tensor:
        """As the paper's, without what is left out."""
        if self.one_blob:
            footprint = encoded_footprint(queries)
        else:
            footprint = torch.cat([queries[..., :2], size_coordinate(queries[..., 2:3])], dim=-1)
        x = torch.cat([codes[:, None].expand(-1, queries.shape[1], -1), footprint], dim=-1)
        for layer in self.fusion:
            x = F.leaky_relu(layer(x), SLOPE)
        x = F.leaky_relu(self.angular_in(torch.cat([x, queries[..., 3:]], dim=-1)), SLOPE)
        x = F.leaky_relu(self.angular_hidden(self.angular_block(x)), SLOPE)
        return self.angular_out(x)


@dataclass(frozen=True)
class AblationScale:
    """Materials, queries of each and epochs; ``seed`` of draws and training."""

    materials: int
    queries: int
    epochs: int
    seed: int = 0


def made_examples(materials: range, scale: AblationScale) -> Examples:
    """Reflection of materials of the data set of the seed, computed on the spot."""
    settings = DatasetSettings(queries=scale.queries, samples=SAMPLES, seed=scale.seed)
    drawn = [draw_material(settings, k) for k in materials]
    queries = [draw_queries(settings, k, "reflection") for k in materials]
    targets = [aggregate(m, q, samples=SAMPLES, seed=k) for k, (m, q) in enumerate(zip(drawn, queries, strict=True))]
    tiles, parameters = material_inputs(drawn)
    return Examples(
        tiles, parameters, torch.from_numpy(np.stack(queries)), torch.from_numpy(np.stack(targets)),
        torch.arange(len(drawn)),
    )  # fmt: skip


def ablations(scale: AblationScale, progress: Callable[[str], None] | None = None) -> list[dict[str, Any]]:
    """Errors of each of ``VARIANTS`` on what was learned and on two other materials of the same weaves."""
    learned = made_examples(range(scale.materials), scale)
    others = made_examples(range(scale.materials, scale.materials + 2), scale)
    data = Split(learned, others, others.of(torch.arange(0)))
    settings = TrainSettings(
        architecture="paper", epochs=scale.epochs, batch=min(1024, 4 * scale.queries), rate=2e-3, seed=scale.seed,
        augment=False,
    )  # fmt: skip
    rows = []
    for name, (one_blob, fusion) in VARIANTS.items():
        torch.manual_seed(scale.seed)
        network = train(data, settings, network=AblatedNetwork("reflection", one_blob, fusion)).network
        with torch.no_grad():
            rows.append({
                "network": name,
                **{f"learned_{k}": measures(network, learned)[k] for k in ("loss", "value")},
                **{f"others_{k}": measures(network, others)[k] for k in ("loss", "value")},
            })  # fmt: skip
        if progress:
            progress(name)
    return rows


INTERPOLATED = {"roughness": (0.2, 0.8), "height_scale": (0.2, 0.8)}
"""Fields of a material, and the two values whose codes are mixed."""

MIXED_AT = (0.3, 0.5, 0.6, 0.9)
"""Values that mixed codes stand for; the last lies beyond both."""


def interpolations(networks: Mapping[str, Weights], queries: int, seed: int = 0) -> list[dict[str, Any]]:
    """Codes mixed of two against codes of the encoder: mean absolute difference of what they answer, over the mean.

    ``mixed`` and ``encoded``: the same of each against the surface model.
    """
    network = networks["reflection"].network
    asked = draw_queries(DatasetSettings(queries=queries, seed=seed + 1), 0, "reflection")
    base, rows = unseen_twill(), []
    for field, (low, high) in INTERPOLATED.items():
        values = (low, high, *MIXED_AT)
        materials = [replace(base, **{field: value}) for value in values]  # type: ignore[arg-type]
        with torch.no_grad():
            codes = network.encode(*material_inputs(materials))
            for k, value in enumerate(MIXED_AT):
                share = (value - low) / (high - low)
                both = torch.stack([torch.lerp(codes[0], codes[1], share), codes[2 + k]])
                repeated = torch.from_numpy(asked)[None].expand(2, -1, -1)
                mixed, encoded = network.components(network.decode(both, repeated)).sum(dim=-1).numpy()
                true = aggregate(materials[2 + k], asked, samples=256, seed=seed).sum(axis=1)
                rows.append({
                    "field": field, "value": value, "beyond": not low <= value <= high,
                    "difference": float(np.abs(mixed - encoded).mean() / encoded.mean()),
                    "mixed": float(np.abs(mixed - true).mean() / true.mean()),
                    "encoded": float(np.abs(encoded - true).mean() / true.mean()),
                })  # fmt: skip
    return rows


def format_ablations(ablated: list[dict[str, Any]], mixed: list[dict[str, Any]]) -> str:
    """Both tables as text."""
    lines = []
    if ablated:
        lines.append(f"{'paper network':<20}{'learned: loss':>14}{'error':>8}{'others: loss':>14}{'error':>8}")
        lines += [
            f"{r['network']:<20}{r['learned_loss']:>14.4f}{r['learned_value']:>8.3f}"
            f"{r['others_loss']:>14.4f}{r['others_value']:>8.3f}"
            for r in ablated
        ]
        lines.append("")
    lines.append(f"{'codes mixed for':<20}{'value':>6}{'to encoded':>12}{'to truth':>10}{'encoded to truth':>18}")
    lines += [
        f"{r['field']:<20}{r['value']:>6.2f}{r['difference']:>12.3f}{r['mixed']:>10.3f}{r['encoded']:>18.3f}"
        for r in mixed
    ]
    return "\n".join(lines)
