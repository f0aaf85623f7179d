"""The same fibers in Mitsuba: explicit copies of the patch as B-spline curves with Mitsuba's own hair BSDF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fibers import Patch
from usdfab.scattering.roughness import absorption_from_albedo
from usdfab.usd.scene import Camera, DomeLight, PointLight

UNITS = 1e5
"""Mitsuba units per metre. Its rays start 9e-5 (1 + |p|) units off the surface: far too much for fibers in metres."""


def curves_text(patch: Patch, around: int, center: np.ndarray, folder: Path) -> dict[str, Path]:
    """Files for ``bsplinecurve``: the patch and ``around`` copies on each side, in ``UNITS`` per metre.

    The place ``center`` (2,) of the cloth, metres, goes to the origin: Mitsuba's rays are the more exact the nearer.
    """
    files = {}
    for system in patch.systems:
        # A uniform cubic B-spline starts at its second knot: one control point before, two after close the period.
        points, offsets = system.extended(1, 2)
        lines = []
        shifts = [
            np.array([i * patch.size[0] - center[0], j * patch.size[1] - center[1], 0.0])
            for i in range(-around, around + 1)
            for j in range(-around, around + 1)
        ]
        for curve in range(system.curves):
            own = points[offsets[curve] : offsets[curve + 1]]
            for shift in shifts:
                lines.append(
                    "\n".join(
                        f"{x:.9g} {y:.9g} {z:.9g} {UNITS * system.radius:.9g}" for x, y, z in UNITS * (own + shift)
                    )
                )
        path = folder / f"{system.system}.txt"
        path.write_text("\n\n".join(lines) + "\n")
        files[system.system] = path
    return files


def mitsuba_dict(
    mi,
    fabric: FabricParameters,
    files: dict[str, Path],
    camera: Camera,
    lights: list,
    size: tuple[int, int],
    depth: int,
) -> dict:
    """A Mitsuba scene dictionary. Yarns need ``roughness_primary == roughness_longitudinal`` and one colour each."""
    scene: dict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": 5},
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2.0 * np.arctan(camera.tan_half[0]))),
            "fov_axis": "x",
            "near_clip": 1e-4 * UNITS,
            "far_clip": 100.0 * UNITS,
            # Mitsuba's camera looks along +z with x to the left.
            "to_world": mi.ScalarTransform4f(_scaled(camera.to_world) @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "film": {
                "type": "hdrfilm",
                "width": size[0],
                "height": size[1],
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        },
    }
    for k, light in enumerate(lights):
        if isinstance(light, DomeLight):
            scene[f"light{k}"] = {"type": "constant", "radiance": {"type": "rgb", "value": light.radiance.tolist()}}
            continue
        assert isinstance(light, PointLight)
        scene[f"light{k}"] = {
            "type": "point",
            "position": (UNITS * light.position).tolist(),
            "intensity": {"type": "rgb", "value": (UNITS**2 * light.intensity).tolist()},
        }
    for name, path in files.items():
        yarn = fabric.system(name)  # type: ignore[arg-type]
        assert yarn.roughness_primary == yarn.roughness_longitudinal and not yarn.yarn_albedo
        scene[name] = {
            "type": "bsplinecurve",
            "filename": str(path),
            "bsdf": {
                "type": "hair",
                "longitudinal_roughness": yarn.roughness_longitudinal,
                "azimuthal_roughness": yarn.roughness_azimuthal,
                "scale_tilt": 0.0,
                "int_ior": yarn.ior,
                "ext_ior": 1.0,
                "sigma_a": {
                    "type": "rgb",
                    "value": absorption_from_albedo(np.asarray(yarn.albedo), yarn.roughness_azimuthal).tolist(),
                },
            },
        }
    return scene


def plugin_dict(yarn: YarnParameters) -> dict:
    """Our own BSDF in Mitsuba for the fibers of a yarn, where Mitsuba's `hair` is not exact enough."""
    return {
        "type": "usdfab_fiber",
        "albedo": {"type": "rgb", "value": list(yarn.albedo)},
        "gamma_m": yarn.roughness_longitudinal,
        "gamma_n": yarn.roughness_azimuthal,
        "gamma_m0": yarn.roughness_primary,
        "eta": yarn.ior,
    }


def _scaled(to_world: np.ndarray) -> np.ndarray:
    scaled = to_world.copy()
    scaled[:3, 3] *= UNITS
    return scaled
