"""Decodes photographs and masks of untrusted callers; rejects them by their headers, before memory is allocated.

Imports only `mapless_server.errors`. Begin with `decode`.
"""

from .decode import ANY_SIZE, ImageLimits, decode_image, image_size
from .exif import Upright, upright_of
from .masks import check_mask, decode_mask
