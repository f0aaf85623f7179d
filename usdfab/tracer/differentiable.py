"""Pictures of a fabric as a function of its optics, and their derivatives, in our own tracer.

    tracer = DifferentiableTracer(scene, camera, (128, 128))
    image = tracer.render(tracer.optics, spp=64, seed=0)
    gradient = tracer.gradient(tracer.optics, adjoint, spp=64, seed=1)

The geometry is frozen: tiles are built once, other optics change some rows of numbers. Gradients take the same paths as
the picture of the same seed (forward mode, ``tape.py``): one pass, no second traversal, whatever the number of
parameters. They are unbiased; those of a loss are if its adjoint was computed from a picture of another seed.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.fabric import SYSTEMS
from usdfab.fabric.optics import ROUGHNESSES, Optics, optics_of, with_optics
from usdfab.scattering.fiber_numba_grad import SLOPES_SIZE, pack_slopes
from usdfab.tracer.film import CHANNELS, RGB
from usdfab.tracer.gradient_kernel import gradient_tile
from usdfab.tracer.kernel import render_tile
from usdfab.tracer.patch_scene import PatchScene, fiber_parameters, pack_material
from usdfab.tracer.render import RenderSettings, Shot, Tracer, thread_count
from usdfab.tracer.schedule import Window, plan_tiles
from usdfab.tracer.tape import SHARED, tape_size
from usdfab.tracer.world import World
from usdfab.usd.scene import Camera, Scene

Floats = NDArray[np.float64]
_Result = TypeVar("_Result")


class DifferentiableTracer:
    """A picture of a fabric as a function of the fabric's optics. Make it once, use it with as many optics as you like.

    Parameters
    ----------
    scene:
        As for ``Tracer``: any lights, meshes and surfaces. Derivatives are by the optics of one fabric; light that
        others and surfaces scatter is there, without derivatives of its own.
    camera:
        What to see; its exposure counts.
    size:
        (width, height) in pixels.
    max_depth:
        Longest path in vertices, counted as in ``RenderSettings``.
    fabric:
        Which of ``scene.fabrics``.
    keep:
        In [0, 1]. 1: gradients without bias. Less: the influence of a scattered direction on light that comes n
        vertices later counts keep^(n-1) only, which takes most of the noise from the derivatives by roughness and
        index.
    threads:
        None: all cores. Results are the same bits for any number.

    Attributes
    ----------
    optics:
        Those of the scene's fabric; they give the layout of all vectors.
    warnings:
        Those of the scene's textures.

    Raises
    ------
    UsdfabError
        As ``Tracer``; without a fabric; for a size and a depth that make no picture.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        size: tuple[int, int],
        *,
        max_depth: int = 64,
        fabric: int = 0,
        keep: float = 1.0,
        threads: int | None = None,
    ) -> None:
        if min(size) < 1 or max_depth < 1:
            raise UsdfabError(f"size {size} and depth {max_depth} must be at least 1")
        if not 0 <= fabric < len(scene.fabrics):
            raise UsdfabError(f"the scene has {len(scene.fabrics)} fabrics, none is number {fabric}", place=scene.path)
        if not 0.0 <= keep <= 1.0:
            raise UsdfabError(f"got {keep}, expected a number in [0, 1]", place="keep", remedy="1 gives no bias")
        self.size = size
        self.keep = float(keep)
        self.max_depth = max_depth
        self.fabric = scene.fabrics[fabric].fabric
        self.optics = optics_of(self.fabric)
        self._threads = thread_count(threads)
        self._camera = camera
        self._tracer = Tracer(scene)
        self.warnings = self._tracer.warnings
        self._view = self._tracer.view(Shot(camera, *size, seed=0, max_depth=max_depth))
        self._gain = 2.0**camera.exposure
        self._owners = np.concatenate([self._owners_of(*tile) for tile in self._tracer.tiles])

    def render(self, optics: Optics | ArrayLike, spp: int, seed: int) -> Floats:
        """(H, W, 3) linear Rec. 709, rows from the top: what ``Tracer`` shows of a fabric with these optics.

        Parameters
        ----------
        optics:
            Laid out as ``self.optics``, or its vector (3 K + 8,).

        Raises
        ------
        UsdfabError
            For another layout, numbers out of range, and less than one sample.
        """
        world, _ = self._world(self._layout(optics))
        _check(spp)

        def tile(window: Window) -> Floats:
            film, squares = _zeros(window, CHANNELS), _zeros(window, 3)
            render_tile(world, self._view, np.uint64(seed), window, 0, spp, self.max_depth, film, squares, None)
            return film[..., RGB : RGB + 3]

        image = np.zeros((self.size[1], self.size[0], 3))
        for (x0, y0, x1, y1), part in self._tiles(tile):
            image[y0:y1, x0:x1] = part
        return self._gain * (image / spp)

    def gradient(self, optics: Optics | ArrayLike, adjoint: ArrayLike, spp: int, seed: int) -> Floats:
        """(3 K + 8,) derivatives of the sum of ``adjoint`` times image by the entries of ``Optics.vector``.

        Costs about as much as a picture, and no memory.

        Parameters
        ----------
        optics:
            As for ``render``.
        adjoint: (H, W, 3)
            dJ/dimage of a loss J. Where it follows from a picture, that must have another ``seed``: else the two are
            correlated, and the gradient is biased.

        Raises
        ------
        UsdfabError
            As ``render``, and for an adjoint of another shape or with numbers that are not finite.
        """
        return self.image_and_gradient(optics, adjoint, spp, seed)[1]

    def image_and_gradient(
        self, optics: Optics | ArrayLike, adjoint: ArrayLike, spp: int, seed: int
    ) -> tuple[Floats, Floats]:
        """The picture (H, W, 3) that ``render`` gives for this seed, at no cost, and ``gradient`` by the same paths.

        The adjoint must not come from this picture. With lamps that have an extent the two pictures agree in the mean.
        """
        weights = np.asarray(adjoint, dtype=np.float64)
        if weights.shape != (self.size[1], self.size[0], 3) or not np.isfinite(weights).all():
            raise UsdfabError(
                f"expected finite numbers of shape {(self.size[1], self.size[0], 3)}, got {weights.shape}",
                place="adjoint",
            )
        sample = self._sampler(self._layout(optics), spp, seed)

        def tile(window: Window) -> tuple[Floats, Floats]:
            x0, y0, x1, y1 = window
            film, sums = sample(window)
            # By channel: (3, pixels) with (pixels, G / 3, 3).
            return film, np.einsum("pc,pgc->gc", weights[y0:y1, x0:x1].reshape(-1, 3), _by_channel(sums))

        image = np.zeros((self.size[1], self.size[0], 3))
        total = np.zeros((tape_size(len(self.optics.albedo)) // 3, 3))
        for (x0, y0, x1, y1), (film, part) in self._tiles(tile):
            image[y0:y1, x0:x1] = film
            total += part
        scale = self._gain / spp
        colors = len(self.optics.albedo)
        return self._gain * (image / spp), scale * np.concatenate(
            [total[:colors].ravel(), _shared_order(total[colors:].sum(axis=1))]
        )

    def gradient_images(self, optics: Optics | ArrayLike, spp: int, seed: int, block: int = 1) -> tuple[Floats, Floats]:
        """The picture and its derivative by each parameter: the Jacobian, for a look and for Gauss-Newton steps.

        Noise counts twice in J^T J, which comes out too large: the product of two Jacobians of different seeds does
        not. An adjoint's product with these images is ``gradient`` of the same seed.

        Parameters
        ----------
        optics, spp, seed:
            As for ``render``.
        block:
            Pixels are averaged over squares of this side, which must divide both sides of the picture.

        Returns
        -------
        image: (H / block, W / block, 3)
        gradients: (3 K + 8, H / block, W / block, 3)
        """
        width, height = self.size
        if block < 1 or width % block or height % block:
            raise UsdfabError(
                f"blocks of {block} pixels do not fill {width} x {height}", remedy="give a common divisor"
            )
        sample = self._sampler(self._layout(optics), spp, seed)
        groups = tape_size(len(self.optics.albedo)) // 3
        image = np.zeros((height // block, width // block, 3))
        jacobian = np.zeros((height // block, width // block, groups, 3))
        scale = self._gain / (spp * block * block)
        for (x0, y0, x1, y1), (film, sums) in self._tiles(sample):
            rows, columns = np.arange(y0, y1) // block, np.arange(x0, x1) // block
            np.add.at(image, (rows[:, None], columns), scale * film)
            np.add.at(jacobian, (rows[:, None], columns), scale * sums.reshape(*sums.shape[:2], groups, 3))
        colors = len(self.optics.albedo)
        result = np.zeros((self.optics.size, *image.shape))
        for k in range(colors):
            for channel in range(3):
                result[3 * k + channel, ..., channel] = jacobian[..., k, channel]
        result[3 * colors :] = _shared_order(np.moveaxis(jacobian[..., colors:, :], 2, 0))
        return image, result

    def guides(self, spp: int = 16, seed: int = 0) -> tuple[Floats, Floats]:
        """Albedo and normal (H, W, 3) of what is seen first, of the fabric itself: what the denoiser is guided by."""
        settings = RenderSettings(self.size, spp=spp, max_depth=1, seed=seed, threads=self._threads)
        render = self._tracer.render(self._camera, settings)
        return render.albedo.astype(np.float64), render.normal.astype(np.float64)

    def _layout(self, optics: Optics | ArrayLike) -> Optics:
        if not isinstance(optics, Optics):
            return self.optics.with_vector(np.asarray(optics, dtype=np.float64))
        if not np.array_equal(optics.system, self.optics.system):
            raise UsdfabError(f"the fabric has {len(self.optics.system)} colours, the new optics {len(optics.system)}")
        return optics

    def _sampler(self, optics: Optics, spp: int, seed: int) -> Callable[[Window], tuple[Floats, Floats]]:
        """A window's sums of radiance (h, w, 3) and of the tape (h, w, G)."""
        world, slopes = self._world(optics)
        _check(spp)

        def tile(window: Window) -> tuple[Floats, Floats]:
            film, sums = _zeros(window, CHANNELS), _zeros(window, tape_size(len(optics.albedo)))
            gradient_tile(
                world,
                self._view,
                np.uint64(seed),
                window,
                spp,
                self.max_depth,
                slopes,
                self._owners,
                self.keep,
                film,
                sums,
            )
            return film[..., RGB : RGB + 3], sums

        return tile

    def _tiles(self, tile: Callable[[Window], _Result]) -> list[tuple[Window, _Result]]:
        """``tile`` of all windows of the picture, in their order, which does not depend on the threads."""
        windows = [t.window for t in plan_tiles(*self.size, (0, 0, *self.size))]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(zip(windows, pool.map(tile, windows), strict=True))

    def _owners_of(self, fabric: FabricParameters, scene: PatchScene) -> NDArray[np.int32]:
        """(M, 2) colour and system of a tile's materials, -1 for those of another fabric."""
        owners = np.full((len(scene.materials), 2), -1, dtype=np.int32)
        if fabric != self.fabric:
            return owners
        for row, color, system in zip(owners, scene.albedo[:, :3], scene.systems, strict=True):
            same = (self.optics.system == system) & (self.optics.albedo == color).all(axis=1)
            row[:] = np.flatnonzero(same)[0], system
        return owners

    def _world(self, optics: Optics) -> tuple[World, Floats]:
        """What kernels read with these optics, and the slopes of its materials: all that depends on them."""
        with_optics(self.fabric, optics)  # complains of what is out of range
        world = self._tracer.world
        materials, albedo = world.patches.materials.copy(), world.patches.albedo.copy()
        slopes = np.zeros((len(materials), SLOPES_SIZE))
        yarns = [
            replace(
                self.fabric.system(system),
                **dict(zip(ROUGHNESSES, optics.roughness[k].tolist(), strict=True)),
                ior=float(optics.ior[k]),
            )
            for k, system in enumerate(SYSTEMS)
        ]
        for row, (color, system) in enumerate(self._owners):
            if color < 0:
                continue
            rgb = tuple(optics.albedo[color].tolist())
            materials[row], albedo[row] = pack_material(yarns[system], rgb)
            slopes[row] = pack_slopes(*fiber_parameters(yarns[system], rgb))
        return world._replace(patches=world.patches._replace(materials=materials, albedo=albedo)), slopes


def _zeros(window: Window, channels: int) -> Floats:
    return np.zeros((window[3] - window[1], window[2] - window[0], channels))


def _by_channel(sums: Floats) -> Floats:
    """(h, w, G) as (h w, G / 3, 3)."""
    return sums.reshape(sums.shape[0] * sums.shape[1], -1, 3)


def _shared_order(shared: Floats) -> Floats:
    """From the tape's order, (2 SHARED, ...) by system, to that of ``Optics.vector``: roughnesses, then indices."""
    by_system = shared.reshape(2, SHARED, *shared.shape[1:])
    return np.concatenate([by_system[:, :3].reshape(6, *shared.shape[1:]), by_system[:, 3]])


def _check(spp: int) -> None:
    if spp < 1:
        raise UsdfabError(f"{spp} samples per pixel make no picture", place="spp", remedy="give 1 or more")
