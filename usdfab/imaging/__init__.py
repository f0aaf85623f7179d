"""Image files, colour, error metrics and picture layout. OpenImageIO is loaded only when a file is read or written."""

from usdfab.imaging.color import linear_to_srgb as linear_to_srgb
from usdfab.imaging.color import luminance as luminance
from usdfab.imaging.color import srgb_to_linear as srgb_to_linear
from usdfab.imaging.image_file import Image as Image
from usdfab.imaging.image_file import read_image as read_image
from usdfab.imaging.image_file import read_layers as read_layers
from usdfab.imaging.image_output import encoded as encoded
from usdfab.imaging.image_output import write_image as write_image
from usdfab.imaging.layout import grid as grid
from usdfab.imaging.layout import side_by_side as side_by_side
from usdfab.imaging.metrics import mse as mse
from usdfab.imaging.metrics import psnr as psnr
from usdfab.imaging.metrics import relmse as relmse
