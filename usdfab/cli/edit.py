"""``usdfab edit``: change parameters of a fabric."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, print_json, say


def run(
    fabric: Path,
    /,
    *,
    output: Output,
    set_: Annotated[list[str], Parameter(name="--set", help="NAME=VALUE; may be given several times.")],
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Change parameters of a fabric and write the result as a new file.

    Names are weave, size, seed, variants, name, and warp., weft. or both. followed by a parameter: count, radius,
    flattening, fiber_count, fiber_radius, packing, inclination, crimp, twist, ply_count, ply_twist, irregularity,
    migration, migration_rate, flyaway_density, flyaway_loop_fraction, flyaway_length, flyaway_spread, albedo,
    yarn_albedo, roughness_longitudinal, roughness_azimuthal, roughness_primary, ior, cuticle_tilt.

    Usage examples:

        usdfab edit fabric.usda --set warp.albedo=.1,.2,.5 -o blue.usda
        usdfab edit fabric.usda --set "weave=twill 2/2" --set both.radius=120um -o twill.usda

    Parameters
    ----------
    fabric:
        A USD file that holds one fabric.
    """
    from usdfab.cli.settings import parse_settings
    from usdfab.fabric import as_table
    from usdfab.usd.fabric_io import edit_fabric, read_fabric

    edit_fabric(fabric, parse_settings(set_), output, overwrite=overwrite)
    if json:
        print_json({"fabric": as_table(read_fabric(output)), "output": output})
    elif not quiet:
        say(f"wrote {output}")
