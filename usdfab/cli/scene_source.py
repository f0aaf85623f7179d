"""Where a scene comes from, in a few words that can be sent to another process."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from usdfab.fabric import FabricParameters
    from usdfab.usd.scene import Scene


@dataclass(frozen=True)
class SceneSource:
    """The options of ``usdfab render`` that choose the scene: files, absolute, and names within them.

    ``strict``: whatever is wrong with the stage or a file that it names is an error; else it is left out and named in
    the scene's warnings.
    """

    stage: str
    fabric: str | None = None
    rig: str | None = None
    camera: str | None = None
    time_code: float | None = None
    strict: bool = False

    def read(self) -> tuple[Scene, FabricParameters | None]:
        """The scene to render, and the fabric that was put on it, if any."""
        from usdfab.usd.fabric_io import fabric_prims, read_fabric
        from usdfab.usd.read_scene import read_scene
        from usdfab.usd.rig import swatch_scene
        from usdfab.usd.stage import has_geometry, open_stage

        opened = open_stage(self.stage)
        if not has_geometry(opened) and fabric_prims(opened):
            if self.fabric is not None:
                raise UsdfabError("--fabric needs a stage with cloth to put it on", place=self.stage)
            return swatch_scene(read_fabric(self.stage), self.rig, strict=self.strict), None
        if self.rig is not None:
            raise UsdfabError("--rig is for fabrics; this stage has geometry of its own", place=self.stage)
        override = read_fabric(self.fabric) if self.fabric is not None else None
        return read_scene(self.stage, self.time_code, self.camera, override, strict=self.strict), override


def frame_numbers(stage: str | Path, frames: str) -> list[float]:
    """The time codes that ``--frames`` asks for; see ``usdfab.usd.frames.frame_times``."""
    from usdfab.usd.frames import frame_times
    from usdfab.usd.stage import open_stage

    opened = open_stage(stage)
    try:
        return frame_times(opened, frames)
    except UsdfabError as error:
        raise UsdfabError(error.problem, place=f"--frames {frames}", remedy=error.remedy) from error


def read_textures(scene: Scene, strict: bool = False) -> tuple[Scene, dict]:
    """The pictures of dome lights, (H, W, 3) linear, by file name; textures of materials are the tracer's.

    Returns
    -------
    scene:
        Without the dome lights whose picture cannot be read, or that come after another with a picture: its
        ``warnings`` name them.

    Raises
    ------
    UsdfabError
        If ``strict``, for the first picture that cannot be read.
    """
    from usdfab.imaging import read_image
    from usdfab.usd.scene import DomeLight

    found: dict = {}
    lights, warnings = [], list(scene.warnings)
    for light in scene.lights:
        path = light.texture_path if isinstance(light, DomeLight) else ""
        if path and found and not strict:
            warnings.append(f"{light.path}: a second dome light with a texture is not supported, left out")
            continue
        if path and path not in found:
            try:
                found[path] = read_image(path).pixels
            except UsdfabError as error:
                if strict:
                    raise
                warnings.append(f"{light.path}: {error.problem} ({path}); the light is left out")
                continue
        lights.append(light)
    return replace(scene, lights=tuple(lights), warnings=tuple(warnings)), found


def scene_fingerprint(scene: Scene, textures: dict) -> str:
    """A hash of all that pixels depend on: the scene, dome lights' pictures, and the files that materials name."""
    from usdfab.tracer.checkpoint import fingerprint

    named = {t.file for material in scene.materials for t in material.textures.values()}
    named |= {surface.albedo_map.file for surface in scene.fabrics if surface.albedo_map}
    return fingerprint(scene, textures, {file: _digest(file) for file in named})


def _digest(file: str) -> str:
    """Of a file's bytes; empty where it cannot be read, which the tracer will say."""
    try:
        with Path(file).open("rb") as opened:
            digest = hashlib.sha256()
            while block := opened.read(1 << 20):
                digest.update(block)
            return digest.hexdigest()
    except OSError:
        return ""
