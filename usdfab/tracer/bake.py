"""Tileable maps of a fabric, traced from its fibers (``bake_kernel.py``).

What the maps hold (rows from the top, v upward, texture coordinates (0, 0) at the lower left; x along u):

reflectance
    What a texel's fibers send back to a viewer straight above from a uniform white sky on that side: all orders of
    scattering, the fibers' own shading included. Linear Rec. 709, of the covered share of the texel.
normal
    Mean of the visible fibers' unit normals, then normalised: +x along u, +y along v, +z away from the cloth.
roughness
    GGX roughness of the visible fibers (the width of their reflection along them), widened by how much normals spread
    within the texel.
height
    Metres above the cloth's middle plane, on the side that is looked at.
opacity
    Share of the texel that fibers cover.
orientation
    The visible fiber's direction phi (counter-clockwise from u) as the doubled-angle vector (cos 2 phi, sin 2 phi)
    times its coherence: fibers have no sign, and such vectors can be averaged and filtered.
ao
    Share of a uniform sky's irradiance on the cloth's plane that reaches the visible fibers.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fibers import Patch, generate_patch
from usdfab.fibers.tiles import MAX_TILE_SEGMENTS
from usdfab.tracer import embree
from usdfab.tracer.bake_filter import Map, filled, guided
from usdfab.tracer.bake_kernel import (
    ACROSS,
    BACK,
    BENT,
    COLOR,
    HITS,
    LOOSE,
    PATHS,
    PLACE,
    SKY,
    SUMS,
    THROUGH,
    WARP,
    bake_rows,
)
from usdfab.tracer.intrinsics import filter_address
from usdfab.tracer.patch_scene import build_patch_scene
from usdfab.tracer.render import pack_patches, thread_count

Side = Literal["front", "back"]

MAX_TEXELS = 2**25
"""Most texels of a map: 100 bytes each are needed while it is traced."""
RAYS = 2**24
"""Rays for a whole map where nothing else is said, as far as a texel gets 16 to 256."""
PATHS_IN_ALL = 2**20
"""Rays of a map that go on as paths, as far as a texel gets 1 to 64: the filter makes up for few."""
MAX_DEPTH = 512
"""Longest path: white fibers in white cloth go on for long, and roulette ends the others."""
FILTER_RADIUS = 8
"""Half the window, in texels, in which reflectance is a linear function of the other maps; up to twice as much where a
texel has fewer than four paths."""
AO_RADIUS = 2
"""The same for the ambient occlusion."""
_ROWS = 16


@dataclass(frozen=True)
class BakeSettings:
    """How to bake.

    Parameters
    ----------
    resolution: (width, height) texels
        A height of 0 follows from the patch's shape, so that texels are square.
    repeats: (2,)
        Repeats of the weave (and of its colours) along x and y that the maps hold, each with fibers of its own.
    rays:
        For each texel; None: as many as ``RAYS`` allows.
    seed:
        Of the rays' randomness; the fibers have the fabric's.
    threads:
        All by default; the result does not depend on it.
    """

    resolution: tuple[int, int] = (1024, 0)
    repeats: tuple[int, int] = (1, 1)
    rays: int | None = None
    seed: int = 0
    threads: int | None = None


@dataclass(frozen=True, eq=False)
class BakedMaps:
    """The maps of one side, (H, W) or (H, W, C) float32, and what is the same everywhere. See the module's head.

    Parameters
    ----------
    size: (2,) metres
        Of cloth that the maps show.
    transmittance: (3,)
        Mean share of a uniform sky below that shines through to a viewer above, gaps included.
    loose: float
        Share of what is seen that is flyaways.
    thickness: metres
        Between the highest and the lowest place of any fiber but flyaways.
    rays: int
        For each texel.
    """

    side: Side
    size: tuple[float, float]
    reflectance: Map
    normal: Map
    roughness: Map
    height: Map
    opacity: Map
    orientation: Map
    ao: Map
    transmittance: tuple[float, float, float]
    loose: float
    thickness: float
    rays: int

    @property
    def texel(self) -> tuple[float, float]:
        """(width, height) of a texel in metres."""
        rows, columns = self.opacity.shape
        return self.size[0] / columns, self.size[1] / rows

    @property
    def mean_reflectance(self) -> NDArray[np.float64]:
        """(3,) of the whole map, gaps counted as black."""
        return (self.reflectance * self.opacity[..., None]).mean(axis=(0, 1), dtype=np.float64)


def bake(
    fabric: FabricParameters,
    settings: BakeSettings | None = None,
    sides: tuple[Side, ...] = ("front",),
    progress: Callable[[int, int], None] | None = None,
) -> list[BakedMaps]:
    """The maps of a fabric, one set for each of ``sides``.

    Both sides have the same texture coordinates: a texel of the back lies behind that of the front.

    Parameters
    ----------
    progress:
        Called with (rows done, rows in all).

    Raises
    ------
    UsdfabError
        For sizes that make no sense or are too large.
    """
    settings = settings or BakeSettings()
    if min(settings.repeats) < 1:
        raise UsdfabError(f"{settings.repeats} repeats make no map", place="repeats", remedy="use 1x1 or more")
    picks, ends = fabric.repeat()
    check_segments(fabric, settings.repeats)
    size = (fabric.cell[0] * ends * settings.repeats[0], fabric.cell[1] * picks * settings.repeats[1])
    width, height = map_resolution(settings.resolution, size)
    rays = int(np.clip(RAYS // (width * height), 16, 256)) if settings.rays is None else settings.rays
    if not 1 <= rays <= 2**16:
        raise UsdfabError(f"{rays} rays for each texel", place="rays", remedy="use 1 to 65536")
    patch = generate_patch(fabric, copies=settings.repeats)
    packed = _Packed(patch, fabric)
    done = 0

    def advance(rows: int) -> None:
        nonlocal done
        done += rows
        if progress is not None:
            progress(done, height * len(sides))

    return [packed.side(side, width, height, rays, settings, advance) for side in sides]


def check_segments(fabric: FabricParameters, repeats: tuple[int, int]) -> None:
    """``UsdfabError`` if so many repeats are too many fibers to hold."""
    picks, ends = fabric.repeat()
    fibers = fabric.warp.fiber_count * ends * picks + fabric.weft.fiber_count * picks * ends
    segments = 40 * fibers * repeats[0] * repeats[1]
    if repeats != (1, 1) and segments > 4 * MAX_TILE_SEGMENTS:
        raise UsdfabError(
            f"{repeats[0]} x {repeats[1]} repeats hold {segments / 1e6:.0f} million fiber segments",
            place="repeats",
            remedy="use fewer repeats",
        )


def map_resolution(resolution: tuple[int, int], size: tuple[float, float]) -> tuple[int, int]:
    """(width, height) in texels; a height of 0 follows from ``size`` so that texels are nearly square."""
    width, height = resolution
    if height == 0:
        height = max(1, round(width * size[1] / size[0]))
    if width < 4 or height < 4 or width * height > MAX_TEXELS:
        raise UsdfabError(
            f"{width} x {height} texels",
            place="resolution",
            remedy=f"use 4 or more a side, {MAX_TEXELS} in all at most",
        )
    return width, height


class _Packed:
    """A patch ready for the kernel."""

    def __init__(self, patch: Patch, fabric: FabricParameters) -> None:
        self._patch, self._fabric = patch, fabric
        self._scene = build_patch_scene(fabric, patch)
        self._patches = pack_patches([self._scene])
        intersect, occluded = embree.function_addresses()
        self._addresses = tuple(np.uint64(a) for a in (intersect, occluded, filter_address()))
        self._last_warp = 1 + int(patch.warp.yarn.max())
        self._first_loose = sum(s.curves for s in patch.systems)

    def side(
        self, side: Side, width: int, height: int, rays: int, settings: BakeSettings, advance: Callable[[int], None]
    ) -> BakedMaps:
        """Trace all rows and turn sums into maps."""
        up = 1.0 if side == "front" else -1.0
        paths = min(rays, int(np.clip(PATHS_IN_ALL // (width * height), 1, 64)))
        layers = np.empty((height, width, SUMS - 3), np.float32)

        def band(first: int) -> tuple[int, NDArray]:
            last = min(first + _ROWS, height)
            sums = np.zeros((last - first, width, SUMS))
            bake_rows(
                self._addresses, self._patches, width, height, up, np.uint64(settings.seed), (first, last), rays, paths,
                MAX_DEPTH, self._last_warp, self._first_loose, sums,
            )  # fmt: skip
            layers[first:last] = sums[..., :THROUGH]
            return last - first, np.r_[sums[..., THROUGH:].sum((0, 1)), sums[..., PATHS].sum()]

        through = np.zeros(4)
        with ThreadPoolExecutor(thread_count(settings.threads)) as pool:
            try:
                for rows, part in pool.map(band, range(0, height, _ROWS)):
                    through += part
                    advance(rows)
            except BaseException:
                pool.shutdown(cancel_futures=True)  # Ctrl-C: do not trace what is still waiting
                raise
        return self._maps(side, layers, through, rays)

    def _maps(self, side: Side, layers: Map, through: NDArray, rays: int) -> BakedMaps:
        up = 1.0 if side == "front" else -1.0
        hits = layers[..., HITS]
        some: Map = np.maximum(hits, 1.0)
        seen = hits > 0
        mean = {name: layers[..., name] / some for name in (PLACE, SKY, WARP)}
        bent = layers[..., BENT : BENT + 3] / some[..., None] * np.array([1.0, 1.0, up], np.float32)
        across = layers[..., ACROSS : ACROSS + 2] / some[..., None]
        color = layers[..., COLOR : COLOR + 3] / some[..., None]
        place: Map = np.float32(up) * mean[PLACE] / np.float32(self._scene.units_per_meter)
        place[~seen] = place[seen].min() if seen.any() else 0.0
        length = np.linalg.norm(bent, axis=-1)
        flat = np.array([0.0, 0.0, 1.0], np.float32)
        normal = np.where(seen[..., None], bent / np.maximum(length, 1e-9)[..., None], flat)
        # Seen from above no visible normal points down, so that a mean does not either; that is up to rounding.
        normal[..., 2] = np.maximum(normal[..., 2], 1e-3)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        shape: Map = filled(np.concatenate([color, bent[..., 2:], place[..., None]], axis=-1), hits)
        # One sky ray for each ray makes grain that the eye sees.
        sky = guided(mean[SKY][..., None].astype(np.float32), shape[..., 3:], hits, AO_RADIUS)
        sky = np.clip(sky, 0.0, 1.0).astype(np.float32)
        guides = np.concatenate([shape, sky], axis=-1)
        noisy = (layers[..., BACK : BACK + 3] / np.maximum(layers[..., PATHS], 1.0)[..., None]).astype(np.float32)
        radius = round(FILTER_RADIUS * np.sqrt(4.0 / min(max(float(layers[..., PATHS].max()), 1.0), 4.0)))
        reflectance = guided(noisy, guides, layers[..., PATHS], radius)
        coverage = float(hits.mean(dtype=np.float64)) / rays
        paths = max(float(through[3]), 1.0)
        transmittance = tuple(float(1.0 - coverage + coverage * t / paths) for t in through[:3])
        fibers = self._patch.systems
        low = min(float(s.points[:, 2].min()) - s.radius for s in fibers)
        high = max(float(s.points[:, 2].max()) + s.radius for s in fibers)
        return BakedMaps(
            side=side,
            size=self._patch.size,
            reflectance=np.clip(filled(reflectance, layers[..., PATHS]), 0.0, 1.0),
            normal=normal.astype(np.float32),
            roughness=self._roughness(filled(np.stack([mean[WARP], length], axis=-1), hits)),
            height=place,
            opacity=hits / np.float32(rays),
            orientation=across,
            ao=sky[..., 0],
            transmittance=transmittance,  # type: ignore[arg-type]
            loose=float(layers[..., LOOSE].sum(dtype=np.float64) / max(hits.sum(dtype=np.float64), 1.0)),
            thickness=high - low,
            rays=rays,
        )

    def _roughness(self, known: Map) -> Map:
        """GGX roughness from (share of warp, length of the mean normal)."""
        warp, weft = (fiber_alpha(self._fabric.system(s).roughness_primary) for s in ("warp", "weft"))
        alpha2 = known[..., 0] * warp**2 + (1.0 - known[..., 0]) * weft**2
        # Slopes of normals whose mean has length r have the variance (1 - r) / r in each direction (Toksvig 2005), and
        # GGX of width alpha has about alpha^2 / 2.
        length = np.clip(known[..., 1], 1e-3, 1.0)
        alpha2 = alpha2 + 2.0 * (1.0 - length) / length
        return np.clip(alpha2, 1e-4, 1.0).astype(np.float32) ** np.float32(0.25)


def fiber_alpha(roughness_primary: float) -> float:
    """GGX width of a fiber's reflection along itself.

    The primary lobe has the standard deviation sqrt(v) of inclinations (MODEL: Chiang et al. 2015, with gamma_M0).
    Mirrors turned by an angle turn what they reflect by twice that; slopes of standard deviation s make alpha = sqrt(2)
    s.
    """
    g = roughness_primary
    return float(np.sqrt(2.0) * 0.5 * (0.726 * g + 0.812 * g**2 + 3.7 * g**20))
