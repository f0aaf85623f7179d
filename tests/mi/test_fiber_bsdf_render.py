"""A piece of cloth with the fiber plugin in Mitsuba's path tracer against our own tracer, on the same curves."""

from __future__ import annotations

import sys
from pathlib import Path

import mitsuba_variant
import numpy as np
import pytest

if mitsuba_variant.why_not():
    pytest.skip(mitsuba_variant.why_not(), allow_module_level=True)

sys.path.append(str(Path(__file__).parents[1] / "tracer"))

import mitsuba as mi
from mitsuba_scene import curves_text, mitsuba_dict, plugin_dict
from scenes import fabric, swatch

from usdfab.fibers import generate_patch
from usdfab.mi.fiber_bsdf import register_fiber_bsdf
from usdfab.tracer import RenderSettings, Tracer, knots
from usdfab.tracer.patch_scene import tile_copies

SIDE = 16
RUNS = 16


def compare(cloth, depth: int, spp: int, tolerance: float, folder: Path) -> None:
    """Means of the two renderers, within their noise, which has to be below the tolerance."""
    theirs, scene, camera = both(cloth, depth, SIDE, folder)
    means = [np.array(mi.render(theirs, spp=spp // RUNS, seed=k)).mean(axis=(0, 1), dtype=float) for k in range(RUNS)]
    mean, error = np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / np.sqrt(RUNS)
    ours = Tracer(scene).render(camera, RenderSettings((SIDE, SIDE), spp=spp, max_depth=depth))
    our_mean = ours.pixels.mean(axis=(0, 1), dtype=float)
    error = np.hypot(error, np.sqrt(ours.variance.sum(axis=(0, 1))) / SIDE**2) / our_mean
    ratio = mean / our_mean
    print(f"plugin / ours {ratio} +- {error}")
    assert error.max() < tolerance, f"too noisy to tell: {error}"
    assert np.all(abs(ratio - 1.0) < 3.0 * error), f"plugin / ours {ratio} +- {error}"


def both(cloth, depth: int, side: int, folder: Path):
    """A Mitsuba scene with the plugin, and the same for the tracer with its camera."""
    mi.set_variant("llvm_ad_rgb")
    register_fiber_bsdf()
    scene, camera = swatch(cloth, zoom=0.16)
    patch = generate_patch(cloth, copies=tile_copies(cloth))
    center = np.mod(np.asarray(cloth.size) / 2, patch.size)
    files = curves_text(patch, 1, center, folder)
    description = mitsuba_dict(mi, cloth, files, camera, list(scene.lights), (side, side), depth)
    for name in files:
        description[name]["bsdf"] = plugin_dict(cloth.system(name))
    return mi.load_dict(description, parallel=False), scene, camera


def test_mean(tmp_path):
    compare(fabric(fibers=8), 16, 512, 0.01, tmp_path)


@pytest.mark.slow
def test_mean_of_satin_with_narrow_lobes(tmp_path, monkeypatch):
    """Where Mitsuba's `hair` is 2 to 3 % too bright: its samples of the last lobe do not follow its density.

    With all knots of the splines: without those that the tracer leaves out these few thick fibers are 1.3 % darker.
    """
    monkeypatch.setattr(knots, "BEND", 1e-9)
    compare(fabric("satin", fibers=8, roughness_azimuthal=0.1), 64, 65536, 0.006, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("spp", [8192, 32768])
def test_where_the_light_is_after_many_bounces(tmp_path, spp):
    """Blocks of 4 x 4 pixels, each within its noise.

    With Mitsuba's `hair` instead of the plugin the mean is 0.3 % brighter, and the blocks' z scores have rms 1.4 to 1.6
    (here 1.13).
    """
    side = 24
    theirs, scene, camera = both(fabric(fibers=8), 64, side, tmp_path)
    pictures = [np.array(mi.render(theirs, spp=spp // RUNS, seed=100 + k)) for k in range(RUNS)]
    variance = np.var(pictures, axis=0, ddof=1, dtype=float) / RUNS
    ours = Tracer(scene).render(camera, RenderSettings((side, side), spp=2 * spp, max_depth=64))

    def blocks(image):
        return image.reshape(side // 4, 4, side // 4, 4, 3).mean(axis=(1, 3), dtype=float)

    noise = np.sqrt(blocks(variance + ours.variance) / 16)
    z = (blocks(ours.pixels) - blocks(np.mean(pictures, axis=0, dtype=float))) / noise
    assert (noise / blocks(ours.pixels)).mean() < 0.015, "too noisy to tell"
    assert np.sqrt(np.mean(z**2)) < 1.35, f"rms {np.sqrt(np.mean(z**2))}, largest {abs(z).max()}"
