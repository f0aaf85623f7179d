"""Fibers against their baked maps, seen from afar: brightness and blurred difference under several lights.

    python tests/benchmarks/bench_export.py [denim linen ...] [--side 256] [--spp 64] [--smoke]

Each fabric is exported as ``usdfab export`` does, its look layer is read back without the fabric schema, and both are
rendered on the same mesh under the same lights. A ratio is the maps' mean over the fibers', by channel; the difference
is the root mean square of the blurred pictures' difference over the fibers' mean. One line of JSON for each fabric.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pxr import Usd
from scipy.ndimage import gaussian_filter

from usdfab.cli.export_files import ExportOptions, export
from usdfab.fabric import FabricParameters, YarnParameters, preset
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.bake import BakeSettings
from usdfab.tracer.bake_files import MAPS
from usdfab.usd.fabric_io import find_fabric, write_fabric
from usdfab.usd.look_layer import without_fibers
from usdfab.usd.problems import Problems
from usdfab.usd.read_materials import read_material
from usdfab.usd.read_scene import read_scene
from usdfab.usd.rig import swatch_scene
from usdfab.usd.scene import Camera, DistantLight, DomeLight, Material, Scene

DRAPE = Path(__file__).resolve().parents[2] / "samples" / "drape.usda"
PRESETS = ("denim", "linen", "silk-satin", "woollen-twill")


@dataclass(frozen=True)
class Comparison:
    """Of one view: (3,) ratio of means, and the blurred difference."""

    view: str
    ratio: NDArray[np.float64]
    difference: float


def sky(below: bool = False) -> DomeLight:
    """A uniform white sky about +z, or the whole sphere."""
    if below:
        return DomeLight("/Sky", np.eye(4), np.ones(3))
    half = np.zeros((64, 128, 3), np.float32)
    half[:32] = 1.0
    upright = np.eye(4)
    upright[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return DomeLight("/Sky", upright, np.ones(3), texture=half)


def sun(degrees: float, azimuth: float) -> DistantLight:
    """Parallel light so many degrees from +z, under which a white diffuse sheet has radiance 1."""
    a, b = math.radians(degrees), math.radians(azimuth)
    toward = np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)])
    return DistantLight("/Sun", -toward, np.full(3, math.pi / math.cos(a)), 0.0)


def tilted(camera: Camera, degrees: float) -> Camera:
    """The swatch's camera, turned about the sample's middle towards +x."""
    a, distance = math.radians(degrees), float(camera.to_world[2, 3])
    to_world = np.eye(4)
    to_world[:3, 0] = math.cos(a), 0.0, -math.sin(a)
    to_world[:3, 2] = math.sin(a), 0.0, math.cos(a)
    to_world[:3, 3] = distance * to_world[:3, 2]
    return replace(camera, to_world=to_world)


def views(fabric: FabricParameters) -> Iterator[tuple[str, Scene, Camera]]:
    """Scenes with fibers."""
    scene = swatch_scene(fabric)
    camera = scene.cameras[0]
    yield "rig", scene, camera
    yield "sky", replace(scene, lights=(sky(),)), camera
    yield "sun 45, from 30", replace(scene, lights=(sun(45, 30),)), camera
    around = tuple(replace(s, irradiance=s.irradiance / 8) for s in (sun(45, 45 * k) for k in range(8)))
    yield "sun 45, mean", replace(scene, lights=around), camera
    yield "sky, seen at 60", replace(scene, lights=(sky(),)), tilted(camera, 60)
    yield "all around", replace(scene, lights=(sky(below=True),)), camera


def mapped(scene: Scene, look: Material) -> Scene:
    """The same scene with a plain surface in the place of the fabric."""
    materials = tuple(replace(look, path=m.path) if m.fabric >= 0 else m for m in scene.materials)
    return replace(scene, materials=materials, fabrics=())


def exported_look(fabric: FabricParameters, folder: Path, side: int, meters_per_uv: float = 1.0) -> Material:
    """The look of a fabric as another program reads it from the exported layer."""
    source, out = folder / "fabric.usda", folder / f"look{meters_per_uv:g}"
    if not source.exists():
        write_fabric(fabric, source)
    export(
        source,
        out,
        ExportOptions("folder", MAPS, BakeSettings((side, 0)), meters_per_uv=meters_per_uv),
        lambda *_: None,
    )
    stage = Usd.Stage.Open(str(out / "fabric_look.usda"))
    path = find_fabric(stage).GetPath()
    assert without_fibers(stage) == [str(path)]
    problems = Problems(strict=True)
    return read_material(stage.GetPrimAtPath(path), Usd.TimeCode.Default(), problems).material


def compared(view: str, fibers: Scene, maps: Scene, camera: Camera, spp: int, side: int = 48) -> Comparison:
    """Render both and compare."""
    settings = RenderSettings(resolution=(side, 0), spp=spp)
    a, b = (Tracer(scene).render(camera, settings).pixels.astype(float) for scene in (fibers, maps))
    blurred = [gaussian_filter(p, (3, 3, 0)) for p in (a, b)]
    difference = math.sqrt(float(((blurred[0] - blurred[1]) ** 2).mean())) / float(a.mean())
    return Comparison(view, b.mean(axis=(0, 1)) / a.mean(axis=(0, 1)), difference)


def compare(fabric: FabricParameters, side: int = 256, spp: int = 64, drape: bool = True) -> list[Comparison]:
    """All views of a fabric."""
    fabric = replace(fabric, albedo_map="")
    with tempfile.TemporaryDirectory() as name:
        look = exported_look(fabric, Path(name), side)
        rows = [compared(view, scene, mapped(scene, look), camera, spp) for view, scene, camera in views(fabric)]
        if drape:
            scene = read_scene(DRAPE, fabric_override=fabric)
            size = scene.fabrics[0].meters_per_uv
            scaled = exported_look(fabric, Path(name), side, size)
            rows.append(compared("drape", scene, mapped(scene, scaled), scene.cameras[0], spp, 96))
    return rows


def main() -> None:
    """Print a line of JSON for each fabric."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("presets", nargs="*", default=PRESETS)
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--spp", type=int, default=64)
    arguments = parser.parse_args()
    for name in ["small"] if arguments.smoke else arguments.presets:
        fabric, side, spp = (small(), 32, 2) if arguments.smoke else (preset(name), arguments.side, arguments.spp)
        start = time.perf_counter()
        found = compare(fabric, side, spp, drape=not arguments.smoke)
        table = {
            row.view: {"ratio": row.ratio.round(4).tolist(), "difference": round(row.difference, 4)} for row in found
        }
        print(
            json.dumps(
                {"bench": "export", "fabric": name, "side": side, "spp": spp, "s": time.perf_counter() - start}
                | {"load": os.getloadavg()[0], "views": table}
            ),
            flush=True,
        )


def small() -> FabricParameters:
    """A fabric of few fibers."""
    yarn = YarnParameters(count=6, radius=2.4e-4, fiber_count=6)
    return FabricParameters(size=(3e-3, 3e-3), warp=yarn, weft=yarn, variants=1)


if __name__ == "__main__":
    main()
