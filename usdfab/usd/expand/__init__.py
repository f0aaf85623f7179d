"""Cloth as fibers in USD files: instanced pieces of the fabric's tile, or curves bent onto the surface."""

from usdfab.usd.expand.command import (
    MAX_INSTANCES as MAX_INSTANCES,
    MAX_POINTS as MAX_POINTS,
    MAX_XFORMS as MAX_XFORMS,
    TOLERANCE as TOLERANCE,
    ExpandOptions as ExpandOptions,
    Expansion as Expansion,
    TextureReader as TextureReader,
    expand as expand,
)
from usdfab.usd.expand.read_back import WorldCurves as WorldCurves, world_curves as world_curves
from usdfab.usd.expand.seams import Seams as Seams
