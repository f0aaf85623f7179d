"""Where a scene comes from, in a few words that can be sent to another process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from usdfab.fabric import FabricParameters
    from usdfab.usd.scene import Scene


@dataclass(frozen=True)
class SceneSource:
    """The options of ``usdfab render`` that choose the scene: files, absolute, and names within them."""

    stage: str
    fabric: str | None = None
    rig: str | None = None
    camera: str | None = None
    time_code: float | None = None

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
            return swatch_scene(read_fabric(self.stage), self.rig), None
        if self.rig is not None:
            raise UsdfabError("--rig is for fabrics; this stage has geometry of its own", place=self.stage)
        override = read_fabric(self.fabric) if self.fabric is not None else None
        return read_scene(self.stage, self.time_code, self.camera, override), override


def read_textures(scene: Scene) -> dict:
    """Pictures that the scene names, (H, W, 3) linear, by file name."""
    from usdfab.imaging import read_image
    from usdfab.usd.scene import DomeLight

    paths = [light.texture_path for light in scene.lights if isinstance(light, DomeLight) and light.texture_path]
    return {path: read_image(path).pixels for path in paths}
