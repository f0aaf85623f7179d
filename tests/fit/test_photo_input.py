"""Photos as they come: every kind of file, any size and aspect, cropped, averaged."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import weave_from_name
from usdfab.fit import photo_input
from usdfab.fit.analysis import analyze_photo
from usdfab.fit.photo_input import averaged, load_photo
from usdfab.imaging import linear_to_srgb, write_image
from usdfab.imaging.openimageio import openimageio


@cache
def cloth() -> NDArray[np.float32]:
    """240 x 200 pixels, 8 ends, 8 picks of 240 rows."""
    drawn = Cloth(
        weave_from_name("plain").matrix, 8, 8, size=240,
        warp_colours=((0.6, 0.3, 0.2),), weft_colours=((0.2, 0.4, 0.6),), twist=(0.0, 0.0),
    )  # fmt: skip
    return draw(drawn).astype(np.float32)[:200]


def save(path: Path, values: NDArray, kind: str, **attributes: object) -> Path:
    """An image file written by OpenImageIO itself."""
    oiio = openimageio()
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
    if values.shape[2] in (2, 4):
        spec.alpha_channel = values.shape[2] - 1
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(values) and out.close()
    return path


def codes(bits: int) -> NDArray:
    """The cloth, sRGB encoded."""
    top = 2**bits - 1
    return np.round(linear_to_srgb(cloth()) * top).astype(np.uint8 if bits == 8 else np.uint16)


def written(kind: str, folder: Path) -> Path:
    """The same photo as another kind of file."""
    turned = np.ascontiguousarray(np.rot90(codes(8)))  # an orientation of 6 turns it by a quarter clockwise
    opaque = np.dstack([codes(8), np.full(cloth().shape[:2], 255, np.uint8)])
    return {
        "png": lambda: save(folder / "a.png", codes(8), "uint8"),
        "png 16 bit": lambda: save(folder / "b.png", codes(16), "uint16"),
        "jpeg": lambda: save(folder / "c.jpg", codes(8), "uint8", Compression="jpeg:95"),
        "jpeg, on its side": lambda: save(folder / "d.jpg", turned, "uint8", Compression="jpeg:95", Orientation=6),
        "tiff 8 bit": lambda: save(folder / "e.tif", codes(8), "uint8"),
        "tiff 16 bit": lambda: save(folder / "f.tif", codes(16), "uint16"),
        "exr": lambda: save(folder / "g.exr", cloth(), "float"),
        "with alpha": lambda: save(folder / "h.png", opaque, "uint8"),
    }[kind]()


KINDS = ("png", "png 16 bit", "jpeg", "jpeg, on its side", "tiff 8 bit", "tiff 16 bit", "exr", "with alpha")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_gives_the_same_photo(kind: str, tmp_path: Path) -> None:
    path = written(kind, tmp_path)
    photo = load_photo(path, width=3e-3)
    assert photo.pixels.shape == (200, 240, 3) and photo.pixels.dtype == np.float32
    off = np.abs(linear_to_srgb(photo.pixels) - linear_to_srgb(cloth()))
    assert off.mean() < 0.02 if "jpeg" in kind else off.max() < 0.012
    assert (photo.width, photo.size_source) == (3e-3, "--size")
    assert photo.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert ("turned upright by its EXIF orientation 6" in photo.notes) == ("side" in kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["jpeg", "jpeg, on its side", "tiff 16 bit", "exr"])
def test_every_kind_of_file_shows_the_same_cloth(kind: str, tmp_path: Path) -> None:
    seen = analyze_photo(load_photo(written(kind, tmp_path), width=3e-3).pixels)
    assert seen.weave_class == "plain"
    assert (seen.warp.count, seen.weft.count) == (pytest.approx(8, rel=0.05), pytest.approx(8 * 200 / 240, rel=0.05))
    assert seen.warp.colour[0] > 1.5 * seen.warp.colour[2] and seen.weft.colour[2] > 1.5 * seen.weft.colour[0]


def test_grey_and_transparent_photos(tmp_path: Path) -> None:
    grey = codes(8)[..., :1]
    photo = load_photo(save(tmp_path / "grey.png", grey, "uint8"), 3e-3)
    assert (photo.pixels[..., 0] == photo.pixels[..., 2]).all()
    hole = np.dstack([codes(8), np.full(cloth().shape[:2], 255, np.uint8)])
    hole[:40, :50, 3] = 0
    photo = load_photo(save(tmp_path / "hole.png", hole, "uint8"), 3e-3)
    assert any("transparent" in note for note in photo.warnings)
    assert (photo.pixels[:40, :50] == 0).all() and (photo.pixels[60:] > 0).any()


def test_a_crop_keeps_the_size_of_a_pixel(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.png", cloth())
    whole = load_photo(path, 3e-3)
    photo = load_photo(path, 3e-3, crop=lambda w, h: (20, 10, w - 20, 130))
    np.testing.assert_array_equal(photo.pixels, whole.pixels[10:130, 20:220])
    assert photo.width == pytest.approx(3e-3 * 200 / 240) and photo.box == (20, 10, 220, 130)
    assert load_photo(path, pixel_size=1e-5, crop=lambda *_: (0, 0, 100, 90)).width == pytest.approx(1e-3)
    # Of the picture as one sees it, not as the file stores it.
    side = written("jpeg, on its side", tmp_path)
    upright = load_photo(side, 3e-3)
    part = load_photo(side, 3e-3, crop=lambda w, h: (0, 0, w // 2, h))
    np.testing.assert_array_equal(part.pixels, upright.pixels[:, :120])


@pytest.mark.parametrize("box", [(0, 0, 241, 10), (-1, 0, 9, 9), (5, 5, 5, 9), (9, 0, 3, 9), (0, 0, 9, 201)])
def test_a_crop_outside_the_picture(box: tuple[int, int, int, int], tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.png", cloth())
    with pytest.raises(UsdfabError, match="is no part of a picture of 240 x 200 pixels") as caught:
        load_photo(path, 3e-3, crop=lambda *_: box)
    assert caught.value.place == "--crop"


@pytest.mark.parametrize("tags", [(2540.0, 2540.0), (2540.0, 2600.0)])
def test_the_files_resolution_counts_and_pixels_are_square(tags: tuple[float, float], tmp_path: Path) -> None:
    path = save(
        tmp_path / "a.png", codes(8), "uint8", XResolution=tags[0], YResolution=tags[1], ResolutionUnit="in"
    )  # fmt: skip
    photo = load_photo(path)
    assert photo.width == pytest.approx(240e-5, rel=1e-3) and photo.size_source == "the file's resolution"
    assert any("their width is taken for both" in note for note in photo.warnings) == (tags[0] != tags[1])


def test_a_large_photo_is_averaged_and_measures_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photo_input, "WORKING_SIDE", 64)
    path = write_image(tmp_path / "a.exr", cloth(), half=False)
    photo = load_photo(path, 3e-3)
    assert photo.pixels.shape == (66, 80, 3)
    np.testing.assert_allclose(photo.pixels, cloth()[:198].reshape(66, 3, 80, 3, 3).mean((1, 3)), atol=1e-6)
    assert photo.width == pytest.approx(3e-3)
    assert any("averaged over 3 x 3 pixels, from 240 x 200" in note for note in photo.notes)
    cut = load_photo(path, 3e-3, crop=lambda w, h: (0, 0, 197, h))  # 2 columns are left over
    assert cut.width == pytest.approx(3e-3 * 195 / 240)


def test_of_a_long_photo_the_middle_is_used(tmp_path: Path) -> None:
    wide = np.tile(cloth()[:30], (1, 2, 1))
    for name, pixels in (("wide", wide), ("tall", np.swapaxes(wide, 0, 1))):
        photo = load_photo(write_image(tmp_path / f"{name}.png", pixels), 4.8e-3)
        assert sorted(photo.pixels.shape[:2]) == [30, 120]
        assert any("only the middle of the long photo" in note for note in photo.warnings)
        assert photo.width == pytest.approx(4.8e-3 * photo.pixels.shape[1] / pixels.shape[1])


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 6))
def test_averages_are_those_of_whole_blocks(rows: int, columns: int, factor: int) -> None:
    pixels = np.random.default_rng(rows * 41 + columns).random((rows, columns, 3)).astype(np.float32)
    found = averaged(pixels, factor)
    assert found.shape == (rows // factor, columns // factor, 3)
    if found.size:
        block = pixels[-(rows % factor) - factor :, -(columns % factor) - factor :][:factor, :factor]
        np.testing.assert_allclose(found[-1, -1], block.mean((0, 1)), atol=1e-5)
