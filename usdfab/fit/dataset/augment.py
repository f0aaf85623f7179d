"""What cameras and files do to a picture: drawn anew each time a sample is shown to a network in training.

Renders are clean, linear and evenly exposed; photos from cheap microscopes are none of that. The order is a camera's:
light (exposure, white balance, uneven lighting), lens (blur), sensor (noise), processing (tone curve, saturation,
sharpening), file (JPEG, 8 bits). Pictures are float (H, W, 3). Every step is a pure function; the first three and the
noise keep the picture's mean or change it by a known factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from usdfab.srgb import linear_to_srgb

Picture = NDArray[np.float32]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
"""Of linear Rec. 709 (BT.709-6)."""

MIDDLE_GREY = 0.18
"""Mean luminance that an automatic exposure aims at."""

# ITU-T T.81 (JPEG), Annex K, tables K.1 and K.2.
_LUMINANCE_TABLE = np.array([
    [16, 11, 10, 16, 24, 40, 51, 61], [12, 12, 14, 19, 26, 58, 60, 55], [14, 13, 16, 24, 40, 57, 69, 56],
    [14, 17, 22, 29, 51, 87, 80, 62], [18, 22, 37, 56, 68, 109, 103, 77], [24, 35, 55, 64, 81, 104, 113, 92],
    [49, 64, 78, 87, 103, 121, 120, 101], [72, 92, 95, 98, 112, 100, 103, 99],
], dtype=np.float32)  # fmt: skip
_CHROMINANCE_TABLE = np.full((8, 8), 99, dtype=np.float32)
_CHROMINANCE_TABLE[:4, :4] = [[17, 18, 24, 47], [18, 21, 26, 66], [24, 26, 56, 99], [47, 66, 99, 99]]

# ITU-T T.871 (JFIF), section 7.
_TO_YCC = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], dtype=np.float32)
_FROM_YCC = np.linalg.inv(_TO_YCC).astype(np.float32)


@dataclass(frozen=True)
class Camera:
    """One camera, its settings and its file.

    Parameters
    ----------
    exposure:
        Stops after ``metering``.
    metering:
        0: the light as it is; 1: all pictures equally bright; between, in proportion in stops.
    balance: (3,)
        Gains of red, green and blue.
    slope: (2,)
        Relative rise of the lighting from the middle to the right and upper border.
    vignetting:
        Relative loss of light at the middle of the borders, by the square of the distance.
    blur:
        Standard deviation of the lens's spot in pixels.
    shot_noise, read_noise:
        Variance per unit of signal, and standard deviation, in linear light with white at 1.
    gamma:
        Exponent after the sRGB curve.
    saturation:
        1 leaves colours as they are.
    sharpening, sharpening_radius:
        Amount of the unsharp mask, and its standard deviation in pixels.
    quality:
        Of the JPEG file, 1 to 100; 0 for none.
    """

    exposure: float = 0.0
    metering: float = 0.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    slope: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0
    blur: float = 0.0
    shot_noise: float = 0.0
    read_noise: float = 0.0
    gamma: float = 1.0
    saturation: float = 1.0
    sharpening: float = 0.0
    sharpening_radius: float = 1.0
    quality: int = 0


PLAIN = Camera()
"""Encodes a picture as sRGB and does nothing else."""


def sample_camera(rng: np.random.Generator) -> Camera:
    """A random camera, from a good one to a cheap USB microscope."""
    red, green, blue = np.exp(rng.normal(0.0, 0.1, 3)).tolist()
    return Camera(
        exposure=float(rng.normal(0.2, 0.5)),
        metering=float(rng.uniform(0.3, 1.0)),
        balance=(red, green, blue),
        slope=(float(rng.normal(0.0, 0.07)), float(rng.normal(0.0, 0.07))),
        vignetting=float(rng.uniform(0.0, 0.25)) if rng.random() < 0.6 else 0.0,
        blur=float(rng.uniform(0.3, 1.3)) if rng.random() < 0.6 else 0.0,
        shot_noise=float(np.exp(rng.uniform(np.log(1e-5), np.log(2e-3)))),
        read_noise=float(np.exp(rng.uniform(np.log(3e-4), np.log(1e-2)))),
        gamma=float(np.exp(rng.normal(0.0, 0.12))),
        saturation=float(rng.uniform(0.75, 1.3)),
        sharpening=float(rng.uniform(0.2, 2.5)) if rng.random() < 0.6 else 0.0,
        sharpening_radius=float(rng.uniform(0.7, 2.0)),
        quality=int(rng.integers(55, 99)) if rng.random() < 0.8 else 0,
    )


def photographed(picture: Picture, camera: Camera, rng: np.random.Generator) -> Picture:
    """A linear picture as the camera's file shows it: sRGB codes from 0 to 1, (H, W, 3) float32, in steps of 1/255.

    ``rng`` draws the sensor's noise.
    """
    x = np.asarray(picture, dtype=np.float32)
    x = x * (exposure_gain(x, camera) * np.asarray(camera.balance, dtype=np.float32))
    x = unevenly_lit(x, camera.slope, camera.vignetting)
    x = blurred(x, camera.blur)
    x = noisy(x, camera.shot_noise, camera.read_noise, rng)
    x = saturated(x, camera.saturation)
    x = linear_to_srgb(np.clip(x, 0.0, 1.0)) ** np.float32(camera.gamma)
    x = np.clip(sharpened(x, camera.sharpening, camera.sharpening_radius), 0.0, 1.0)
    if camera.quality:
        x = jpeg(x, camera.quality)
    return (np.round(255.0 * np.clip(x, 0.0, 1.0)) / 255.0).astype(np.float32)


def exposure_gain(picture: Picture, camera: Camera) -> np.float32:
    """The factor of the camera's exposure for a linear picture."""
    mean = max(float((picture @ LUMINANCE).mean()), 1e-6)
    return np.float32(2.0**camera.exposure * (MIDDLE_GREY / mean) ** camera.metering)


def unevenly_lit(picture: Picture, slope: tuple[float, float], vignetting: float) -> Picture:
    """``picture`` times a smooth field of mean 1 that rises by ``slope`` to the right and up and falls to the rim."""
    height, width = picture.shape[:2]
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * 2 - 1, 1 - (np.arange(height) + 0.5) / height * 2)
    field = np.maximum((1.0 + slope[0] * x + slope[1] * y) * (1.0 - vignetting * (x * x + y * y)), 0.0)
    return (picture * (field / field.mean())[..., None]).astype(np.float32)


def blurred(picture: Picture, sigma: float) -> Picture:
    """``picture`` convolved with a Gaussian, mirrored at the border, which keeps the mean."""
    return ndimage.gaussian_filter(picture, (sigma, sigma, 0.0), mode="reflect") if sigma > 0 else picture


def noisy(picture: Picture, shot: float, read: float, rng: np.random.Generator) -> Picture:
    """``picture`` with independent normal noise of variance ``shot * value + read^2`` and mean 0."""
    sigma = np.sqrt(np.float32(shot) * np.maximum(picture, 0.0) + np.float32(read * read))
    return (picture + sigma * rng.standard_normal(picture.shape, dtype=np.float32)).astype(np.float32)


def saturated(picture: Picture, amount: float) -> Picture:
    """Colours moved away from (above 1) or towards the grey of their luminance, which stays. Linear."""
    grey = (picture @ LUMINANCE)[..., None]
    return (grey + np.float32(amount) * (picture - grey)).astype(np.float32)


def sharpened(picture: Picture, amount: float, radius: float) -> Picture:
    """Unsharp mask, not clipped: keeps the mean."""
    return picture + np.float32(amount) * (picture - blurred(picture, radius)) if amount > 0 else picture


def jpeg(picture: Picture, quality: int) -> Picture:
    """sRGB codes 0 to 1 after JPEG compression with the standard's tables and chroma at half resolution.

    The quality scales the tables as the Independent JPEG Group's software does. Entropy coding loses nothing and is
    left out.
    """
    scale = 50.0 / quality if quality < 50 else 2.0 - 0.02 * quality
    height, width = picture.shape[:2]
    pad = (-height % 16, -width % 16)
    codes = np.pad(255.0 * picture, ((0, pad[0]), (0, pad[1]), (0, 0)), mode="edge") @ _TO_YCC.T
    tall, wide = codes.shape[:2]
    out = np.empty_like(codes)
    out[..., 0] = _quantized(codes[..., 0] - 128.0, _LUMINANCE_TABLE, scale) + 128.0
    for k in (1, 2):
        small = codes[..., k].reshape(tall // 2, 2, wide // 2, 2).mean(axis=(1, 3))
        out[..., k] = _quantized(small, _CHROMINANCE_TABLE, scale).repeat(2, axis=0).repeat(2, axis=1)
    return np.clip(out[:height, :width] @ _FROM_YCC.T / 255.0, 0.0, 1.0).astype(np.float32)


def _quantized(plane: NDArray, table: NDArray, scale: float) -> NDArray:
    """A plane whose sides are multiples of 8, its 8 x 8 blocks' cosine coefficients rounded to steps of ``table``."""
    steps = np.clip(np.floor(table * scale + 0.5), 1.0, 255.0)
    height, width = plane.shape
    blocks = plane.reshape(height // 8, 8, width // 8, 8).swapaxes(1, 2)
    coefficients = fft.dctn(blocks, axes=(2, 3), norm="ortho")
    back = fft.idctn(np.round(coefficients / steps) * steps, axes=(2, 3), norm="ortho")
    return back.swapaxes(1, 2).reshape(height, width)
