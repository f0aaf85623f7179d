"""``schemas/schema.usda`` as text, made from the parameter table so that the two cannot drift apart.

``FABRIC_ATTRIBUTES`` and ``YARN_ATTRIBUTES`` are also what reading and writing go by: one list of names and types.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from usdfab.fabric.fabric import SIZE_RANGE, VARIANTS_RANGE
from usdfab.fabric.parameters import YARN_PARAMETERS, Parameter
from usdfab.fabric.weave import MAX_REPEAT
from usdfab.usd.registration import FABRIC_API, YARN_API

SCHEMA_VERSION = 4
NAMESPACE = "usdfab"
YARN_NAMESPACE = f"{NAMESPACE}:yarn"
_TYPES = {"float": "double", "int": "int", "color": "color3d", "colors": "color3d[]"}
Limits = tuple[float, float]


@dataclass(frozen=True)
class SchemaAttribute:
    """One attribute of the schema.

    ``name`` is without its namespace (``fiberCount``, ``weave:size``), ``field`` the dataclass field it holds (empty
    where there is none), ``default`` the value in Python, ``text`` the same as usda text, ``since`` the schema version
    that brought it.
    """

    name: str
    field: str
    type_name: str
    default: Any
    text: str
    label: str
    group: str
    doc: str
    hard: Limits | None = None
    soft: Limits | None = None
    since: int = 1


def camel(name: str) -> str:
    """``fiber_count`` -> ``fiberCount``: the fixed mapping from the table's names to USD's."""
    first, *rest = name.split("_")
    return first + "".join(word.capitalize() for word in rest)


def yarn_attribute_name(system: str, attribute: str) -> str:
    """Full name on a prim: ``("warp", "fiberCount")`` -> ``usdfab:yarn:warp:fiberCount``."""
    return f"{YARN_NAMESPACE}:{system}:{attribute}"


def fabric_attribute_name(attribute: str) -> str:
    """Full name on a prim: ``"weave:size"`` -> ``usdfab:weave:size``."""
    return f"{NAMESPACE}:{attribute}"


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(float(value))


def _usda(value: Any, kind: str) -> str:
    if kind == "color":
        return "(" + ", ".join(_number(v) for v in value) + ")"
    if kind == "colors":
        return "[" + ", ".join(_usda(v, "color") for v in value) + "]"
    return _number(value)


def _range_doc(low: float, high: float) -> str:
    return f"[{low:g}, {high:g}]" if math.isfinite(high) else f"[{low:g}, inf)"


def _yarn_attribute(p: Parameter) -> SchemaAttribute:
    doc = f"{p.doc}\nSymbol: {p.symbol}\nUnits: {'dimensionless' if p.unit == '1' else p.unit}"
    doc += f"\nRange: {_range_doc(*p.hard)}"
    label = p.name.replace("_", " ").capitalize() + ("" if p.unit == "1" else f" ({p.unit})")
    return SchemaAttribute(
        camel(p.name), p.name, _TYPES[p.kind], p.default, _usda(p.default, p.kind), label, p.group, doc, p.hard, p.soft,
        p.since,
    )  # fmt: skip


YARN_ATTRIBUTES: tuple[SchemaAttribute, ...] = tuple(_yarn_attribute(p) for p in YARN_PARAMETERS)
"""Attributes of ``UsdfabYarnAPI`` in the table's order."""


def _text(name: str, field: str, label: str, doc: str) -> SchemaAttribute:
    return SchemaAttribute(name, field, "string", "", '""', label, "Provenance", doc)


def _texts(name: str, field: str, label: str, doc: str) -> SchemaAttribute:
    return SchemaAttribute(name, field, "string[]", (), "[]", label, "Provenance", doc)


FABRIC_ATTRIBUTES: tuple[SchemaAttribute, ...] = (
    SchemaAttribute(
        "schemaVersion", "", "int", SCHEMA_VERSION, str(SCHEMA_VERSION), "Schema version", "Fabric",
        "Version of these attributes. Raised when attributes are added; a breaking change gets new schema names.",
    ),
    SchemaAttribute(
        "name", "name", "string", "Fabric", '"Fabric"', "Name", "Fabric",
        "Name of the cloth for people; the prim's own name is free.",
    ),
    SchemaAttribute(
        "weave:name", "", "string", "plain", '"plain"', "Weave", "Weave",
        "Name of the weave for people; the matrix decides.",
    ),
    SchemaAttribute(
        "weave:size", "", "int2", (2, 2), "(2, 2)", "Weave size", "Weave",
        "Picks (rows) and ends (columns) of the weave matrix: one repeat.\nUnits: yarns\n"
        f"Range: [2, {MAX_REPEAT}]", (2, MAX_REPEAT),
    ),
    SchemaAttribute(
        "weave:matrix", "", "int[]", (1, 0, 0, 1), "[1, 0, 0, 1]", "Weave matrix", "Weave",
        "1 where the weft is on top, 0 where the warp is. One row per weft pick, bottom row (small v) first, in a row "
        "the leftmost warp end (small u) first; weft runs along +u, warp along +v. Length: picks * ends.\n"
        "Units: dimensionless\nRange: [0, 1]", (0, 1),
    ),
    SchemaAttribute(
        "sampleSize", "size", "double2", (5e-3, 5e-3), "(0.005, 0.005)", "Sample size (m)", "Fabric",
        "Width (along u) and height (along v) of the sample to which the yarn counts refer; width / ends is the "
        "distance between ends. Metres whatever the stage's units.\n"
        f"Units: m\nRange: {_range_doc(*SIZE_RANGE)}", SIZE_RANGE,
    ),
    SchemaAttribute(
        "seed", "seed", "int", 0, "0", "Seed", "Fabric",
        "Fixes every random draw of the fibers.\nUnits: dimensionless\nRange: [0, 2147483647]", (0, 2**31 - 1),
    ),
    SchemaAttribute(
        "variants", "variants", "int", 4, "4", "Variants", "Fabric",
        "How many variants of the repeating tile a renderer mixes, so that the eye finds no repetition; 1 is off.\n"
        f"Units: dimensionless\nRange: {_range_doc(*VARIANTS_RANGE)}", VARIANTS_RANGE, since=2,
    ),
    SchemaAttribute(
        "metersPerUv", "", "double", 0.0, "0", "Metres per uv (m)", "Fabric",
        "Length on the cloth of one unit of its texture coordinates, in metres. 0: measured on each surface, "
        "sqrt(area on the surface / area in uv).\nUnits: m\nRange: [0, inf)", (0.0, math.inf),
    ),
    SchemaAttribute(
        "albedoMap", "albedo_map", "asset", "", "@@", "Albedo map", "Fabric",
        "Image that multiplies the fiber albedo, looked up with the texture coordinates of the cloth, repeated beyond "
        "them. OpenEXR and Radiance files are linear Rec. 709, others sRGB. Not authored, or empty: none. The primvar "
        "usdfab:albedo of a mesh multiplies the albedo likewise.", since=2,
    ),
    SchemaAttribute(
        "neural:weights", "neural_weights", "asset", "", "@@", "Neural weights", "Fabric",
        "File of `usdfab train neural --asset` with a network of this fabric's own, for the neural backend. It is used "
        "only as long as the fabric is the one that it was trained on. Not authored, or empty: none.", since=4,
    ),
    _text("provenance:source", "source", "Source", "The photo or file that the parameters come from."),
    _text("provenance:sourceSha256", "source_sha256", "Source SHA-256", "SHA-256 of the source file, hexadecimal."),
    _text("provenance:generator", "generator", "Generator", "Program and version that wrote the parameters."),
    _texts("provenance:stages", "stages", "Stages", "Stages of the fit that were run, in order."),
    _texts("provenance:notes", "notes", "Notes", "Remarks of the program or of people."),
)  # fmt: skip
"""Attributes of ``UsdfabFabricAPI``."""

_HEADER = f'''#usda 1.0
(
    """usdfab's USD schema: a woven cloth as a Material that carries its yarns' and fibers' parameters.

    Made from the parameter table by `python -m usdfab.usd.generate_schema`; edit usdfab/fabric/parameters.py or
    usdfab/usd/schema_source.py, not this file. Codeless: any USD program can load it through PXR_PLUGINPATH_NAME.
    """
    subLayers = [ @usd/schema.usda@ ]
)

over "GLOBAL" (
    customData = {{
        string libraryName = "usdfab"
        string libraryPath = "."
        string libraryPrefix = "Usdfab"
        bool skipCodeGeneration = true
    }}
)
{{
}}

class "{FABRIC_API}" (
    inherits = </APISchemaBase>
    customData = {{
        string className = "FabricAPI"
        token apiSchemaType = "singleApply"
        token[] apiSchemaCanOnlyApplyTo = ["Material"]
    }}
    doc = """A woven fabric: its weave, the size of the sample, and where the numbers come from. Lengths are in metres
    whatever the stage's units, since materials travel between stages."""
)
{{
'''

_YARN_HEADER = f'''}}

class "{YARN_API}" (
    inherits = </APISchemaBase>
    customData = {{
        string className = "YarnAPI"
        token apiSchemaType = "multipleApply"
        token propertyNamespacePrefix = "{YARN_NAMESPACE}"
        token[] apiSchemaAllowedInstanceNames = ["warp", "weft"]
        token[] apiSchemaCanOnlyApplyTo = ["Material"]
    }}
    doc = """One yarn system of a woven fabric: `warp` runs along +v, `weft` along +u. Symbols and equations are those
    of Li et al. 2024. Lengths are in metres whatever the stage's units."""
)
{{
'''


def _limits(attribute: SchemaAttribute) -> str:
    def block(label: str, limits: Limits) -> str:
        rows = [f"double {k} = {_number(v)}" for k, v in zip(("minimum", "maximum"), limits, strict=True)
                if math.isfinite(v)]  # fmt: skip
        return "".join(
            [f"            dictionary {label} = {{\n", *(f"                {r}\n" for r in rows), "            }\n"]
        )

    parts = [block("hard", attribute.hard)] if attribute.hard else []
    if attribute.soft:
        parts.append(block("soft", attribute.soft))
    return "        limits = {\n" + "".join(parts) + "        }\n" if parts else ""


def _declaration(attribute: SchemaAttribute, namespace: str) -> str:
    doc = attribute.doc.replace("\n", "\n        ")
    return (
        f"    uniform {attribute.type_name} {namespace}{attribute.name} = {attribute.text} (\n"
        f'        displayName = "{attribute.label}"\n'
        f'        displayGroup = "{attribute.group}"\n'
        f'        doc = """{doc}"""\n'
        f"{_limits(attribute)}"
        "    )\n"
    )


def _class_body(attributes: Iterable[SchemaAttribute], namespace: str) -> str:
    return "\n".join(_declaration(a, namespace) for a in attributes)


def schema_source() -> str:
    """The text of ``schemas/schema.usda``."""
    fabric = _class_body(FABRIC_ATTRIBUTES, f"{NAMESPACE}:")
    return f"{_HEADER}{fabric}{_YARN_HEADER}{_class_body(YARN_ATTRIBUTES, '')}}}\n"


if __name__ == "__main__":
    print(schema_source(), end="")
