"""Loading pyvista, and finding out whether VTK can draw before it crashes on it."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from usdfab.errors import UsdfabError

GL_REMEDY = (
    "install Mesa's EGL (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri) or run on a machine with a display"
)


def pyvista() -> Any:
    """The pyvista module, loaded on first use.

    Raises
    ------
    UsdfabError
        If it is not installed.
    """
    try:
        import pyvista
    except ImportError as error:
        raise UsdfabError(
            f"viewing fibers needs pyvista, which cannot be loaded ({error})", remedy="pip install 'usdfab[view]'"
        ) from error
    return pyvista


def check_off_screen() -> None:
    """Make sure that VTK finds a way to draw without a display.

    VTK tries GLX, EGL and OSMesa in turn and kills the process if none works, so the last one is checked here.

    Raises
    ------
    UsdfabError
        If there is none.
    """
    pyvista()
    import vtkmodules.vtkRenderingOpenGL2
    import vtkmodules.vtkRenderingUI  # noqa: F401  (both register the kinds of windows)
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    with quiet_vtk():
        window = vtkRenderWindow()
    kind = type(window).__name__
    if kind == "vtkRenderWindow" or (kind == "vtkOSOpenGLRenderWindow" and not _has_osmesa()):
        raise UsdfabError("VTK finds no OpenGL to draw with", remedy=GL_REMEDY)


def check_display() -> None:
    """Make sure that a window can be opened.

    Raises
    ------
    UsdfabError
        If there is no display.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsdfabError("there is no display to open a window on", remedy="write a picture with --screenshot instead")
    check_off_screen()


@contextmanager
def quiet_vtk() -> Iterator[None]:
    """Keep VTK's warnings off stderr: it prints one about a missing X server before it goes on to EGL."""
    from vtkmodules.vtkCommonCore import vtkLogger

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)


def _has_osmesa() -> bool:
    names = ["libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so", ctypes.util.find_library("OSMesa")]
    for name in filter(None, names):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False
