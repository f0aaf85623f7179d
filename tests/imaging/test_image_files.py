"""Image files: what is written is read back; what is broken is said once, in words."""

import subprocess
import sys

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from usdfab.errors import UsdfabError
from usdfab.imaging import image_file as image_file_module, read_image, read_layers, srgb_to_linear, write_image
from usdfab.imaging.image_file import _oriented

FEW = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
SHAPES = st.tuples(st.integers(1, 17), st.integers(1, 17), st.just(3))


def noise(height=40, width=50, channels=3, dtype=np.uint8, seed=0):
    top = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    values = np.random.default_rng(seed).random((height, width, channels)) * top
    return values.astype(dtype)


def save(path, data, kind=None, **attributes):
    """A file as some other program would write it."""
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], kind or str(data.dtype).replace("32", ""))
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    assert output.open(str(path), spec) and output.write_image(data) and output.close()
    return path


# --- Round trips ---


@FEW
@given(pixels=arrays(np.float32, SHAPES, elements=st.floats(0, 1, width=32)))
def test_png16_round_trip(tmp_path, pixels):
    back = read_image(write_image(tmp_path / "a.png", pixels, bits=16, overwrite=True)).pixels
    assert back.dtype == np.float32 and back.shape == pixels.shape
    # Half a code, at the steepest (2.28 in linear light per encoded unit).
    np.testing.assert_allclose(back, pixels, atol=0.51 / 65535 * 2.28, rtol=1e-5)


@FEW
@given(pixels=arrays(np.float32, SHAPES, elements=st.floats(-1e6, 1e6, width=32)))
def test_float_exr_round_trip_is_exact(tmp_path, pixels):
    path = write_image(tmp_path / "a.exr", pixels, half=False, overwrite=True)
    np.testing.assert_array_equal(read_image(path).pixels, pixels)


@FEW
@given(pixels=arrays(np.float16, SHAPES, elements=st.floats(-1000, 1000, width=16)))
def test_half_exr_round_trip_is_exact(tmp_path, pixels):
    path = write_image(tmp_path / "a.exr", pixels, overwrite=True)
    np.testing.assert_array_equal(read_image(path).pixels, pixels.astype(np.float32))


@pytest.mark.parametrize(("suffix", "atol"), [(".png", 0.0046), (".tif", 0.0046), (".jpg", 0.03)])
def test_8_bit_files_are_srgb(tmp_path, suffix, atol):
    ramp = np.repeat(np.linspace(0, 1, 64, dtype=np.float32)[None, :, None], 3, axis=-1).repeat(16, axis=0)
    path = write_image(tmp_path / f"a{suffix}", ramp)
    np.testing.assert_allclose(read_image(path).pixels, ramp, atol=atol)
    raw = oiio.ImageInput.open(str(path)).read_image("uint8")
    assert abs(int(raw[0, 14, 0]) - 130) <= 2  # 14/63 linear is code 130


def test_clipping(tmp_path):
    bright = np.array([[[1e9, -1.0, 2.0]]], np.float32)
    np.testing.assert_array_equal(read_image(write_image(tmp_path / "a.png", bright)).pixels, [[[1, 0, 1]]])
    np.testing.assert_array_equal(read_image(write_image(tmp_path / "a.exr", bright)).pixels, [[[65504, -1, 2]]])


def test_layers(tmp_path):
    rng = np.random.default_rng(1)
    picture, albedo, normal = (rng.random((5, 7, 3)).astype(np.float16).astype(np.float32) for _ in range(3))
    depth = rng.random((5, 7)).astype(np.float32)
    depth[0, 0] = np.inf
    path = write_image(tmp_path / "a.exr", picture, aovs={"albedo": albedo, "normal": normal, "Z": depth})
    names = set(oiio.ImageInput.open(str(path)).spec().channelnames)
    assert {"R", "G", "B", "albedo.R", "normal.X", "normal.Z", "Z"} <= names
    layers = read_layers(path)
    for name, values in {"": picture, "albedo": albedo, "normal": normal, "Z": depth}.items():
        np.testing.assert_array_equal(layers[name], values)
    np.testing.assert_array_equal(read_image(path).pixels, picture)


# --- What other programs write ---


def test_16_and_8_bit_files_use_the_exact_curve(tmp_path):
    for dtype in (np.uint8, np.uint16):
        codes = noise(dtype=dtype)
        for suffix in (".png", ".tif"):
            image = read_image(save(tmp_path / f"{codes.dtype}{suffix}", codes))
            expected = srgb_to_linear(codes / np.iinfo(dtype).max)
            np.testing.assert_allclose(image.pixels, expected, rtol=1e-6, atol=1e-9)


def test_grey_alpha_and_grey_alpha(tmp_path):
    codes = noise(channels=4)
    linear = srgb_to_linear(codes / 255)
    grey = read_image(save(tmp_path / "g.png", codes[..., :1].copy())).pixels
    np.testing.assert_allclose(grey, np.repeat(linear[..., :1], 3, -1), rtol=1e-6)
    color = read_image(save(tmp_path / "c.png", codes, oiio__UnassociatedAlpha=1))
    np.testing.assert_allclose(color.pixels, linear[..., :3] * (codes[..., 3:] / 255), rtol=1e-5, atol=1e-9)
    assert any("transparent" in note for note in color.notes)
    codes[..., 3] = 255
    opaque = read_image(save(tmp_path / "o.png", codes))
    assert not any("transparent" in note for note in opaque.notes)
    np.testing.assert_allclose(opaque.pixels, linear[..., :3], rtol=1e-6)


def test_float_tiff_and_hdr_are_linear(tmp_path):
    values = noise(dtype=np.float32)
    np.testing.assert_array_equal(read_image(save(tmp_path / "a.tif", values)).pixels, values)
    np.testing.assert_allclose(read_image(save(tmp_path / "a.hdr", values)).pixels, values, atol=0.01)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".tif", ".jpg"])
def test_orientation(tmp_path, orientation, suffix):
    # EXIF tag 274: which side of the scene the file's row 0 and column 0 show.
    row, column = ["", "tl", "tr", "br", "bl", "lt", "rt", "rb", "lb"][orientation]
    scene = np.zeros((32, 48, 3), np.uint8)
    scene[:16, :16] = (255, 0, 0)  # red at the top left
    scene[:16, 32:] = (0, 255, 0)  # green at the top right
    stored = scene
    if row in "lr":
        stored = stored.swapaxes(0, 1)
    if row in "br":
        stored = stored[::-1]
    if column in "br":
        stored = stored[:, ::-1]
    # OpenImageIO's TIFF writer makes both resolutions equal.
    down = 50800.0 if suffix == ".jpg" else 25400.0
    attributes = {"Orientation": orientation, "XResolution": 25400.0, "YResolution": down, "ResolutionUnit": "in"}
    image = read_image(save(tmp_path / f"a{suffix}", np.ascontiguousarray(stored), **attributes))
    assert image.pixels.shape == scene.shape
    np.testing.assert_allclose(image.pixels[4:12:7, [4, 44]], scene[4:12:7, [4, 44]] / 255.0, atol=0.01)
    expected = (1e-6, 0.0254 / down) if orientation < 5 else (0.0254 / down, 1e-6)
    assert image.pixel_size == pytest.approx(expected)
    assert image.size == pytest.approx((48 * expected[0], 32 * expected[1]))


def test_orientations_undo_themselves():
    square = np.arange(9).reshape(3, 3)
    inverse = {6: 8, 8: 6}
    for orientation in range(2, 9):
        there = _oriented(square, orientation)
        np.testing.assert_array_equal(_oriented(there, inverse.get(orientation, orientation)), square)


# --- Pixel size ---


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
@pytest.mark.parametrize("size", [2.5e-7, 1e-6, 5e-6])
def test_pixel_size_round_trip(tmp_path, suffix, size):
    path = write_image(tmp_path / f"a{suffix}", np.zeros((2, 3, 3)), pixel_size=(size, size))
    assert read_image(path).pixel_size == pytest.approx((size, size), rel=2e-3)


@pytest.mark.parametrize(
    ("attributes", "size", "words"),
    [
        ({}, None, "no pixel size"),
        ({"XResolution": 72.0, "YResolution": 72.0, "ResolutionUnit": "in"}, None, "default"),
        ({"XResolution": 38.0, "YResolution": 38.0, "ResolutionUnit": "cm"}, None, "default"),
        ({"XResolution": 600.0, "YResolution": 600.0, "ResolutionUnit": "in"}, 0.0254 / 600, "resolution tags"),
        ({"XResolution": 9.0, "YResolution": 9.0, "ResolutionUnit": "none"}, None, "no unit"),
        ({"ImageDescription": 'PhysicalSizeX="0.65" PhysicalSizeXUnit="µm" PhysicalSizeY="0.65"'}, 0.65e-6, "OME"),
        (
            {"ImageDescription": "ImageJ=1.54f\nunit=micron\n", "XResolution": 1.6, "YResolution": 1.6},
            1e-6 / 1.6,
            "ImageJ",
        ),
    ],
)
def test_pixel_size_of_tiff(tmp_path, attributes, size, words):
    image = read_image(save(tmp_path / "a.tif", noise(4, 4), **attributes))
    assert any(words in note for note in image.notes), image.notes
    assert image.pixel_size == (None if size is None else pytest.approx((size, size), rel=1e-4))


# --- Broken input ---


@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.97])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr", ".hdr", ".webp", ".bmp"])
def test_cut_off_files(tmp_path, capfd, suffix, fraction):
    values = noise(120, 150, dtype=np.float32 if suffix in (".exr", ".hdr") else np.uint8)
    whole = save(tmp_path / f"whole{suffix}", values).read_bytes()
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole[: int(len(whole) * fraction)])
    with pytest.raises(UsdfabError) as caught:
        read_image(path)
    assert caught.value.place == str(path) and caught.value.remedy
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr"])
def test_damaged_files(tmp_path, capfd, suffix):
    data = bytearray(save(tmp_path / f"a{suffix}", noise(120, 150).astype(np.float32) / 255, "uint8").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 8] = b"\xff\xd9\x55\xff\xff\x77\x00\x01"
    (tmp_path / f"a{suffix}").write_bytes(data)
    with pytest.raises(UsdfabError, match=r"damaged|not an image"):
        read_image(tmp_path / f"a{suffix}")
    assert capfd.readouterr().err == ""


def test_files_that_are_no_images(tmp_path, monkeypatch):
    cases = {"missing.png": None, "empty.png": b"", "text.png": b"hello " * 99, "text.txt": b"hello", "a.pdf": b"%PDF"}
    words = {"missing.png": "no such file", "empty.png": "empty"}
    for name, content in cases.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(UsdfabError, match=words.get(name, "not an image")) as caught:
            read_image(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
    with pytest.raises(UsdfabError, match="folder"):
        read_image(tmp_path)
    with pytest.raises(UsdfabError):
        read_image("x" * 5000)
    save(tmp_path / "wide.png", noise(2, 60))
    monkeypatch.setattr(image_file_module, "MAX_SIDE", 50)
    with pytest.raises(UsdfabError, match="60 x 2 pixels are too many"):
        read_image(tmp_path / "wide.png")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_in_files(tmp_path, bad):
    values = noise(dtype=np.float32)
    values[3, 4, 1] = bad
    with pytest.raises(UsdfabError, match="NaN"):
        read_image(save(tmp_path / "a.exr", values))


@FEW
@given(content=st.binary(min_size=1, max_size=300), suffix=st.sampled_from([".png", ".jpg", ".tif", ".exr", ".bmp"]))
def test_garbage_never_gets_through(tmp_path, content, suffix):
    magic = {".png": b"\x89PNG\r\n\x1a\n", ".jpg": b"\xff\xd8\xff", ".tif": b"II*\0", ".exr": b"v/1\1", ".bmp": b"BM"}
    path = tmp_path / f"a{suffix}"
    path.write_bytes(magic[suffix] + content)
    with pytest.raises(UsdfabError):
        read_image(path)


# --- Writing ---


def test_existing_files_are_kept(tmp_path):
    path = write_image(tmp_path / "a.png", np.zeros((2, 2, 3)))
    before = path.read_bytes()
    with pytest.raises(UsdfabError, match="exists"):
        write_image(path, np.ones((2, 2, 3)))
    assert path.read_bytes() == before
    write_image(path, np.ones((2, 2, 3)), overwrite=True)
    assert path.read_bytes() != before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "pixels", "options", "words"),
    [
        ("a.gif", np.zeros((2, 2, 3)), {}, "cannot write '.gif'"),
        ("a", np.zeros((2, 2, 3)), {}, "cannot write ''"),
        ("no/a.png", np.zeros((2, 2, 3)), {}, "folder does not exist"),
        ("a.png", np.full((2, 2, 3), np.nan), {}, "4 pixels are NaN"),
        ("a.exr", np.full((2, 2, 3), np.inf), {}, "infinite"),
        ("a.png", np.zeros((2, 2, 4)), {}, "no picture"),
        ("a.png", np.zeros((2, 2, 3)), {"bits": 12}, "12 bits"),
        ("a.png", np.zeros((2, 2, 3)), {"aovs": {"Z": np.zeros((2, 2))}}, "no further layers"),
        ("a.exr", np.zeros((2, 2, 3)), {"aovs": {"Z": np.zeros((3, 2))}}, "shape"),
        ("a.exr", np.zeros((2, 2, 3)), {"aovs": {"Z": np.full((2, 2), np.nan)}}, "NaN"),
        ("a.exr", np.zeros((2, 2, 3)), {"aovs": {"R": np.zeros((2, 2))}}, "names"),
    ],
)
def test_refusals_leave_nothing_behind(tmp_path, name, pixels, options, words):
    with pytest.raises(UsdfabError, match=words) as caught:
        write_image(tmp_path / name, pixels, **options)
    assert caught.value.place == str(tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on file sizes")
@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
def test_a_full_disk_leaves_the_old_file(tmp_path, suffix):
    path = write_image(tmp_path / f"a{suffix}", np.zeros((2, 2, 3)))
    before = path.read_bytes()
    script = """
import resource, signal, sys
import numpy as np
from usdfab.errors import UsdfabError
from usdfab.imaging import write_image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
try:
    write_image(sys.argv[1], np.random.default_rng(0).random((200, 300, 3)), overwrite=True)
except UsdfabError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, timeout=60)
    assert "cannot be written" in done.stdout and done.stderr == "", done
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("usdfab.files.os.access", lambda *_: False)  # root may write everywhere
    with pytest.raises(UsdfabError, match="not writable"):
        write_image(tmp_path / "a.png", np.zeros((2, 2, 3)))


def test_import_is_light():
    script = "import sys, usdfab.imaging; sys.exit('OpenImageIO' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == 0
