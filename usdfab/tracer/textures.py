"""Images for kernels, and the materials of surfaces that read them.

An image lies as float32 texels in one flat array beside all the others; a table says where. Of a texture only the
channels that are used are kept: three for ``rgb``, else one. Lookups are bilinear between texel centres, without mip
levels: many samples per pixel average what is minified. Texture space is USD's: (0, 0) is the lower left corner of the
image, v goes up.

Row of the table: 0 first texel's offset, 1 width, 2 height, 3 channels, 4 and 5 wrap mode in s and t, 6:9 scale,
9:12 bias, 12:18 uv transform (rows).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.imaging.color import srgb_to_linear
from usdfab.imaging.image_file import read_layers
from usdfab.scattering.surface_numba import SURFACE_SIZE, WORKFLOW, load_surface, pack_surface
from usdfab.usd.scene import Material, Texture

REPEAT, CLAMP, MIRROR, BLACK = 0, 1, 2, 3
WRAP_MODES = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR, "black": BLACK}
_COLUMNS = 18

INPUTS = ("diffuseColor", "roughness", "metallic", "opacity", "normal", "emissiveColor", "specularColor")
"""Inputs of UsdPreviewSurface that a texture can drive, in the order of ``Materials.textures``."""
_DIFFUSE, _ROUGHNESS, _METALLIC, _OPACITY, _NORMAL, _EMISSIVE, _SPECULAR = range(len(INPUTS))

_EMISSION = SURFACE_SIZE
_ALPHA = SURFACE_SIZE + 3
_THRESHOLD = SURFACE_SIZE + 4
MATERIAL_SIZE = SURFACE_SIZE + 5


class Textures(NamedTuple):
    """Packed textures: ``texels`` of all, ``table`` (N, 18) with a row for each."""

    texels: NDArray[np.float32]
    table: NDArray[np.float64]


class Materials(NamedTuple):
    """Packed materials of surfaces.

    ``rows`` (M, MATERIAL_SIZE): ``pack_surface``, then emission (3), opacity, opacity threshold. ``textures`` (M, 7)
    int32: for each of ``INPUTS`` the row of the texture that replaces it, or -1.
    """

    rows: NDArray[np.float64]
    textures: NDArray[np.int32]


# --- files -----------------------------------------------------------------------------------------------------------


def load_texture_images(textures: Iterable[Texture], strict: bool = False) -> tuple[dict[str, NDArray], list[str]]:
    """The image files of textures as stored, not linearised: (H, W, C) float32, rows from the top.

    C is 1 (grey), 2 (grey, alpha), 3 or 4. Each file is read once.

    Returns
    -------
    images:
        By ``Texture.file``. A file that cannot be read is absent: what it should replace keeps its constant.
    warnings:
        One sentence for each absent file.

    Raises
    ------
    UsdfabError
        If ``strict``, for the first file that cannot be read.
    """
    images: dict[str, NDArray] = {}
    warnings: list[str] = []
    for file in dict.fromkeys(texture.file for texture in textures):
        try:
            images[file] = _read(file)
        except UsdfabError as error:
            if strict:
                raise
            warnings.append(f"a texture is left out: {error}")
    return images, warnings


def _read(file: str) -> NDArray[np.float32]:
    layers = read_layers(file)
    if "" in layers:
        color = layers[""]
    else:
        grey = next((layers[name] for name in ("Y", "I", "L") if name in layers), None)
        if grey is None:
            grey = next((layer for name, layer in layers.items() if layer.ndim == 2 and name != "A"), None)
        if grey is None:
            raise UsdfabError("holds no colour", place=file, remedy="give an RGB or grey image")
        color = grey[..., None]
    image = np.concatenate([color, layers["A"][..., None]], axis=-1) if "A" in layers else color
    if not np.isfinite(image).all():
        raise UsdfabError("the picture has NaN or infinite pixels", place=file, remedy="repair it")
    return image


# --- packing ---------------------------------------------------------------------------------------------------------


def pack_textures(textures: Sequence[Texture], images: Mapping[str, NDArray]) -> Textures:
    """Textures as arrays for ``lookup``, in their order.

    Parameters
    ----------
    images:
        By ``Texture.file``: (H, W) or (H, W, C), C from 1 to 4 as ``load_texture_images`` gives them; whole numbers
        count as codes of which the largest is 1.

    Raises
    ------
    UsdfabError
        For a texture whose image is not there, is not an image, or has values that are not finite.
    """
    table = np.zeros((len(textures), _COLUMNS))
    parts: list[NDArray[np.float32]] = []
    known: dict[tuple[str, str, bool], tuple[int, NDArray[np.float32]]] = {}
    offset = 0
    for row, texture in zip(table, textures, strict=True):
        key = texture.file, texture.channels, texture.linear
        if key not in known:
            texels = _texels(texture, images)
            known[key] = offset, texels
            parts.append(texels.ravel())
            offset += texels.size
        start, texels = known[key]
        row[0:4] = start, texels.shape[1], texels.shape[0], texels.shape[2]
        for column, mode in zip((4, 5), texture.wrap, strict=True):
            if mode not in WRAP_MODES:
                raise UsdfabError(f"{mode} is no wrap mode", place=texture.file, remedy=f"use {', '.join(WRAP_MODES)}")
            row[column] = WRAP_MODES[mode]
        single = _CHANNELS.get(texture.channels)
        pick = [0, 1, 2] if single is None else 3 * [single]
        row[6:9], row[9:12] = np.asarray(texture.scale)[pick], np.asarray(texture.bias)[pick]
        row[12:18] = np.asarray(texture.uv_transform, dtype=float).ravel()
        if not np.isfinite(row).all():
            raise UsdfabError("scale, bias or uv transform is not finite", place=texture.file)
    return Textures(np.concatenate(parts) if parts else np.zeros(1, dtype=np.float32), table)


_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}


def _texels(texture: Texture, images: Mapping[str, NDArray]) -> NDArray[np.float32]:
    """(H, W, 3 or 1) linear texels of the channels that the texture uses."""
    if texture.file not in images:
        raise UsdfabError("the texture was not loaded", place=texture.file)
    image = np.asarray(images[texture.file])
    image = image[..., None] if image.ndim == 2 else image
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4 or image.size == 0:
        raise UsdfabError(f"an array of shape {image.shape} is no image", place=texture.file)
    alpha = image.shape[2] in (2, 4)
    colors = image.shape[2] - alpha
    if texture.channels == "rgb":
        texels = np.repeat(image[..., :1], 3, axis=2) if colors == 1 else image[..., :3]
    elif texture.channels == "a":
        # An image without transparency is opaque.
        texels = image[..., -1:] if alpha else np.ones_like(image[..., :1], dtype=np.float32)
    elif texture.channels in _CHANNELS:
        channel = min(_CHANNELS[texture.channels], colors - 1)
        texels = image[..., channel : channel + 1]
    else:
        raise UsdfabError(f"{texture.channels} is no channel", place=texture.file, remedy="use rgb, r, g, b or a")
    if np.issubdtype(texels.dtype, np.integer):
        texels = texels.astype(np.float32) / np.float32(np.iinfo(texels.dtype).max)
    texels = texels.astype(np.float32)
    if not texture.linear and texture.channels != "a":
        texels = srgb_to_linear(texels)
    if not np.isfinite(texels).all():
        raise UsdfabError("the picture has NaN or infinite pixels", place=texture.file, remedy="repair it")
    return np.ascontiguousarray(texels)


def pack_materials(
    materials: Sequence[Material], images: Mapping[str, NDArray]
) -> tuple[Materials, list[Texture], list[str]]:
    """Materials as arrays for ``surface_at``, ``opacity_at`` and ``normal_at``.

    Numbers outside UsdPreviewSurface's ranges are cut off at their ends, others replaced by defaults. A texture without
    an image in ``images`` is left out, so that the material's constant stands.

    Returns
    -------
    materials:
        A row for each material, those with a fabric included.
    textures:
        For ``pack_textures``; ``Materials.textures`` numbers them.
    warnings:
        A sentence with the material's path for each number that was replaced.
    """
    rows = np.zeros((len(materials), MATERIAL_SIZE))
    index = np.full((len(materials), len(INPUTS)), -1, dtype=np.int32)
    textures: list[Texture] = []
    numbers: dict[tuple, int] = {}
    warnings: list[str] = []
    for row, slots, material in zip(rows, index, materials, strict=True):

        def ranged(value: object, name: str, path: str = material.path) -> NDArray:
            raw = np.asarray(value, dtype=float)
            cut = np.clip(np.nan_to_num(raw, nan=0.0), 0.0, 1.0)
            if not np.array_equal(cut, raw):
                warnings.append(f"{path}: {name} is out of its range, cut to 0 to 1")
            return cut

        specular, ior = material.specular_color, material.ior
        if not (np.isfinite(ior) and ior > 0.0):
            warnings.append(f"{material.path}: ior {ior} is not above 0, taken as 1.5")
            ior = 1.5
        row[:SURFACE_SIZE] = pack_surface(
            ranged(material.base_color, "diffuseColor"),
            float(ranged(material.roughness, "roughness")),
            float(ranged(material.metallic, "metallic")),
            None if specular is None else ranged(specular, "specularColor"),
            float(ranged(material.clearcoat, "clearcoat")),
            float(ranged(material.clearcoat_roughness, "clearcoatRoughness")),
            ior,
        )
        row[_EMISSION : _EMISSION + 3] = np.maximum(np.nan_to_num(material.emissive, posinf=0.0), 0.0)
        row[_ALPHA] = float(ranged(material.opacity, "opacity"))
        row[_THRESHOLD] = material.opacity_threshold
        for slot, name in enumerate(INPUTS):
            texture = material.textures.get(name)
            if texture is not None and texture.file in images:
                key = _identity(texture)
                if key not in numbers:
                    numbers[key] = len(textures)
                    textures.append(texture)
                slots[slot] = numbers[key]
    return Materials(rows, index), textures, warnings


def _identity(texture: Texture) -> tuple:
    arrays = (np.asarray(a, dtype=float).tobytes() for a in (texture.scale, texture.bias, texture.uv_transform))
    return texture.file, texture.channels, tuple(texture.wrap), texture.linear, *arrays


# --- in kernels ------------------------------------------------------------------------------------------------------


@njit(cache=True, inline="always")
def _wrapped(i, count, mode):
    """Index of texel i of a row of ``count`` that goes on to both sides, or -1 for black."""
    if 0 <= i < count:
        return i
    if mode == REPEAT:
        return i % count
    if mode == CLAMP:
        return 0 if i < 0 else count - 1
    if mode == MIRROR:
        i %= 2 * count
        return i if i < count else 2 * count - 1 - i
    return -1


@njit(cache=True)
def lookup(textures, index, u, v):
    """Value of texture ``index`` at texture coordinates: (r, g, b), three times the same for one channel.

    Bilinear between the centres of texels; ``black`` is 0 beyond the border, before scale and bias. Coordinates that
    are not finite give the bias alone.
    """
    table, texels = textures.table, textures.texels
    k = index
    s = table[k, 12] * u + table[k, 13] * v + table[k, 14]
    t = table[k, 15] * u + table[k, 16] * v + table[k, 17]
    if not (abs(s) < 1e9 and abs(t) < 1e9):
        return table[k, 9], table[k, 10], table[k, 11]
    offset, width, height, channels = int(table[k, 0]), int(table[k, 1]), int(table[k, 2]), int(table[k, 3])
    x, y = s * width - 0.5, (1.0 - t) * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    r = g = b = 0.0
    for dy in range(2):
        row = _wrapped(y0 + dy, height, int(table[k, 5]))
        wy = fy if dy == 1 else 1.0 - fy
        for dx in range(2):
            column = _wrapped(x0 + dx, width, int(table[k, 4]))
            if row < 0 or column < 0:
                continue
            w = wy * (fx if dx == 1 else 1.0 - fx)
            at = offset + (row * width + column) * channels
            r += w * texels[at]
            if channels == 3:
                g += w * texels[at + 1]
                b += w * texels[at + 2]
    if channels == 1:
        g = b = r
    return (
        r * table[k, 6] + table[k, 9],
        g * table[k, 7] + table[k, 10],
        b * table[k, 8] + table[k, 11],
    )


@njit(cache=True)
def surface_at(materials, textures, k, u, v):
    """Material k at texture coordinates: (surface, r, g, b), a tuple for ``prepare_surface`` and the emission.

    Emission is radiance in all directions of the upper side.
    """
    rows, slots = materials.rows, materials.textures
    p = load_surface(rows, k)
    r, g, b = rows[k, _EMISSION], rows[k, _EMISSION + 1], rows[k, _EMISSION + 2]
    base_r, base_g, base_b, roughness, metallic = p[0], p[1], p[2], p[3], p[4]
    f0_r, f0_g, f0_b = p[5], p[6], p[7]
    if slots[k, _DIFFUSE] >= 0:
        base_r, base_g, base_b = lookup(textures, slots[k, _DIFFUSE], u, v)
    if slots[k, _ROUGHNESS] >= 0:
        roughness = lookup(textures, slots[k, _ROUGHNESS], u, v)[0]
    if slots[k, _METALLIC] >= 0:
        metallic = lookup(textures, slots[k, _METALLIC], u, v)[0]
    if slots[k, _SPECULAR] >= 0 and p[WORKFLOW] != 0.0:
        f0_r, f0_g, f0_b = lookup(textures, slots[k, _SPECULAR], u, v)
    if slots[k, _EMISSIVE] >= 0:
        r, g, b = lookup(textures, slots[k, _EMISSIVE], u, v)
        r, g, b = max(r, 0.0), max(g, 0.0), max(b, 0.0)
    surface = (base_r, base_g, base_b, roughness, metallic, f0_r, f0_g, f0_b, p[8], p[9], p[10], p[11])
    return surface, r, g, b


@njit(cache=True)
def opacity_at(materials, textures, k, u, v):
    """Share of rays that material k stops at texture coordinates, in [0, 1]; 0 or 1 where it has a threshold."""
    rows = materials.rows
    opacity = rows[k, _ALPHA]
    if materials.textures[k, _OPACITY] >= 0:
        opacity = min(max(lookup(textures, materials.textures[k, _OPACITY], u, v)[0], 0.0), 1.0)
    if rows[k, _THRESHOLD] > 0.0:
        return 1.0 if opacity >= rows[k, _THRESHOLD] else 0.0
    return opacity


@njit(cache=True)
def normal_at(materials, textures, k, u, v):
    """Tangent-space normal of material k: (mapped, x, y, z), unit; (False, 0, 0, 1) without a map.

    x goes along dp/du, y along dp/dv, z along the shading normal. A map that points below the surface counts as none.
    """
    index = materials.textures[k, _NORMAL]
    if index < 0:
        return False, 0.0, 0.0, 1.0
    x, y, z = lookup(textures, index, u, v)
    length = np.sqrt(x * x + y * y + z * z)
    if not (z > 0.0 and length > 1e-12):
        return False, 0.0, 0.0, 1.0
    return True, x / length, y / length, z / length
