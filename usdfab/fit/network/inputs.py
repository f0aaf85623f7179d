"""From a picture to the numbers that the network takes: Gram statistics of VGG features, and spectra.

Full Gram matrices of four layers hold 175,000 different numbers. Here the channels of each layer are first reduced to
``COMPONENTS`` whitened ones (principal components over some of the pictures that the network learns from), whose means
and covariances then are ``texture_size`` numbers; the raw Gram matrix of the same components follows from them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from usdfab.errors import UsdfabError
from usdfab.fit.features import FeatureNet, load_features

SIZE = 256
"""Pixels on a side of the pictures that are looked at."""

LEVELS = (1, 2, 4)
"""By how much they are reduced, one after the other, for the features."""

COMPONENTS = 24
"""Of each layer's channels."""

BRIGHTNESS = 0.2
"""Mean luminance that pictures are brought to: their exposure is not known anyway."""

LEAST_PIXELS = 32

LUMINANCE = (0.2126, 0.7152, 0.0722)
REVISION = 1
"""Raised whenever the same picture gives other numbers."""


@dataclass(frozen=True, eq=False)
class Basis:
    """What the channels of each layer are reduced to.

    ``mean`` (C,) and ``directions`` (C, q) for each tap: whitened components are ``(channels - mean) @ directions``.
    """

    mean: tuple[Tensor, ...]
    directions: tuple[Tensor, ...]

    @property
    def texture_size(self) -> int:
        """Numbers that :func:`texture_vectors` gives for one picture."""
        return len(LEVELS) * sum(q + q * (q + 1) // 2 for q in (d.shape[1] for d in self.directions))

    def tensors(self) -> dict[str, Tensor]:
        """For a file, by name."""
        named = {f"basis.{k}.mean": m for k, m in enumerate(self.mean)}
        return named | {f"basis.{k}.directions": d for k, d in enumerate(self.directions)}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> Basis:
        """The inverse of :meth:`tensors`; raises ``KeyError`` where one is missing."""
        count = sum(name.startswith("basis.") for name in tensors) // 2
        if not count:
            raise KeyError("basis.0.mean")
        return cls(
            tuple(tensors[f"basis.{k}.mean"].float() for k in range(count)),
            tuple(tensors[f"basis.{k}.directions"].float() for k in range(count)),
        )

    def checksum(self) -> str:
        """Of what texture vectors depend on."""
        digest = hashlib.sha256(repr((SIZE, LEVELS, BRIGHTNESS, REVISION)).encode())
        for tensor in (*self.mean, *self.directions):
            digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()[:16]


def feature_net(dtype: torch.dtype = torch.float32, device: str = "cpu") -> FeatureNet:
    """The shipped VGG-16, with maximum pooling: as it was trained."""
    return load_features(dtype=dtype, device=device, pooling="maximum")


def prepared(linear: NDArray) -> NDArray[np.float32]:
    """The middle square of a linear picture (H, W, 3), (SIZE, SIZE, 3), antialiased, exposed to ``BRIGHTNESS``.

    Raises
    ------
    UsdfabError
        For what is no picture, is too small, or holds no light.
    """
    pixels = np.asarray(linear, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise UsdfabError(f"expected an RGB picture (H, W, 3), got an array of shape {pixels.shape}")
    side = min(pixels.shape[:2])
    if side < LEAST_PIXELS:
        raise UsdfabError(f"{pixels.shape[1]} x {pixels.shape[0]} pixels are too few", remedy="give at least 32 x 32")
    if not np.isfinite(pixels).all():
        raise UsdfabError("the picture holds numbers that are not finite")
    top, left = ((n - side) // 2 for n in pixels.shape[:2])
    square = np.ascontiguousarray(pixels[top : top + side, left : left + side])
    if side != SIZE:
        tensor = torch.from_numpy(square).permute(2, 0, 1)[None]
        tensor = F.interpolate(tensor, (SIZE, SIZE), mode="bicubic", antialias=True, align_corners=False)
        square = tensor[0].permute(1, 2, 0).numpy()
    square = np.clip(square, 0.0, None)
    mean = float((square @ np.asarray(LUMINANCE, dtype=np.float32)).mean())
    if not mean > 1e-6:
        raise UsdfabError("the picture is black", remedy="check its exposure")
    return np.ascontiguousarray(square * np.float32(BRIGHTNESS / mean))


def fitted_basis(net: FeatureNet, pictures: Sequence[NDArray[np.float32]]) -> Basis:
    """The basis of a set of prepared pictures: principal components of the channels over their pixels and levels."""
    count = [0] * len(net.channels)
    first = [torch.zeros(c, dtype=torch.float64) for c in net.channels]
    second = [torch.zeros(c, c, dtype=torch.float64) for c in net.channels]
    with torch.no_grad():
        for picture in pictures:
            for maps in _maps(net, picture[None]):
                for k, tap in enumerate(maps):
                    x = tap.permute(0, 2, 3, 1).reshape(-1, tap.shape[1]).double()
                    count[k] += len(x)
                    first[k] += x.sum(dim=0)
                    second[k] += x.T @ x
    means, directions = [], []
    for n, total, squares in zip(count, first, second, strict=True):
        mean = total / n
        variances, vectors = torch.linalg.eigh(squares / n - mean[:, None] * mean)
        q = min(COMPONENTS, len(mean))
        variances, vectors = variances.flip(0)[:q], vectors.flip(1)[:, :q]
        # Eigenvectors come with either sign.
        vectors = vectors * torch.sign(vectors.gather(0, vectors.abs().argmax(dim=0, keepdim=True)))
        means.append(mean.float())
        whitened = vectors / variances.clamp(min=1e-9 * float(variances[0])).sqrt()
        # As weights files keep them: what was trained on and what is used later must be the same numbers.
        directions.append(whitened.half().float())
    return Basis(tuple(means), tuple(directions))


def texture_vectors(net: FeatureNet, basis: Basis, pictures: NDArray[np.float32]) -> NDArray[np.float32]:
    """(B, texture_size) of prepared pictures (B, SIZE, SIZE, 3).

    For each level and tap the means of the components and the upper triangle of their covariances.
    """
    parts = []
    with torch.no_grad():
        for maps in _maps(net, pictures):
            for tap, mean, directions in zip(maps, basis.mean, basis.directions, strict=True):
                x = (tap.permute(0, 2, 3, 1).flatten(1, 2).float() - mean) @ directions
                middle = x.mean(dim=1, keepdim=True)
                covariance = (x - middle).transpose(1, 2) @ (x - middle) / x.shape[1]
                rows, columns = torch.triu_indices(x.shape[2], x.shape[2])
                parts += [middle[:, 0], covariance[:, rows, columns]]
    return torch.cat(parts, dim=1).numpy()


def even(texture: Tensor, components: Sequence[int]) -> Tensor:
    """Texture vectors (B, D) with covariances as log deviations and correlations: numbers of one size each."""
    parts = []
    for mean, covariance, q in split(texture, components):
        deviation = covariance.diagonal(dim1=1, dim2=2).clamp(min=1e-6).sqrt()
        rows, columns = torch.triu_indices(q, q, offset=1)
        correlation = (covariance / (deviation[:, :, None] * deviation[:, None, :]))[:, rows, columns]
        parts += [mean, deviation.log(), correlation]
    return torch.cat(parts, dim=1)


def gram(texture: Tensor, components: Sequence[int]) -> Tensor:
    """Texture vectors (B, D) as the upper triangles of raw Gram matrices, mean products, as in Li et al. 2024."""
    parts = []
    for mean, covariance, q in split(texture, components):
        rows, columns = torch.triu_indices(q, q)
        parts.append((covariance + mean[:, :, None] * mean[:, None, :])[:, rows, columns])
    return torch.cat(parts, dim=1)


def split(texture: Tensor, components: Sequence[int]) -> list[tuple[Tensor, Tensor, int]]:
    """For each level and tap of texture vectors (B, D): means (B, q), whole covariances (B, q, q), q."""
    wanted = sum(q + q * (q + 1) // 2 for q in components)
    if texture.shape[1] != wanted:
        raise UsdfabError(f"texture vectors have {texture.shape[1]} numbers, not {wanted}")
    found, at = [], 0
    for q in components:
        rows, columns = torch.triu_indices(q, q)
        mean, upper = texture[:, at : at + q], texture[:, at + q : at + q + len(rows)]
        covariance = texture.new_zeros(len(texture), q, q)
        covariance[:, rows, columns] = upper
        covariance[:, columns, rows] = upper
        found.append((mean, covariance, q))
        at += q + len(rows)
    return found


def _maps(net: FeatureNet, pictures: NDArray[np.float32]) -> list[list[Tensor]]:
    """Feature maps of (B, H, W, 3) pictures at each level."""
    image = torch.from_numpy(np.ascontiguousarray(pictures)).permute(0, 3, 1, 2)
    return [net(image if level == 1 else F.avg_pool2d(image, level)) for level in LEVELS]
