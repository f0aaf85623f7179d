"""Embree's C API, as far as usdfab needs it, bound once.

The embreex wheel carries the whole of Embree 4 but its Cython layer binds triangles only; curves are reached through
the C API with ctypes. Kernels call ``rtcIntersect1`` and ``rtcOccluded1`` by address (``intrinsics.py``).
Constants and structures follow ``rtcore_*.h`` of Embree 4.
"""

from __future__ import annotations

import ctypes
import importlib.util
import sys
import threading
import weakref
from collections.abc import Callable
from functools import lru_cache, wraps
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError

_GEOMETRY_TRIANGLE = 0
_GEOMETRY_ROUND_LINEAR_CURVE = 16
_GEOMETRY_INSTANCE = 121
_BUFFER_INDEX, _BUFFER_VERTEX, _BUFFER_FLAGS = 0, 1, 32
_FORMAT_UCHAR, _FORMAT_UINT, _FORMAT_UINT3 = 0x1001, 0x5001, 0x5003
_FORMAT_FLOAT3, _FORMAT_FLOAT4 = 0x9003, 0x9004
_FORMAT_FLOAT3X4_ROW_MAJOR = 0x9134
_BUILD_QUALITY_HIGH = 2
_SCENE_COMPACT, _SCENE_ROBUST = 2, 4
_PROPERTY_VERSION, _PROPERTY_CURVES, _PROPERTY_FILTER = 0, 99, 66
_ERRORS = {1: "unknown error", 2: "invalid argument", 3: "invalid operation", 4: "out of memory", 5: "unsupported CPU"}

NEIGHBOR_LEFT, NEIGHBOR_RIGHT = 1, 2
"""Flags of a linear segment: another one joins at its start, at its end."""

_PADDING = 16
"""Bytes that Embree may read past the last vertex of a shared buffer."""


T = TypeVar("T")
_lock = threading.RLock()


def _once(function: Callable[[], T]) -> Callable[[], T]:
    """The function's first result for ever, also where threads ask at the same time.

    ``lru_cache`` alone may then call it twice, and a geometry of one device in a scene of another is silently empty.
    """
    cached = lru_cache(maxsize=1)(function)

    @wraps(function)
    def locked() -> T:
        with _lock:
            return cached()

    return locked


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


@_once
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
        "rtcAttachGeometryByID": (None, [p, p, u]),
        "rtcSetGeometryTimeStepCount": (None, [p, u]),
        "rtcSetGeometryInstancedScene": (None, [p, p]),
        "rtcSetGeometryTransform": (None, [p, u, ctypes.c_int, ctypes.c_void_p]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


@_once
def device() -> int:
    """The one Embree device of this process: a scene of one device takes no geometry of another."""
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


_FEATURES = {
    "packets of 4": 32,
    "packets of 8": 33,
    "packets of 16": 34,
    "ray mask": 64,
    "filter functions": 66,
    "triangles": 96,
    "curves": 99,
    "back-face culling of curves": 63,
    "parallel commit": 130,
}
"""Device properties that tell what a build of Embree, on this processor, can do."""


def features() -> dict[str, bool]:
    """What this build of Embree can do on this processor."""
    return {name: bool(library().rtcGetDeviceProperty(device(), number)) for name, number in _FEATURES.items()}


@_once
def function_addresses() -> tuple[int, int]:
    """Addresses of ``rtcIntersect1`` and ``rtcOccluded1`` for compiled kernels."""
    lib = library()
    return tuple(  # type: ignore[return-value]
        ctypes.cast(getattr(lib, name), ctypes.c_void_p).value for name in ("rtcIntersect1", "rtcOccluded1")
    )


@_once
def packet_address() -> int:
    """Address of ``rtcIntersect16`` (valid, scene, rays and hits, arguments)."""
    address = ctypes.cast(library().rtcIntersect16, ctypes.c_void_p).value
    assert address is not None
    return address


@_once
def packet_shadow_address() -> int:
    """Address of ``rtcOccluded16`` (valid, scene, rays, arguments)."""
    address = ctypes.cast(library().rtcOccluded16, ctypes.c_void_p).value
    assert address is not None
    return address


class EmbreeScene:
    """A committed Embree scene. Keeps its buffers alive; freed with the object.

    ``handle`` is the address that kernels pass to Embree.
    """

    def __init__(self) -> None:
        lib = library()
        self.buffers: list[NDArray] = []
        """What Embree reads, in the order in which it was added; not to be changed."""
        self._scenes: list[EmbreeScene] = []
        self._geometries = 0
        self.handle: int = lib.rtcNewScene(device())
        self._finalizer = weakref.finalize(self, lib.rtcReleaseScene, self.handle)
        lib.rtcSetSceneFlags(self.handle, _SCENE_COMPACT | _SCENE_ROBUST)
        lib.rtcSetSceneBuildQuality(self.handle, _BUILD_QUALITY_HIGH)

    def add(self, geometry_type: int, buffers: list[tuple[int, int, int, NDArray, int]], time_steps: int = 1) -> None:
        """Add a geometry from (kind, slot, format, array, stride) buffers."""
        lib = library()
        geometry = lib.rtcNewGeometry(device(), geometry_type)
        lib.rtcSetGeometryTimeStepCount(geometry, time_steps)
        for kind, slot, data_format, array, stride in buffers:
            memory = _padded(array)
            self.buffers.append(memory)
            lib.rtcSetSharedGeometryBuffer(
                geometry, kind, slot, data_format, memory.ctypes.data, 0, stride, array.nbytes // stride
            )
        lib.rtcSetGeometryBuildQuality(geometry, _BUILD_QUALITY_HIGH)
        self._attach(geometry)

    def add_instance(self, scene: EmbreeScene, to_world: NDArray) -> None:
        """Add a placed copy of a committed scene; ``to_world`` (K, 3, 4) at K equally spaced times."""
        lib = library()
        geometry = lib.rtcNewGeometry(device(), _GEOMETRY_INSTANCE)
        lib.rtcSetGeometryInstancedScene(geometry, scene.handle)
        lib.rtcSetGeometryTimeStepCount(geometry, len(to_world))
        for step, matrix in enumerate(np.ascontiguousarray(to_world, dtype=np.float32)):
            lib.rtcSetGeometryTransform(geometry, step, _FORMAT_FLOAT3X4_ROW_MAJOR, matrix.ctypes.data)
        self._scenes.append(scene)
        self._attach(geometry)

    def _attach(self, geometry: int) -> None:
        lib = library()
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometryByID(self.handle, geometry, self._geometries)
        lib.rtcReleaseGeometry(geometry)
        self._geometries += 1

    def commit(self) -> EmbreeScene:
        """Build the hierarchy; rays can be traced from now on."""
        library().rtcCommitScene(self.handle)
        error = library().rtcGetDeviceError(device())
        if error:
            raise UsdfabError(f"Embree could not build the scene: {_ERRORS.get(error, error)}")
        return self

    @property
    def nbytes(self) -> int:
        """Bytes of the vertex and index buffers (the hierarchy comes on top)."""
        return sum(b.nbytes for b in self.buffers)


def _padded(array: NDArray) -> NDArray:
    """A copy of the array with memory behind it that may be read."""
    memory = np.zeros(array.nbytes + _PADDING, dtype=np.uint8)
    copy = memory[: array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def add_triangles(scene: EmbreeScene, points: NDArray, triangles: NDArray) -> None:
    """Add triangles (T, 3) to a scene: points (V, 3), or (K, V, 3) at K equally spaced times."""
    keys = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, *points.shape[-2:])
    scene.add(
        _GEOMETRY_TRIANGLE,
        [
            *((_BUFFER_VERTEX, slot, _FORMAT_FLOAT3, key, 12) for slot, key in enumerate(keys)),
            (_BUFFER_INDEX, 0, _FORMAT_UINT3, np.ascontiguousarray(triangles, dtype=np.uint32), 12),
        ],
        len(keys),
    )


def curve_scene(vertices: NDArray, first: NDArray, flags: NDArray) -> EmbreeScene:
    """A scene of round linear segments.

    Parameters
    ----------
    vertices: (V, 4)
        x, y, z, radius.
    first: (S,) or (S, N)
        A segment joins vertex ``first[s]`` and ``first[s] + 1``. More columns stand in the buffer for who reads it
        besides Embree. (Vertices could not have any: Embree wants them at multiples of 16 bytes.)
    flags: (S,)
        ``NEIGHBOR_LEFT | NEIGHBOR_RIGHT``: whether vertex ``first - 1`` and ``first + 2`` continue the curve.
    """
    scene = EmbreeScene()
    first = np.asarray(first, dtype=np.uint32)
    scene.add(
        _GEOMETRY_ROUND_LINEAR_CURVE,
        [
            (_BUFFER_VERTEX, 0, _FORMAT_FLOAT4, np.asarray(vertices, dtype=np.float32), 16),
            (_BUFFER_INDEX, 0, _FORMAT_UINT, first, 4 * int(np.prod(first.shape[1:]))),
            (_BUFFER_FLAGS, 0, _FORMAT_UCHAR, np.ascontiguousarray(flags, dtype=np.uint8), 1),
        ],
    )
    return scene.commit()
