"""Decodes photographs, masks and depth of untrusted callers; rejects them by their headers, before memory is allocated.

Imports only `mapless_server.errors`. Begin with `decode`.
"""

from .decode import ANY_SIZE, ImageLimits, decode_image, image_size
from .depth import check_depth, decode_depth
from .exif import Upright, upright_of
from .masks import check_mask, decode_mask
