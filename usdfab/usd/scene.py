"""A stage in plain data: what renderers need, over NumPy arrays, free of ``pxr``.

Everything is in metres and in world space, with the stage's own up axis. Matrices are 4 x 4 for column vectors,
``p' = M @ p``. Colours are linear Rec. 709; radiance is in the unit in which UsdLux measures ``intensity`` (a diffuse
light of intensity 1 seen directly has pixel value 1 at exposure 0). Arrays are float64 unless said otherwise and are
not to be written to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.fabric import FabricParameters

Array = NDArray[np.float64]
IntArray = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera that looks along its -z, y up: a pinhole or, with ``lens_radius`` > 0, a thin lens.

    Parameters
    ----------
    to_world: (4, 4)
        Rigid: camera space to world space, without scale.
    tan_half: (2,)
        Tangents of half the horizontal and half the vertical field of view.
    offset: (2,)
        Film offset in units of half the film's width and height. The ray through film position (s, t) in [-1, 1]^2
        (right, up) has direction ``(tan_half[0] * (s + offset[0]), tan_half[1] * (t + offset[1]), -1)``.
    exposure: EV
        Pixel value = radiance * 2^exposure; holds all of UsdGeomCamera's exposure attributes.
    lens_radius: metres
        focalLength / (2 fStop); 0 is a pinhole.
    focus_distance: metres
        From the camera to the plane in focus, along -z.
    to_world_close: (4, 4) or None
        ``to_world`` at the shutter's closing, where the camera moves while it is open; between, matrices are blended
        linearly.
    """

    path: str
    to_world: Array
    tan_half: Array
    offset: Array
    exposure: float
    lens_radius: float = 0.0
    focus_distance: float = 0.0
    to_world_close: Array | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Parameters
    ----------
    points: (V, 3) metres
    triangles: (T, 3) int32
        Counter-clockwise seen from the front (the stage's orientation and mirroring transforms are resolved).
    normals: (T, 3, 3) or None
        Unit shading normals at the corners, where the stage authors them or the mesh is a subdivision surface.
    uv: (T, 3, 2) or None
        Texture coordinates at the corners; turned where a fabric is turned on it (``usdfab.usd.orientation``).
    face_material: (T,) int32
        Index into ``Scene.materials``.
    placements: (K, 3, 4) or None
        Copies of the mesh: local to world in metres. None: one copy, ``points`` are in world space. A copy looks as if
        its placed points were a mesh of their own with the same ``uv``: a point of the cloth is ``uv * meters_per_uv``
        whatever the placement's scale, so that yarns grow with a copy that is larger.
    points_close: (V, 3) or None
        ``points`` at the shutter's closing, where they move while it is open; straight lines between.
    placements_close: (K, 3, 4) or None
        The same for ``placements``.
    albedo: (T, 3, 3) or None
        ``primvars:usdfab:albedo`` at the corners, linear Rec. 709; multiplies the fiber albedo of a fabric.
    """

    path: str
    points: Array
    triangles: IntArray
    normals: Array | None
    uv: Array | None
    face_material: IntArray
    double_sided: bool
    placements: Array | None = None
    points_close: Array | None = None
    placements_close: Array | None = None
    albedo: Array | None = None


@dataclass(frozen=True, eq=False)
class Texture:
    """A UsdUVTexture with its coordinates: value = texel(uv') * scale + bias.

    Parameters
    ----------
    file:
        Resolved path of the image.
    channels:
        ``"rgb"``, ``"r"``, ``"g"``, ``"b"`` or ``"a"``: the output that is connected.
    wrap: (s, t)
        ``"repeat"``, ``"clamp"``, ``"mirror"`` or ``"black"``.
    linear:
        Whether texels are data or linear colour; False: they are sRGB and are to be linearised.
    scale, bias: (4,)
    uv_transform: (2, 3)
        uv' = uv_transform @ (u, v, 1), from UsdTransform2d; the identity where there is none.
    """

    file: str
    channels: str
    wrap: tuple[str, str]
    linear: bool
    scale: Array
    bias: Array
    uv_transform: Array


@dataclass(frozen=True, eq=False)
class Material:
    """How a face looks. ``fabric`` is an index into ``Scene.fabrics``, or -1; the rest is UsdPreviewSurface's.

    ``textures`` replaces inputs, by UsdPreviewSurface's input names (``diffuseColor``, ``roughness``, ``normal`` ...).
    ``specular_color`` is None in the metallic workflow. An ``opacity_threshold`` above 0 makes opacity a cut-out.
    """

    path: str
    fabric: int
    base_color: Array
    roughness: float
    metallic: float
    opacity: float
    emissive: Array = field(default_factory=lambda: np.zeros(3))
    specular_color: Array | None = None
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.01
    ior: float = 1.5
    opacity_threshold: float = 0.0
    textures: Mapping[str, Texture] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FabricSurface:
    """A fabric on one mesh. A point of the cloth is ``uv * meters_per_uv``: x along the weft, y along the warp."""

    path: str
    fabric: FabricParameters
    meters_per_uv: float
    albedo_map: Texture | None = None
    """Multiplies the fiber albedo; looked up with the mesh's uv, its transform undoing the fabric's rotation."""


@dataclass(frozen=True, eq=False)
class PointLight:
    """``intensity`` (3,) in W/sr (radiance times square metres), the same in all directions."""

    path: str
    position: Array
    intensity: Array


@dataclass(frozen=True, eq=False)
class SphereLight:
    """A sphere of ``radius`` metres about ``center`` that emits ``radiance`` outward."""

    path: str
    center: Array
    radius: float
    radiance: Array


@dataclass(frozen=True, eq=False)
class DistantLight:
    """Light from infinity that travels along the unit vector ``direction``.

    ``irradiance`` (3,) is what a surface facing the light receives; it comes uniformly from a cone of half angle
    ``half_angle`` radians, 0 for parallel light.
    """

    path: str
    direction: Array
    irradiance: Array
    half_angle: float


@dataclass(frozen=True, eq=False)
class RectLight:
    """The parallelogram ``corner + a edge_u + b edge_v``, a and b in [0, 1], that emits on the side of ``normal``."""

    path: str
    corner: Array
    edge_u: Array
    edge_v: Array
    normal: Array
    radiance: Array


@dataclass(frozen=True, eq=False)
class DiskLight:
    """The ellipse ``center + a axis_u + b axis_v``, a^2 + b^2 <= 1, that emits on the side of ``normal``."""

    path: str
    center: Array
    axis_u: Array
    axis_v: Array
    normal: Array
    radiance: Array


@dataclass(frozen=True, eq=False)
class CylinderLight:
    """The side of a cylinder, without caps, that emits outward: axis from ``center - half`` to ``center + half``."""

    path: str
    center: Array
    half: Array
    radius: float
    radiance: Array


@dataclass(frozen=True, eq=False)
class DomeLight:
    """Light from all directions.

    Parameters
    ----------
    to_world: (4, 4)
        Rotation. In the dome's own space +y is the pole (top row of the image), the image's middle lies in direction
        +z and its left quarter in +x: OpenEXR's latitude-longitude convention, seen from inside.
    radiance: (3,)
        Multiplies the texture, or is the radiance where there is none.
    texture: (H, W, 3) or None
        For scenes made in memory. ``read_scene`` leaves it None: it gives the file's name in ``texture_path``.
    texture_path:
        Latitude-longitude image file, or empty.
    """

    path: str
    to_world: Array
    radiance: Array
    texture: NDArray[Any] | None = None
    texture_path: str = ""


Light = PointLight | SphereLight | DistantLight | RectLight | DiskLight | CylinderLight | DomeLight


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything a renderer needs of a stage at one time.

    ``warnings`` names what was left out or approximated, one sentence each, with prim paths.
    """

    path: str
    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    fabrics: tuple[FabricSurface, ...]
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    warnings: tuple[str, ...]
    up_axis: str
