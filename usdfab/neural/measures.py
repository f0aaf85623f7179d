"""How far a network is from the surface model on materials that it did or did not learn from."""

from __future__ import annotations

import torch

from usdfab.neural.examples import Examples, Split
from usdfab.neural.network import MaterialNetwork, loss
from usdfab.neural.training import outputs_of


def measures(network: MaterialNetwork, examples: Examples) -> dict[str, float]:
    """Errors over all queries of some materials.

    ``loss``: paper B's; ``diffuse`` and ``specular``: root mean square errors of the components over their root mean
    square; ``value``: mean absolute error of the BSDF with all albedos 1, over its mean.
    """
    outputs = outputs_of(network, examples)
    found, true = network.components(outputs), examples.targets
    error = found - true

    def relative(part: slice) -> float:
        return float((error[..., part].square().mean() / true[..., part].square().mean().clamp(min=1e-20)).sqrt())

    whole = error.sum(dim=-1).abs().mean() / true.sum(dim=-1).mean().clamp(min=1e-20)
    return {
        "materials": len(examples),
        "loss": float(loss(outputs, true, network.curvature)),
        "diffuse": relative(slice(0, 2)),
        "specular": relative(slice(2, 4)),
        "value": float(whole),
    }


def table(network: MaterialNetwork, data: Split) -> dict[str, dict[str, float]]:
    """``measures`` of what was learned, of other materials of the same weaves, and of other weaves."""
    parts = {"learned": data.learned, "held_out_materials": data.materials, "held_out_weaves": data.weaves}
    with torch.no_grad():
        return {name: measures(network, part) for name, part in parts.items() if len(part)}
