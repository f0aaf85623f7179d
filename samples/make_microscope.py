"""Make the sample photo: a fabric that is none of the presets, rendered by usdfab's own tracer under its capture rig.

    python samples/make_microscope.py

writes ``microscope.png`` and the truth that the fit is judged by, ``microscope_truth.usda``, beside this file. The
picture is synthetic and free to use; no photo of real cloth with a licence that allows shipping it was at hand.
"""

from __future__ import annotations

from pathlib import Path

from usdfab.fabric import FabricParameters, YarnParameters, weave_from_name
from usdfab.imaging import write_image
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.fabric_io import write_fabric
from usdfab.usd.rig import swatch_scene

HERE = Path(__file__).resolve().parent
SIDE = 4e-3
PIXELS = 400
SPP = 160


def sample_fabric() -> FabricParameters:
    """A 2/2 twill of 29 ends and 24 picks per cm: petrol warp, sand-coloured weft, both spun with Z twist."""
    common = {"inclination": 0.75, "roughness_azimuthal": 0.3, "roughness_primary": 0.25}
    warp = YarnParameters(
        count=11.6,
        radius=1.42e-4,
        flattening=1.18,
        fiber_count=96,
        crimp=0.8,
        twist=0.12,
        irregularity=0.22,
        albedo=(0.1, 0.42, 0.5),
        roughness_longitudinal=0.48,
        **common,
    )
    weft = YarnParameters(
        count=9.6,
        radius=1.6e-4,
        flattening=1.22,
        fiber_count=110,
        crimp=0.75,
        twist=0.1,
        irregularity=0.28,
        albedo=(0.7, 0.55, 0.33),
        roughness_longitudinal=0.5,
        **common,
    )
    return FabricParameters(weave_from_name("twill 2/2 z"), (SIDE, SIDE), warp, weft, seed=20, name="Microscope")


def main() -> None:
    """Write the photo and its truth."""
    fabric = sample_fabric()
    scene = swatch_scene(fabric)
    render = Tracer(scene).render(scene.cameras[0], RenderSettings((PIXELS, PIXELS), spp=SPP, seed=7))
    write_image(HERE / "microscope.png", render.pixels, overwrite=True)
    write_fabric(fabric, HERE / "microscope_truth.usda", overwrite=True)
    print(f"{render.seconds:.0f} s, {render.rays / render.seconds / 1e6:.2f} million rays/s")


if __name__ == "__main__":
    main()
