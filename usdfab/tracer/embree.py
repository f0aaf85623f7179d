"""Embree's C API, as far as usdfab needs it, bound once.

The embreex wheel carries the whole of Embree 4 but its Cython layer binds triangles only; curves are reached through
the C API with ctypes. Kernels call ``rtcIntersect1`` and ``rtcOccluded1`` by address (``intrinsics.py``).
Constants and structures follow ``rtcore_*.h`` of Embree 4.
"""

from __future__ import annotations

import ctypes
import importlib.util
import sys
import weakref
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError

_GEOMETRY_TRIANGLE = 0
_GEOMETRY_ROUND_LINEAR_CURVE = 16
_BUFFER_INDEX, _BUFFER_VERTEX, _BUFFER_FLAGS = 0, 1, 32
_FORMAT_UCHAR, _FORMAT_UINT, _FORMAT_UINT3 = 0x1001, 0x5001, 0x5003
_FORMAT_FLOAT3, _FORMAT_FLOAT4 = 0x9003, 0x9004
_BUILD_QUALITY_HIGH = 2
_SCENE_ROBUST = 4
_PROPERTY_VERSION, _PROPERTY_CURVES, _PROPERTY_FILTER = 0, 99, 66
_ERRORS = {1: "unknown error", 2: "invalid argument", 3: "invalid operation", 4: "out of memory", 5: "unsupported CPU"}

NEIGHBOR_LEFT, NEIGHBOR_RIGHT = 1, 2
"""Flags of a linear segment: another one joins at its start, at its end."""

_PADDING = 16
"""Bytes that Embree may read past the last vertex of a shared buffer."""


def _library_path() -> Path:
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise UsdfabError("Embree was not found", remedy="install it with: pip install embreex")
    package = Path(spec.origin).parent
    folders = [package.parent / "embreex.libs", package / ".dylibs", package]
    names = ["libembree4*.so*", "libembree4*.dylib", "embree4*.dll"]
    for folder in folders:
        for name in names:
            found = sorted(folder.glob(name))
            if found:
                return found[0]
    raise UsdfabError(
        "the embreex package holds no Embree 4 library", place=str(package), remedy="run: pip install -U embreex"
    )


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The loaded Embree library, with argument types declared."""
    path = _library_path()
    if sys.platform == "win32":
        import os

        os.add_dll_directory(str(path.parent))
    lib = ctypes.CDLL(str(path))
    p, u, s = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    signatures: dict[str, tuple[object, list]] = {
        "rtcNewDevice": (p, [ctypes.c_char_p]),
        "rtcReleaseDevice": (None, [p]),
        "rtcGetDeviceError": (ctypes.c_int, [p]),
        "rtcGetDeviceProperty": (ctypes.c_ssize_t, [p, ctypes.c_int]),
        "rtcNewScene": (p, [p]),
        "rtcReleaseScene": (None, [p]),
        "rtcSetSceneFlags": (None, [p, ctypes.c_int]),
        "rtcSetSceneBuildQuality": (None, [p, ctypes.c_int]),
        "rtcCommitScene": (None, [p]),
        "rtcNewGeometry": (p, [p, ctypes.c_int]),
        "rtcReleaseGeometry": (None, [p]),
        "rtcSetGeometryBuildQuality": (None, [p, ctypes.c_int]),
        "rtcSetSharedGeometryBuffer": (None, [p, ctypes.c_int, u, ctypes.c_int, p, s, s, s]),
        "rtcCommitGeometry": (None, [p]),
        "rtcAttachGeometry": (u, [p, p]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


@lru_cache(maxsize=1)
def device() -> int:
    """The one Embree device of this process."""
    lib = library()
    handle = lib.rtcNewDevice(None)
    if not handle:
        error = lib.rtcGetDeviceError(None)
        raise UsdfabError(f"Embree does not start: {_ERRORS.get(error, error)}")
    for number, what in ((_PROPERTY_CURVES, "curves"), (_PROPERTY_FILTER, "filter functions")):
        if not lib.rtcGetDeviceProperty(handle, number):
            raise UsdfabError(f"this build of Embree has no {what}", remedy="run: pip install -U embreex")
    return handle


def version() -> str:
    """Version of the Embree library, for example ``"4.4.0"``."""
    number = library().rtcGetDeviceProperty(device(), _PROPERTY_VERSION)
    return f"{number // 10000}.{number // 100 % 100}.{number % 100}"


@lru_cache(maxsize=1)
def function_addresses() -> tuple[int, int]:
    """Addresses of ``rtcIntersect1`` and ``rtcOccluded1`` for compiled kernels."""
    lib = library()
    return tuple(  # type: ignore[return-value]
        ctypes.cast(getattr(lib, name), ctypes.c_void_p).value for name in ("rtcIntersect1", "rtcOccluded1")
    )


class EmbreeScene:
    """A committed Embree scene with one geometry. Keeps its buffers alive; freed with the object.

    ``handle`` is the address that kernels pass to Embree.
    """

    def __init__(self, geometry_type: int, buffers: list[tuple[int, int, NDArray, int]]) -> None:
        lib, dev = library(), device()
        self._buffers = [_padded(array) for _, _, array, _ in buffers]
        self.handle: int = lib.rtcNewScene(dev)
        self._finalizer = weakref.finalize(self, lib.rtcReleaseScene, self.handle)
        lib.rtcSetSceneFlags(self.handle, _SCENE_ROBUST)
        lib.rtcSetSceneBuildQuality(self.handle, _BUILD_QUALITY_HIGH)
        geometry = lib.rtcNewGeometry(dev, geometry_type)
        for (kind, data_format, array, stride), memory in zip(buffers, self._buffers, strict=True):
            lib.rtcSetSharedGeometryBuffer(
                geometry, kind, 0, data_format, memory.ctypes.data, 0, stride, array.nbytes // stride
            )
        lib.rtcSetGeometryBuildQuality(geometry, _BUILD_QUALITY_HIGH)
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometry(self.handle, geometry)
        lib.rtcReleaseGeometry(geometry)
        lib.rtcCommitScene(self.handle)
        error = lib.rtcGetDeviceError(dev)
        if error:
            raise UsdfabError(f"Embree could not build the scene: {_ERRORS.get(error, error)}")

    @property
    def nbytes(self) -> int:
        """Bytes of the vertex and index buffers (the hierarchy comes on top)."""
        return sum(b.nbytes for b in self._buffers)


def _padded(array: NDArray) -> NDArray[np.uint8]:
    memory = np.zeros(array.nbytes + _PADDING, dtype=np.uint8)
    memory[: array.nbytes] = np.ascontiguousarray(array).view(np.uint8).ravel()
    return memory


def triangle_scene(points: NDArray, triangles: NDArray) -> EmbreeScene:
    """A scene of triangles: points (V, 3), triangles (T, 3)."""
    return EmbreeScene(
        _GEOMETRY_TRIANGLE,
        [
            (_BUFFER_VERTEX, _FORMAT_FLOAT3, np.ascontiguousarray(points, dtype=np.float32), 12),
            (_BUFFER_INDEX, _FORMAT_UINT3, np.ascontiguousarray(triangles, dtype=np.uint32), 12),
        ],
    )


def curve_scene(vertices: NDArray, first: NDArray, flags: NDArray) -> EmbreeScene:
    """A scene of round linear segments.

    Parameters
    ----------
    vertices: (V, 4)
        x, y, z, radius.
    first: (S,)
        A segment joins vertex ``first[s]`` and ``first[s] + 1``.
    flags: (S,)
        ``NEIGHBOR_LEFT | NEIGHBOR_RIGHT``: whether vertex ``first - 1`` and ``first + 2`` continue the curve.
    """
    return EmbreeScene(
        _GEOMETRY_ROUND_LINEAR_CURVE,
        [
            (_BUFFER_VERTEX, _FORMAT_FLOAT4, np.ascontiguousarray(vertices, dtype=np.float32), 16),
            (_BUFFER_INDEX, _FORMAT_UINT, np.ascontiguousarray(first, dtype=np.uint32), 4),
            (_BUFFER_FLAGS, _FORMAT_UCHAR, np.ascontiguousarray(flags, dtype=np.uint8), 1),
        ],
    )
