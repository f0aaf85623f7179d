"""How alike two textures are: statistics of feature maps at several scales (Li et al. 2024, eq. 12; Gatys et al. 2015).

Statistics do not know where things are, so a render need not lie on the photo yarn by yarn; and they are means over
pixels, so the two may differ in size. Their scale must agree: the same number of pixels to a metre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.features import FeatureNet

LEVELS = (2, 4, 8)
"""By how much images are reduced before their features are computed (Li et al. 2024, eq. 12)."""

Kind = Literal["gram", "covariance"]
DEFAULT_KIND: Kind = "covariance"
"""``usdfab evaluate losses`` on 15 photos: cloths made equal in colour lie 3.9 deviations apart, with ``gram`` 3.6, and
a changed scale, direction or contrast stands out more from the chance of which part of the cloth is seen (softness and
brightness a little less: the colour loss sees brightness)."""

SCALE_TOLERANCE = 0.01
"""Relative difference up to which two scales in pixels per metre are the same."""

ROLL_OFF = 0.1
"""Slope with which light above 1, where photos are clipped, begins to count: little, but so that gradients remain."""


@dataclass(frozen=True, eq=False)
class Target:
    """What a photo's texture is, computed once; renders are compared with it.

    Parameters
    ----------
    net:
        The network that saw it; renders are shown to the same.
    levels, kind:
        As in :meth:`from_image`.
    statistics:
        Of each level and tap: for ``gram`` the Gram matrix (1, C, C), for ``covariance`` the mean (1, C) and the
        covariance matrix (1, C, C).
    scales:
        Of each statistic: the mean of its absolute values, by which differences are divided.
    mean_color:
        (3,), linear Rec. 709, light above 1 rolled off.
    size:
        (height, width) in pixels.
    pixels_per_meter:
        Scale of the photo; ``None`` where it is not known.
    """

    net: FeatureNet
    levels: tuple[int, ...]
    kind: Kind
    statistics: tuple[Tensor, ...]
    scales: tuple[Tensor, ...]
    mean_color: Tensor
    size: tuple[int, int]
    pixels_per_meter: float | None = None

    @classmethod
    def from_image(
        cls,
        image: Tensor,
        net: FeatureNet,
        levels: Sequence[int] = LEVELS,
        kind: Kind = DEFAULT_KIND,
        pixels_per_meter: float | None = None,
    ) -> Target:
        """The statistics of a photo.

        Parameters
        ----------
        image:
            (3, H, W) or (1, 3, H, W), linear Rec. 709, the exposure applied.
        levels:
            By how much the image is reduced, antialiased by area, before its features are computed.
        kind:
            ``gram``: Gram matrices, as the paper; ``covariance``: means and covariances, each divided by its size.

        Raises
        ------
        UsdfabError
            If the image is smaller than the coarsest level needs, holds numbers that are not finite, or is no image.
        """
        levels = tuple(levels)
        if kind not in ("gram", "covariance"):
            raise UsdfabError(f"'{kind}' is no kind of texture statistics", remedy="choose gram or covariance")
        if not levels or any(level < 1 or level != int(level) for level in levels):
            raise UsdfabError(f"{levels} are no levels", remedy="give whole numbers such as (2, 4, 8)")
        with torch.no_grad():
            image = _checked(image, net, levels, "the target")
            if len(image) != 1:
                raise UsdfabError(f"the target is {len(image)} images", remedy="make a target of each")
            statistics = tuple(texture_statistics(image, net, levels, kind))
            return cls(
                net,
                levels,
                kind,
                statistics,
                tuple(_scale(statistic, statistics, i, kind) for i, statistic in enumerate(statistics)),
                rolled_off(image).mean(dim=(0, 2, 3)),
                (image.shape[2], image.shape[3]),
                pixels_per_meter,
            )


def texture_loss(render: Tensor, target: Target, pixels_per_meter: float | None = None) -> Tensor:
    """How far a render's texture is from the target's: 0 for the same image, about 1 for another fabric.

    The mean over levels, taps and statistics of the mean absolute difference (L1), each divided by the target's mean
    absolute value, so that each layer counts alike whatever the size of its numbers.

    Parameters
    ----------
    render:
        (3, H, W) or (B, 3, H, W), linear Rec. 709, the exposure applied. The size may differ from the target's.
    pixels_per_meter:
        Scale of the render; checked against the target's where both are known.

    Returns
    -------
    loss:
        A scalar, the mean over the batch; differentiable.

    Raises
    ------
    UsdfabError
        If the render is too small, at another scale, or holds numbers that are not finite.
    """
    if pixels_per_meter is not None and target.pixels_per_meter is not None:
        ratio = pixels_per_meter / target.pixels_per_meter
        if not abs(ratio - 1.0) <= SCALE_TOLERANCE:
            raise UsdfabError(
                f"the render has {pixels_per_meter:.6g} pixels per metre, the target {target.pixels_per_meter:.6g}",
                remedy="textures can only be compared at the same scale",
            )
    image = _checked(render, target.net, target.levels, "the render")
    found = texture_statistics(image, target.net, target.levels, target.kind)
    terms = [(a - b).abs().mean() / scale for a, b, scale in zip(found, target.statistics, target.scales, strict=True)]
    return torch.stack(terms).mean()


def color_loss(render: Tensor, target: Target) -> Tensor:
    """Mean absolute difference (L1) of the mean colours, relative to the target's mean (Li et al. 2024, eq. 13).

    Linear light; divided by the target's mean over the channels, so that dark cloth counts as much as bright cloth.
    """
    image = rolled_off(render if render.ndim == 4 else render[None])
    mean = target.mean_color
    return (image.mean(dim=(2, 3)) - mean.to(image)).abs().mean() / mean.mean().clamp(min=1e-3).to(image)


def residuals(render: Tensor, target: Target) -> Tensor:
    """(R,) what ``texture_loss`` and ``color_loss`` are means of absolute values of, each off-diagonal pair once.

    Differences of the statistics over the target's mean entry, then of the mean colours over the target's mean.

    Parameters
    ----------
    render:
        (3, H, W), as for ``texture_loss``.
    """
    image = _checked(render, target.net, target.levels, "the render")
    found = texture_statistics(image, target.net, target.levels, target.kind)
    parts = []
    for ours, theirs, scale in zip(found, target.statistics, target.scales, strict=True):
        difference = ((ours - theirs) / scale)[0]
        parts.append(difference[_upper(difference)] if difference.ndim == 2 else difference)
    mean = target.mean_color.to(image)
    parts.append((rolled_off(image).mean(dim=(0, 2, 3)) - mean) / mean.mean().clamp(min=1e-3))
    return torch.cat([part.float() for part in parts])


def residual_weights(target: Target, texture: float = 1.0, color: float = 1.0) -> Tensor:
    """(R,) weights with which the absolute values of ``residuals`` add up to the weighted sum of the two losses."""
    parts = []
    for statistic in target.statistics:
        entries = statistic[0]
        shares = entries.new_full(entries.shape, texture / (entries.numel() * len(target.statistics)))
        if entries.ndim == 2:
            # A pair off the diagonal stands for two entries.
            shares = (2.0 * shares - shares.diagonal().diag())[_upper(entries)]
        parts.append(shares.float())
    return torch.cat([*parts, target.mean_color.new_full((3,), color / 3.0).float()])


def _upper(matrix: Tensor) -> tuple[Tensor, ...]:
    return tuple(torch.triu_indices(*matrix.shape))


def texture_statistics(image: Tensor, net: FeatureNet, levels: Sequence[int], kind: Kind) -> list[Tensor]:
    """Statistics of (B, 3, H, W) linear images: for each level, for each tap, Gram or mean and covariance matrices."""
    result: list[Tensor] = []
    light = rolled_off(image)
    for level in levels:
        for maps in net(reduced(light, level)):
            result += [gram_matrix(maps)] if kind == "gram" else mean_and_covariance(maps)
    return result


def gram_matrix(maps: Tensor) -> Tensor:
    """(B, C, C) mean products of channels over the pixels of (B, C, h, w) maps; float32 at least."""
    features = _columns(maps)
    return features.transpose(1, 2) @ features / features.shape[1]


def mean_and_covariance(maps: Tensor) -> list[Tensor]:
    """Means (B, C) and covariances (B, C, C) of the channels over the pixels of (B, C, h, w) maps; float32 at least."""
    features = _columns(maps)
    mean = features.mean(dim=1, keepdim=True)
    centered = features - mean
    return [mean[:, 0], centered.transpose(1, 2) @ centered / features.shape[1]]


def reduced(image: Tensor, level: int) -> Tensor:
    """(B, 3, H, W) averaged over blocks of ``level`` pixels; what is left at the right and lower side is dropped."""
    return image if level == 1 else F.avg_pool2d(image, level)


def rolled_off(linear: Tensor) -> Tensor:
    """Linear light with what exceeds 1 compressed to ``1 + ROLL_OFF ln x``: photos clip there, gradients must live."""
    return torch.where(linear > 1.0, 1.0 + ROLL_OFF * linear.clamp(min=1.0).log(), linear)


def smallest_side(net: FeatureNet, levels: Sequence[int]) -> int:
    """Pixels that an image needs along each side."""
    return max(levels) * net.reduction


def _columns(maps: Tensor) -> Tensor:
    # A view where the maps lie channels last.
    columns = maps.permute(0, 2, 3, 1).flatten(1, 2)
    return columns if columns.dtype == torch.float64 else columns.float()


def _scale(statistic: Tensor, statistics: Sequence[Tensor], index: int, kind: Kind) -> Tensor:
    scale = statistic.abs().mean()
    if kind == "covariance" and index % 2:
        # A plain surface has no covariance: then a thousandth of the squared mean is the measure.
        scale = scale + 1e-3 * statistics[index - 1].square().mean()
    return scale.clamp(min=torch.finfo(torch.float32).tiny)


def _checked(image: Tensor, net: FeatureNet, levels: Sequence[int], what: str) -> Tensor:
    batch = image[None] if image.ndim == 3 else image
    if batch.ndim != 4 or batch.shape[1] != 3 or not batch.is_floating_point():
        raise UsdfabError(f"{what} is no RGB image (3, height, width) but has the shape {tuple(image.shape)}")
    height, width = batch.shape[2:]
    needed = smallest_side(net, levels)
    if min(height, width) < needed:
        raise UsdfabError(
            f"{what} has {width} x {height} pixels, too few to be reduced by {max(levels)}",
            remedy=f"at least {needed} x {needed} are needed",
        )
    if not batch.isfinite().all():
        raise UsdfabError(f"{what} holds numbers that are not finite")
    return batch
