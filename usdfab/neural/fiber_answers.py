"""Queries answered by the fibers themselves: what the neural material is fine-tuned to.

The cloth is flat and endless, made of the tiles that the tracer renders. As for the surface model
(``aggregation``) an answer is radiance towards the viewer per irradiance across the light's direction, cosine included,
meaned over the footprint; light that passes between fibers without meeting any adds nothing. The footprint is a
square (in tiles) of the cloth's middle plane, through which viewers' rays go.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.neural.fiber_kernel import COLOR, GLOSS, PARTS, answer_queries
from usdfab.tracer import embree
from usdfab.tracer.intrinsics import filter_address
from usdfab.tracer.patch_scene import build_tiles
from usdfab.tracer.render import pack_patches, thread_count

Floats = NDArray[np.float64]

MAX_DEPTH = 64
"""That of ``usdfab render``."""

_PIECE = 64


class FiberAnswers:
    """A fabric ready to be asked.

    ``tile`` is what queries call one: (ends, picks) after which weave and colours repeat.
    """

    def __init__(self, fabric: FabricParameters) -> None:
        picks, ends = fabric.repeat()
        self.tile = (ends, picks)
        self._scenes = build_tiles(fabric)
        self._patches = pack_patches(self._scenes)
        self._systems = np.concatenate([scene.systems for scene in self._scenes]).astype(np.int32)
        units = self._scenes[0].units_per_meter
        self._size = units * np.array([fabric.cell[0] * ends, fabric.cell[1] * picks])
        intersect, occluded = embree.function_addresses()
        self._addresses = tuple(np.uint64(a) for a in (intersect, occluded, filter_address()))

    def ask(
        self, queries: ArrayLike, lights: ArrayLike, samples: int, *, back: bool = False, seed: int = 0,
        threads: int | None = None, max_depth: int = MAX_DEPTH, progress: Callable[[int, int], None] | None = None,
    ) -> Floats:  # fmt: skip
        """Answers (Q, L, 8): RGB by warp, RGB by weft, gloss by warp, gloss by weft.

        Parameters
        ----------
        queries: (Q, 5)
            Footprint u, v and side in tiles; x, y towards the viewer.
        lights: (Q, L, 3)
            Unit vectors towards lights, the same paths for all of a query; z > 0 on the viewer's side.
        samples:
            Paths of each.
        back:
            Seen from behind: the cloth turned about its warp, u and x run the other way.

        The same for the same arguments whatever the threads.

        Raises
        ------
        UsdfabError
            For queries and lights of other shapes or that are no footprints and directions.
        """
        rows = np.ascontiguousarray(queries, dtype=np.float64)
        towards = np.ascontiguousarray(lights, dtype=np.float64)
        if rows.shape[1:] != (5,) or towards.ndim != 3 or towards.shape[::2] != (len(rows), 3):
            raise UsdfabError(f"queries of shape {rows.shape} and lights of {towards.shape} do not go together")
        unit = np.abs((towards**2).sum(axis=-1) - 1.0).max(initial=0.0) < 1e-3
        flat = (rows[:, 3] ** 2 + rows[:, 4] ** 2).max(initial=0.0) <= 1.0 and rows[:, 2].min(initial=0.0) >= 0.0
        if not (unit and flat and np.isfinite(rows).all()):
            raise UsdfabError(
                "a query is not finite, has a negative footprint, a viewer outside the unit disk, or no unit vector"
            )
        if samples < 1:
            raise UsdfabError(f"{samples} samples are none", place="samples", remedy="give 1 or more")
        out = np.empty((*towards.shape[:2], PARTS))

        def piece(first: int) -> int:
            some = slice(first, min(first + _PIECE, len(rows)))
            answer_queries(
                self._addresses, self._patches, self._systems, self._size, -1.0 if back else 1.0, rows[some],
                towards[some], first, samples, np.uint64(seed), max_depth, out[some],
            )  # fmt: skip
            return len(rows[some])

        done = 0
        with ThreadPoolExecutor(thread_count(threads)) as pool:
            try:
                for count in pool.map(piece, range(0, len(rows), _PIECE)):
                    done += count
                    if progress:
                        progress(done, len(rows))
            except BaseException:
                pool.shutdown(cancel_futures=True)  # Ctrl-C: do not trace what is still waiting
                raise
        return out


def colors_of(answers: Floats) -> Floats:
    """RGB (..., 3) of answers (..., 8)."""
    return (
        answers[..., COLOR : COLOR + 3] + answers[..., COLOR + 3 : COLOR + 6]
        + answers[..., GLOSS : GLOSS + 2].sum(axis=-1, keepdims=True)
    )  # fmt: skip
