"""UsdPreviewSurface as a Mitsuba plugin against the tracer's formulas, of which it is the second writing."""

from __future__ import annotations

import mitsuba_variant
import numpy as np
import pytest

if mitsuba_variant.why_not():
    pytest.skip(mitsuba_variant.why_not(), allow_module_level=True)

import drjit as dr
import mitsuba as mi

from usdfab.mi.surface_bsdf import SURFACE, register_surface_bsdf
from usdfab.scattering.surface_numba import eval_surface, pack_surface, prepare_surface, sample_surface

MATERIALS = {
    "matte": {"base_color": (0.8, 0.4, 0.1), "ior": 1.0},
    "plastic": {"base_color": (0.8, 0.4, 0.1), "roughness": 0.4},
    "wool": {"base_color": (0.32, 0.33, 0.35), "roughness": 0.9},
    "metal": {"base_color": (0.9, 0.7, 0.3), "roughness": 0.25, "metallic": 1.0},
    "half": {"base_color": (0.9, 0.7, 0.3), "roughness": 0.5, "metallic": 0.5, "ior": 1.8},
    "weak": {"base_color": (0.5, 0.5, 0.5), "ior": 1.03},
    "specular": {"base_color": (0.5, 0.2, 0.1), "specular_color": (0.3, 0.4, 0.5), "metallic": 0.7, "roughness": 0.3},
    "coat": {"base_color": (0.1, 0.2, 0.6), "roughness": 0.7, "clearcoat": 0.8, "clearcoat_roughness": 0.2},
    "black": {"base_color": (0.0, 0.0, 0.0), "ior": 1.0},
}
COUNT = 400


@pytest.fixture(params=MATERIALS)
def material(request):
    """(the plugin, the tracer's packed material)."""
    mi.set_variant("llvm_ad_rgb")
    register_surface_bsdf()
    values = MATERIALS[request.param]
    colors = {k: {"type": "rgb", "value": list(v)} for k, v in values.items() if isinstance(v, tuple)}
    numbers = {k: v for k, v in values.items() if not isinstance(v, tuple)}
    return mi.load_dict({"type": SURFACE, **colors, **numbers}, parallel=False), pack_surface(**values)


def directions(seed: int) -> np.ndarray:
    """(COUNT, 3) unit vectors of the sphere."""
    w = np.random.default_rng(seed).normal(size=(COUNT, 3))
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def vertex(wo: np.ndarray):
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    si.wi = mi.Vector3f(*(mi.Float(wo[:, k]) for k in range(3)))
    return si


def test_value_and_density(material):
    plugin, packed = material
    wi, wo = directions(0), directions(1)
    si = vertex(wo)
    value, pdf = plugin.eval_pdf(mi.BSDFContext(), si, mi.Vector3f(*(mi.Float(wi[:, k]) for k in range(3))))
    expected = np.array([eval_surface(prepare_surface(packed, o[2]), *i, *o) for i, o in zip(wi, wo, strict=True)])
    np.testing.assert_allclose(np.array(value).T, expected[:, :3], rtol=2e-4, atol=1e-7)
    np.testing.assert_allclose(np.array(pdf), expected[:, 3], rtol=2e-4, atol=1e-7)
    assert expected[:, 3].max() > 0.1


def test_samples(material):
    """The same numbers give the same directions and weights, but where a number is next to a lobe's border."""
    plugin, packed = material
    wo = directions(2)
    wo[:, 2] = np.abs(wo[:, 2])
    u = np.random.default_rng(3).random((COUNT, 3)).astype(np.float32)
    sample, weight = plugin.sample(mi.BSDFContext(), vertex(wo), mi.Float(u[:, 0]), mi.Point2f(u[:, 1], u[:, 2]))
    expected = np.array([
        sample_surface(prepare_surface(packed, o[2]), *o, *(float(x) for x in r)) for o, r in zip(wo, u, strict=True)
    ])  # fmt: skip
    got = np.c_[np.array(sample.wo).T, np.array(weight).T, np.array(sample.pdf)]
    # Where the lobe is narrow single precision moves the direction along it, so densities differ a little more.
    same = np.isclose(got, expected, rtol=5e-3, atol=2e-4).all(axis=1)
    assert same.mean() > 0.99, np.c_[got, expected][~same]
