"""Meshes without fabrics: PLY files, and UsdPreviewSurface: our own plugin, or in ``scalar`` Mitsuba's ``principled``.

What differs from the tracer. Normal maps are left out. Textures are resampled to ``TEXELS`` on a side over what the
mesh uses of them. In the scalar variant, where no plugin of ours runs: ``principled`` has Disney's diffuse lobe, which
is darker or brighter towards grazing angles by its roughness, and its own energy balance between the lobes; its coat is
weighted by a quarter and has another roughness scale; specularColor is not known to it. So pictures agree to a few
percent there, while a surface without specular (an index of refraction below 1.07) is exactly Lambert in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.mi.fibers import Rest
from usdfab.mi.lights import rgb
from usdfab.mi.space import Space
from usdfab.usd.scene import Material, Mesh, Scene, Texture

Floats = NDArray[np.float64]
TextureReader = Callable[[Texture, Floats], Floats]
Description = dict[str, Any]

TEXELS = 1024

_DIFFUSE_BELOW = 1.07
"""Index of refraction below which there is no specular lobe, as in the tracer."""

_KNOWN = ("diffuseColor", "roughness", "metallic", "opacity", "emissiveColor")

_OWN = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants in which our own plugin runs."""


def surface_shapes(
    mi: Any, scene: Scene, rest: Sequence[Rest], textures: TextureReader | None, space: Space, folder: Path
) -> tuple[dict[str, Description], list[str]]:
    """Mitsuba dictionaries of all that is not made of fibers, by mesh, copy and material; and what was left out.

    ``rest`` is cloth without fibers, which is drawn as its material's preview surface.
    """
    shapes: dict[str, Description] = {}
    warnings: list[str] = []
    worn = np.array([m.fabric >= 0 for m in scene.materials])
    for mesh in scene.meshes:
        if mesh.points_close is not None or mesh.placements_close is not None:
            warnings.append(f"{mesh.path}: the Mitsuba backend has no motion blur, the shutter's opening is shown")
    bare = [Rest(mesh, ~worn[mesh.face_material], None) for mesh in scene.meshes]
    for part in (*bare, *rest):
        mesh = part.mesh
        for index in np.unique(mesh.face_material[part.faces]):
            material = scene.materials[index]
            faces = part.faces & (mesh.face_material == index)
            look, said = _look(mi, material, None if mesh.uv is None else mesh.uv[faces], textures)
            warnings += said
            for points, normals in _copies(mesh, faces, part.copy):
                name = f"mesh{len(shapes)}"
                file = folder / f"{name}.ply"
                write_ply(file, space.points(points), normals, None if mesh.uv is None else mesh.uv[faces])
                smooth = {"face_normals": True} if normals is None else {}
                shapes[name] = {"type": "ply", "filename": str(file), **smooth, **look}
    return shapes, list(dict.fromkeys(warnings))


def _copies(mesh: Mesh, faces: NDArray[np.bool_], copy: int | None) -> list[tuple[Floats, Floats | None]]:
    """World-space corners (T, 3, 3) of the chosen faces and their normals, for each placement or one of them."""
    points = mesh.points[mesh.triangles[faces]]
    normals = None if mesh.normals is None else mesh.normals[faces]
    if mesh.placements is None:
        return [(points, normals)]
    found = []
    for matrix in mesh.placements if copy is None else mesh.placements[copy : copy + 1]:
        linear = matrix[:, :3]
        placed = points @ linear.T + matrix[:, 3]
        turned = None if normals is None else normals @ np.linalg.inv(linear)
        if turned is not None:
            turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-300)
        if np.linalg.det(linear) < 0.0:
            # A mirrored copy shows its front where the corners run clockwise.
            placed = placed[:, ::-1]
            turned = None if turned is None else turned[:, ::-1]
        found.append((placed, turned))
    return found


def write_ply(path: Path, corners: Floats, normals: Floats | None, uv: Floats | None) -> None:
    """Triangles (T, 3, 3) with normals and texture coordinates of their corners, as binary PLY."""
    columns = {"x": corners[..., 0], "y": corners[..., 1], "z": corners[..., 2]}
    if normals is not None:
        columns |= {"nx": normals[..., 0], "ny": normals[..., 1], "nz": normals[..., 2]}
    if uv is not None:
        columns |= {"u": uv[..., 0], "v": uv[..., 1]}
    vertices = np.stack([c.ravel() for c in columns.values()], axis=1).astype("<f4")
    faces = np.zeros(len(corners), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, np.arange(3 * len(corners)).reshape(-1, 3)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _look(
    mi: Any, material: Material, uv: Floats | None, textures: TextureReader | None
) -> tuple[Description, list[str]]:
    """BSDF and emitter of a material, and what was left out."""
    own = mi.variant() in _OWN
    known = (*_KNOWN, "specularColor") if own else _KNOWN
    warnings = [f"{material.path}: {name} textures are left out" for name in material.textures if name not in known]
    used = {name: t for name, t in material.textures.items() if name in known}
    if used and (textures is None or uv is None):
        warnings.append(f"{material.path}: textures are left out")
        used = {}

    def value(name: str, constant: Any, change: Callable[[Floats], Floats] = lambda v: v) -> Any:
        if name in used and textures is not None and uv is not None:
            return _bitmap(mi, used[name], uv, textures, change)
        return constant

    base = value("diffuseColor", rgb(material.base_color))
    plain = material.metallic == 0.0 and not material.clearcoat and not {"metallic", "specularColor"} & set(used)
    if material.specular_color is not None and not own:
        warnings.append(f"{material.path}: specularColor is left out")
    if plain and (material.ior == 1.0 and material.specular_color is None if own else material.ior < _DIFFUSE_BELOW):
        bsdf: Description = {"type": "diffuse", "reflectance": base}
    elif own:
        from usdfab.mi.surface_bsdf import SURFACE, register_surface_bsdf

        register_surface_bsdf()
        bsdf = {
            "type": SURFACE,
            "base_color": base,
            "roughness": value("roughness", float(material.roughness), _one),
            "metallic": value("metallic", float(material.metallic), _one),
            "ior": float(material.ior),
            "clearcoat": float(material.clearcoat),
            "clearcoat_roughness": float(material.clearcoat_roughness),
        }
        if material.specular_color is not None:
            bsdf["specular_color"] = value("specularColor", rgb(material.specular_color))
    else:
        bsdf = {
            "type": "principled",
            "base_color": base,
            "roughness": value("roughness", float(material.roughness), _one),
            "metallic": value("metallic", float(material.metallic), _one),
            "eta": max(float(material.ior), 1.001),
            "clearcoat": float(material.clearcoat),
            "clearcoat_gloss": 1.0 - float(material.clearcoat_roughness),
        }
    bsdf = {"type": "twosided", "bsdf": bsdf}
    cut = material.opacity_threshold
    opacity = (lambda v: (v >= cut).astype(float)) if cut > 0.0 else (lambda v: v)
    solid = float(opacity(np.asarray(float(material.opacity))))
    if solid < 1.0 or "opacity" in used:
        bsdf = {"type": "mask", "opacity": value("opacity", solid, lambda v: opacity(_one(v))), "bsdf": bsdf}
    look: Description = {"bsdf": bsdf}
    if np.any(material.emissive) or "emissiveColor" in used:
        look["emitter"] = {"type": "area", "radiance": value("emissiveColor", rgb(material.emissive))}
    return look, warnings


def _one(values: Floats) -> Floats:
    """Inputs with one number have it three times."""
    return values[..., :1]


def _bitmap(
    mi: Any, texture: Texture, uv: Floats, textures: TextureReader, change: Callable[[Floats], Floats]
) -> Description:
    """A texture as the tracer sees it, over the box of texture coordinates that the mesh uses."""
    low, high = uv.reshape(-1, 2).min(axis=0), uv.reshape(-1, 2).max(axis=0)
    size = np.maximum(high - low, 1e-9)
    place = (np.arange(TEXELS) + 0.5) / TEXELS
    u, v = np.meshgrid(low[0] + size[0] * place, low[1] + size[1] * place)
    values = change(textures(texture, np.stack([u.ravel(), v.ravel()], axis=1)).reshape(TEXELS, TEXELS, 3))
    transform = np.eye(4)
    transform[0, 0], transform[1, 1] = 1.0 / size
    transform[:2, 3] = -low / size
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)),
        "raw": True,
        "wrap_mode": "clamp",
        "to_uv": mi.ScalarTransform4f(transform),
    }
