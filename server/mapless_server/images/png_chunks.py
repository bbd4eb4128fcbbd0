"""The chunks of a PNG's pixels, which alone are passed to the decoder.

The decoder allocates for whatever length a chunk of text claims, gigabytes for a file of a kilobyte, and inflates every
compressed text and profile, megabytes for kilobytes each; so it does not get them. Colour profiles, gamma and
transparency are not applied, so that nothing is lost.
"""

import struct
import zlib
from collections.abc import Iterable

from mapless_server.errors import InvalidArgument

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_ESSENTIAL = frozenset({b"IHDR", b"PLTE", b"IDAT"})
_END = b"\0\0\0\0IEND\xaeB`\x82"
_MAX_CHUNKS = 100_000  # of 160 bytes each in the largest file; encoders make chunks of 4 KiB and more
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""By the header's colour type."""
_DATA_SLACK_BYTES = 2**16
_TRUSTED_DATA_BYTES = 2**18
"""So much data inflates to 270 MB at most, in less than a second, whatever it holds."""
_PIECE_BYTES = 2**20


def essential_png(data: bytes, field: str = "image", what: str = "image") -> bytes:
    """The PNG with only header, palette and pixels; the decoder checks their checksums.

    InvalidArgument, naming `field` and `what` it is, if a chunk exceeds the file's end, the end is missing, there are
    too many chunks, or there are more data than pixels, which would be inflated all the same.
    """

    def fault(text: str, reason: str) -> InvalidArgument:
        return InvalidArgument(text, reason=reason, field=field)

    undecodable = f"the {what} cannot be decoded: the PNG is cut off"
    view = memoryview(data)
    kept: list[memoryview | bytes] = [_SIGNATURE]
    pixel_data: list[memoryview] = []
    position = len(_SIGNATURE)
    for _ in range(_MAX_CHUNKS):
        if position + 12 > len(data):
            raise fault(undecodable, "IMAGE_UNDECODABLE")
        (length,) = struct.unpack_from(">I", data, position)
        kind, end = data[position + 4 : position + 8], position + 12 + length
        if end > len(data):
            raise fault(f"{undecodable} or damaged", "IMAGE_UNDECODABLE")
        if kind == b"IEND":
            break
        if kind in _ESSENTIAL:
            kept.append(view[position:end])
        if kind == b"IDAT":
            pixel_data.append(view[position + 8 : position + 8 + length])
        position = end
    else:
        raise fault("the PNG has too many chunks", "IMAGE_TOO_COMPLEX")
    data_bytes, most_bytes = sum(map(len, pixel_data)), _most_data_bytes(data)
    if data_bytes > most_bytes or (data_bytes > _TRUSTED_DATA_BYTES and _inflates_beyond(most_bytes, pixel_data)):
        raise fault("the PNG has more data than pixels", "IMAGE_TOO_COMPLEX")
    return b"".join([*kept, _END])


def _inflates_beyond(most_bytes: int, compressed: Iterable[memoryview]) -> bool:
    """Whether a stream inflates to more than this many bytes; it is inflated only so far, and nothing is kept.

    The decoder inflates the stream to its end, even beyond the pixels: a megabyte of zeros becomes a gigabyte.
    """
    inflater, inflated_bytes = zlib.decompressobj(), 0
    try:
        for rest in compressed:
            while rest and inflated_bytes <= most_bytes:
                inflated_bytes += len(inflater.decompress(rest, _PIECE_BYTES))
                rest = memoryview(inflater.unconsumed_tail)
    except zlib.error:  # it is the decoder's to refuse, where it ends
        return False
    return inflated_bytes > most_bytes


def _most_data_bytes(data: bytes) -> int:
    """Largest size of the data of a valid file's pixels, however badly they are compressed."""
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    row_bytes = (width * depth * _CHANNELS.get(colour, 4) + 7) // 8
    # Interlaced rows come in seven parts, each with its own filter byte and padding, and stored blocks have headers.
    return int((row_bytes + 16) * height * 9 // 8 + _DATA_SLACK_BYTES)


def png_chunk_names(data: bytes) -> frozenset[bytes]:
    """Names of a PNG's chunks, up to the first that is cut off, and of the first 100,000 only."""
    position, names = len(_SIGNATURE), set()
    for _ in range(_MAX_CHUNKS):
        if position + 12 > len(data):
            break
        (length,) = struct.unpack_from(">I", data, position)
        names.add(data[position + 4 : position + 8])
        position += 12 + length
    return frozenset(names)
