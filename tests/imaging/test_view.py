"""Pictures for screens, and where a picture's pixels belong in a larger one."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given, strategies as st

from usdfab.errors import UsdfabError
from usdfab.imaging import luminance, read_image, read_layers, view_transform, write_image
from usdfab.imaging.view import REINHARD_WHITE, VIEWS

COLORS = st.lists(st.floats(0, 1e4, width=32), min_size=3, max_size=3)


def test_standard_is_the_picture_itself():
    pixels = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    np.testing.assert_array_equal(view_transform(pixels), pixels)
    np.testing.assert_allclose(view_transform(pixels, -2.0), pixels / 4)
    np.testing.assert_array_equal(view_transform([[-1.0, 0.25, 7.0]], 1.0), [[0.0, 0.5, 1.0]])


def test_reinhard_at_the_values_of_its_formula():
    for level, shown in ((0.0, 0.0), (1.0, (1 + 1 / 16) / 2), (REINHARD_WHITE, 1.0)):
        np.testing.assert_allclose(view_transform(np.full((1, 3), level), view="reinhard"), shown, rtol=1e-6)
    np.testing.assert_allclose(view_transform(np.full((1, 3), 1e-4), view="reinhard"), 1e-4, rtol=1e-3)


@given(COLORS, st.floats(-3, 3), st.sampled_from(VIEWS))
def test_views_stay_in_range_and_keep_the_order_of_channels(color, exposure, view):
    shown = view_transform(np.array([color]), exposure, view)[0]
    assert np.all((shown >= 0) & (shown <= 1))
    assert np.all(np.diff(shown[np.argsort(color)]) >= 0)


@given(COLORS, st.floats(0.1, 0.9))
def test_reinhard_keeps_the_hue_of_what_it_does_not_clip(color, scale):
    color = np.array(color) / max(*color, 1e-6) * scale
    shown = view_transform(color[None], view="reinhard")[0].astype(float)
    if luminance(color) > 1e-3:
        np.testing.assert_allclose(shown / luminance(shown), color / luminance(color), rtol=1e-4, atol=1e-6)


def test_an_unknown_view_is_said():
    with pytest.raises(UsdfabError, match="--view"):
        view_transform(np.zeros((1, 1, 3)), view="nice")


def test_a_region_has_its_place_in_exr(tmp_path):
    pixels = np.random.default_rng(1).random((5, 7, 3)).astype(np.float16).astype(np.float32)
    path = write_image(tmp_path / "a.exr", pixels, offset=(10, 20), full_size=(640, 480))
    spec = oiio.ImageInput.open(str(path)).spec()
    assert (spec.x, spec.y, spec.width, spec.height) == (10, 20, 7, 5)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 640, 480)
    np.testing.assert_array_equal(read_image(path).pixels, pixels)
    png = write_image(tmp_path / "a.png", pixels, offset=(10, 20), full_size=(640, 480))
    assert read_image(png).pixels.shape == (5, 7, 3)


def test_layers_of_one_two_and_three_channels(tmp_path):
    rng = np.random.default_rng(2)
    picture = rng.random((4, 6, 3)).astype(np.float16).astype(np.float32)
    layers = {
        "Z": rng.random((4, 6)).astype(np.float32),
        "A": rng.integers(0, 2, (4, 6)).astype(np.float32),
        "uv": rng.random((4, 6, 2)).astype(np.float32),
        "fiber_id": rng.integers(0, 2**24 + 1, (4, 6)),
        "variance": 1e-9 * rng.random((4, 6, 3)).astype(np.float32),
    }
    path = write_image(tmp_path / "a.exr", picture, aovs=layers)
    spec = oiio.ImageInput.open(str(path)).spec()
    names = {"R", "G", "B", "A", "Z", "uv.U", "uv.V", "fiber_id", "variance.R", "variance.G", "variance.B"}
    assert set(spec.channelnames) == names
    assert spec.channelnames[spec.alpha_channel] == "A" and spec.channelnames[spec.z_channel] == "Z"
    back = read_layers(path)
    for name, values in (layers | {"": picture}).items():
        np.testing.assert_array_equal(back[name], values, err_msg=name)
    np.testing.assert_array_equal(read_image(path).pixels, picture)
