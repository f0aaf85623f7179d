"""Textures: values come back, colours are encoded and data are not, the physical size is in the header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from usdfab.errors import UsdfabError
from usdfab.imaging import linear_to_srgb
from usdfab.imaging.texture_file import write_texture

RAMP = np.linspace(0.0, 1.0, 60, dtype=np.float32).reshape(6, 10)
COLOR = np.stack([RAMP, RAMP**2, 1.0 - RAMP], axis=-1)


def stored(path: Path) -> tuple[np.ndarray, oiio.ImageSpec]:
    """Numbers as they are in the file, (H, W, C), and the header."""
    file = oiio.ImageInput.open(str(path))
    pixels = np.asarray(file.read_image("float"))
    spec = file.spec()
    file.close()
    return pixels.reshape(spec.height, spec.width, spec.nchannels), spec


@pytest.mark.parametrize(("bits", "step"), [(8, 1 / 255), (16, 1 / 65535)])
def test_data_are_stored_as_they_are(tmp_path: Path, bits: int, step: float) -> None:
    pixels, spec = stored(write_texture(tmp_path / "height.png", RAMP, color=False, bits=bits))
    assert spec.nchannels == 1 and spec.format.basesize() == bits // 8
    assert pixels[..., 0] == pytest.approx(RAMP, abs=0.51 * step)


def test_colours_are_srgb_encoded(tmp_path: Path) -> None:
    pixels, _ = stored(write_texture(tmp_path / "albedo.png", COLOR, color=True))
    assert pixels == pytest.approx(linear_to_srgb(COLOR), abs=0.51 / 255)


def test_exr_holds_the_values_themselves(tmp_path: Path) -> None:
    heights = (RAMP - 0.5) * 1e-3
    pixels, spec = stored(write_texture(tmp_path / "height.exr", heights, color=False))
    assert str(spec.format) == "float" and pixels[..., 0] == pytest.approx(heights, abs=1e-10)
    pixels, spec = stored(write_texture(tmp_path / "albedo.exr", COLOR, color=True))
    assert str(spec.format) == "half" and pixels == pytest.approx(COLOR, abs=1e-3)


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_the_size_of_a_texel_is_in_the_header(tmp_path: Path, suffix: str) -> None:
    _, spec = stored(write_texture(tmp_path / f"map{suffix}", RAMP, color=False, texel=(1e-5, 1e-5)))
    per_unit = {"in": 0.0254, "inch": 0.0254, "cm": 0.01}[spec.get_string_attribute("ResolutionUnit")]
    assert per_unit / spec.get_float_attribute("XResolution") == pytest.approx(1e-5, rel=1e-3)
    assert per_unit / spec.get_float_attribute("YResolution") == pytest.approx(1e-5, rel=1e-3)


@pytest.mark.parametrize("values", [np.zeros((4, 4, 2)), np.zeros((0, 4)), np.full((2, 2), np.nan), np.zeros(5)])
def test_what_is_no_texture_is_refused(tmp_path: Path, values: np.ndarray) -> None:
    with pytest.raises(UsdfabError):
        write_texture(tmp_path / "bad.png", values, color=False)
    assert list(tmp_path.iterdir()) == []


def test_files_are_not_overwritten_unasked(tmp_path: Path) -> None:
    path = write_texture(tmp_path / "a.png", RAMP, color=False)
    with pytest.raises(UsdfabError, match="exists"):
        write_texture(path, RAMP, color=False)
    with pytest.raises(UsdfabError, match="cannot write"):
        write_texture(tmp_path / "a.gif", RAMP, color=False)
