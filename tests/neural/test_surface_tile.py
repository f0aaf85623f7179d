"""The maps of one tile, and the materials they come from."""

from __future__ import annotations

import numpy as np
import pytest
from surface_reference import Surface

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import weave_from_name
from usdfab.neural.surface_material import SurfaceMaterial, weave_from_bits, weave_of
from usdfab.neural.surface_tile import surface_tile


def material(weave: str = "twill_3x3", **values) -> SurfaceMaterial:
    numbers = {"twist": (0.5, -0.4), "inclination": (0.5, 0.35)} | values
    return SurfaceMaterial(weave_of(weave_from_name(weave)), **numbers)


@pytest.mark.parametrize("weave", ["plain", "twill_3x3", "satin_5x10"])
@pytest.mark.parametrize("scaled", [False, True])
def test_the_maps_are_those_of_the_equations(weave: str, scaled: bool) -> None:
    m = material(weave, height_scale=1.7)
    tile = surface_tile(m, 48, scaled=scaled)
    centres = (np.arange(48) + 0.5) / 48
    points = np.stack(np.meshgrid(centres * m.columns, centres * m.rows), axis=-1)
    like = m if scaled else material(weave, height_scale=1.0)
    warp, gap, normal, t = Surface(like).frame(points)
    assert tile.size == (m.columns, m.rows)
    assert np.array_equal(tile.yarn, np.where(gap, 2, np.where(warp, 1, 0)))
    assert np.allclose(tile.normal, normal, atol=1e-6) and np.allclose(tile.orientation, t, atol=1e-6)


def test_frames_are_orthonormal_and_gaps_marked() -> None:
    tile = surface_tile(material(), 64, scaled=True)
    yarn = tile.yarn < 2
    assert np.allclose(np.linalg.norm(tile.normal, axis=2), 1, atol=1e-6)
    assert np.allclose(np.linalg.norm(tile.orientation, axis=2), yarn, atol=1e-6)
    assert np.abs(np.sum(tile.normal * tile.orientation, axis=2)).max() < 1e-6
    assert np.all(tile.normal[~yarn] == (0, 0, 1))
    assert np.all(tile.normal[..., 2] > 0.2)
    assert np.mean(~yarn) == pytest.approx(0.2, abs=0.03)
    channels = tile.channels()
    assert channels.shape == (6, 64, 64) and np.array_equal(channels[3], tile.orientation[..., 0])


def test_yarns_lie_where_the_weave_says() -> None:
    """Row 0 is the lowest pick; the crossing's middle shows its yarn, whose fibers run along it."""
    m = material(twist=(0.0, 0.0))
    tile = surface_tile(m, 30)
    middles = tile.yarn[5::10, 5::10]
    assert np.array_equal(middles == 1, m.weave)
    along = tile.orientation[5::10, 5::10]
    assert np.all(np.abs(along[m.weave][:, 0]) < 1e-6) and np.all(along[m.weave][:, 1] > 0.8)
    assert np.all(np.abs(along[~m.weave][:, 1]) < 1e-6) and np.all(along[~m.weave][:, 0] > 0.8)


def test_twist_is_the_same_handedness_in_both_systems() -> None:
    """Turned by a quarter, a weave's fibers turn with it."""
    weave = weave_from_name("twill_3x3")
    m = SurfaceMaterial(weave_of(weave), (0.5, -0.3), (0.5, 0.4))
    turned = SurfaceMaterial(weave_of(weave.rotated()), (-0.3, 0.5), (0.4, 0.5))
    a, b = surface_tile(m, 48), surface_tile(turned, 48)
    assert np.array_equal(np.where(a.yarn == 2, 2, 1 - a.yarn % 2), np.rot90(b.yarn[::-1], -1)[::-1])

    def rotated_back(image: np.ndarray) -> np.ndarray:
        # Rows count upwards: what turned counter-clockwise is turned back clockwise.
        back = np.rot90(image[::-1], -1)[::-1]
        return np.stack([back[..., 1], -back[..., 0], back[..., 2]], axis=-1)

    assert np.allclose(a.normal, rotated_back(b.normal), atol=1e-6)
    # The direction of a fiber has no sign.
    cosine = np.sum(a.orientation * rotated_back(b.orientation), axis=2)
    assert np.allclose(np.abs(cosine[a.yarn < 2]), 1.0, atol=1e-5)


def test_materials_are_values() -> None:
    m = material()
    assert m == material() and hash(m) == hash(material())
    assert m != material(roughness=0.4)
    assert np.array_equal(weave_from_bits(m.bits()), m.weave)
    assert (m.rows, m.columns) == (3, 3)


@pytest.mark.parametrize(
    "values,said",
    [({"roughness": 0.0}, "roughness"), ({"height_scale": 5.0}, "height_scale"), ({"gap": 0.0}, "gap"),
     ({"twist": (0.0, 2.0)}, "twist"), ({"inclination": (-0.1, 0.0)}, "inclination"), ({"twist": (0.0,)}, "twist"),
     ({"roughness": float("nan")}, "roughness")],
)  # fmt: skip
def test_bad_numbers_are_named(values: dict, said: str) -> None:
    with pytest.raises(UsdfabError, match=said):
        material(**values)


def test_a_yarn_that_never_interlaces_is_refused() -> None:
    with pytest.raises(UsdfabError, match="never interlaces"):
        SurfaceMaterial(np.array([[True, True], [True, False]]))
    with pytest.raises(UsdfabError, match="pixels"):
        surface_tile(material(), 2)
