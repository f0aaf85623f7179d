"""The size of a pixel, from what microscopes and cameras write into image files."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

SCREEN_DPI = (72.0, 96.0)
"""Resolutions that programs write when they know nothing."""

PRINT_DPI = (150.0, 180.0, 240.0, 300.0, 350.0)
"""Resolutions that cameras with a lens write besides; they speak of printing, not of the thing in the picture."""

_METRES = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "μm": 1e-6,
    "micron": 1e-6,
    "microns": 1e-6,
    "nm": 1e-9,
    "in": 0.0254,
    "inch": 0.0254,
    "inches": 0.0254,
}

PixelSize = tuple[float, float]


def pixel_size_from_tags(tags: Mapping[str, Any]) -> tuple[PixelSize | None, str]:
    """Width and height of a pixel in metres, and one sentence on where they come from or why they are unknown.

    Looked at, in this order: OME-XML in a TIFF's description (``PhysicalSizeX``), ImageJ's description (``unit=``
    with pixels per unit as resolution), and the resolution tags of TIFF, PNG, JPEG and EXR.

    Parameters
    ----------
    tags:
        Tags by OpenImageIO's names: ``XResolution``, ``YResolution``, ``ResolutionUnit``, ``ImageDescription``,
        ``Exif:FocalLength``.
    """
    description = str(tags.get("ImageDescription", ""))
    size = _ome_pixel_size(description)
    if size:
        return size, f"pixel size {_text(size)} from OME metadata"
    x = _number(tags.get("XResolution"))
    y = _number(tags.get("YResolution")) or x
    if not x or not y:
        return None, "no pixel size in the file"
    imagej = re.search(r"^unit=(\S+)", description, re.MULTILINE) if description.startswith("ImageJ=") else None
    unit = (_unescaped(imagej[1]) if imagej else str(tags.get("ResolutionUnit", ""))).lower()
    if unit not in _METRES:
        return None, "no pixel size in the file (the resolution tags have no unit)"
    size = (_METRES[unit] / x, _METRES[unit] / y)
    dpi = 0.0254 / size[0]
    if not imagej:
        if any(abs(dpi - default) <= 1.0 for default in SCREEN_DPI):
            return None, f"no pixel size in the file ({dpi:.0f} dpi is a default that means nothing)"
        if "Exif:FocalLength" in tags and any(abs(dpi - default) <= 1.0 for default in PRINT_DPI):
            return None, f"no pixel size in the file ({dpi:.0f} dpi is a camera's default that means nothing)"
    return (
        size,
        f"pixel size {_text(size)} from {'ImageJ metadata' if imagej else f'the resolution tags ({dpi:.6g} dpi)'}",
    )


def _ome_pixel_size(description: str) -> PixelSize | None:
    """``PhysicalSizeX="0.65" PhysicalSizeXUnit="µm"`` of OME-XML; micrometres where no unit is given."""
    sizes = []
    for axis in "XY":
        value = re.search(rf'PhysicalSize{axis}="([^"]+)"', description)
        unit = re.search(rf'PhysicalSize{axis}Unit="([^"]+)"', description)
        length = _number(value[1]) if value else None
        scale = _METRES.get(_unescaped(unit[1]).lower()) if unit else 1e-6
        if not length or not scale:
            return None
        sizes.append(length * scale)
    return sizes[0], sizes[1]


def _unescaped(text: str) -> str:
    """The micro sign as XML and ImageJ write it."""
    return re.sub(r"&#(181|xB5);|\\u00B5|Âµ", "µ", text, flags=re.IGNORECASE)


def _number(value: Any) -> float | None:
    """A positive finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _text(size: PixelSize) -> str:
    x, y = size[0] * 1e6, size[1] * 1e6
    return f"{x:.6g} um" if abs(x - y) <= 1e-6 * x else f"{x:.6g} x {y:.6g} um"
