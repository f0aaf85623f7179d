"""From a finished render to its file, for the commands that write one, and what ``--json`` says of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from usdfab.tracer import Render


@dataclass(frozen=True)
class PictureOptions:
    """How to write pictures: AOV names, and for files to look at the exposure in stops and the view."""

    aovs: tuple[str, ...] = ()
    denoise: bool = False
    exposure: float = 0.0
    view: str = "standard"
    overwrite: bool = False


def picture_options(
    target: Path,
    aov: Sequence[str] | None,
    denoise: bool,
    exposure: float | None,
    view: str | None,
    overwrite: bool,
) -> PictureOptions:
    """The options, checked against the kind of file, before any work.

    Raises
    ------
    UsdfabError
        For names that do not exist, and for options that the kind of file cannot follow.
    """
    from usdfab import imaging
    from usdfab.tracer.aovs import parse_aovs

    names = parse_aovs(aov)
    scene_linear = target.suffix.lower() == ".exr"
    if names and not scene_linear:
        raise UsdfabError("only .exr files hold further layers", place="--aov", remedy="write to an .exr file")
    for option, value in (("--exposure", exposure), ("--view", view)):
        if value is not None and scene_linear:
            raise UsdfabError(".exr files stay scene-linear", place=option, remedy="write to a .png file")
    if exposure is not None and not -100 <= exposure <= 100:
        raise UsdfabError(f"{exposure} is no exposure in stops", place="--exposure", remedy="give e.g. 1 or -0.5")
    if view is not None and view not in imaging.VIEWS:
        raise UsdfabError(f"there is no '{view}'", place="--view", remedy=f"choose {' or '.join(imaging.VIEWS)}")
    if denoise:
        imaging.check_denoiser()
    return PictureOptions(names, denoise, exposure or 0.0, view or "standard", overwrite)


def write_picture(target: Path, render: Render, options: PictureOptions) -> None:
    """Write a render to its file."""
    from usdfab import imaging
    from usdfab.tracer.aovs import aov_layers

    pixels = render.pixels
    if options.denoise:
        pixels = imaging.denoise(pixels, render.albedo, render.normal)
    layers = aov_layers(render, options.aovs) if options.aovs else None
    write_pixels(target, pixels, render.region, render.size, options, layers)


def write_pixels(
    target: Path,
    pixels: NDArray[np.float32],
    region: tuple[int, int, int, int],
    size: tuple[int, int],
    options: PictureOptions,
    layers: dict[str, NDArray] | None = None,
) -> None:
    """Write linear pixels (H, W, 3), the ``region`` of a picture of ``size``, to a file."""
    from usdfab import imaging
    from usdfab._version import __version__

    if target.suffix.lower() != ".exr":
        pixels = imaging.view_transform(pixels, options.exposure, options.view)
    imaging.write_image(
        target,
        pixels,
        overwrite=options.overwrite,
        aovs=layers,
        metadata={"Software": f"usdfab {__version__}"},
        offset=region[:2],
        full_size=size,
    )


def render_facts(target: Path, render: Render) -> dict[str, Any]:
    """What ``--json`` says of a render."""
    height, width = render.pixels.shape[:2]
    return {
        "output": target,
        "backend": "embree",
        "width": width,
        "height": height,
        "region": list(render.region),
        "full_size": list(render.size),
        "spp": render.spp,
        "spp_min": int(render.samples.min()),
        "spp_max": int(render.samples.max()),
        "noise": round(render.noise, 6) if math.isfinite(render.noise) else None,
        "seconds": round(render.seconds, 3),
        "rays": render.rays,
        "fiber_segments": render.patch_segments,
    }


def render_line(target: Path, render: Render) -> str:
    """One sentence for people."""
    height, width = render.pixels.shape[:2]
    rate = render.rays / max(render.seconds, 1e-9) / 1e6
    low, high = int(render.samples.min()), int(render.samples.max())
    spp = f"{render.spp} spp" if low == high else f"{render.spp} spp on average ({low} to {high})"
    noise = f", noise {render.noise:.3g}" if math.isfinite(render.noise) else ""
    return f"wrote {target}: {width} x {height}, {spp}{noise}, {render.seconds:.1f} s, {rate:.2f} million rays/s"
