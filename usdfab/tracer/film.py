"""What a pixel's sums hold: the channels that kernels add to."""

from __future__ import annotations

RGB = 0
"""3: radiance."""
ALBEDO = 3
"""3: of what is seen first, for the denoiser."""
NORMAL = 6
"""3: shading normal of what is seen first, world space."""
DEPTH = 9
"""Distance from the camera in metres, over the samples that hit something."""
ALPHA = 10
"""1 where something was hit."""
RAYS = 11
"""Rays traced."""
DIRECT = 12
"""3: the part of the radiance that came from a light with at most one scattering event between it and the camera."""
UV = 15
"""2: texture coordinates of what is seen first."""
FIBER_ID = 17
"""Of the pixel's first sample (set, not added): 1 + index of the curve in its patch; 0: no fiber."""
YARN_ID = 18
"""The same for yarns: 1 + index, warp yarns first."""
SAMPLES = 19
"""Samples taken."""
CHANNELS = 20
