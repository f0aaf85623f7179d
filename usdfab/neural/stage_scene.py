"""A scene made ready for the neural renderer: meshes in Embree, materials as plans, lights one by one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.neural.asset_file import fabric_digest, load_asset_network
from usdfab.neural.asset_network import TINTED, AssetMaterial
from usdfab.neural.cloth_scene import has_bodies, pack_cloth
from usdfab.neural.decoder import Plan, pack_plans, plans_of
from usdfab.neural.gbuffer import Cloth
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS
from usdfab.neural.rendered_material import learned_material, reversed_material
from usdfab.neural.strips import Decoders
from usdfab.neural.surface_from_fabric import surface_from_fabric
from usdfab.neural.surface_material import SurfaceMaterial
from usdfab.tracer import embree
from usdfab.tracer.embree import EmbreeScene
from usdfab.tracer.intrinsics import filter_address
from usdfab.tracer.lights import Lights, pack_lights
from usdfab.tracer.macro_scene import Tiles, build_macro
from usdfab.tracer.render import pack_patches
from usdfab.tracer.textures import load_texture_images, pack_materials, pack_textures
from usdfab.tracer.world import World
from usdfab.usd.scene import DistantLight, DomeLight, Light, PointLight, Scene, Texture

LARGEST_REPEAT = 16
"""Most ends or picks in a tile: beyond, a yarn is less than four pixels wide in what the encoder sees."""

DOME_PLACES, AREA_PLACES = 16, 4
"""Directions of a dome, places on a light with an extent: of each sample."""

SHARP = 0.01
"""Half angle in radians up to which a distant light is one direction."""


@dataclass(frozen=True, eq=False)
class PlacedLight:
    """A light alone, and on how many places it is looked at for each sample."""

    lights: Lights
    places: int


@dataclass(frozen=True, eq=False)
class NeuralScene:
    """Everything the renderer asks.

    Parameters
    ----------
    materials: 2 to each fabric without a network of its own
        Front and back, as the networks know them.
    plans: 4 to each fabric
        Front lit from the front, from behind; back lit from its own front, from behind.
    albedo: (fabrics, 2, 4, 3)
        Of C_warp, C_weft, S_warp, S_weft, for light from the front and from behind; of a fabric with a network of its
        own: what makes its columns colours (``AssetMaterial.albedo``).
    tinted: (fabrics, 4)
        Which of an answer's four numbers are of light that a print colours: 1, else 0.
    crossings: (fabrics, 2)
        Ends and picks of what queries call one tile.
    assets:
        Networks of fabrics' own, by the fabrics' numbers.
    decoders:
        The plans for the compiled driver; None: ``plans`` are asked one by one.
    cloth:
        See ``gbuffer.Cloth``.
    embree:
        Keeps the meshes alive.
    """

    world: World
    materials: list[SurfaceMaterial]
    plans: list[Plan]
    decoders: Decoders | None
    albedo: NDArray[np.float32]
    tinted: NDArray[np.float32]
    crossings: NDArray[np.int64]
    assets: Mapping[int, AssetMaterial]
    cloth: Cloth
    lights: list[PlacedLight]
    embree: EmbreeScene
    warnings: tuple[str, ...]


def build(
    scene: Scene, networks: Mapping[str, Weights], pictures: Mapping[str, NDArray], strict: bool = False,
    own: bool = True,
) -> NeuralScene:  # fmt: skip
    """A scene made ready.

    Parameters
    ----------
    networks:
        For ``reflection`` and ``transmission``.
    pictures:
        Of dome lights, by path.
    strict:
        Whether what cannot be drawn is an error; else it is one of ``warnings``.
    own:
        Whether fabrics that have networks of their own (``FabricParameters.neural_weights``) are drawn with them.

    Raises
    ------
    UsdfabError
        If there is nothing to see or no light, a cloth has no uv, a weave is larger than the encoder takes, or
        a fabric's own network cannot be read.
    """
    if not scene.lights:
        raise UsdfabError("the stage has no light", place=scene.path, remedy="add a UsdLux light, e.g. a DomeLight")
    warnings: list[str] = []

    def left_out(problem: str, place: str) -> None:
        if strict:
            raise UsdfabError(problem, place=place, remedy="use --backend embree, or leave --strict out")
        warnings.append(f"{place}: {problem}")

    for material in scene.materials:
        if material.fabric < 0 and (np.any(material.emissive) or "emissiveColor" in material.textures):
            left_out("a surface that glows lights nothing in the neural backend", material.path)
    _check_uv(scene)
    assets = asset_networks(scene, left_out) if own else {}
    return _assemble(scene, _dress(scene, assets), networks, [*warnings], pictures, strict)


@dataclass(frozen=True, eq=False)
class _Dress:
    """What fabrics look like: fields of ``NeuralScene``, ``materials`` only of those without a network of their own."""

    materials: list[SurfaceMaterial]
    albedo: NDArray[np.float32]
    tinted: NDArray[np.float32]
    crossings: NDArray[np.int64]
    assets: Mapping[int, AssetMaterial]

    def plans(self, networks: Mapping[str, Weights]) -> list[Plan]:
        """``plans`` of ``NeuralScene``; the encoders run here."""
        both = [plans_of(networks[k].network, self.materials) for k in KINDS] if self.materials else [[], []]
        shared = iter([both[kind][k] for k in range(len(self.materials)) for kind in range(len(KINDS))])
        return [
            plan
            for number in range(len(self.albedo))
            for plan in (
                self.assets[number].plans() if number in self.assets else [next(shared) for _ in range(2 * len(KINDS))]
            )
        ]

    def tiles(self, scene: Scene) -> NDArray[np.float64]:
        """Width and height in metres (fabrics, 2) of what queries call one tile; one row if there is no fabric."""
        if not scene.fabrics:
            return np.ones((1, 2))
        return np.array([surface.fabric.cell for surface in scene.fabrics]) * self.crossings


def _dress(scene: Scene, assets: Mapping[int, AssetMaterial]) -> _Dress:
    """Fabrics as the networks know them.

    Raises
    ------
    UsdfabError
        If a weave is larger than the encoder takes.
    """
    materials: list[SurfaceMaterial] = []
    albedo = np.zeros((len(scene.fabrics), 2, 4, 3))
    tinted = np.tile([1.0, 1.0, 0.0, 0.0], (len(scene.fabrics), 1))
    crossings = np.ones((len(scene.fabrics), 2), dtype=np.int64)
    for number, surface in enumerate(scene.fabrics):
        if number in assets:
            albedo[number], tinted[number], crossings[number] = assets[number].albedo, TINTED, assets[number].tile
            continue
        crossings[number] = surface.fabric.weave.ends, surface.fabric.weave.picks
        sides, albedo[number] = shared_dress(surface.fabric, surface.path)
        materials += sides
    return _Dress(materials, albedo.astype(np.float32), tinted.astype(np.float32), crossings, assets)


def shared_dress(fabric: FabricParameters, place: str) -> tuple[list[SurfaceMaterial], NDArray[np.float64]]:
    """Front and back of a fabric as the shared networks know them, and the albedos (2, 4, 3) of their components.

    Raises
    ------
    UsdfabError
        If the weave is larger than the encoder takes.
    """
    cloth, colors = surface_from_fabric(fabric)
    cloth, cover = learned_material(cloth)
    if max(cloth.rows, cloth.columns) > LARGEST_REPEAT:
        raise UsdfabError(
            f"a weave of {cloth.columns} ends and {cloth.rows} picks is larger than the encoder takes "
            f"({LARGEST_REPEAT})", place=place, remedy="use --backend embree",
        )  # fmt: skip
    return [cloth, reversed_material(cloth)], cover * np.stack([colors.reflection, colors.transmission])


def dressed(ready: NeuralScene, scene: Scene, networks: Mapping[str, Weights]) -> NeuralScene:
    """A scene with its fabrics changed: their yarns, colours and weaves, nothing else. Takes milliseconds.

    A fabric's own network does not know the fabric changed: then the shared networks show it.
    """
    assets = {k: asset for k, asset in ready.assets.items() if asset.digest == fabric_digest(scene.fabrics[k].fabric)}
    dress = _dress(scene, assets)
    known = ([_identity(m) for m in ready.materials], set(ready.assets))
    if ([_identity(m) for m in dress.materials], set(assets)) != known:
        plans = dress.plans(networks)
        ready = replace(ready, plans=plans, decoders=pack_plans(plans))
    cloth = pack_cloth(dress.tiles(scene), scene, ready.world, ready.cloth.mips)
    return replace(ready, cloth=cloth, **vars(dress))


def relit(ready: NeuralScene, scene: Scene, pictures: Mapping[str, NDArray]) -> NeuralScene:
    """A scene with other lights."""
    world = ready.world._replace(lights=pack_lights(scene, dict(pictures)))
    cloth = ready.cloth._replace(bodies=has_bodies(world))
    return replace(ready, world=world, cloth=cloth, lights=_placed(scene, pictures))


def _identity(material: SurfaceMaterial) -> tuple:
    """All that an encoder sees of a material."""
    return (
        material.weave.shape, material.weave.tobytes(), material.twist, material.inclination, material.roughness,
        material.height_scale, material.gap,
    )  # fmt: skip


def asset_networks(scene: Scene, left_out: Callable[[str, str], None]) -> dict[int, AssetMaterial]:
    """The networks of fabrics' own, by the fabrics' numbers; ``left_out`` is told (problem, place) of stale ones."""
    found: dict[int, AssetMaterial] = {}
    for number, surface in enumerate(scene.fabrics):
        file = surface.fabric.neural_weights
        if not file:
            continue
        material = load_asset_network(file, surface.fabric)
        if material is None:
            left_out(f"the fabric is not what {file} was trained on, which is not used", surface.path)
        else:
            found[number] = material
    return found


def _check_uv(scene: Scene) -> None:
    worn = {k for k, material in enumerate(scene.materials) if material.fabric >= 0}
    for mesh in scene.meshes:
        if mesh.uv is None and worn & set(np.unique(mesh.face_material).tolist()):
            raise UsdfabError(
                "the cloth has no texture coordinates", place=mesh.path, remedy="bind it with: usdfab bind --unwrap"
            )


def _assemble(
    scene: Scene, dress: _Dress, networks: Mapping[str, Weights], warnings: list[str],
    pictures: Mapping[str, NDArray], strict: bool,
) -> NeuralScene:  # fmt: skip
    maps = [surface.albedo_map for surface in scene.fabrics]
    wanted = [t for m in scene.materials if m.fabric < 0 for t in m.textures.values()] + [m for m in maps if m]
    images, said = load_texture_images(wanted, strict)
    plain = [m if m.fabric < 0 else replace(m, textures={}) for m in scene.materials]
    rows, used, more = pack_materials(plain, images)
    mips = np.full((len(maps), 2), -1, dtype=np.int32)
    for number, image in enumerate(maps):
        if image is not None and image.file in images:
            levels = mip_levels(image, images)
            mips[number] = len(used), len(levels)
            for level, (texture, texels) in enumerate(levels):
                name = f"{image.file}#{number}.{level}"
                images[name] = texels
                used.append(replace(texture, file=name))
    tiles = [Tiles(number, 1) for number in range(len(scene.fabrics))]
    macro, embree_scene = build_macro(scene, tiles, [-1] * len(tiles))
    intersect, occluded = embree.function_addresses()
    addresses = tuple(np.uint64(a) for a in (intersect, occluded, filter_address(), embree_scene.handle))
    world = World(
        macro, pack_patches([]), rows, pack_textures(used, images), pack_lights(scene, dict(pictures)),
        addresses,  # type: ignore[arg-type]
    )  # fmt: skip
    plans = dress.plans(networks)
    return NeuralScene(
        world=world, plans=plans, decoders=pack_plans(plans), **vars(dress),
        cloth=pack_cloth(dress.tiles(scene), scene, world, mips), lights=_placed(scene, pictures),
        embree=embree_scene, warnings=(*warnings, *said, *more),
    )  # fmt: skip


def _placed(scene: Scene, pictures: Mapping[str, NDArray]) -> list[PlacedLight]:
    return [
        PlacedLight(pack_lights(replace(scene, lights=(light,)), dict(pictures)), _places(light))
        for light in scene.lights
    ]


def _places(light: Light) -> int:
    if isinstance(light, DomeLight):
        return DOME_PLACES
    if isinstance(light, PointLight) or (isinstance(light, DistantLight) and light.half_angle <= SHARP):
        return 1
    return AREA_PLACES


def mip_levels(texture: Texture, images: Mapping[str, NDArray]) -> Sequence[tuple[Texture, NDArray[np.float32]]]:
    """A texture and smaller and smaller copies, each the mean of four texels, down to one: (texture, linear texels)."""
    packed = pack_textures([texture], images)
    height, width, channels = (int(packed.table[0, k]) for k in (2, 1, 3))
    texels = np.repeat(packed.texels[: height * width * channels].reshape(height, width, channels), 4 - channels, 2)
    linear = replace(texture, linear=True, channels="rgb")
    levels = [(linear, texels[..., :3])]
    while max(texels.shape[:2]) > 1:
        for axis in (0, 1):
            count = texels.shape[axis]
            if count > 1:
                even = texels.take(range(count - count % 2), axis=axis)
                texels = 0.5 * (even.take(range(0, count - 1, 2), axis=axis) + even.take(range(1, count, 2), axis=axis))
        levels.append((linear, np.ascontiguousarray(texels[..., :3], dtype=np.float32)))
    return levels
