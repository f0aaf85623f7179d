"""Image files, colour, error metrics and picture layout. OpenImageIO is loaded only when a file is read or written."""

from usdfab.imaging.color import (
    linear_to_srgb as linear_to_srgb,
    luminance as luminance,
    srgb_to_linear as srgb_to_linear,
)
from usdfab.imaging.denoise import check_denoiser as check_denoiser, denoise as denoise
from usdfab.imaging.flip import flip as flip, flip_map as flip_map
from usdfab.imaging.image_file import Image as Image, read_image as read_image, read_layers as read_layers
from usdfab.imaging.image_output import encoded as encoded, write_image as write_image
from usdfab.imaging.layout import grid as grid, side_by_side as side_by_side
from usdfab.imaging.metrics import mse as mse, psnr as psnr, relmse as relmse
from usdfab.imaging.view import VIEWS as VIEWS, view_transform as view_transform
