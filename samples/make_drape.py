"""Make ``drape.usda``: a square cloth that fell over a ball on a stand.

    python samples/make_drape.py [-o samples/drape.usda]

Takes half a minute and gives the same file bit for bit. The cloth has no fabric bound to it: bring your own with
``usdfab render samples/drape.usda --fabric fabric.usda`` or ``usdfab bind``. One unit of its texture coordinates is
0.3 m of cloth in both directions. Units are metres; z is up.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from cloth_simulation import simulate

SIDE = 0.30
"""Side of the cloth at rest."""
QUADS = 96
"""Quads along a side."""
SPACING = SIDE / QUADS
BALL_RADIUS = 0.05
BALL_CENTER = (0.0, 0.0, 0.132)
GAP = 0.0009
"""Distance kept between the cloth's mid-surface and the ball or the floor."""
THICKNESS = 0.0022
"""Distance kept between parts of the cloth that fold onto each other."""

DENSITY = 0.16
"""Mass per area, kg / m^2: a light cotton."""
BENDING = 4.0e-6
"""Bending stiffness of the cloth, N m."""
SHEAR = 4.0
"""Shear stiffness, N / m."""
FRICTION = 0.35
DRAG = 1.5
"""Damping by the air, 1 / s."""
GRAVITY = 9.81
DURATION = 2.0
STEP = 1.0 / 9600.0

EYE = (0.15, -0.56, 0.245)
TARGET = (0.0, 0.0, 0.088)
KEY = (0.75, -0.45, 0.75)
BALL_COLOR = "(0.45, 0.3, 0.18)"
BACKDROP_COLOR = "(0.32, 0.33, 0.35)"

Mesh = tuple[np.ndarray, np.ndarray]
"""Points (N, 3) in metres and quads (M, 4), counterclockwise seen from outside; a triangle repeats a corner."""


def initial_cloth() -> np.ndarray:
    """The cloth above the ball, turned, shifted and a little bent so that no two folds come out alike.

    Returns (QUADS+1, QUADS+1, 3); the row index runs along v, the column index along u.
    """
    along = np.linspace(-SIDE / 2, SIDE / 2, QUADS + 1)
    u, v = np.meshgrid(along, along)
    cos, sin = 0.9396926207859084, 0.3420201433256687  # 20 degrees
    x = cos * u - sin * v + 0.006
    y = sin * u + cos * v - 0.009
    z = BALL_CENTER[2] + BALL_RADIUS + 0.006 + 0.02 * u - 0.012 * v + 1.5 * u * v * v
    return np.stack([x, y, z], axis=-1)


def draped_cloth(duration: float = DURATION) -> np.ndarray:
    """The cloth after ``duration`` seconds, (QUADS+1, QUADS+1, 3)."""
    points = initial_cloth()
    inverse_mass = 1.0 / (DENSITY * SPACING**2)
    unit = 1.0 / (inverse_mass * STEP**2)
    simulate(
        points,
        spacing=SPACING,
        steps=round(duration / STEP),
        step=STEP,
        shear=unit / SHEAR,
        bending=unit * SPACING**2 / BENDING,
        ball=np.array(BALL_CENTER),
        radius=BALL_RADIUS,
        gap=GAP,
        thickness=THICKNESS,
        friction=FRICTION,
        drag=DRAG,
        gravity=GRAVITY,
    )
    return points


# --- Meshes ---


def grid_quads(rows: int, columns: int) -> np.ndarray:
    """Quads (rows * columns, 4) of a grid of (rows+1) x (columns+1) points stored row by row."""
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1, 1)
    return first + np.array([0, 1, columns + 2, columns + 1])


def turned_profile(profile: list[tuple[float, float]], sides: int) -> Mesh:
    """Surface of revolution about z from (radius, height) pairs given from the bottom up; radius 0 closes it."""
    angle = np.arange(sides + 1) * (2 * math.pi / sides)
    radius, height = np.array(profile).T
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    points = np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1).reshape(-1, 3)
    # The seam and the poles become one point each.
    points, merged = np.unique(np.round(points, 7), axis=0, return_inverse=True)
    return points, merged.ravel()[grid_quads(len(profile) - 1, sides)]


def ball_mesh() -> Mesh:
    """The ball, 64 x 32 quads."""
    polar = [math.pi * k / 32 for k in range(33)]
    profile = [(BALL_RADIUS * math.sin(t), BALL_CENTER[2] - BALL_RADIUS * math.cos(t)) for t in polar]
    return turned_profile([(0.0, profile[0][1]), *profile[1:-1], (0.0, profile[-1][1])], 64)


def stand_mesh() -> Mesh:
    """A round foot and a pole that ends inside the ball."""
    foot = [(0.036, 0.0), (0.036, 0.004), (0.034, 0.006), (0.008, 0.007), (0.006, 0.010)]
    return turned_profile([*foot, (0.006, BALL_CENTER[2] - 0.8 * BALL_RADIUS)], 48)


def backdrop_mesh() -> Mesh:
    """A floor that bends up into a wall behind the cloth, as in a photo studio."""
    bend, start, width = 0.6, 0.9, 2.4
    turn = [0.5 * math.pi * k / 24 for k in range(25)]
    profile = [(-1.5, 0.0)] + [(start + bend * math.sin(t), bend * (1 - math.cos(t))) for t in turn]
    profile.append((start + bend, 2.0))
    points = [(x, y, z) for y, z in profile for x in (-width, width)]
    return np.array(points), grid_quads(len(profile) - 1, 1)


def smooth_normals(points: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3), each the area-weighted mean of the quads that meet there."""
    corners = points[quads]
    area = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals = np.zeros_like(points)
    np.add.at(normals, quads.ravel(), np.repeat(area, 4, axis=0))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


# --- The file ---


def number(value: float, digits: int) -> str:
    """Shortest text of a rounded number."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def tuples(rows: np.ndarray, digits: int) -> str:
    """``[(x, y, z), ...]``."""
    return "[" + ", ".join("(" + ", ".join(number(x, digits) for x in row) + ")" for row in rows) + "]"


def mesh_text(kind: str, name: str, mesh: Mesh, color: str, extra: str = "", material: str = "") -> str:
    """A Mesh prim, its points rounded to 0.01 mm; ``extra`` is put at its end."""
    points, quads = mesh
    faces = [list(dict.fromkeys(face)) for face in quads.tolist()]
    head = 'prepend apiSchemas = ["MaterialBindingAPI"]\n        ' if material else ""
    binding = f"\n        rel material:binding = <{material}>" if material else ""
    return f'''
    def Mesh "{name}" (
        {head}kind = "{kind}"
    )
    {{
        uniform bool doubleSided = 1
        float3[] extent = {tuples(np.array([points.min(axis=0), points.max(axis=0)]), 5)}
        int[] faceVertexCounts = [{", ".join(str(len(face)) for face in faces)}]
        int[] faceVertexIndices = [{", ".join(str(corner) for face in faces for corner in face)}]{binding}
        normal3f[] normals = {tuples(smooth_normals(points, quads), 4)} (
            interpolation = "vertex"
        )
        point3f[] points = {tuples(points, 5)}
        color3f[] primvars:displayColor = [{color}]{extra}
        uniform token subdivisionScheme = "none"
    }}
'''


def material_text(name: str, color: str, roughness: float) -> str:
    """A plain UsdPreviewSurface."""
    return f'''
        def Material "{name}"
        {{
            token outputs:surface.connect = </World/Looks/{name}/Surface.outputs:surface>

            def Shader "Surface"
            {{
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = {color}
                float inputs:roughness = {roughness}
                token outputs:surface
            }}
        }}
'''


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> str:
    """The matrix, as USD text, of something at ``eye`` whose -z points at ``target`` and whose y points up."""
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    rows = np.zeros((4, 4))
    rows[0, :3], rows[1, :3], rows[2, :3], rows[3] = right, np.cross(back, right), back, (*eye, 1.0)
    return "( " + ", ".join("(" + ", ".join(number(x, 6) for x in row) + ")" for row in rows) + " )"


def drape_text(cloth: np.ndarray) -> str:
    """The whole USD layer for a cloth (N, N, 3) as ``draped_cloth`` gives it."""
    n = len(cloth)
    v, u = np.divmod(np.arange(n * n), n)
    uv = np.stack([u, v], axis=-1) / (n - 1)
    st = f"""
        texCoord2f[] primvars:st = {tuples(uv, 5)} (
            doc = "One unit is {SIDE} m of cloth at rest; u runs along the weft, v along the warp"
            interpolation = "vertex"
        )"""
    meshes = mesh_text("component", "Cloth", (cloth.reshape(-1, 3), grid_quads(n - 1, n - 1)), "(0.6, 0.58, 0.54)", st)
    for name, mesh, color in [
        ("Ball", ball_mesh(), BALL_COLOR),
        ("Stand", stand_mesh(), BALL_COLOR),
        ("Backdrop", backdrop_mesh(), BACKDROP_COLOR),
    ]:
        look = "/World/Looks/Backdrop" if name == "Backdrop" else "/World/Looks/Wood"
        meshes += mesh_text("component", name, mesh, color, material=look)
    return f"""#usda 1.0
(
    defaultPrim = "World"
    doc = "A cloth draped over a ball, made by samples/make_drape.py; bring your own fabric"
    kilogramsPerUnit = 1
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "World" (
    kind = "assembly"
)
{{{meshes}
    def Camera "Camera"
    {{
        float2 clippingRange = (0.01, 100)
        float focalLength = 0.5
        float focusDistance = {number(math.dist(EYE, TARGET), 4)}
        float horizontalAperture = 0.32
        token projection = "perspective"
        float verticalAperture = 0.24
        matrix4d xformOp:transform = {look_at(EYE, TARGET)}
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}

    def RectLight "Key"
    {{
        color3f inputs:color = (1, 0.96, 0.9)
        float inputs:height = 0.5
        float inputs:intensity = 16
        float inputs:width = 0.5
        matrix4d xformOp:transform = {look_at(KEY, TARGET)}
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}

    def DomeLight "Dome"
    {{
        color3f inputs:color = (0.85, 0.92, 1)
        float inputs:intensity = 0.3
    }}

    def Scope "Looks"
    {{{material_text("Wood", BALL_COLOR, 0.4)}{material_text("Backdrop", BACKDROP_COLOR, 0.9)}    }}
}}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("drape.usda"))
    options = parser.parse_args()
    options.output.write_text(drape_text(draped_cloth()), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
