"""Fiber geometry from fabric parameters: centre line, cross-section, noise, yarns, periodic patch."""

from usdfab.fibers.budget import (
    MAX_PATCH_POINTS as MAX_PATCH_POINTS,
    patch_points as patch_points,
    thinned as thinned,
)
from usdfab.fibers.draws import Draws as Draws, Variation as Variation, draw as draw, variation as variation
from usdfab.fibers.fibers import (
    YarnShape as YarnShape,
    closed_twist as closed_twist,
    fiber_offsets as fiber_offsets,
    successors as successors,
)
from usdfab.fibers.flyaways import OpenCurves as OpenCurves
from usdfab.fibers.patch import (
    PATH_TRACING_VERTICES as PATH_TRACING_VERTICES,
    RASTERIZATION_VERTICES as RASTERIZATION_VERTICES,
    FiberSystem as FiberSystem,
    Patch as Patch,
    generate_patch as generate_patch,
    patch_variants as patch_variants,
)
from usdfab.fibers.segments import Layout as Layout, lay_out as lay_out
