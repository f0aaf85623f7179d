"""Fabrics that people know by name, with plausible real sizes.

Ends and picks per centimetre and yarn sizes are typical of the trade, not measurements of one cloth. The radius follows
from the cover (yarn width over spacing) that such a cloth has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from usdfab.errors import UsdfabError
from usdfab.fabric.fabric import Color, FabricParameters, YarnParameters
from usdfab.fabric.weave import NAMED_WEAVES


def _system(per_cm: float, size: float, cover: float, flattening: float, **values: object) -> YarnParameters:
    """A yarn system from its density (yarns per cm), the sample's side (m) and the cover it reaches."""
    radius = 0.5 * cover * 0.01 / per_cm / flattening
    base = YarnParameters(count=per_cm * 100 * size, radius=radius, flattening=flattening)
    return replace(base, **values)  # type: ignore[arg-type]


def _fabric(name: str, weave: str, mm: float, warp: dict, weft: dict) -> FabricParameters:
    size = mm * 1e-3
    return FabricParameters(
        NAMED_WEAVES[weave], (size, size), _system(size=size, **warp), _system(size=size, **weft), name=name
    )


_SPUN = {"irregularity": 0.25, "twist": 0.11, "fiber_count": 130, "inclination": 0.8}
_FILAMENT = {"irregularity": 0.06, "twist": 0.005, "fiber_count": 80, "inclination": 0.5, "roughness_primary": 0.08}

# Two plies, with the twist at which they close over one repeat, and fibers twisted the other way.
_PLIED = _SPUN | {"ply_count": 2, "twist": 0.25, "ply_twist": -0.2}

_FLAX: Color = (0.66, 0.58, 0.44)
_INDIGO: Color = (0.035, 0.055, 0.17)
_ECRU: Color = (0.78, 0.74, 0.64)


def _linen_plain() -> FabricParameters:
    yarn = dict(per_cm=14, cover=0.82, flattening=1.3, albedo=_FLAX, **_SPUN | {"irregularity": 0.4, "twist": 0.08})
    return _fabric("LinenPlain", "plain", 5, yarn | {"crimp": 0.75}, yarn | {"per_cm": 13, "crimp": 0.85})


def _denim() -> FabricParameters:
    warp = dict(per_cm=26, cover=1.0, flattening=1.15, albedo=_INDIGO, crimp=0.9, **_SPUN)
    weft = dict(per_cm=18, cover=0.85, flattening=1.2, albedo=_ECRU, crimp=0.5, **_SPUN)
    return _fabric("Denim", "denim", 4, warp, weft)


def _wool_twill() -> FabricParameters:
    yarn = dict(per_cm=20, cover=0.95, flattening=1.2, albedo=(0.2, 0.17, 0.16), **_SPUN | {"irregularity": 0.45})
    yarn |= {"cuticle_tilt": 0.05, "roughness_longitudinal": 0.35}
    return _fabric("WoolTwill", "twill_2_2", 4, yarn, yarn | {"per_cm": 19, "albedo": (0.3, 0.27, 0.25)})


def _silk_satin() -> FabricParameters:
    warp = dict(per_cm=90, cover=1.05, flattening=2.2, albedo=(0.75, 0.32, 0.3), crimp=0.35, **_FILAMENT)
    weft = dict(per_cm=44, cover=0.9, flattening=1.8, albedo=(0.75, 0.32, 0.3), crimp=0.5, **_FILAMENT)
    return _fabric("SilkSatin", "satin", 1.2, warp, weft)


def _cotton_sateen() -> FabricParameters:
    warp = dict(per_cm=50, cover=0.95, flattening=1.3, albedo=(0.8, 0.79, 0.76), crimp=0.6, **_SPUN)
    weft = dict(per_cm=44, cover=1.05, flattening=1.5, albedo=(0.8, 0.79, 0.76), crimp=0.5, **_SPUN)
    return _fabric("CottonSateen", "sateen_8", 2, warp, weft)


def _canvas() -> FabricParameters:
    yarn = dict(per_cm=16, cover=0.95, flattening=1.1, albedo=(0.72, 0.66, 0.53), **_SPUN)
    return _fabric("Canvas", "basket", 5, yarn, yarn | {"per_cm": 15})


def _herringbone() -> FabricParameters:
    warp = dict(per_cm=18, cover=0.97, flattening=1.2, albedo=(0.55, 0.5, 0.42), **_SPUN | {"irregularity": 0.45})
    return _fabric("Herringbone", "herringbone", 6, warp, warp | {"per_cm": 17, "albedo": (0.12, 0.1, 0.09)})


def _taffeta() -> FabricParameters:
    warp = dict(per_cm=60, cover=1.0, flattening=1.6, albedo=(0.12, 0.4, 0.38), crimp=0.4, **_FILAMENT)
    weft = dict(per_cm=32, cover=0.95, flattening=1.4, albedo=(0.55, 0.2, 0.35), crimp=0.8, **_FILAMENT)
    return _fabric("Taffeta", "plain", 1.5, warp, weft)


def _woollen_twill() -> FabricParameters:
    yarn = dict(per_cm=12, cover=0.95, flattening=1.15, albedo=(0.5, 0.1, 0.09), crimp=0.8, **_PLIED)
    yarn |= {"irregularity": 0.35, "cuticle_tilt": 0.05, "roughness_longitudinal": 0.35, "migration_rate": 1.0}
    yarn |= {"flyaway_density": 9000.0, "flyaway_length": 7e-4, "flyaway_loop_fraction": 0.35}
    return _fabric("WoollenTwill", "twill_2_2", 5, yarn, yarn | {"per_cm": 11, "albedo": (0.56, 0.13, 0.11)})


def _duck() -> FabricParameters:
    yarn = dict(per_cm=14, cover=0.95, flattening=1.1, albedo=(0.72, 0.66, 0.53), crimp=0.8, **_PLIED)
    yarn |= {"flyaway_density": 2500.0, "flyaway_length": 3.5e-4}
    return _fabric("Duck", "plain", 5, yarn, yarn | {"per_cm": 12})


PRESETS: dict[str, Callable[[], FabricParameters]] = {
    "linen": _linen_plain,
    "denim": _denim,
    "wool-twill": _wool_twill,
    "silk-satin": _silk_satin,
    "cotton-sateen": _cotton_sateen,
    "canvas": _canvas,
    "herringbone": _herringbone,
    "taffeta": _taffeta,
    "woollen-twill": _woollen_twill,
    "duck": _duck,
}


def preset(name: str) -> FabricParameters:
    """The preset called ``name``; ``UsdfabError`` listing the names where there is none."""
    try:
        return PRESETS[name.strip().lower()]()
    except KeyError:
        raise UsdfabError(f"unknown preset '{name}'", remedy=f"use one of {', '.join(PRESETS)}") from None
