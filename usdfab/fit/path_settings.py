"""How stage 3 of the fit works: pixels, samples and iterations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from usdfab.errors import UsdfabError
from usdfab.fit.path_loss import Weights
from usdfab.fit.texture import LEVELS

Quality = Literal["draft", "standard", "paper"]
Backend = Literal["tracer", "mitsuba"]
Passes = Literal["recycled", "separate"]
Steps = Literal["model", "adam"]
Noise = Literal["auto", "denoise", "match", "ignore"]

SIDE_RANGE, ITERATIONS_RANGE, SPP_RANGE = (8, 4096), (1, 10_000), (1, 1 << 16)


@dataclass(frozen=True)
class PathSettings:
    """Settings of stage 3.

    Parameters
    ----------
    side:
        Pixels along the picture's longer side; the photo is reduced to it.
    iterations:
        Renders, each followed by a step.
    spp, gradient_spp:
        Samples per pixel of each picture and of each gradient. With recycled passes both come from the same
        paths, ``spp + gradient_spp`` of them.
    rate:
        Adam's learning rate, in the coordinates of ``OpticsSpace``.
    passes:
        ``recycled``: each picture and its derivatives join those of earlier iterations, moved to the new optics by
        the derivatives; only our tracer gives them. ``separate``: as the paper, a picture and then a gradient with
        another seed in each iteration, all forgotten in the next.
    spread:
        Whether fireflies are spread before the loss sees the picture, see ``path_noise``.
    steps:
        ``model``: to where the loss is least by the derivatives of all statistics (Gauss-Newton), at most ``trust``
        away in each coordinate; needs recycled passes. ``adam``: as the paper.
    noise:
        What is done about the render's noise, see ``path_noise``: ``denoise`` it, ``match`` it by noise on the photo,
        ``ignore`` it. ``auto``: denoise with our tracer where the denoiser is installed, else match.
    keep:
        As for ``DifferentiableTracer``; 1 has no bias.
    gain:
        Whether the exposure gain is estimated; it starts at 1.
    max_depth:
        Longest path in vertices.
    seed:
        Of all renders.
    backend:
        ``tracer``: ours; ``mitsuba``: the reference.
    device:
        Of Mitsuba: auto, llvm or cuda.
    features:
        The feature network's name or file.
    levels:
        As for ``Target.from_image``.
    weights:
        Of the parts of the loss.
    threads:
        None: all cores.
    """

    side: int = 128
    iterations: int = 50
    spp: int = 24
    gradient_spp: int = 16
    rate: float = 0.02
    passes: Passes = "recycled"
    steps: Steps = "model"
    trust: float = 0.2
    noise: Noise = "auto"
    keep: float = 1.0
    gain: bool = True
    max_depth: int = 64
    seed: int = 0
    backend: Backend = "tracer"
    device: str = "auto"
    features: str = "vgg16"
    levels: tuple[int, ...] = LEVELS
    weights: Weights = Weights()
    threads: int | None = None

    def __post_init__(self) -> None:
        for name, value, (low, high) in (
            ("side", self.side, SIDE_RANGE),
            ("iterations", self.iterations, ITERATIONS_RANGE),
            ("spp", self.spp, SPP_RANGE),
            ("gradient_spp", self.gradient_spp, SPP_RANGE),
        ):
            if not low <= value <= high:
                raise UsdfabError(f"{value} is not between {low} and {high}", place=name)
        if not 0.0 < self.rate <= 1.0:
            raise UsdfabError(f"got {self.rate}, expected a number above 0, up to 1", place="rate")
        for name, known in (
            ("passes", get_args(Passes)),
            ("backend", get_args(Backend)),
            ("steps", get_args(Steps)),
            ("noise", get_args(Noise)),
        ):
            if getattr(self, name) not in known:
                raise UsdfabError(
                    f"there is no '{getattr(self, name)}'", place=name, remedy=f"choose {' or '.join(known)}"
                )
        if not 0.0 < self.trust <= 2.0:
            raise UsdfabError(f"got {self.trust}, expected a number above 0, up to 2", place="trust")
        if self.steps == "model" and self.passes != "recycled":
            raise UsdfabError("model steps need recycled passes", place="steps", remedy="use adam")
        if self.backend == "mitsuba" and (self.passes != "separate" or self.keep != 1.0):
            raise UsdfabError(
                "Mitsuba gives no derivative of each pixel, and none with a fading drift",
                place="backend",
                remedy="use passes='separate', steps='adam' and keep=1",
            )

    @property
    def paths(self) -> float:
        """Millions of camera paths of all iterations for a square picture."""
        return 1e-6 * self.side**2 * (self.spp + self.gradient_spp) * self.iterations


QUALITIES: dict[Quality, PathSettings] = {
    "draft": PathSettings(side=96, iterations=20, spp=10, gradient_spp=6, rate=0.04),
    "standard": PathSettings(side=128, iterations=40, spp=24, gradient_spp=12),
    "paper": PathSettings(side=720, iterations=50, spp=1024, gradient_spp=256, passes="separate", steps="adam"),
}
"""Draft and standard take about 90 and 600 CPU seconds: 20 for a million paths, 1.6 and 3 for each step's sums."""


def settings_for(quality: Quality = "standard", **changes: object) -> PathSettings:
    """The settings of a quality, with changes; with ``backend="mitsuba"`` passes are separate.

    Raises
    ------
    UsdfabError
        For an unknown quality and settings out of range.
    """
    if quality not in QUALITIES:
        raise UsdfabError(f"there is no quality '{quality}'", remedy=f"choose {', '.join(QUALITIES)}")
    if changes.get("backend") == "mitsuba":
        changes = {"passes": "separate", "steps": "adam"} | changes
    return replace(QUALITIES[quality], **changes)  # type: ignore[arg-type]
