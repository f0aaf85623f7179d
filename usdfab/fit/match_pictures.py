"""Pictures of fabrics for the match stage, and how their texture differs from the photo's."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.imaging import denoise
from usdfab.imaging.lens import photographed
from usdfab.tracer import Render, RenderSettings, Tracer
from usdfab.usd.rig import Rig, sample_scene

if TYPE_CHECKING:
    from usdfab.fit.texture import Target

Singles = NDArray[np.float32]

MOST_SPP = 32
"""Samples per pixel beyond which ``spend`` buys no more."""

VARIED_CELLS = 16
"""Crossings of all variants of the repeat together beyond which pictures show fewer variants."""


class MatchPictures:
    """Pictures of fabrics, and how their statistics differ from the target's.

    Parameters
    ----------
    target:
        Statistics of the photo.
    width, spp, seed:
        Pixels along x, samples per pixel before the denoiser, and seed of the renders.
    later_scale:
        Least scale of azimuthal lobes after the first bounce, rad, see ``Tracer``; None: as they are.
    """

    def __init__(self, target: Target, width: int, spp: int, seed: int, later_scale: float | None = None) -> None:
        self.target, self.width, self.spp, self.seed = target, width, spp, seed
        self.later_scale = later_scale
        weights = []
        for statistic, upper in zip(target.statistics, self._upper(target.statistics), strict=True):
            # Symmetric matrices: each pair off the diagonal stands for two entries.
            shares = np.full(len(upper[0]), 2.0, dtype=np.float32)
            shares[upper[0] == upper[1]] = 1.0
            weights.append(shares / np.float32(statistic[0].numel() * len(target.statistics)))
        # The mean colour counts as much as all the texture, as in Li et al. 2024, 7.2.
        weights.append(np.full(3, 1.0 / 3.0, dtype=np.float32))
        self.weights: Singles = np.concatenate(weights)
        self.mean = target.mean_color.float().reshape(3).numpy()

    @staticmethod
    def _upper(statistics: tuple) -> list[tuple[NDArray, NDArray]]:
        return [np.triu_indices(s.shape[-1]) if s.ndim == 3 else (np.arange(s.shape[-1]),) * 2 for s in statistics]

    def spend(self, rays: float, fabric: FabricParameters, rig: Rig | None) -> None:
        """Raise ``spp`` to what so many rays a pixel pay for: paths end soon in dark cloth.

        Deterministic: the rays of a small picture of the fabric are counted.
        """
        probe = self._render(fabric, rig, max(16, self.width // 6), 2)
        each = probe.rays / max(float(probe.samples.sum()), 1.0)
        self.spp = max(self.spp, min(int(rays / max(each, 1.0)), MOST_SPP))

    def picture(self, fabric: FabricParameters, rig: Rig | None) -> Singles:
        """(H, W, 3) linear, denoised, at exposure 1."""
        render = self._render(fabric, rig, self.width, self.spp)
        return denoise(render.pixels, render.albedo, render.normal)

    def _render(self, fabric: FabricParameters, rig: Rig | None, width: int, spp: int) -> Render:
        repeat = math.prod(fabric.repeat())
        # Statistics need only so many different crossings; each is fibers to build and to keep.
        fewer = replace(fabric, variants=max(1, min(fabric.variants, VARIED_CELLS // repeat)))
        scene = sample_scene(fewer, rig)
        size = (width, max(1, round(width * fabric.size[1] / fabric.size[0])))
        tracer = Tracer(scene, later_scale=self.later_scale)
        return tracer.render(scene.cameras[0], RenderSettings(size, spp=spp, seed=self.seed))

    def residuals(self, picture: Singles, exposure: float, blur: float = 0.0) -> Singles:
        """What differs at an exposure, through a camera whose blur is given in pixels (``imaging.lens``).

        (R,) differences of the statistics from the target's, each matrix in units of the target's mean entry, and of
        the mean colours, in units of the mean over the target's channels."""
        import torch

        from usdfab.fit.texture import rolled_off, texture_statistics

        target = self.target
        seen = photographed(picture, blur)
        with torch.inference_mode():
            image = torch.from_numpy(np.float32(exposure) * seen).permute(2, 0, 1)[None]
            found = texture_statistics(image, target.net, target.levels, target.kind)
            parts = []
            for ours, theirs, scale, upper in zip(
                found, target.statistics, target.scales, self._upper(target.statistics), strict=True
            ):
                difference = ((ours - theirs) / scale)[0].numpy()
                parts.append(difference[upper] if difference.ndim == 2 else difference)
            color = rolled_off(image).mean(dim=(0, 2, 3)).numpy() - self.mean
            parts.append(color / max(float(self.mean.mean()), 1e-3))
        return np.concatenate(parts).astype(np.float32)
