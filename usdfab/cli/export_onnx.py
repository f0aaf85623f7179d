"""``usdfab export --onnx``: a fabric's neural material for other engines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from usdfab.cli.options import print_json, say
from usdfab.errors import UsdfabError


@dataclass(frozen=True)
class OnnxOptions:
    """What the command line says."""

    fabric: Path
    output: Path
    prim: str | None
    reflection_weights: Path | None
    transmission_weights: Path | None
    overwrite: bool
    json: bool
    quiet: bool


def export_onnx(options: OnnxOptions) -> None:
    """Write reflection.onnx and transmission.onnx into the output's folder, which may be new."""
    from usdfab.cli.render_neural import load_networks
    from usdfab.files import checked_output
    from usdfab.usd.fabric_io import read_fabric

    output = options.output
    if output.suffix:
        raise UsdfabError("two graphs go into a folder", place=str(output), remedy=f"write e.g. -o {output.stem}")
    if output.exists() and not output.is_dir():
        raise UsdfabError("a file is in the folder's place", place=str(output), remedy="choose another name")
    given = {"reflection": options.reflection_weights, "transmission": options.transmission_weights}
    files = {kind: output / f"{kind}.onnx" for kind in given}
    if output.is_dir():
        for file in files.values():
            checked_output(file, (".onnx",), overwrite=options.overwrite)
    fabric = read_fabric(options.fabric, options.prim)
    networks = load_networks(given, "export --onnx")

    from usdfab.neural.asset_file import load_asset_network
    from usdfab.neural.onnx_graph import fabric_decoders, graph_of, require_onnx, write_graph

    require_onnx()
    own = fabric.neural_weights if not any(given.values()) else ""
    asset = load_asset_network(own, fabric) if own else None
    warnings = [f"the fabric is not what {own} was trained on, which is not used"] if own and asset is None else []
    decoders, tile = fabric_decoders(fabric, networks, asset, str(options.fabric))
    about: dict[str, Any] = {
        "fabric": fabric.name,
        "trained_on": "the fabric's fibers" if asset is not None else "the surface model",
        "tile_meters": [tile[0] * fabric.cell[0], tile[1] * fabric.cell[1]],
        "tile_yarns": list(tile),
    }
    try:
        output.mkdir(exist_ok=True)
    except OSError as error:
        raise UsdfabError(f"cannot make the folder ({error.strerror or error})", place=str(output)) from error
    for kind, decoder in decoders.items():
        write_graph(graph_of(decoder, about), files[kind])
    if not options.quiet:
        for warning in warnings:
            say(f"note: {warning}")
    if options.json:
        said = {"output": output, "files": [str(file) for file in files.values()], "warnings": warnings}
        print_json(said | about | {"architecture": decoders["reflection"].network.architecture})
    elif not options.quiet:
        size = sum(file.stat().st_size for file in files.values())
        say(f"wrote {' and '.join(file.name for file in files.values())} to {output} ({size / 1e6:.2f} MB)")
