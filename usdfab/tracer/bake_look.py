"""What a plain surface with baked maps must look like to be as bright as the fibers.

A UsdPreviewSurface has one diffuse colour and one reflection for all lights; fibers have not. The two lights in which
cloth is mostly seen from straight above decide: a uniform sky, and the lamp of the capture rig near the camera's axis.
Under the lamp cloth is brighter, by about the same in all colours: that is its reflection. So index of refraction,
roughness and how far normals lean are tried until the surface gains as much from sky to lamp, staying near the fibers'
own values where several do, and the diffuse colour is the baked reflectance times one factor for each channel.

Normals lean less than the fibers' (by about a half): each fiber scatters light that comes from behind it too, a surface
does not. At other angles the surface differs from the fibers: cloth is brighter at grazing views, and anisotropic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters
from usdfab.scattering.surface_numba import eval_surface, pack_surface, prepare_surface
from usdfab.tracer.bake import BakedMaps
from usdfab.tracer.bake_filter import Map
from usdfab.tracer.intrinsics import ENTRY
from usdfab.tracer.render import RenderSettings, Tracer
from usdfab.usd.rig import rig_for, swatch_scene
from usdfab.usd.scene import PointLight

COARSE, FINE = (512, 24), (8192, 128)
"""Places that stand for all, and directions that stand for the sky: while searching, and in the end."""
F0_TRIED = (0.015, 0.025, 0.035, 0.0465, 0.06, 0.08)
"""Reflectances at normal incidence that are tried: indices of refraction from 1.28 to 1.8; 1.55 is a fiber's."""
ROUGHNESS_TRIED = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Factors of the roughness that are tried."""
STRENGTHS_TRIED = (0.15, 0.25, 0.4, 0.6, 0.8, 1.0)
"""Factors of the normals' lean that are tried."""
_RELUCTANCE = 0.01
"""Error of brightness that is worth a change of reflectance, roughness or lean by a factor of e."""


@dataclass(frozen=True, eq=False)
class Look:
    """A plain surface that looks like the fibers from afar.

    Parameters
    ----------
    albedo: (H, W, 3)
        Diffuse colour, linear Rec. 709.
    normal: (H, W, 3)
        The baked normals, leaning less.
    roughness: (H, W)
    ior:
        Index of refraction.
    strength:
        Factor of the normals' lean.
    error: (2, 3)
        Brightness of the surface over the fibers', less 1: under the sky and under the lamp.
    """

    albedo: Map
    normal: Map
    roughness: Map
    ior: float
    strength: float
    error: NDArray[np.float64]


@njit(**ENTRY)
def _mean_values(roughness, normals, weights, albedo, directions, shares, f0, packed):
    """Weighted means over texels of what comes back to +z: (3,) of diffuse light, and of the reflection.

    ``directions`` (N, 3) towards the light, ``shares`` (N,) the irradiance of each on a plane that faces it.
    """
    diffuse, shine = np.zeros(3), 0.0
    for t in range(len(roughness)):
        nx, ny, nz = normals[t, 0], normals[t, 1], normals[t, 2]
        # Any frame will do: the surface is isotropic.
        a = 1.0 / (1.0 + nz)
        b = -nx * ny * a
        ux, uy, uz = 1.0 - nx * nx * a, b, -nx
        vx, vy, vz = b, 1.0 - ny * ny * a, -ny
        # Base colours 0, 1, 1: the first channel is the reflection, the second has the diffuse light on top.
        surface = (0.0, 1.0, 1.0, roughness[t], 0.0, f0, f0, f0, packed[8], packed[9], packed[10], packed[11])
        prepared = prepare_surface(surface, max(nz, 1e-4))
        for k in range(len(directions)):
            x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
            low, high, _, _ = eval_surface(
                prepared, ux * x + uy * y + uz * z, vx * x + vy * y + vz * z, nx * x + ny * y + nz * z, uz, vz, nz
            )
            low, high = low * shares[k] * weights[t], high * shares[k] * weights[t]
            shine += low
            for c in range(3):
                diffuse[c] += (high - low) * albedo[t, c]
    return diffuse, shine


def fit_look(fabric: FabricParameters, maps: BakedMaps, *, threads: int | None = None) -> Look:
    """The surface for ``maps`` of ``fabric``. The back is fitted to the lamp as it lights the face."""
    targets = maps.mean_reflectance, lamp_reflectance(fabric, threads=threads)
    usual = float(np.mean([f0_of(y.ior) for y in (fabric.warp, fabric.weft)]).clip(F0_TRIED[0], F0_TRIED[-1]))
    rough = _Fit(maps, targets, *COARSE)
    best = None
    for f0 in F0_TRIED:
        for smoother in ROUGHNESS_TRIED:
            for strength in STRENGTHS_TRIED:
                _, error = rough.best(f0, smoother, strength)
                # Where several do, the one nearest to the fibers' own.
                far = math.log(f0 / usual) ** 2 + math.log(smoother) ** 2 + math.log(strength) ** 2
                total = float((error**2).mean()) + _RELUCTANCE**2 * far
                if best is None or total < best[0]:
                    best = total, f0, smoother, strength
    assert best is not None
    _, f0, smoother, strength = best
    factor, error = _Fit(maps, targets, *FINE).best(f0, smoother, strength)
    return Look(
        np.clip(maps.reflectance * factor.astype(np.float32), 0.0, 1.0),
        _bent(maps.normal, strength),
        np.float32(smoother) * maps.roughness,
        ior_of(f0),
        strength,
        error,
    )


class _Fit:
    """Brightness of a surface with the maps, for any reflection, over the fibers' under sky and lamp."""

    def __init__(self, maps: BakedMaps, targets: tuple[NDArray, NDArray], places: int, directions: int) -> None:
        rows, columns, fx, fy = _places(maps.opacity.shape, places)

        def pick(layer: Map) -> NDArray[np.float64]:
            """Between texels, as viewers look maps up: that makes normals lean less."""
            values = layer.astype(np.float64).reshape(*layer.shape[:2], -1)
            below, right = (rows + 1) % layer.shape[0], (columns + 1) % layer.shape[1]
            upper = values[rows, columns] * (1.0 - fx) + values[rows, right] * fx
            lower = values[below, columns] * (1.0 - fx) + values[below, right] * fx
            return (upper * (1.0 - fy) + lower * fy).reshape(-1, *layer.shape[2:])

        self._roughness, self._normals, weights = pick(maps.roughness), pick(maps.normal), pick(maps.opacity)
        # The chosen places stand for all: their means are to be the map's.
        self._weights = weights * (maps.opacity.mean(dtype=np.float64) / max(weights.sum(), 1e-9))
        albedo = pick(maps.reflectance)
        mean = (albedo * self._weights[:, None]).sum(axis=0)
        self._albedo = albedo * (maps.mean_reflectance / np.maximum(mean, 1e-9))
        self._lights = _sky_lights(directions), _lamp_lights()
        self._targets = np.maximum(np.stack(targets), 1e-4)

    def best(self, f0: float, smoother: float, strength: float) -> tuple[NDArray, NDArray]:
        """(3,) the best factors of the albedo, and the (2, 3) relative errors that are left."""
        packed = pack_surface((1.0, 1.0, 1.0), 0.5, 0.0, None, 0.0, 0.01, ior_of(f0))
        normals = _bent(self._normals, strength)
        means = [
            _mean_values(smoother * self._roughness, normals, self._weights, self._albedo, *lights, f0, packed)
            for lights in self._lights
        ]
        diffuse = np.stack([m[0] for m in means]) / self._targets
        shine = np.array([m[1] for m in means])[:, None] / self._targets
        factor = (diffuse * (1.0 - shine)).sum(axis=0) / np.maximum((diffuse**2).sum(axis=0), 1e-12)
        factor = np.maximum(factor, 0.0)
        return factor, diffuse * factor + shine - 1.0


def _bent(normals: NDArray, strength: float) -> NDArray:
    """Normals (..., 3) leaning less: x and y times ``strength``, normalised."""
    scaled = normals * np.array([strength, strength, 1.0], dtype=normals.dtype)
    return scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)


def f0_of(ior: float) -> float:
    """What an index of refraction reflects at normal incidence."""
    return ((ior - 1.0) / (ior + 1.0)) ** 2


def ior_of(f0: float) -> float:
    """The index of refraction that reflects ``f0`` at normal incidence."""
    root = math.sqrt(f0)
    return (1.0 + root) / (1.0 - root)


def lamp_reflectance(fabric: FabricParameters, *, threads: int | None = None, spp: int = 64) -> NDArray[np.float64]:
    """(3,) the fabric's brightness under the capture rig's lamp over that of a white diffuse sheet.

    Viewed by the rig's camera; the mean over the sample and over four places of the lamp around the axis.
    """
    rig = rig_for(fabric.size)
    x, _, z = rig.light_position
    places = np.array([(x, 0, z), (0, x, z), (-x, 0, z), (0, -x, z)])
    power = np.full(3, rig.light_intensity / len(places))
    lights = tuple(PointLight(f"/Lamp{k}", place, power) for k, place in enumerate(places))
    scene = replace(swatch_scene(replace(fabric, albedo_map="")), lights=lights)
    settings = RenderSettings(resolution=(48, 48), spp=spp, threads=threads)
    pixels = Tracer(scene).render(scene.cameras[0], settings).pixels.astype(np.float64)
    rows, columns = pixels.shape[:2]
    px = ((np.arange(columns) + 0.5) / columns - 0.5) * fabric.size[0]
    py = (0.5 - (np.arange(rows) + 0.5) / rows) * fabric.size[1]
    white = np.zeros((rows, columns))
    for place in places:
        distance = np.sqrt((place[0] - px) ** 2 + (place[1] - py[:, None]) ** 2 + z**2)
        white += rig.light_intensity / len(places) * z / distance**3 / math.pi
    return pixels.mean(axis=(0, 1)) / white.mean()


def _sky_lights(count: int) -> tuple[NDArray, NDArray]:
    """Directions and shares of a uniform sky of radiance 1: equal solid angles on a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, phi = k / count, 2.0 * math.pi * ((0.6180339887498949 * k) % 1.0)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(phi), flat * np.sin(phi), z], axis=1), np.full(count, 2.0 * math.pi / count)


def _lamp_lights() -> tuple[NDArray, NDArray]:
    """The rig's lamp at four places around the axis, so bright that a white diffuse sheet has radiance 1."""
    rig = rig_for((5e-3, 5e-3))
    x, _, z = rig.light_position
    directions = np.array([(x, 0, z), (0, x, z), (-x, 0, z), (0, -x, z)]) / math.hypot(x, z)
    return directions, np.full(4, math.pi / directions[0, 2] / 4)


def _places(shape: tuple[int, ...], count: int) -> tuple[NDArray[np.int64], ...]:
    """Rows and columns (N,) of places strewn evenly over a map, and (N, 1) how far on to the next texel they are."""
    k = np.arange(count)
    x, y = (0.7548776662466927 * k) % 1.0 * shape[1], (0.5698402909980532 * k) % 1.0 * shape[0]
    columns, rows = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    return rows, columns, (x - columns)[:, None], (y - rows)[:, None]
