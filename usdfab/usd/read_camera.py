"""UsdGeomCamera as plain data: field of view, film offset, exposure, lens.

Focal length, apertures and their offsets are in tenths of a stage unit, ``focusDistance`` is in stage units.
"""

from __future__ import annotations

import math

import numpy as np
from pxr import Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.scene import Array, Camera
from usdfab.usd.stage import site

_TENTH = 0.1
"""Stage units in the unit of focal length and apertures."""


def shutter_of(prim: Usd.Prim, time: Usd.TimeCode) -> tuple[float, float]:
    """``shutter:open`` and ``shutter:close`` of a camera, in time codes relative to the frame."""
    camera = UsdGeom.Camera(prim)
    return float(camera.GetShutterOpenAttr().Get(time)), float(camera.GetShutterCloseAttr().Get(time))


def is_perspective(prim: Usd.Prim, time: Usd.TimeCode) -> bool:
    """Whether usdfab can render through the camera ``prim``."""
    return UsdGeom.Camera(prim).GetProjectionAttr().Get(time) == UsdGeom.Tokens.perspective


def read_camera(
    prim: Usd.Prim, to_world: Array, to_world_close: Array | None, meters_per_unit: float, time: Usd.TimeCode
) -> tuple[Camera, list[str]]:
    """A perspective camera, and what could not be honoured.

    Parameters
    ----------
    to_world: (4, 4), to_world_close: (4, 4) or None
        Local to world in stage units, column vectors: as the shutter opens and as it closes. Scale is dropped.

    Raises
    ------
    UsdfabError
        Unless focal length and apertures are above 0, all numbers finite and the transforms regular.
    """
    camera, place = UsdGeom.Camera(prim), str(prim.GetPath())
    aperture, offset = (
        np.array([float(a.Get(time)) for a in pair])
        for pair in (
            (camera.GetHorizontalApertureAttr(), camera.GetVerticalApertureAttr()),
            (camera.GetHorizontalApertureOffsetAttr(), camera.GetVerticalApertureOffsetAttr()),
        )
    )
    focal = float(camera.GetFocalLengthAttr().Get(time))
    exposure = math.log2(max(float(camera.ComputeLinearExposureScale(time)), 1e-300))
    if not np.isfinite([focal, *aperture, *offset, exposure]).all() or focal <= 0 or (aperture <= 0).any():
        raise UsdfabError("focal length and apertures must be above 0", place=site(prim.GetStage(), prim))
    radius, distance, warnings = _lens(camera, focal, meters_per_unit, time)
    rigid = _rigid(prim, to_world, meters_per_unit)
    close = None if to_world_close is None else _rigid(prim, to_world_close, meters_per_unit)
    if close is not None and np.allclose(close, rigid, rtol=0.0, atol=1e-12):
        close = None
    half, film = aperture / (2.0 * focal), 2.0 * offset / aperture
    return Camera(place, rigid, half, film, exposure, radius, distance, close), warnings


def _lens(
    camera: UsdGeom.Camera, focal: float, meters_per_unit: float, time: Usd.TimeCode
) -> tuple[float, float, list[str]]:
    """Radius of the lens and distance of the plane in focus, metres; (0, 0) for a pinhole."""
    stop, distance = float(camera.GetFStopAttr().Get(time)), float(camera.GetFocusDistanceAttr().Get(time))
    if stop == 0.0:
        return 0.0, 0.0, []
    place = str(camera.GetPath())
    if not (math.isfinite(stop) and stop > 0):
        return 0.0, 0.0, [f"{place}: an fStop of {stop} is not above 0, everything is in focus"]
    if not (math.isfinite(distance) and distance > 0):
        return 0.0, 0.0, [f"{place}: there is an fStop but no focusDistance above 0, everything is in focus"]
    return focal * _TENTH * meters_per_unit / (2.0 * stop), distance * meters_per_unit, []


def _rigid(prim: Usd.Prim, to_world: Array, meters_per_unit: float) -> Array:
    """The transform without its scale and shear, in metres."""
    if not np.isfinite(to_world).all():
        raise UsdfabError("the transform is not finite", place=site(prim.GetStage(), prim))
    u, scale, vt = np.linalg.svd(to_world[:3, :3])
    if scale[-1] == 0:
        raise UsdfabError("the transform is singular", place=site(prim.GetStage(), prim))
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = to_world[:3, 3] * meters_per_unit
    return rigid
