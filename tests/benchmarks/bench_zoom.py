"""The switch from fibers to the neural cloth along a zoom: FLIP beside the fibers, frame by frame. One JSON line.

    python tests/benchmarks/bench_zoom.py [--smoke] [--fabric denim] [--spp 64] [--pictures FOLDER]

``flip``: mean FLIP over the pixels in which ``--backend auto`` shows any neural cloth, of its picture against fibers
alone; ``flip_unmatched``: the same with the albedos that follow from the fabric's parameters; ``noise``: of the fibers
against themselves with other random numbers, what two renders of the same thing differ by. ``brightness``: ratio of the
means there. ``step``: mean FLIP there between this frame and the next of a zoom, ``STEP`` nearer, of auto; and
``step_fibers``, of fibers alone: what auto has more than these is a flicker or a visible switch. Pictures are denoised
where the denoiser is installed (``denoised``).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
ZOOMS = (4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
STEP = 1.02
"""From one frame to the next: a zoom by 2 takes 35 frames."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--fabric", default="denim", help="a preset")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--pictures", type=Path, help="folder for fibers, auto and neural side by side")
    arguments = parser.parse_args()

    from usdfab.cli.render_neural import load_networks
    from usdfab.errors import UsdfabError
    from usdfab.fabric import preset
    from usdfab.imaging import check_denoiser, denoise, view_transform, write_image
    from usdfab.imaging.flip import flip_map
    from usdfab.neural.far_look import far_share, matched_scene
    from usdfab.neural.render import render
    from usdfab.neural.stage_scene import build
    from usdfab.tracer import RenderSettings, Tracer
    from usdfab.tracer.render import thread_count
    from usdfab.usd.read_scene import read_scene
    from usdfab.usd.scene import Camera

    try:
        check_denoiser()
        denoised = True
    except UsdfabError:
        denoised = False
    threads = thread_count(arguments.threads)
    size, spp, zooms = ((16, 12), 1, ZOOMS[2:4]) if arguments.smoke else ((160, 120), arguments.spp, ZOOMS)
    window = (0, 0, *size)
    scene = read_scene(ROOT / "samples" / "drape.usda", fabric_override=preset(arguments.fabric))
    ready, tracer = build(scene, load_networks({}), {}), Tracer(scene)

    def fibers(camera: Camera, seed: int) -> np.ndarray:
        made = tracer.render(camera, RenderSettings(size, spp=spp, seed=seed, threads=threads))
        return denoise(made.pixels, made.albedo, made.normal) if denoised else made.pixels

    def mixed(camera: Camera, near: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Share of neural cloth, picture of both, neural cloth alone."""
        share = far_share(ready, scene, camera, size, window)[..., None]
        matched = matched_scene(ready, scene, camera, size, tracer, seed=seed, threads=threads)
        far = render(matched, camera, size, window, 4, threads).pixels
        return share, near + share * (far - near), far

    rows = []
    for number, zoom in enumerate(zooms):
        camera, following = (
            replace(scene.cameras[0], tan_half=scene.cameras[0].tan_half / each) for each in (zoom, STEP * zoom)
        )
        first, second, third = fibers(camera, 0), fibers(camera, 1), fibers(following, 3)
        share, auto, far = mixed(camera, second, 2)
        share_after, auto_after, _ = mixed(following, third, 4)
        plain = render(ready, camera, size, window, 4, threads).pixels
        unmatched = second + share * (plain - second)
        shown = (share[..., 0] > 0.0) | (share_after[..., 0] > 0.0)
        row: dict = {"zoom": zoom, "neural": round(float(share.mean()), 3)}
        if shown.any():
            reference = view_transform(first)
            for name, picture in (("flip", auto), ("flip_unmatched", unmatched), ("noise", second)):
                row[name] = round(float(flip_map(view_transform(picture), reference)[shown].mean()), 4)
            for name, before, after in (("step", auto, auto_after), ("step_fibers", second, third)):
                row[name] = round(float(flip_map(view_transform(after), view_transform(before))[shown].mean()), 4)
            row["brightness"] = round(float(auto[shown].mean() / first[shown].mean()), 3)
        rows.append(row)
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            side = np.concatenate([first, auto, far], axis=1)
            write_image(arguments.pictures / f"zoom-{number}.png", view_transform(side), overwrite=True)
    told = {"bench": "zoom", "fabric": arguments.fabric, "size": size, "spp": spp, "denoised": denoised, "frames": rows}
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
