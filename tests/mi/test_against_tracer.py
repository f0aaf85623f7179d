"""Fabrics in Mitsuba, as curves bent onto the mesh, against the two-scale tracer that has one tile of them.

Mitsuba's own hair, which the scalar variant has, draws the samples of its last lobe all in the normal plane; with
roughness .6 and .5 that hardly shows. The compiled variant has our own plugin, which takes any roughness.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mitsuba")
sys.path.insert(0, str(Path(__file__).parents[1] / "tracer"))

import scenes

from usdfab.mi import llvm
from usdfab.mi.render import MitsubaSettings, render
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.scene import PointLight

SIDE = 24
LAMP = PointLight("/Lamp", np.array([0.02, 0.01, 0.05]), np.full(3, 0.006))


def swatch():
    """A fabric of four variants under the rig, close."""
    scene, view = scenes.swatch(scenes.fabric(fibers=6, variants=4), zoom=0.2)
    return scene, view


def bent():
    """Cloth on a cylinder of 1 cm, 0.9 mm thick.

    The tracer's light goes on in the fabric where the mesh ends, so the picture's own 2.4 mm must be well inside.
    """

    def point(a, b):
        x, y = 8e-3 * (a - 0.5), 8e-3 * (b - 0.5)
        return np.stack([x, 0.01 * np.sin(y / 0.01), 0.01 * (np.cos(y / 0.01) - 1.0)], axis=-1)

    sheet = scenes.sheet(point, lambda a, b: np.stack([8e-3 * a, 8e-3 * b], axis=-1), 4, 24)
    view = scenes.look((0.003, -0.01, 0.03), (0.0, 0.0, 0.0), (0.04, 0.04))
    return scenes.scene([sheet], [scenes.cloth_material()], [LAMP], [scenes.fabric(fibers=6)]), view


def two():
    """Two fabrics side by side, one mirrored, over a diffuse table that shows between, under a lamp and a sky."""
    red = replace(scenes.fabric(fibers=6).warp, albedo=(0.8, 0.2, 0.1))
    cloths = [scenes.fabric("twill 2/2", fibers=6), replace(scenes.fabric(fibers=6), warp=red)]
    left, right = (scenes.plane(9e-3, k, 1e-3, (sign * 4.6e-3, 0.0)) for k, sign in ((0, -1), (1, 1)))
    left = replace(left, uv=left.uv * (-1.0, 1.0))
    table = scenes.plane(0.03, 2)
    materials = [scenes.cloth_material(0), scenes.cloth_material(1), scenes.lambert((0.4, 0.5, 0.6))]
    scene = scenes.scene([left, right, table], materials, [LAMP, scenes.dome(0.3)], cloths)
    return scene, scenes.look((0.0, -0.005, 0.03), (0.0, 0.0, 0.0), (0.07, 0.07))


def blocks(image):
    """Means over 4 x 4 pixels."""
    return image.reshape(SIDE // 4, 4, SIDE // 4, 4, 3).mean(axis=(1, 3), dtype=float)


@pytest.mark.parametrize(("make", "spp", "tolerance"), [(swatch, 256, 0.01), (bent, 256, 0.01), (two, 256, 0.01)])
def test_same_mean_and_same_blocks(make, spp, tolerance):
    scene, view = make()
    compare(scene, view, spp, tolerance, "scalar")


@pytest.mark.skipif(llvm.choose().library is None, reason="no LLVM library for Dr.Jit")
def test_smooth_fibers_of_two_roughnesses():
    """What Mitsuba's hair cannot do: a primary roughness and a cuticle of their own, narrow lobes."""
    cloth = scenes.fabric(fibers=6)
    smooth = {
        "roughness_longitudinal": 0.4,
        "roughness_primary": 0.25,
        "roughness_azimuthal": 0.3,
        "cuticle_tilt": 0.05,
    }
    cloth = replace(cloth, warp=replace(cloth.warp, **smooth), weft=replace(cloth.weft, **smooth))
    scene, view = scenes.swatch(cloth, zoom=0.2)
    compare(scene, view, 1024, 0.01, "llvm")


def compare(scene, view, spp, tolerance, device):
    settings = MitsubaSettings((SIDE, SIDE), (0, 0, SIDE, SIDE), spp, device=device, fibers="flattened")
    theirs = render(scene, view, settings)
    assert theirs.points > 10_000 and not theirs.warnings
    ours = Tracer(scene).render(view, RenderSettings((SIDE, SIDE), spp=2 * spp))
    variance = np.asarray(ours.variance, dtype=float) + theirs.variance
    mean, their_mean = (p.mean(axis=(0, 1), dtype=float) for p in (ours.pixels, theirs.pixels))
    error = np.sqrt(variance.sum(axis=(0, 1))) / SIDE**2 / their_mean
    ratio = mean / their_mean
    assert error.max() < tolerance, f"too noisy to tell: {error}"
    assert np.all(np.abs(ratio - 1.0) < tolerance + 2.0 * error), f"ours / Mitsuba {ratio} +- {error}"
    z = (blocks(ours.pixels) - blocks(theirs.pixels)) / np.sqrt(blocks(variance) / 16)
    rms = np.sqrt(np.mean(z**2))
    assert rms < 1.4, f"z scores of blocks have rms {rms}, largest {np.abs(z).max()}"


@pytest.mark.skipif(llvm.choose().library is None, reason="no LLVM library for Dr.Jit")
def test_the_compiled_variant_gives_the_same():
    """All cores and wavefronts against one path after the other, in one process."""
    scene, view = swatch()
    settings = [
        MitsubaSettings((16, 16), (0, 0, 16, 16), 128, device=device, fibers="flattened")
        for device in ("scalar", "llvm")
    ]
    scalar, compiled = (render(scene, view, s) for s in settings)
    assert (scalar.device, compiled.device) == ("scalar", "llvm")
    error = np.sqrt((scalar.variance + compiled.variance).sum(axis=(0, 1), dtype=float)) / 16**2
    means = [r.pixels.mean(axis=(0, 1), dtype=float) for r in (scalar, compiled)]
    assert np.all(error < 0.03 * means[0])
    assert np.all(np.abs(means[0] - means[1]) < 4.0 * error)
