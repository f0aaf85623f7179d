"""Bring expanded fibers into Blender, with the materials and parameters that its importer drops.

    blender --background --python samples/blender_import.py -- fibers.usdc --render fibers.png
    python samples/blender_import.py fibers.usdc --save fibers.blend        (with the bpy package)

Blender (5.0 and 5.2 were tried) reads what `usdfab expand` writes, point instancers of curves included, but loses the
materials of curves and all attributes of schemas. `usdfab expand` therefore repeats what is needed as custom data on
the curves. ``restore`` reads it, gives the curves a Principled Hair material of the fibers' own albedo and roughness
(Chiang's model, the one usdfab renders with), and keeps every parameter as a custom property. Rows of
``primvars:usdfab:albedo`` on an instancer, which tint its copies, become an attribute of the instances.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import bpy
import mathutils

KEY = "usdfab"
"""Custom property on curves that holds the facts as JSON."""

TINT = "usdfab_albedo"
"""Attribute of instances that multiplies the fiber albedo."""

CURVE_STEPS = 3
"""Straight pieces between two control points."""


def import_stage(path: Path) -> list[bpy.types.Curves]:
    """Import a USD file into the open scene; returns the fibers, restored."""
    before = set(bpy.data.hair_curves)
    if bpy.context.scene.world is None:
        # Without a world the importer drops dome lights.
        bpy.context.scene.world = bpy.data.worlds.new("World")
    if "FINISHED" not in bpy.ops.wm.usd_import(filepath=str(path)):
        raise SystemExit(f"Blender cannot import {path}")
    fibers = [c for c in bpy.data.hair_curves if c not in before and KEY in c]
    restore(fibers)
    tints = restore_tints(path)
    if tints:
        print(f"tints of {tints} copies restored")
    return fibers


def restore(fibers: list[bpy.types.Curves]) -> None:
    """Give curves their material, and their parameters as custom properties of their own."""
    materials: dict[str, bpy.types.Material] = {}
    for curves in fibers:
        text = curves[KEY]
        facts = json.loads(text)
        for name, value in facts.items():
            curves[f"{KEY}:{name}"] = value
        if text not in materials:
            materials[text] = hair_material(facts)
        curves.materials.clear()
        curves.materials.append(materials[text])
        if "resolution" not in curves.attributes:
            curves.attributes.new("resolution", "INT", "CURVE")
        steps = [CURVE_STEPS] * len(curves.curves)
        curves.attributes["resolution"].data.foreach_set("value", steps)


def hair_material(facts: dict) -> bpy.types.Material:
    """Chiang's fiber model; colour from ``displayColor`` times the tint of the instance.

    Cycles' roughness is usdfab's longitudinal, its radial roughness the azimuthal; its coat makes the first reflection
    sharper: primary roughness = (1 - coat) roughness.
    """
    name = f"{facts.get('fabric') or 'Fabric'} {facts['system']}"
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    hair = tree.nodes.new("ShaderNodeBsdfHairPrincipled")
    hair.model = "CHIANG"
    hair.parametrization = "COLOR"
    longitudinal = float(facts["roughness_longitudinal"])
    coat = 1.0 - float(facts["roughness_primary"]) / max(longitudinal, 1e-3)
    for socket, value in (
        ("Roughness", longitudinal),
        ("Radial Roughness", float(facts["roughness_azimuthal"])),
        ("Coat", min(max(coat, 0.0), 1.0)),
        ("IOR", float(facts["ior"])),
        ("Offset", float(facts["cuticle_tilt"])),
        ("Random Color", 0.0),
        ("Random Roughness", 0.0),
    ):
        if socket in hair.inputs:
            hair.inputs[socket].default_value = value
    color = tree.nodes.new("ShaderNodeAttribute")
    color.attribute_type, color.attribute_name = "GEOMETRY", "displayColor"
    tint = tree.nodes.new("ShaderNodeAttribute")
    tint.attribute_type, tint.attribute_name = "INSTANCER", TINT
    # Without the attribute alpha is 0, and the tint is to be white.
    factor = tree.nodes.new("ShaderNodeMix")
    factor.data_type, factor.blend_type = "RGBA", "MIX"
    factor.inputs["A"].default_value = (1.0, 1.0, 1.0, 1.0)
    product = tree.nodes.new("ShaderNodeMix")
    product.data_type, product.blend_type = "RGBA", "MULTIPLY"
    product.inputs["Factor"].default_value = 1.0
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    colors = [s for s in factor.inputs if s.type == "RGBA"]
    tree.links.new(tint.outputs["Alpha"], factor.inputs["Factor"])
    colors[0].default_value = (1.0, 1.0, 1.0, 1.0)
    tree.links.new(tint.outputs["Color"], colors[1])
    first, second = (s for s in product.inputs if s.type == "RGBA")
    tree.links.new(color.outputs["Color"], first)
    tree.links.new(next(s for s in factor.outputs if s.type == "RGBA"), second)
    tree.links.new(next(s for s in product.outputs if s.type == "RGBA"), hair.inputs["Color"])
    tree.links.new(hair.outputs["BSDF"], output.inputs["Surface"])
    return material


def restore_tints(path: Path) -> int:
    """Tints of instances from the file, as point attributes of the imported instancers; returns how many there are."""
    bpy.utils.expose_bundled_modules()
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    clouds = {o.name.split(".")[0]: o for o in bpy.data.objects if o.type == "POINTCLOUD"}
    total, by_parent = 0, {}
    for o in bpy.data.objects:
        if o.type == "POINTCLOUD" and o.parent:
            by_parent[o.parent.name] = o
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.PointInstancer):
            continue
        tint = UsdGeom.PrimvarsAPI(prim).GetPrimvar("usdfab:albedo")
        cloud = by_parent.get(prim.GetParent().GetName()) or clouds.get(prim.GetName())
        if not tint or not tint.HasValue() or cloud is None:
            continue
        values = [c for color in tint.ComputeFlattened() for c in (*color, 1.0)]
        attributes = cloud.data.attributes
        attribute = attributes.get(TINT) or attributes.new(TINT, "FLOAT_COLOR", "POINT")
        if 4 * len(attribute.data) == len(values):
            attribute.data.foreach_set("color", values)
            total += len(attribute.data)
    return total


# --- command line ----------------------------------------------------------------------------------------------------


def look(eye: tuple[float, ...], target: tuple[float, ...], angle: float) -> None:
    """A camera of its own: from ``eye`` to ``target``, with a vertical field of view of ``angle`` degrees."""
    camera = bpy.data.cameras.new("Closeup")
    camera.sensor_fit, camera.angle = "VERTICAL", math.radians(angle)
    distance = math.dist(eye, target)
    camera.clip_start, camera.clip_end = 1e-3 * distance, 1e3 * distance
    holder = bpy.data.objects.new("Closeup", camera)
    forward = mathutils.Vector(target) - mathutils.Vector(eye)
    holder.matrix_world = mathutils.Matrix.Translation(eye) @ forward.to_track_quat("-Z", "Y").to_matrix().to_4x4()
    bpy.context.scene.collection.objects.link(holder)
    bpy.context.scene.camera = holder


def render(path: Path, resolution: tuple[int, int], samples: int) -> None:
    """Draw the scene with Cycles on the processor: plain sRGB, no tone mapping."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", samples
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    for bounces in ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces"):
        setattr(scene.cycles, bounces, 32)
    scene.cycles_curves.shape = "THICK"
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x, scene.render.resolution_y = resolution
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = str(path.absolute())
    if scene.camera is None:
        scene.camera = next((o for o in scene.objects if o.type == "CAMERA"), None)
    if scene.camera is None:
        raise SystemExit("the stage has no camera: give --eye and --target")
    bpy.ops.render.render(write_still=True)


def numbers(text: str) -> tuple[float, ...]:
    """``1,2,3`` as numbers."""
    return tuple(float(part) for part in text.split(","))


def main(arguments: list[str]) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="what `usdfab expand` wrote")
    parser.add_argument("--render", type=Path, help="draw a picture with Cycles")
    parser.add_argument("--save", type=Path, help="save a .blend file")
    parser.add_argument("--resolution", default="640x480")
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--eye", type=numbers, help="x,y,z of a camera, metres")
    parser.add_argument("--target", type=numbers, help="x,y,z of where it looks, metres")
    parser.add_argument("--angle", type=float, default=24.0, help="vertical field of view, degrees")
    given = parser.parse_args(arguments)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fibers = import_stage(given.file)
    if given.eye and given.target:
        look(given.eye, given.target, given.angle)
    counts = {"curve_objects": len(fibers), "instances": 0}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        counts["instances"] += instance.is_instance and instance.object.type == "CURVES"
    counts["materials"] = len({m.name for c in fibers for m in c.materials if m})
    print(json.dumps(counts))
    if given.render:
        width, height = (int(n) for n in given.resolution.split("x"))
        render(given.render, (width, height), given.samples)
    if given.save:
        bpy.ops.wm.save_as_mainfile(filepath=str(given.save.absolute()))


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
