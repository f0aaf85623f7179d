"""A picture to look at while the kernels are compiled: the first render of an installation takes a minute to begin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from usdfab.cli.options import say
from usdfab.cli.picture import PictureOptions, write_pixels
from usdfab.cli.render_files import RenderFile
from usdfab.errors import UsdfabError

if TYPE_CHECKING:
    from types import TracebackType

    from usdfab.tracer import Tracer
    from usdfab.tracer.render import Shot

SUFFIX = ".preview.png"
WIDEST = 640
"""Pixels on the longer side of a preview."""


class Preview:
    """Beside a picture ``out.png`` the file ``out.preview.png``, from the begin of compiling to the end of the render.

    A context manager that removes the file at its end. A file that has the name already is left alone.
    """

    def __init__(
        self, file: RenderFile, tracer: Tracer | None, shot: Shot, options: PictureOptions, *, quiet: bool
    ) -> None:
        """``tracer`` None: somebody else renders, and nothing is shown."""
        self.path: Path = file.output.with_name(f"{file.output.stem}{SUFFIX}")
        self._tracer, self._shot, self._options, self._quiet = tracer, shot, options, quiet
        self._written = False

    def show(self, line: str) -> None:
        """Draw and write the file, and say ``line``, what it is waited for, and where to look."""
        if self._tracer is not None and not self.path.exists():
            from usdfab.tracer.preview import preview

            scale = min(1.0, WIDEST / max(self._shot.width, self._shot.height))
            size = max(1, round(scale * self._shot.width)), max(1, round(scale * self._shot.height))
            pixels = preview(self._tracer, self._shot.camera, *size)
            looks = PictureOptions(view=self._options.view)
            try:
                write_pixels(self.path, pixels, (0, 0, *size), size, looks)
            except UsdfabError as error:
                line += f" (no preview: {error.problem})"
            else:
                self._written = True
                line += f"; {self.path} shows what will be there"
        if not self._quiet:
            say(line)

    def __enter__(self) -> Preview:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._written:
            self.path.unlink(missing_ok=True)
