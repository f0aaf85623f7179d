"""Knitted cloth drawn as tubes along loops (stockinette): what is cloth, but not woven."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def draw_knit(
    wales: float = 9.0, courses: float = 12.0, size: int = 240, color: tuple[float, float, float] = (0.6, 0.5, 0.4),
    seed: int = 0, turned: bool = False, radius: float = 0.24, face: float = 1.0,
) -> Array:  # fmt: skip
    """Linear RGB (size, size, 3). ``face`` 1 shows the V of the legs, -1 the back; ``turned`` lays the wales level.

    Loops are x = t w / 2 pi + a sin 2 t, y = h cos t, z = -d cos 2 t, with h above half a course, so that each course
    hooks into the next.
    """
    rng = np.random.default_rng(seed)
    width, height = size / wales, size / courses
    depth, image = np.full((size, size), -np.inf), np.full((size, size, 3), 0.01)
    t = np.linspace(0.0, 2.0 * np.pi * (wales + 2), int(60 * (wales + 2)))
    reach = int(np.ceil(radius * width)) + 1
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    for course in range(-2, int(courses) + 3):
        wander = 0.05 * np.cumsum(rng.standard_normal(len(t))) / np.sqrt(len(t))
        x = (t / (2.0 * np.pi) - 1.0 + 0.22 * np.sin(2.0 * t) + wander) * width
        y = (course + 1.05 * np.cos(t)) * height
        z = -face * np.cos(2.0 * t)
        gx, gy = np.gradient(x), np.gradient(y)
        length = np.hypot(gx, gy) + 1e-9
        for k in range(len(t)):
            px, py = round(float(x[k])) + dx, round(float(y[k])) + dy
            ox, oy = px - x[k], py - y[k]
            across = (ox * gy[k] - oy * gx[k]) / length[k] / (radius * width)
            inside = (np.hypot(ox, oy) < radius * width) & (px >= 0) & (px < size) & (py >= 0) & (py < size)
            bulge = np.sqrt(np.clip(1.0 - across**2, 0.0, 1.0))
            high = z[k] + 0.4 * bulge
            inside &= high > depth[np.clip(py, 0, size - 1), np.clip(px, 0, size - 1)]
            stripes = 1.0 + 0.18 * np.sin(0.35 * k + 5.0 * across)
            shade = (0.3 + 0.7 * bulge) * (0.8 + 0.2 * z[k]) * stripes
            depth[py[inside], px[inside]] = high[inside]
            image[py[inside], px[inside]] = shade[inside][:, None] * np.asarray(color)
    image = np.clip(image + 0.01 * rng.standard_normal((size, size, 1)), 0.0, 1.0)
    return np.swapaxes(image, 0, 1) if turned else image
