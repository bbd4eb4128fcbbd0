"""Decodes photographs of untrusted callers; rejects them by their headers, before memory is allocated for them.

Imports only `mapless_server.errors`. Begin with `decode`.
"""

from .decode import ImageLimits, decode_image, image_size

__all__ = ["ImageLimits", "decode_image", "image_size"]
