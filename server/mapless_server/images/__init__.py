"""Encoded photographs of strangers to pixels; one is rejected by its header, before memory is allocated for it.

Imports only `mapless_server.errors`. Begin with `decode`.
"""

from .decode import ImageLimits, decode_image, image_size

__all__ = ["ImageLimits", "decode_image", "image_size"]
