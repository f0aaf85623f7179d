"""Textures in kernels against SciPy's interpolation, and the materials that read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.ndimage import map_coordinates

from usdfab.errors import UsdfabError
from usdfab.imaging import srgb_to_linear, write_image
from usdfab.scattering.surface_numba import pack_surface
from usdfab.tracer.textures import (
    INPUTS,
    Textures,
    load_texture_images,
    lookup,
    normal_at,
    opacity_at,
    pack_materials,
    pack_textures,
    surface_at,
)
from usdfab.usd.scene import Material, Texture

IDENTITY = np.array([[1.0, 0, 0], [0, 1.0, 0]])
PLAIN = Texture("a.png", "rgb", ("repeat", "repeat"), True, np.ones(4), np.zeros(4), IDENTITY)
RNG = np.random.default_rng(1)
IMAGE = RNG.random((5, 7, 4)).astype(np.float32)
SCIPY_MODES = {"repeat": "grid-wrap", "clamp": "nearest", "mirror": "reflect", "black": "grid-constant"}


def packed(image=IMAGE, **changes) -> Textures:
    return pack_textures([replace(PLAIN, **changes)], {"a.png": image})


# --- lookups ---------------------------------------------------------------------------------------------------------


def test_the_origin_is_the_lower_left_texel():
    textures = packed()
    height, width = IMAGE.shape[:2]
    for row in range(height):
        for column in range(width):
            value = lookup(textures, 0, (column + 0.5) / width, (height - row - 0.5) / height)
            np.testing.assert_allclose(value, IMAGE[row, column, :3], rtol=1e-6)


@pytest.mark.parametrize("s", SCIPY_MODES)
@pytest.mark.parametrize("t", SCIPY_MODES)
@given(u=st.floats(-4.0, 4.0), v=st.floats(-4.0, 4.0))
def test_wrap_modes(s, t, u, v):
    """Against SciPy along one axis at a time: the sum over a row of its values times the weights of the other axis."""
    x, y = u * IMAGE.shape[1] - 0.5, (1.0 - v) * IMAGE.shape[0] - 0.5
    rows = [map_coordinates(row, [[x]], order=1, mode=SCIPY_MODES[s])[0] for row in IMAGE[..., 1].astype(float)]
    expected = map_coordinates(np.array(rows), [[y]], order=1, mode=SCIPY_MODES[t])[0]
    assert lookup(packed(wrap=(s, t)), 0, u, v)[1] == pytest.approx(expected, abs=1e-6)


def test_one_texel():
    for wrap in ("repeat", "clamp", "mirror"):
        value = lookup(packed(np.full((1, 1, 3), 0.3), wrap=(wrap, wrap)), 0, 0.9, -3.3)
        assert value == pytest.approx((0.3, 0.3, 0.3))


@pytest.mark.parametrize(("channels", "index"), [("r", 0), ("g", 1), ("b", 2), ("a", 3)])
def test_single_channels(channels, index):
    """With the scale and bias of their own channel."""
    scale, bias = np.array([2.0, 3.0, 4.0, 5.0]), np.array([0.1, 0.2, 0.3, 0.4])
    value = lookup(packed(channels=channels, scale=scale, bias=bias), 0, 2.5 / 7, 2.5 / 5)
    assert value == pytest.approx(3 * [IMAGE[2, 2, index] * scale[index] + bias[index]], rel=1e-6)


def test_colors_are_scaled_and_biased():
    scale, bias = np.array([2.0, 3.0, 4.0, 5.0]), np.array([0.1, 0.2, 0.3, 0.4])
    value = lookup(packed(scale=scale, bias=bias), 0, 2.5 / 7, 2.5 / 5)
    assert value == pytest.approx(IMAGE[2, 2, :3] * scale[:3] + bias[:3], rel=1e-6)


@pytest.mark.parametrize(
    ("shape", "channels", "expected"),
    [
        ((2, 2), "rgb", "000"),  # grey is all three colours
        ((2, 2, 1), "g", "000"),
        ((2, 2, 1), "a", "111"),  # and is opaque
        ((2, 2, 2), "rgb", "000"),
        ((2, 2, 2), "a", "vvv"),
        ((2, 2, 3), "a", "111"),
    ],
)
def test_few_channels(shape, channels, expected):
    """Images with 1, 2 or 3 channels; "0" is the first, "v" the second, "1" one."""
    image = RNG.random(shape)
    flat = image.reshape(2, 2, -1)
    values = {"0": flat[1, 0, 0], "v": flat[1, 0, -1], "1": 1.0}
    value = lookup(packed(image, channels=channels), 0, 0.25, 0.25)
    assert value == pytest.approx([values[c] for c in expected], rel=1e-6)


def test_srgb_is_made_linear_except_alpha():
    codes = RNG.integers(0, 256, (3, 3, 4), dtype=np.uint8)
    at = (0.5 / 3, 0.5 / 3)
    color = lookup(packed(codes, linear=False), 0, *at)
    assert color == pytest.approx(srgb_to_linear(codes[2, 0, :3] / 255.0), rel=1e-5)
    assert lookup(packed(codes, linear=True), 0, *at) == pytest.approx(codes[2, 0, :3] / 255.0, rel=1e-5)
    assert lookup(packed(codes, linear=False, channels="a"), 0, *at)[0] == pytest.approx(codes[2, 0, 3] / 255.0)


def test_uv_transform():
    matrix = np.array([[0.0, -2.0, 0.3], [0.5, 0.1, -0.2]])
    u, v = 0.37, 0.81
    moved = matrix @ [u, v, 1.0]
    assert lookup(packed(uv_transform=matrix), 0, u, v) == pytest.approx(lookup(packed(), 0, *moved))


def test_coordinates_that_are_no_place():
    textures = packed(bias=np.array([0.5, 0.6, 0.7, 0.0]))
    for bad in (np.nan, np.inf, -np.inf, 1e300):
        assert lookup(textures, 0, bad, 0.0) == (0.5, 0.6, 0.7)


def test_many_textures_in_one_array():
    """Each finds its own texels, and the same texels are kept once."""
    other = RNG.random((4, 3, 3)).astype(np.float32)
    list_ = [PLAIN, replace(PLAIN, file="b.png"), replace(PLAIN, wrap=("clamp", "clamp")), replace(PLAIN, channels="g")]
    textures = pack_textures(list_, {"a.png": IMAGE, "b.png": other})
    assert textures.texels.size == IMAGE[..., :3].size + other.size + IMAGE[..., 1].size
    assert lookup(textures, 1, 0.5 / 3, 0.5 / 4) == pytest.approx(other[3, 0])
    assert lookup(textures, 2, 0.5 / 7, 0.5 / 5) == pytest.approx(IMAGE[4, 0, :3])
    assert lookup(textures, 3, 0.5 / 7, 0.5 / 5)[0] == pytest.approx(IMAGE[4, 0, 1])


@pytest.mark.parametrize(
    ("changes", "image", "match"),
    [
        ({"file": "c.png"}, IMAGE, "was not loaded"),
        ({"channels": "x"}, IMAGE, "no channel"),
        ({"wrap": ("repeat", "sideways")}, IMAGE, "no wrap mode"),
        ({"scale": np.array([1.0, np.nan, 1.0, 1.0])}, IMAGE, "not finite"),
        ({}, np.zeros((0, 3, 3)), "no image"),
        ({}, np.zeros((2, 2, 5)), "no image"),
        ({}, np.full((2, 2, 3), np.nan), "NaN"),
    ],
)
def test_pack_refuses(changes, image, match):
    with pytest.raises(UsdfabError, match=match):
        packed(image, **changes)


# --- files -----------------------------------------------------------------------------------------------------------


def test_files(tmp_path):
    """A picture written as PNG (sRGB) and as EXR (linear) is the same to a texture."""
    pixels = RNG.random((6, 4, 3)).astype(np.float32)
    png, exr = str(tmp_path / "a.png"), str(tmp_path / "a.exr")
    write_image(png, pixels)
    write_image(exr, pixels)
    list_ = [replace(PLAIN, file=png, linear=False), replace(PLAIN, file=exr), replace(PLAIN, file=png, linear=False)]
    images, warnings = load_texture_images(list_)
    assert sorted(images) == sorted([png, exr])
    assert not warnings
    textures = pack_textures(list_, images)
    for k, tolerance in ((0, 1 / 255), (1, 1e-3)):
        assert lookup(textures, k, 0.5 / 4, 0.5 / 6) == pytest.approx(pixels[5, 0], abs=tolerance)


def test_grey_and_transparent_files(tmp_path):
    oiio = pytest.importorskip("OpenImageIO")
    values = RNG.integers(0, 256, (3, 2, 4), dtype=np.uint8)
    for channels in (1, 2, 4):
        file = str(tmp_path / f"{channels}.png")
        out = oiio.ImageOutput.create(file)
        spec = oiio.ImageSpec(2, 3, channels, "uint8")
        spec.alpha_channel = channels - 1 if channels in (2, 4) else -1
        spec.channelnames = {1: ("Y",), 2: ("Y", "A"), 4: ("R", "G", "B", "A")}[channels]
        spec.attribute("oiio:UnassociatedAlpha", 1)
        out.open(file, spec)
        assert out.write_image(np.ascontiguousarray(values[..., :channels])), out.geterror()
        out.close()
        images, warnings = load_texture_images([replace(PLAIN, file=file)])
        assert not warnings
        # Colours under transparent pixels are as they were: nothing is multiplied by alpha.
        np.testing.assert_allclose(images[file], values[..., :channels] / 255.0, atol=1e-6)


def test_a_missing_file_is_left_out(tmp_path):
    missing = replace(PLAIN, file=str(tmp_path / "none.png"))
    images, warnings = load_texture_images([missing])
    assert not images
    assert len(warnings) == 1
    assert "none.png" in warnings[0]
    with pytest.raises(UsdfabError, match="no such file"):
        load_texture_images([missing], strict=True)
    materials, textures, _ = pack_materials([material(textures={"diffuseColor": missing})], images)
    assert not textures
    assert surface_at(materials, pack_textures(textures, images), 0, 0.5, 0.5)[0][:3] == (0.2, 0.4, 0.6)


# --- materials -------------------------------------------------------------------------------------------------------


def material(**changes) -> Material:
    return replace(Material("/M", -1, np.array([0.2, 0.4, 0.6]), 0.7, 0.1, 0.9), **changes)


def test_constants():
    one = material(emissive=np.array([3.0, 0.0, 1.0]), clearcoat=0.5, clearcoat_roughness=0.2, ior=1.3)
    two = material(specular_color=np.array([0.1, 0.2, 0.3]))
    materials, textures, warnings = pack_materials([one, two], {})
    assert not warnings
    empty = pack_textures(textures, {})
    surface, *emission = surface_at(materials, empty, 0, 0.3, 0.3)
    assert surface == tuple(pack_surface(one.base_color, 0.7, 0.1, None, 0.5, 0.2, 1.3))
    assert emission == [3.0, 0.0, 1.0]
    assert surface_at(materials, empty, 1, 0.3, 0.3)[0] == tuple(
        pack_surface(two.base_color, 0.7, 0.1, (0.1, 0.2, 0.3))
    )
    assert opacity_at(materials, empty, 0, 0.3, 0.3) == 0.9
    assert normal_at(materials, empty, 0, 0.3, 0.3) == (False, 0.0, 0.0, 1.0)


def test_textures_replace_inputs():
    names = dict.fromkeys(INPUTS, PLAIN) | {
        "roughness": replace(PLAIN, channels="g"),
        "metallic": replace(PLAIN, channels="b"),
        "opacity": replace(PLAIN, channels="a"),
    }
    listed = [material(textures=names), material(textures=names, specular_color=np.zeros(3))]
    materials, list_, _ = pack_materials(listed, {"a.png": IMAGE})
    assert len(list_) == 4  # equal textures are one
    textures = pack_textures(list_, {"a.png": IMAGE})
    u, v = 2.5 / 7, 2.5 / 5
    texel = IMAGE[2, 2].astype(float)
    surface, *emission = surface_at(materials, textures, 0, u, v)
    assert surface == pytest.approx(pack_surface(texel[:3], texel[1], texel[2]), rel=1e-6)
    assert emission == pytest.approx(texel[:3], rel=1e-6)
    surface, *_ = surface_at(materials, textures, 1, u, v)
    assert surface == pytest.approx(pack_surface(texel[:3], texel[1], texel[2], texel[:3]), rel=1e-6)
    assert opacity_at(materials, textures, 0, u, v) == pytest.approx(texel[3], rel=1e-6)


@pytest.mark.parametrize(("alpha", "expected"), [(0.49, 0.0), (0.5, 1.0), (0.51, 1.0)])
def test_cut_out(alpha, expected):
    constant, _, _ = pack_materials([material(opacity=alpha, opacity_threshold=0.5)], {})
    assert opacity_at(constant, packed(), 0, 0.0, 0.0) == expected
    images = {"a.png": np.full((2, 2), alpha)}
    mapped, list_, _ = pack_materials(
        [material(opacity_threshold=0.5, textures={"opacity": replace(PLAIN, channels="r")})], images
    )
    assert opacity_at(mapped, pack_textures(list_, images), 0, 0.3, 0.3) == expected


def test_normal_map():
    """Codes 0 to 1 with UsdUVTexture's usual scale 2 and bias -1."""
    n = np.array([0.6, -0.48, 0.64])
    texture = replace(PLAIN, scale=np.full(4, 2.0), bias=np.full(4, -1.0))
    for encoded, expected in (
        (0.5 * n + 0.5, (True, *n)),
        (0.25 * n + 0.5, (True, *n)),  # of another length
        (0.5 - 0.5 * n, (False, 0.0, 0.0, 1.0)),  # below the surface
        (np.full(3, 0.5), (False, 0.0, 0.0, 1.0)),
    ):
        images = {"a.png": np.broadcast_to(encoded, (2, 2, 3))}
        materials, list_, _ = pack_materials([material(textures={"normal": texture})], images)
        assert normal_at(materials, pack_textures(list_, images), 0, 0.2, 0.9) == pytest.approx(expected, abs=1e-6)


def test_wild_numbers_are_cut_and_said():
    wild = material(
        base_color=np.array([1.5, 0.5, np.nan]), roughness=-1.0, ior=0.0, emissive=np.array([-1, np.nan, 2])
    )
    materials, list_, warnings = pack_materials([wild], {})
    assert [w.split(":")[0] for w in warnings] == 3 * ["/M"]
    assert all(any(name in w for w in warnings) for name in ("diffuseColor", "roughness", "ior"))
    surface, *emission = surface_at(materials, pack_textures(list_, {}), 0, 0.0, 0.0)
    assert surface == tuple(pack_surface((1.0, 0.5, 0.0), 0.0, 0.1))
    assert emission == [0.0, 0.0, 2.0]
