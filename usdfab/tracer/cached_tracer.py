"""Pictures whose paths end at a radiance cache: bright cloth in half the time with a fraction of the noise, and nearly
right."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.tracer.accumulate import Progress
from usdfab.tracer.radiance_cache import empty_cache, learned
from usdfab.tracer.render import Render, RenderSettings, Tracer, render_by, start, thread_count
from usdfab.tracer.schedule import LAYERS
from usdfab.usd.scene import Camera

DEPTH = 3
"""Vertex at which paths end: two bounces are the fibers' own. At 2, pictures are half as right again."""

STRIPS = 16
"""Of the small picture, each learned from by itself."""

LEARNED_FROM = 2
"""How many times smaller the picture is that ``render_cached`` learns from, along each side."""

OTHER_PATHS = 1000
"""Added to a picture's seed: a cache that learned from the picture's own paths would keep their errors."""


class CachedTracer:
    """A tracer that has learned what comes back from deep in its cloth (``radiance_cache``).

    Parameters
    ----------
    tracer:
        Of a scene with one fabric.
    camera, settings:
        Of a small picture of what will be rendered, whose whole paths are learned from.
    depth:
        Vertex at which paths end.

    Raises
    ------
    UsdfabError
        If the scene has no fabric, or several.
    """

    def __init__(self, tracer: Tracer, camera: Camera, settings: RenderSettings, depth: int = DEPTH) -> None:
        fabrics = {id(fabric): fabric for fabric, _ in tracer.tiles}
        if len(fabrics) != 1:
            raise UsdfabError(f"a radiance cache is of one fabric, the scene has {len(fabrics)}")
        fabric, tile = tracer.tiles[0]
        self._tracer = tracer
        self.cache = empty_cache(fabric, tile, depth)
        """What was learned."""
        shot, _ = start(camera, settings)
        rows = np.linspace(0, shot.height, STRIPS + 1).round().astype(int).tolist()

        def learn(strip: tuple[int, int]) -> NDArray[np.float64]:
            cache = self.cache._replace(sums=np.zeros_like(self.cache.sums))
            film = np.zeros((strip[1] - strip[0], shot.width, LAYERS))
            tracer.sample(shot, (0, strip[0], shot.width, strip[1]), 0, settings.spp, film, cache)
            return cache.sums

        sums = np.zeros_like(self.cache.sums)
        with ThreadPoolExecutor(thread_count(settings.threads)) as pool:
            # In order: a sum of floats depends on it, and must not on the threads.
            for part in pool.map(learn, pairwise(rows)):
                sums += part
        self.cache = learned(self.cache, sums, tile.systems)

    def render(self, camera: Camera, settings: RenderSettings, progress: Progress | None = None) -> Render:
        """As ``Tracer.render``; light that was scattered ``depth`` times or more is the cache's."""
        sample = partial(self._tracer.sample, cache=self.cache)
        return render_by(sample, camera, settings, self._tracer.segments, progress)


def render_cached(tracer: Tracer, camera: Camera, settings: RenderSettings, learning: int) -> Render:
    """A picture whose paths end at a radiance cache, learned from other paths of a smaller one.

    Parameters
    ----------
    learning:
        Samples per pixel of the smaller picture.
    """
    width, height = (max(1, side // LEARNED_FROM) for side in settings.resolution)
    small = replace(settings, resolution=(width, height), spp=learning, seed=settings.seed + OTHER_PATHS)
    return CachedTracer(tracer, camera, small).render(camera, settings)
