"""Writing image files, whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.files import checked_output, whole_file
from usdfab.imaging.color import linear_to_srgb
from usdfab.imaging.openimageio import captured_stderr, openimageio
from usdfab.imaging.resolution import PixelSize

OUTPUT_SUFFIXES = (".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Kinds of files that can be written."""

HALF_MAX = 65504.0
"""Largest finite half float."""

REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""x, y of red, green, blue and white (BT.709-6), for the EXR header."""

_XYZ_LAYERS = frozenset({"normal", "position", "tangent", "velocity"})
_PRECISE_LAYERS = frozenset({"position", "velocity", "variance"})
"""Layers of three that 16-bit floats would spoil: large numbers, and squares of small ones."""
Offset = tuple[int, int]
_TIFF_CHATTER = "failed TIFFWriteCustomDirectory() of the Exif data"  # said of every TIFF without EXIF data


def write_image(
    path: str | Path,
    pixels: ArrayLike,
    *,
    overwrite: bool = False,
    aovs: Mapping[str, ArrayLike] | None = None,
    pixel_size: PixelSize | None = None,
    half: bool = True,
    bits: int = 8,
    metadata: Mapping[str, str] | None = None,
    offset: Offset = (0, 0),
    full_size: tuple[int, int] | None = None,
) -> Path:
    """Write a picture. The file appears only when it is complete; after an error, what was there before is still there.

    ``.exr`` holds linear values. ``.png``, ``.jpg`` and ``.tif`` are sRGB encoded and clipped to [0, 1]. Nothing is
    tone mapped.

    Parameters
    ----------
    path:
        Its suffix chooses the kind: ``OUTPUT_SUFFIXES``. The folder must exist.
    pixels: (H, W, 3) or grey (H, W)
        Linear Rec. 709.
    overwrite:
        Replace an existing file.
    aovs:
        Further layers, EXR only. ``{"albedo": (H, W, 3)}`` becomes the channels ``albedo.R``, ``.G``, ``.B``; normal,
        position, tangent and velocity get ``.X``, ``.Y``, ``.Z``; (H, W, 2) gets ``.U``, ``.V``; (H, W) becomes one
        channel of that name, such as ``Z``, ``A`` being the picture's alpha. Colours, normals and tangents are stored
        like the picture, all else, variance too, as 32-bit floats.
    pixel_size: (width, height) metres
        Written into the resolution tags.
    half:
        EXR: 16-bit floats (larger values are clipped to 65504) or, if False, 32-bit floats.
    bits:
        PNG and TIFF: 8 or 16. JPEG is always 8.
    metadata:
        Text attributes for the header, such as ``{"Software": "usdfab 0.1"}``.
    offset, full_size: (x, y), (width, height)
        Where in a larger picture these pixels belong: EXR's data window in its display window. Other kinds of files
        hold the pixels alone.

    Returns
    -------
    The path.

    Raises
    ------
    UsdfabError
        For an unknown suffix, a missing or unwritable folder, an existing file, pixels that are NaN or infinite,
        arrays whose shapes do not fit, and a disk that refuses.
    """
    target = checked_output(path, OUTPUT_SUFFIXES, overwrite=overwrite, kind="images")
    place, suffix = str(target), target.suffix.lower()
    picture = _checked_pixels(pixels, place)
    if bits not in (8, 16):
        raise UsdfabError(f"{bits} bits are not possible", place=place, remedy="use 8 or 16")
    if suffix == ".exr":
        data, names, kinds = _exr_channels(picture, aovs or {}, half, place)
    elif aovs:
        raise UsdfabError(f"{suffix} files hold no further layers ({', '.join(aovs)})", place=place, remedy="use .exr")
    else:
        kind = "uint16" if bits == 16 and suffix not in (".jpg", ".jpeg") else "uint8"
        data, names, kinds = encoded(picture, 16 if kind == "uint16" else 8), ["R", "G", "B"], [kind] * 3

    oiio = openimageio()
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], kinds[0])
    spec.channelnames = tuple(names)
    if len(set(kinds)) > 1:
        spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in kinds)
    if "A" in names:
        spec.alpha_channel = names.index("A")
    if suffix == ".exr" and full_size is not None:
        spec.x, spec.y = offset
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, *full_size
    describe(spec, suffix, pixel_size, metadata or {})
    save_pixels(oiio, target, spec, data)
    return target


def encoded(pixels: ArrayLike, bits: int = 8) -> NDArray[Any]:
    """Linear values, any shape, as sRGB codes: uint8 or uint16 of the same shape, rounded, clipped to [0, 1]."""
    top = 2**bits - 1
    codes = linear_to_srgb(np.clip(np.asarray(pixels, dtype=np.float64), 0.0, 1.0)) * top
    return np.round(codes).astype(np.uint8 if bits == 8 else np.uint16)


def _checked_pixels(pixels: ArrayLike, place: str) -> NDArray[np.float32]:
    picture = np.asarray(pixels, dtype=np.float32)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=-1)
    if picture.ndim != 3 or picture.shape[-1] != 3 or picture.size == 0:
        raise UsdfabError(f"an array of shape {picture.shape} is no picture (H, W, 3)", place=place)
    bad = ~np.isfinite(picture).all(axis=-1)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise UsdfabError(
            f"{bad.sum()} pixels are NaN or infinite, the first at column {column}, row {row}", place=place
        )
    return picture


def _exr_channels(
    picture: NDArray[np.float32], aovs: Mapping[str, ArrayLike], half: bool, place: str
) -> tuple[NDArray[np.float32], list[str], list[str]]:
    """All layers as one array (H, W, C), with the names and formats of its channels."""
    small = "half" if half else "float"
    layers, names, kinds = [picture], ["R", "G", "B"], [small] * 3
    for name, values in aovs.items():
        layer = np.asarray(values, dtype=np.float32)
        if layer.shape not in (picture.shape, picture.shape[:2], (*picture.shape[:2], 2)):
            raise UsdfabError(f"layer {name} has shape {layer.shape}, the picture {picture.shape}", place=place)
        if np.isnan(layer).any():
            raise UsdfabError(f"layer {name} has NaN pixels", place=place)
        if layer.ndim == 2:
            names.append(name)
            kinds.append("float")
        elif layer.shape[-1] == 2:
            names += [f"{name}.U", f"{name}.V"]
            kinds += ["float"] * 2
        else:
            names += [f"{name}.{axis}" for axis in ("XYZ" if name in _XYZ_LAYERS else "RGB")]
            kinds += ["float" if name in _PRECISE_LAYERS else small] * 3
        layers.append(layer.reshape(*picture.shape[:2], -1))
    if "" in aovs or len(set(names)) < len(names):
        raise UsdfabError(f"layers {', '.join(aovs)} do not all have names of their own", place=place)
    data = np.concatenate(layers, axis=-1)
    for k, kind in enumerate(kinds):
        if kind == "half":
            data[..., k] = np.clip(data[..., k], -HALF_MAX, HALF_MAX)
    return data, names, kinds


def describe(spec: Any, suffix: str, pixel_size: PixelSize | None, metadata: Mapping[str, str]) -> None:
    """Colour space, compression, resolution and text of the header."""
    if suffix == ".exr":
        spec.attribute("oiio:ColorSpace", "lin_rec709_scene")
        spec.attribute("chromaticities", "float[8]", REC709_CHROMATICITIES)
        spec.attribute("compression", "zip")
    else:
        spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    if suffix in (".tif", ".tiff"):
        spec.attribute("compression", "zip")
    if suffix in (".jpg", ".jpeg"):
        spec.attribute("Compression", "jpeg:95")
        spec.attribute("jpeg:subsampling", "4:4:4")
    if pixel_size:
        # JPEG keeps whole numbers up to 65535, EXR only knows inches.
        fine = 0.0254 / min(pixel_size) > 65535 and suffix != ".exr"
        unit, length = ("cm", 0.01) if fine else ("in", 0.0254)
        spec.attribute("ResolutionUnit", unit)
        spec.attribute("XResolution", float(length / pixel_size[0]))
        spec.attribute("YResolution", float(length / pixel_size[1]))
    for name, text in metadata.items():
        spec.attribute(name, text)


def save_pixels(oiio: Any, target: Path, spec: Any, data: NDArray[Any]) -> None:
    """Write beside the target, then rename."""
    place = str(target)
    # libjpeg ends the whole process on a full disk, so that one is asked about beforehand.
    if target.suffix.lower() in (".jpg", ".jpeg") and shutil.disk_usage(target.parent).free < data.nbytes:
        raise UsdfabError("the disk is full", place=place, remedy="make room or choose another folder")
    try:
        with whole_file(target) as temporary, captured_stderr():
            output = oiio.ImageOutput.create(str(temporary))
            if output is None:
                raise UsdfabError(f"cannot be written ({oiio.geterror()})", place=place)
            done = output.open(str(temporary), spec) and output.write_image(np.ascontiguousarray(data))
            done = output.close() and done
            complaint = " ".join(output.geterror().replace(_TIFF_CHATTER, "").split())
            if not done or complaint:
                raise UsdfabError(
                    f"cannot be written ({complaint[:160] or 'no reason given'})",
                    place=place,
                    remedy="check the disk and the folder's permissions",
                )
    except OSError as error:
        raise UsdfabError(f"cannot be written ({error.strerror})", place=place) from error
