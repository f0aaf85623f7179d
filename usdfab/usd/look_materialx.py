"""Baked maps as MaterialX' OpenPBR surface (``ND_open_pbr_surface_surfaceshader``, MaterialX 1.39).

Cloth is thin: ``geometry_thin_walled``, with what shines through as subsurface light that goes straight on. Nodes that
USD's own shader registry does not know (``ND_*``) are a false alarm of its validators; ``usdfab check`` leaves it out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pxr import Gf, Sdf, UsdShade

if TYPE_CHECKING:
    from usdfab.usd.look_layer import MapLook

SURFACE = "ND_open_pbr_surface_surfaceshader"
FUZZ_ROUGHNESS = 0.5


def define_open_pbr(material: UsdShade.Material, look: MapLook, paths: Mapping[str, str], scale: float) -> None:
    """Define the network below ``material`` and connect ``outputs:mtlx:surface``.

    Arguments as in ``look_layer``: ``paths`` are asset paths by map, ``scale`` metres of cloth per unit of uv.
    """
    types = Sdf.ValueTypeNames
    stage, path = material.GetPrim().GetStage(), material.GetPath()

    def node(name: str, kind: str, output: Any, **inputs: tuple[Any, Any]) -> UsdShade.Output:
        """A node and its output; an input is (type, value), where a value can be another node's output."""
        shader = UsdShade.Shader.Define(stage, path.AppendChild(name))
        shader.CreateIdAttr(kind)
        for key, (type_name, value) in inputs.items():
            made = shader.CreateInput(key.rstrip("_"), type_name)
            if isinstance(value, UsdShade.Output):
                made.ConnectToSource(value)
            else:
                made.Set(value)
        return shader.CreateOutput("out", output)

    st = node("MtlxCoordinates", "ND_geompropvalue_vector2", types.Float2, geomprop=(types.String, "st"))
    tiles = Gf.Vec2f(scale / look.size[0], scale / look.size[1])
    place = node("MtlxTiling", "ND_multiply_vector2", types.Float2, in1=(types.Float2, st), in2=(types.Float2, tiles))

    def image(name: str, map_name: str, kind: str, output: Any, default: Any, space: str) -> UsdShade.Output:
        result = node(
            name, f"ND_image_{kind}", output, file=(types.Asset, Sdf.AssetPath(paths[map_name])),
            default=(output, default), texcoord=(types.Float2, place),
            uaddressmode=(types.String, "periodic"), vaddressmode=(types.String, "periodic"),
        )  # fmt: skip
        UsdShade.Shader(result.GetPrim()).GetInput("file").GetAttr().SetColorSpace(space)
        return result

    strongest = max(look.transmittance)
    through = min(max(strongest, 0.0), 0.95)
    inputs: dict[str, tuple[Any, Any]] = {
        "specular_ior": (types.Float, look.ior),
        "geometry_thin_walled": (types.Bool, True),
        # All of the subsurface light leaves on the other side; the base keeps what is reflected.
        "subsurface_weight": (types.Float, through),
        "subsurface_color": (types.Color3f, Gf.Vec3f(*(t / max(strongest, 1e-6) for t in look.transmittance))),
        "subsurface_scatter_anisotropy": (types.Float, 1.0),
        "fuzz_weight": (types.Float, look.fuzz),
        "fuzz_color": (types.Color3f, Gf.Vec3f(*look.albedo)),
        "fuzz_roughness": (types.Float, FUZZ_ROUGHNESS),
    }
    if "albedo" in paths:
        space = "lin_rec709" if look.linear_albedo else "srgb_texture"
        color = image("MtlxAlbedo", "albedo", "color3", types.Color3f, Gf.Vec3f(*look.albedo), space)
        gain = Gf.Vec3f(1.0 / (1.0 - through))
        inputs["base_color"] = (
            types.Color3f,
            node(
                "MtlxBase", "ND_multiply_color3", types.Color3f, in1=(types.Color3f, color), in2=(types.Color3f, gain)
            ),
        )
    if "roughness" in paths:
        found = image("MtlxRoughness", "roughness", "float", types.Float, look.roughness, "raw")
        inputs["specular_roughness"] = (types.Float, found)
    if "opacity" in paths and look.opacity < 1.0:
        found = image("MtlxOpacity", "opacity", "float", types.Float, look.opacity, "raw")
        inputs["geometry_opacity"] = (types.Float, found)
    if "normal" in paths:
        flat = Gf.Vec3f(0.0, 0.0, 1.0) if look.signed_normals else Gf.Vec3f(0.5, 0.5, 1.0)
        found = image("MtlxNormal", "normal", "vector3", types.Float3, flat, "raw")
        if look.signed_normals:  # the normal map node expects codes of [0, 1]
            half = Gf.Vec3f(0.5)
            found = node(
                "MtlxNormalHalf",
                "ND_multiply_vector3",
                types.Float3,
                in1=(types.Float3, found),
                in2=(types.Float3, half),
            )
            found = node(
                "MtlxNormalCode", "ND_add_vector3", types.Float3, in1=(types.Float3, found), in2=(types.Float3, half)
            )
        mapped = node("MtlxNormalMap", "ND_normalmap_float", types.Float3, in_=(types.Float3, found))
        inputs["geometry_normal"] = (types.Float3, mapped)
    surface = node("OpenPBR", SURFACE, types.Token, **inputs)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(surface)
