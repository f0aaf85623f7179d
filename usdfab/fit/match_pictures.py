"""Pictures of fabrics for the match stage, and how their texture differs from the photo's."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.imaging import denoise
from usdfab.imaging.lens import photographed
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.cached_tracer import LEARNED_FROM, CachedTracer, render_cached
from usdfab.tracer.checkpoint import fingerprint
from usdfab.tracer.patch_scene import PatchScene, build_tiles, redyed
from usdfab.tracer.render import Render
from usdfab.usd.rig import Rig, sample_scene
from usdfab.usd.scene import Camera

if TYPE_CHECKING:
    from usdfab.fit.texture import Target

Singles = NDArray[np.float32]

MOST_SPP = 32
"""Samples per pixel beyond which ``spend`` buys no more."""

LEARNING = 0.35
"""Share of the rays that a radiance cache learns from."""

VARIED_CELLS = 16
"""Crossings of all variants of the repeat together beyond which pictures show fewer variants."""

KEPT = 16
"""Latest pictures that are kept: some looks differ only in what the camera does."""


class MatchPictures:
    """Pictures of fabrics, and how their statistics differ from the target's.

    There are two kinds. What the denoiser makes of a few whole paths is smoother than the cloth: bright satin came as
    near as 0.35 to its photo in 6 samples, and was 0.55 away in 400. Paths that end at a radiance cache say 0.55 for
    the price of the 6 samples. But caches that learned from two fabrics differ by more than the fabrics; whole paths of
    the same random draws do not. So pictures are of the first kind, and ``sketch`` gives the other, for differences.

    Parameters
    ----------
    target:
        Statistics of the photo.
    width, spp, seed:
        Pixels along x, samples per pixel of whole paths before the denoiser, and seed of the renders.
    later_scale:
        Least scale of azimuthal lobes after the first bounce, rad, see ``Tracer``; None: as they are.
    """

    def __init__(self, target: Target, width: int, spp: int, seed: int, later_scale: float | None = None) -> None:
        self.target, self.width, self.spp, self.seed = target, width, spp, seed
        self.later_scale, self.cached_spp, self.learning = later_scale, spp, spp
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
        self._kept: dict[str, Singles] = {}
        self._built: tuple[FabricParameters, list[PatchScene]] | None = None

    @staticmethod
    def _upper(statistics: tuple) -> list[tuple[NDArray, NDArray]]:
        return [np.triu_indices(s.shape[-1]) if s.ndim == 3 else (np.arange(s.shape[-1]),) * 2 for s in statistics]

    def spend(self, rays: float, fabric: FabricParameters, rig: Rig | None) -> None:
        """Raise the samples of both kinds to what so many rays a pixel pay for: paths end soon in dark cloth.

        Deterministic: the rays of small pictures of the fabric are counted.
        """
        tracer, camera = self._tracer(fabric, rig)
        probe = self._settings(fabric, max(16, self.width // 6), 2)
        each = _rays_per_sample(tracer.render(camera, probe))
        self.spp = max(self.spp, min(int(rays / each), MOST_SPP))
        self.learning = max(self.learning, min(int(LEARNING * rays * LEARNED_FROM**2 / each), MOST_SPP))
        each = _rays_per_sample(CachedTracer(tracer, camera, probe).render(camera, probe))
        self.cached_spp = max(self.cached_spp, min(int((1.0 - LEARNING) * rays / each), MOST_SPP))

    def picture(self, fabric: FabricParameters, rig: Rig | None) -> Singles:
        """(H, W, 3) linear, denoised, at exposure 1, not through the rig's camera; paths end at a radiance cache."""

        def render(tracer: Tracer, camera: Camera) -> Render:
            return render_cached(tracer, camera, self._settings(fabric, self.width, self.cached_spp), self.learning)

        return self._kept_or(render, fabric, rig, (self.cached_spp, self.learning))

    def sketch(self, fabric: FabricParameters, rig: Rig | None) -> Singles:
        """As ``picture``, of whole paths: smoother than the cloth, but fit to be compared with another."""

        def render(tracer: Tracer, camera: Camera) -> Render:
            return tracer.render(camera, self._settings(fabric, self.width, self.spp))

        return self._kept_or(render, fabric, rig, (self.spp,))

    def _kept_or(
        self, render: Callable[[Tracer, Camera], Render], fabric: FabricParameters, rig: Rig | None,
        spp: tuple[int, ...],
    ) -> Singles:  # fmt: skip
        sharp = replace(rig, blur=0.0, contrast=1.0) if rig else None
        key = fingerprint(fabric, sharp, self.seed, spp)
        if key not in self._kept:
            seen = render(*self._tracer(fabric, sharp))
            self._kept[key] = denoise(seen.pixels, seen.albedo, seen.normal)
            while len(self._kept) > KEPT:
                del self._kept[next(iter(self._kept))]
        return self._kept[key]

    def _tracer(self, fabric: FabricParameters, rig: Rig | None) -> tuple[Tracer, Camera]:
        repeat = math.prod(fabric.repeat())
        # Statistics need only so many different crossings; each is fibers to build and to keep.
        fewer = replace(fabric, variants=max(1, min(fabric.variants, VARIED_CELLS // repeat)))
        scene = sample_scene(fewer, rig)
        return Tracer(scene, later_scale=self.later_scale, build=self._tiles), scene.cameras[0]

    def _tiles(self, fabric: FabricParameters) -> list[PatchScene]:
        """The fabric's tiles; where only its optics have changed, the same fibers as the last time."""
        tiles = redyed(self._built[1], self._built[0], fabric) if self._built else None
        self._built = fabric, tiles or build_tiles(fabric)
        return self._built[1]

    def _settings(self, fabric: FabricParameters, width: int, spp: int) -> RenderSettings:
        size = (width, max(1, round(width * fabric.size[1] / fabric.size[0])))
        return RenderSettings(size, spp=spp, seed=self.seed)

    def residuals(self, picture: Singles, exposure: float, blur: float = 0.0, contrast: float = 1.0) -> Singles:
        """What differs at an exposure, through a camera of a blur, given in pixels, and a contrast (``imaging.lens``).

        (R,) differences of the statistics from the target's, each matrix in units of the target's mean entry, and of
        the mean colours, in units of the mean over the target's channels."""
        import torch

        from usdfab.fit.texture import rolled_off, texture_statistics

        target = self.target
        seen = photographed(picture, blur, exposure, contrast)
        with torch.inference_mode():
            image = torch.from_numpy(seen).permute(2, 0, 1)[None]
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


def _rays_per_sample(render: Render) -> float:
    return max(render.rays / max(float(render.samples.sum()), 1.0), 1.0)
