"""What ``usdfab view`` looks at: a live scene, an orbiting camera, and the window's reactions."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.cli.options import say
from usdfab.cli.picture import PictureOptions, write_pixels
from usdfab.cli.render_neural import left_out
from usdfab.cli.scene_source import SceneSource, read_textures
from usdfab.errors import UsdfabError
from usdfab.imaging import encoded
from usdfab.neural.live import FLATTENING, ROUGHNESS, LiveScene
from usdfab.view.orbit import Orbit, fitted_tangents

if TYPE_CHECKING:
    from usdfab.neural.material_file import Weights
    from usdfab.usd.scene import Camera
    from usdfab.view.window import Drag, PictureWindow, Slider

WEAVES = ("plain", "twill 2/1", "twill 2/2", "twill 3/1", "satin 5/2", "satin 8/3", "basket 2/2")
"""That the key w goes through."""

TURN, LIGHT = 180.0, 120.0
"""Degrees of a drag across the window."""

_CODES = encoded(np.arange(65536) / 65535.0)
"""sRGB codes of linear values in 16 bits: a power for each pixel would cost more than to draw it."""

HELP = "drag: turn   middle: move   wheel: zoom   right: light   w: weave   s: save   r: reset   h: hide   q: quit"


class ViewSession:
    """The scene of ``usdfab view`` and where it is looked at from.

    Raises
    ------
    UsdfabError
        For stages that cannot be drawn; without a camera.
    """

    def __init__(
        self, source: SceneSource, networks: Mapping[str, Weights], threads: int, exposure: float = 0.0
    ) -> None:
        scene, _ = source.read()
        scene, pictures = read_textures(scene, source.strict)
        if not scene.cameras:
            raise UsdfabError("the stage has no camera", place=source.stage, remedy="add a UsdGeomCamera")
        self.camera: Camera = scene.cameras[0]
        said = left_out(scene, self.camera)
        if said and source.strict:
            raise UsdfabError(said[0], remedy="leave --strict out")
        self.live = LiveScene(scene, networks, pictures, source.strict)
        self.live.fabric()  # there is one
        self.warnings = [*scene.warnings, *said, *self.live.warnings]
        self.threads, self.exposure = threads, exposure
        self.first = Orbit(self.camera.to_world.astype(float), self._target(), _up(scene.up_axis))
        self.orbit = self.first
        self.sun = (30.0, 45.0)

    # --- what can be done ---

    def turn(self, azimuth: float, elevation: float) -> None:
        """Degrees to the right and upwards."""
        self.orbit = self.orbit.turned(azimuth, elevation)

    def zoom(self, factor: float) -> None:
        self.orbit = self.orbit.zoomed(factor)

    def light(self, azimuth: float, elevation: float) -> None:
        """Degrees: see ``LiveScene.light``."""
        self.sun = (azimuth, float(np.clip(elevation, -90.0, 90.0)))
        self.live.light(*self.sun)

    def change(self, settings: Mapping[str, str]) -> None:
        """Settings of ``usdfab edit``."""
        if settings:
            self.live.set(settings)

    def next_weave(self) -> None:
        """The next of ``WEAVES``."""
        name = self.live.settings.get("weave", "")
        number = WEAVES.index(name) + 1 if name in WEAVES else 0
        self.change({"weave": WEAVES[number % len(WEAVES)]})

    def pixels(self, size: tuple[int, int], spp: int = 1) -> NDArray[np.float32]:
        """Linear pixels (H, W, 3)."""
        tangents = fitted_tangents(self.camera.tan_half, *size)
        camera = replace(
            self.camera, to_world=self.orbit.to_world, tan_half=tangents, lens_radius=0.0, to_world_close=None
        )
        return self.live.picture(camera, size, spp, self.threads).pixels

    def codes(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """sRGB codes (H, W, 3)."""
        linear = self.pixels(size) * np.float32(65535.0 * 2.0**self.exposure)
        return _CODES[np.minimum(linear, np.float32(65535.0)).astype(np.uint16)]

    def save(self, path: Path, size: tuple[int, int], spp: int, *, overwrite: bool) -> float:
        """Write a picture; returns seconds of drawing."""
        import time

        began = time.perf_counter()
        pixels = self.pixels(size, spp)
        seconds = time.perf_counter() - began
        options = PictureOptions(exposure=self.exposure, overwrite=overwrite)
        write_pixels(path, pixels, (0, 0, *size), size, options)
        return seconds

    def edit_line(self, fabric: Path) -> str:
        """What was changed, as a command."""
        return f"usdfab edit {shlex.quote(str(fabric))} {shlex.join(self.live.edit_arguments())}"

    # --- the window ---

    def window(self, size: tuple[int, int], saved_as: str, spp: int, *, quiet: bool) -> None:
        """Open the window, until it is closed. ``saved_as``: file of the key s, in the current folder."""
        window = self.make_window(size, saved_as, spp, quiet=quiet)
        window.show()

    def make_window(
        self, size: tuple[int, int], saved_as: str, spp: int, *, quiet: bool = True, off_screen: bool = False
    ) -> PictureWindow:
        """The window, not yet running."""
        from usdfab.view.window import Controls, PictureWindow

        def save() -> None:
            path = _free(Path(saved_as))
            self.save(path, tuple(made.plotter.window_size), spp, overwrite=False)
            if not quiet:
                say(f"wrote {path}")
                if self.live.settings:
                    say(f"usdfab edit {shlex.join(self.live.edit_arguments())}")

        def reset() -> None:
            self.orbit = self.first

        def toggle() -> None:
            made.toggle()

        keys = {"w": self.next_weave, "s": save, "r": reset, "h": toggle}
        controls = Controls(self.codes, self._dragged, self.zoom, keys, self._sliders(), HELP)
        made = PictureWindow(f"usdfab view: {self.live.scene.path}", size, controls, off_screen=off_screen)
        return made

    def _dragged(self, kind: Drag, right: float, up: float) -> None:
        if kind == "turn":
            self.turn(-TURN * right, -TURN * up)
        elif kind == "pan":
            self.orbit = self.orbit.panned(right, up, self.camera.tan_half)
        else:
            self.light(self.sun[0] + LIGHT * right, self.sun[1] + LIGHT * up)

    def _sliders(self) -> list[Slider]:
        from usdfab.view.window import Slider

        fabric = self.live.fabric()
        sliders = []
        for system in ("warp", "weft"):
            color = list(fabric.system(system).albedo)
            for k, name in enumerate("RGB"):

                def dye(value: float, system: str = system, color: list = color, k: int = k) -> None:
                    color[k] = value
                    self.change({f"{system}.albedo": ",".join(f"{c:.4g}" for c in color)})

                sliders.append(Slider(f"{system} {name}", 0.0, 1.0, float(color[k]), dye))
        roughness, flattening = fabric.warp.roughness_primary, fabric.warp.flattening
        sliders.append(
            Slider("roughness", 0.02, 1.0, roughness, lambda value: self.change({ROUGHNESS: f"{value:.4g}"}))
        )
        # The height scale is 1 / flattening^2 times what the yarns' spacing gives (surface_from_fabric).
        sliders.append(
            Slider("flattening (relief)", 0.5, 3.0, flattening, lambda value: self.change({FLATTENING: f"{value:.4g}"}))
        )
        return sliders

    def _target(self) -> NDArray[np.float64]:
        """The place in the middle of the picture at the distance of the cloth's middle."""
        eye, back = self.camera.to_world[:3, 3], self.camera.to_world[:3, 2]
        distance = float((eye - self.live.middle()) @ back)
        return eye - max(distance, 1e-4) * back


def _up(axis: str) -> NDArray[np.float64]:
    return np.array([0.0, 0.0, 1.0]) if axis == "Z" else np.array([0.0, 1.0, 0.0])


def _free(path: Path) -> Path:
    """The path, or the first with a number that is not there yet."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_stem(f"{path.stem}-{number}")
    return found
