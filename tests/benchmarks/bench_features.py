"""The feature network and the texture loss: milliseconds forward and backward, and what bfloat16 costs in accuracy.

    python tests/benchmarks/bench_features.py [--sizes 360,180,90,45] [--runs 5] [--threads 2]

Rows of sizes: the network alone on one image of that size. ``loss``: the whole texture loss of an image of the first
size (levels 2, 4, 8). The best of the runs. ``bfloat16 against float32``: relative difference of the loss, and cosine
of the angle between the gradients to the image, far from the target (another picture), near it (the target with 5 %
noise) and under a global change (the target 5 % darker).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from torch import Tensor

from usdfab.fit.features import load_features
from usdfab.fit.texture import Target, gram_matrix, texture_loss

DTYPES = (torch.float32, torch.bfloat16)


def milliseconds(loss: Callable[[Tensor], Tensor], image: Tensor, runs: int) -> tuple[float, float]:
    """Best forward and backward time."""
    forward, backward = [], []
    for _ in range(runs + 1):
        x = image.clone().requires_grad_(True)
        start = time.perf_counter()
        value = loss(x)
        middle = time.perf_counter()
        value.backward()
        forward.append(middle - start)
        backward.append(time.perf_counter() - middle)
    return 1e3 * min(forward[1:]), 1e3 * min(backward[1:])


def weave_picture(side: int, seed: int) -> Tensor:
    """(1, 3, side, side): coloured threads with grain."""
    noise = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    period = 18 + 6 * seed
    over = ((x // period + y // period) % 2).float()
    height = over * torch.sin(torch.pi * (x % period) / period) + (1 - over) * torch.sin(
        torch.pi * (y % period) / period
    )
    color = torch.tensor([[0.5, 0.3, 0.2], [0.2, 0.35, 0.5]])
    light = over[None] * color[0, :, None, None] + (1 - over)[None] * color[1, :, None, None]
    return (light * (0.3 + 0.7 * height) * (1.0 + 0.2 * torch.randn(side, side, generator=noise))).clamp(0.0)[None]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="360,180,90,45")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--smoke", action="store_true", help="once and small, to see that it runs")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.sizes, arguments.runs = "64", 1
    torch.set_num_threads(arguments.threads)
    sizes = [int(s) for s in arguments.sizes.split(",")]
    nets = {dtype: load_features(dtype=dtype) for dtype in DTYPES}
    print(f"{'':<10}" + "".join(f"{d!s:>16}{'forward':>9}{'backward':>9} ms" for d in DTYPES))
    for side in sizes:
        image = weave_picture(side, 0)
        times = [
            milliseconds(lambda x, n=n: sum(gram_matrix(m).mean() for m in n(x)), image, arguments.runs)
            for n in nets.values()
        ]
        print(f"{side:<10}" + "".join(f"{'':>16}{f:9.1f}{b:9.1f}   " for f, b in times))
    image, other = weave_picture(sizes[0], 0), weave_picture(sizes[0], 1)
    for kind in ("gram", "covariance"):
        targets = {dtype: Target.from_image(image, net, kind=kind) for dtype, net in nets.items()}
        times = [milliseconds(lambda x, t=t: texture_loss(x, t), other, arguments.runs) for t in targets.values()]
        print(f"{kind:<10}" + "".join(f"{'':>16}{f:9.1f}{b:9.1f}   " for f, b in times))
        grain = 1.0 + 0.05 * torch.randn(image.shape, generator=torch.Generator().manual_seed(7))
        for name, render in (("far", other), ("near", image * grain), ("darker", 0.95 * image)):
            values, gradients = [], []
            for target in targets.values():
                x = render.clone().requires_grad_(True)
                value = texture_loss(x, target)
                gradients.append(torch.autograd.grad(value, x)[0].double().flatten())
                values.append(value.item())
            cosine = torch.nn.functional.cosine_similarity(*gradients, dim=0)
            slopes = [float((g * render.flatten().double()).sum()) for g in gradients]
            change = 100 * (slopes[1] / slopes[0] - 1)
            difference = 100 * (values[1] / values[0] - 1)
            print(
                f"  bfloat16 against float32, {name:<7} loss {values[0]:.4f}, {difference:+.2f} %; "
                f"gradients' cosine {float(cosine):.4f}; slope with exposure {change:+.2f} %"
            )


if __name__ == "__main__":
    main()
