"""How near a fabric's path-traced picture comes to a photo, and the camera that brings it nearest.

All stages' results are judged by the same pictures, which have more samples than those that they were fitted by.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.fit.match_space import OF_THE_CAMERA, MatchSpace, level_of
from usdfab.imaging import denoise
from usdfab.imaging.lens import photographed
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.cached_tracer import render_cached
from usdfab.usd.rig import Rig, blur_in_pixels, contrast_of, rig_for, sample_scene

if TYPE_CHECKING:
    from torch import Tensor

    from usdfab.fit.features import FeatureNet
    from usdfab.fit.raster_stage import StageSettings

Singles = NDArray[np.float32]

PATHS_PER_PIXEL = 12
"""Of the pictures, before the denoiser, and of half as large ones from which their radiance cache learns. Undenoised,
noise that is clipped at white outweighs the fit: on white yarns the distance was 0.82 at 16 samples of whole paths and
0.68 at 64, 0.58 without noise."""

SETTLING = 40
"""Cameras that are tried for one picture, at most: the last ones gain little."""

SETTLING_STEPS = 1.5
"""How far from the first camera the search looks at once, in steps of ``match_space``."""


class Judge:
    """One photo, and how near pictures of fabrics come to it.

    Parameters
    ----------
    target: (H, W, 3)
        The photo, linear, upright, at the scale of ``settings``.
    settings:
        Width of the pictures, levels of the statistics, weights of the losses.
    net:
        Of the features, see ``features.load_features``.
    """

    def __init__(self, target: NDArray, settings: StageSettings, net: FeatureNet) -> None:
        from usdfab.fit.texture import Target

        self.settings = settings
        self.known = Target.from_image(_channels_first(target), net, settings.levels, settings.kind)

    def picture(self, fabric: FabricParameters, rig: Rig | None = None, seed: int = 0) -> Singles:
        """(H, W, 3) path-traced and denoised, under ``rig`` or the paper's, before any camera's exposure and lens."""
        from usdfab.fit.raster_stage import render_size

        return clear_picture(fabric, rig, render_size(fabric, self.settings.width), PATHS_PER_PIXEL, seed=seed)

    def distance(self, picture: NDArray, width: float, exposure: float = 1.0, rig: Rig | None = None) -> float:
        """Texture and colour loss of a picture that shows ``width`` metres, through the rig's camera."""
        import torch

        from usdfab.fit.texture import color_loss, texture_loss

        shown = through_camera(picture, rig, self.settings.width / width, exposure)
        with torch.inference_mode():
            image = _channels_first(shown)
            texture, color = texture_loss(image, self.known), color_loss(image, self.known)
            return float(self.settings.texture * texture + self.settings.color * color)

    def settled(
        self, picture: NDArray, fabric: FabricParameters, exposure: float, rig: Rig | None
    ) -> tuple[float, Rig | None, float]:
        """Exposure, and the rig with the blur and contrast, that bring a picture nearest; and how near that is.

        A stage found its camera by pictures of few samples, which are smoother than the cloth. A simplex search
        (Nelder and Mead 1965) about it needs no other picture.
        """
        from scipy.optimize import minimize

        width = fabric.size[0]
        blur, contrast = (rig.blur, rig.contrast) if rig else (0.0, 1.0)
        space = MatchSpace.about(fabric, OF_THE_CAMERA, exposure, blur, contrast, level_of(self.known))

        def camera(point: NDArray) -> tuple[float, Rig]:
            seen = replace(rig or rig_for(fabric.size), blur=space.blur_at(point), contrast=space.contrast_at(point))
            return space.exposure(point), seen

        def loss(point: NDArray) -> float:
            return self.distance(picture, width, *camera(point))

        here = np.zeros(len(space.names))
        before = loss(here)
        corners = np.vstack([here, SETTLING_STEPS * np.eye(len(here))])
        found = minimize(
            loss, here, method="Nelder-Mead", options={"initial_simplex": corners, "maxfev": SETTLING, "xatol": 0.02}
        )
        if not found.fun < before:
            return exposure, rig, before
        return *camera(found.x), float(found.fun)


def clear_picture(
    fabric: FabricParameters, rig: Rig | None, size: tuple[int, int], spp: int, learning: int | None = None,
    seed: int = 0,
) -> Singles:  # fmt: skip
    """(H, W, 3) picture of all of a fabric: paths end at a radiance cache, denoised. Sharp, exposure 1.

    Parameters
    ----------
    size:
        Pixels (W, H).
    spp, learning:
        Samples per pixel of the picture, and of the smaller one that its cache learns from (as many, if None).
    """
    scene = sample_scene(fabric, rig)
    settings = RenderSettings(size, spp=spp, seed=seed)
    render = render_cached(Tracer(scene), scene.cameras[0], settings, spp if learning is None else learning)
    return denoise(render.pixels, render.albedo, render.normal)


def through_camera(picture: NDArray, rig: Rig | None, pixels_per_meter: float, exposure: float = 1.0) -> NDArray:
    """A clear picture as the rig's camera shows it, times an exposure; the paper's rig, None, is sharp and linear."""
    return photographed(picture, blur_in_pixels(rig, pixels_per_meter), exposure, contrast_of(rig))


def _channels_first(picture: NDArray) -> Tensor:
    import torch

    return torch.from_numpy(np.ascontiguousarray(picture, dtype=np.float32)).permute(2, 0, 1)
