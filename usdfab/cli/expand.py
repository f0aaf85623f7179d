"""``usdfab expand``: cloth as instanced fibers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from usdfab.cli.options import Json, Output, Overwrite, Quiet, print_json, say


def run(
    stage: Path,
    /,
    *,
    output: Output,
    fabric: Annotated[Path | None, Parameter(help="A fabric file to put on the cloth of the stage.")] = None,
    prim: Annotated[str | None, Parameter(help="Only this mesh.")] = None,
    region: Annotated[str | None, Parameter(help="Only u0,v0,u1,v1 of the mesh's texture coordinates.")] = None,
    vertices_per_segment: Annotated[int, Parameter(help="Control points for each run of a yarn.")] = 40,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write the cloth of a stage as fibers: one patch of BasisCurves, instanced over each mesh.

    The new file sublayers the stage, which is not changed. Write .usdc: the arrays are large.

    Usage examples:

        usdfab expand samples/drape.usda --fabric fabric.usda -o fibers.usdc

    Parameters
    ----------
    stage:
        A USD file with cloth meshes that have texture coordinates.
    """
    from usdfab.usd.expand import expand
    from usdfab.usd.fabric_io import read_fabric

    result = expand(
        stage,
        output,
        read_fabric(fabric) if fabric is not None else None,
        prim=prim,
        region=_region(region),
        vertices_per_segment=vertices_per_segment,
        overwrite=overwrite,
    )
    if json:
        print_json(
            {
                "output": result.path,
                "meshes": result.meshes,
                "instances": result.instances,
                "prototype_curves": result.curves,
                "prototype_points": result.points,
                "warnings": result.warnings,
            }
        )
    elif not quiet:
        for warning in result.warnings:
            say(f"warning: {warning}")
        say(f"wrote {output}: {result.instances} copies of {result.curves} fibers")


def _region(text: str | None) -> tuple[float, float, float, float] | None:
    from usdfab.errors import UsdfabError

    if text is None:
        return None
    try:
        u0, v0, u1, v1 = (float(part) for part in text.split(","))
    except ValueError:
        raise UsdfabError(
            f"'{text}' is no region", place="--region", remedy="write for example 0.4,0.4,0.6,0.6"
        ) from None
    return u0, v0, u1, v1
