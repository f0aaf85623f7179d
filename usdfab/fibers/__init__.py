"""Fiber geometry from fabric parameters: centre line, cross-section, noise, yarns, periodic patch."""

from usdfab.fibers.fibers import (
    Draws as Draws,
)
from usdfab.fibers.fibers import (
    YarnShape as YarnShape,
)
from usdfab.fibers.fibers import (
    draw as draw,
)
from usdfab.fibers.fibers import (
    fiber_offsets as fiber_offsets,
)
from usdfab.fibers.fibers import (
    successors as successors,
)
from usdfab.fibers.patch import (
    PATH_TRACING_VERTICES as PATH_TRACING_VERTICES,
)
from usdfab.fibers.patch import (
    RASTERIZATION_VERTICES as RASTERIZATION_VERTICES,
)
from usdfab.fibers.patch import (
    FiberSystem as FiberSystem,
)
from usdfab.fibers.patch import (
    Patch as Patch,
)
from usdfab.fibers.patch import (
    generate_patch as generate_patch,
)
from usdfab.fibers.segments import Layout as Layout
from usdfab.fibers.segments import lay_out as lay_out
