"""Which texture statistics tell fabrics apart best? ``usdfab evaluate losses FOLDER`` on photos of cloth.

Each photo's top left quarter is a target. A good loss is small for another quarter of the same photo, large for other
photos, also where their colours are made alike, rises when the other quarter is changed as a wrong parameter would
change it (scale, direction, contrast, sharpness), and hardly moves for what does not matter (a shift, noise).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.features import FeatureNet
from usdfab.fit.texture import LEVELS, Kind, Target, smallest_side, texture_loss
from usdfab.imaging.image_file import read_image

SIDE = 480
"""Pixels of the middle of a photo that are used."""

NEIGHBOURS = (1, 4, 7)
"""Each photo is compared with those so many places later in the folder."""

ZOOM, CONTRAST, NOISE = 1.15, 0.8, 0.2
SHIFT = (3, 5)


@dataclass(frozen=True)
class LossQuality:
    """What one kind of statistics makes of a folder of photos.

    Parameters
    ----------
    same, other, matched:
        Losses of another quarter of the same photo, of other photos, and of other photos with the target's mean and
        deviation of each colour channel.
    changed:
        For each change, the median over photos of the loss of the changed other quarter over that of the unchanged,
        the share of photos in which it is larger, and the median's logarithm in standard deviations of ln(same).
    shifted, noisy:
        Median losses of the target itself, shifted by a few pixels, and with noise of a fifth of each pixel's value.
    """

    kind: Kind
    same: tuple[float, ...]
    other: tuple[float, ...]
    matched: tuple[float, ...]
    changed: dict[str, tuple[float, float, float]]
    shifted: float
    noisy: float

    def summary(self) -> dict[str, object]:
        """For ``--json``: medians and the numbers of the table."""
        medians = {f"{name}_median": float(np.median(getattr(self, name))) for name in ("same", "other", "matched")}
        changed = {
            name: {"times": times, "share_rising": share, "deviations": d}
            for name, (times, share, d) in self.changed.items()
        }
        return (
            {"kind": self.kind}
            | medians
            | {
                "separation": self.separation,
                "probability_right": self.right,
                "shifted": self.shifted,
                "noisy": self.noisy,
                "changed": changed,
            }
        )

    @property
    def separation(self) -> float:
        """Distance of ln(loss) between other fabrics in the same colours and the same one, in standard deviations."""
        same, matched = np.log(self.same), np.log(self.matched)
        return float((matched.mean() - same.mean()) / np.sqrt(0.5 * (matched.var() + same.var())))

    @property
    def right(self) -> float:
        """Probability that another fabric in the same colours has a larger loss than another part of the fabric."""
        return float((np.array(self.matched)[:, None] > np.array(self.same)).mean())


def evaluate_losses(
    folder: str | Path,
    net: FeatureNet,
    kinds: Sequence[Kind] = get_args(Kind),
    levels: Sequence[int] = LEVELS,
    progress: Callable[[int, int], None] | None = None,
) -> list[LossQuality]:
    """Judge kinds of texture statistics on the PNG photos of ``folder``.

    Raises
    ------
    UsdfabError
        With fewer than two photos large enough.
    """
    paths = sorted(Path(folder).glob("*.png"))
    photos = [p for p in (_middle(path) for path in paths) if p.shape[-1] // 2 >= smallest_side(net, levels)]
    if len(photos) < 2:
        raise UsdfabError(
            f"{len(photos)} PNG photos are large enough", place=str(folder), remedy="name a folder with two or more"
        )
    with torch.no_grad():
        results = []
        for index, kind in enumerate(kinds):
            report = (
                None if progress is None else lambda i, n=index: progress(n * len(photos) + i, len(kinds) * len(photos))
            )
            results.append(_evaluate(photos, net, kind, levels, report))
    return results


def format_losses(results: Sequence[LossQuality]) -> str:
    """The table as text; each column a kind."""
    rows: list[tuple[str, Callable[[LossQuality], float]]] = [
        ("same photo, other part: median", lambda r: float(np.median(r.same))),
        ("same photo, other part: 90 %", lambda r: float(np.quantile(r.same, 0.9))),
        ("other photo: 10 %", lambda r: float(np.quantile(r.other, 0.1))),
        ("other photo: median", lambda r: float(np.median(r.other))),
        ("other photo, same colours: 10 %", lambda r: float(np.quantile(r.matched, 0.1))),
        ("other photo, same colours: median", lambda r: float(np.median(r.matched))),
        ("  separation, standard deviations", lambda r: r.separation),
        ("  probability of telling right", lambda r: r.right),
        ("target shifted by a few pixels", lambda r: r.shifted),
        ("target with 20 % noise", lambda r: r.noisy),
    ]
    for name in results[0].changed:
        rows.append((f"other part, {name}: times", lambda r, name=name: r.changed[name][0]))  # type: ignore[misc]
        rows.append(("  in standard deviations of same photo", lambda r, name=name: r.changed[name][2]))  # type: ignore[misc]
        rows.append(("  share of photos in which it rises", lambda r, name=name: r.changed[name][1]))  # type: ignore[misc]
    lines = [f"{'':<40}" + "".join(f"{r.kind:>12}" for r in results)]
    return "\n".join(lines + [f"{label:<40}" + "".join(f"{value(r):12.3f}" for r in results) for label, value in rows])


def _evaluate(
    photos: list[Tensor], net: FeatureNet, kind: Kind, levels: Sequence[int], report: Callable[[int], None] | None
) -> LossQuality:
    noise = torch.Generator().manual_seed(0)
    same, other, matched, shifted, noisy = [], [], [], [], []
    changed: dict[str, list[float]] = {}
    for i, photo in enumerate(photos):
        half = photo.shape[-1] // 2
        corner, opposite = photo[..., :half, :half], photo[..., half:, half:]
        target = Target.from_image(corner, net, levels, kind)
        same.append(_loss(opposite, target))
        for name, change in _CHANGES.items():
            changed.setdefault(name, []).append(_loss(change(opposite), target) / same[-1])
        down, right = SHIFT
        shifted.append(_loss(photo[..., down : down + half, right : right + half], target))
        grain = 1.0 + NOISE * torch.randn(corner.shape, generator=noise)
        noisy.append(_loss((corner * grain).clamp(min=0.0), target))
        for j in sorted({(i + step) % len(photos) for step in NEIGHBOURS} - {i}):
            side = photos[j].shape[-1] // 2
            stranger = photos[j][..., :side, :side]
            other.append(_loss(stranger, target))
            matched.append(_loss(_with_colors_of(stranger, corner), target))
        if report:
            report(i + 1)
    spread = max(float(np.log(same).std()), 1e-9)
    ratios = {}
    for name, values in changed.items():
        times = float(np.median(values))
        ratios[name] = (times, float(np.mean(np.array(values) > 1.0)), float(np.log(times)) / spread)
    medians = float(np.median(shifted)), float(np.median(noisy))
    return LossQuality(kind, tuple(same), tuple(other), tuple(matched), ratios, *medians)


def _loss(image: Tensor, target: Target) -> float:
    return float(texture_loss(image, target))


def _middle(path: Path) -> Tensor:
    pixels = np.ascontiguousarray(read_image(path).pixels[..., :3].transpose(2, 0, 1), dtype=np.float32)
    height, width = pixels.shape[1:]
    side = min(height, width, SIDE)
    top, left = (height - side) // 2, (width - side) // 2
    return torch.from_numpy(pixels[None, :, top : top + side, left : left + side])


def _with_colors_of(image: Tensor, other: Tensor) -> Tensor:
    mean, deviation = image.mean(dim=(2, 3), keepdim=True), image.std(dim=(2, 3), keepdim=True)
    wanted, spread = other.mean(dim=(2, 3), keepdim=True), other.std(dim=(2, 3), keepdim=True)
    return ((image - mean) / deviation.clamp(min=1e-6) * spread + wanted).clamp(min=0.0)


def _zoomed(image: Tensor) -> Tensor:
    side = round(image.shape[-1] / ZOOM)
    return F.interpolate(image[..., :side, :side], image.shape[2:], mode="bicubic").clamp(min=0.0)


def _flattened(image: Tensor) -> Tensor:
    mean = image.mean(dim=(2, 3), keepdim=True)
    return mean + CONTRAST * (image - mean)


def _softened(image: Tensor) -> Tensor:
    return F.avg_pool2d(image, 5, stride=1, padding=2, count_include_pad=False)


_CHANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "enlarged by 15 %": _zoomed,
    "turned by 90 degrees": lambda image: image.transpose(2, 3),
    "contrast less 20 %": _flattened,
    "softened over 5 pixels": _softened,
    "darker by 20 %": lambda image: 0.8 * image,
}
