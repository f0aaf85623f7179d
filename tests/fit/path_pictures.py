"""A renderer of stripes and checks with exact derivatives: what the loop of stage 3 can be checked with in no time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.fabric.optics import optics_of

SIDE = 32


def cloth(warp=(0.6, 0.3, 0.2), weft=(0.2, 0.5, 0.6), **changes) -> FabricParameters:
    """Plain cloth, 5 mm, of few rough fibers."""
    values = {
        "count": 6, "radius": 3.6e-4, "fiber_count": 10, "roughness_longitudinal": 0.5, "roughness_azimuthal": 0.25,
        "roughness_primary": 0.3, "irregularity": 0.1,
    }  # fmt: skip
    yarn = YarnParameters(**(values | changes))
    return FabricParameters(
        weave_from_name("plain"), (5e-3, 5e-3), replace(yarn, albedo=warp), replace(yarn, albedo=weft), variants=1
    )


class Stripes:
    """Pixel = albedo of its system, squared as light that scatters twice, with waves as high as gamma_M.

    ``noise`` is the standard deviation of one sample relative to the pixel; ``broken`` holds the numbers of calls that
    give no numbers.
    """

    def __init__(self, fabric: FabricParameters, noise: float = 0.0, side: int = SIDE, broken=()) -> None:
        self.optics = optics_of(fabric)
        self.size = (side, side)
        self.noise, self.broken, self.calls = noise, set(broken), 0
        y, x = (np.mgrid[:side, :side] + 0.5) / side
        self.warp = (np.sin(8 * np.pi * x) * np.sin(8 * np.pi * y) > 0).astype(float)
        self.across = [np.sin(4 * np.pi * x) ** 2, np.sin(4 * np.pi * y) ** 2]

    def exact(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The picture (H, W, 3) and its derivatives (P, H, W, 3) without noise."""
        side = self.size[0]
        image, slopes = np.zeros((side, side, 3)), np.zeros((len(vector), side, side, 3))
        for system, mask in enumerate((self.warp, 1.0 - self.warp)):
            color, width = vector[3 * system : 3 * system + 3], vector[6 + 3 * system]
            wave = 1.0 - 2.0 * self.across[system]
            part = (mask * (1.0 + width * wave))[..., None]
            image += part * color**2
            for channel in range(3):
                slopes[3 * system + channel, ..., channel] = part[..., 0] * 2.0 * color[channel]
            slopes[6 + 3 * system] = (mask * wave)[..., None] * color**2
        return image, slopes

    def _grain(self, spp: int, seed: int) -> np.ndarray | float:
        self.calls += 1
        if self.calls in self.broken:
            return np.nan
        rng = np.random.default_rng(seed)
        return 1.0 + self.noise / np.sqrt(spp) * rng.standard_normal((*self.size, 1))

    def render(self, optics, spp, seed):
        """As ``DifferentiableTracer.render``."""
        return self.exact(np.asarray(optics))[0] * self._grain(spp, seed)

    def gradient(self, optics, adjoint, spp, seed):
        """As ``DifferentiableTracer.gradient``."""
        return np.tensordot(self.exact(np.asarray(optics))[1] * self._grain(spp, seed), adjoint, axes=3)

    def gradient_images(self, optics, spp, seed, block=1):
        """As ``DifferentiableTracer.gradient_images``."""
        image, slopes = self.exact(np.asarray(optics))
        grain = self._grain(spp, seed)
        return image * grain, slopes * grain
