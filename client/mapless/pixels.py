"""The size of a JPEG, PNG or WebP image from its header, without decoding."""

# Frame headers of JPEG: all SOF markers; the others in 0xC0 to 0xCF are tables.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers that no segment follows


def size_of_image(data: bytes) -> tuple[int, int]:
    """Width and height of the raster as it is stored, pixels; EXIF orientation is not applied.

    ValueError for neither a JPEG nor a PNG nor a WebP file, or one without its header.
    """
    try:
        if data.startswith(b"\xff\xd8"):
            return _size_of_jpeg(data)
        if data.startswith(b"\x89PNG\r\n\x1a\n") and data[12:16] == b"IHDR":
            return _big(data, 16, 4), _big(data, 20, 4)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _size_of_webp(data)
    except IndexError:
        raise ValueError("the photograph ends within its header") from None
    raise ValueError("the photograph is not a JPEG, PNG or WebP file")


def _size_of_jpeg(data: bytes) -> tuple[int, int]:
    position = 2
    while True:
        while data[position] != 0xFF or data[position + 1] in (0x00, 0xFF):
            position += 1
        marker = data[position + 1]
        position += 2
        if marker in _JPEG_FRAMES:
            return _big(data, position + 5, 2), _big(data, position + 3, 2)
        if marker not in _JPEG_ALONE:
            position += _big(data, position, 2)


def _size_of_webp(data: bytes) -> tuple[int, int]:
    """The three kinds of a first chunk: extended, lossless, lossy (RFC 9649)."""
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + _little(data, 24, 3), 1 + _little(data, 27, 3)
    if kind == b"VP8L":
        bits = _little(data, 21, 4)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        return _little(data, 26, 2) & 0x3FFF, _little(data, 28, 2) & 0x3FFF
    raise ValueError("the photograph is a WebP file without an image")


def _big(data: bytes, start: int, count: int) -> int:
    return int.from_bytes(_exactly(data, start, count), "big")


def _little(data: bytes, start: int, count: int) -> int:
    return int.from_bytes(_exactly(data, start, count), "little")


def _exactly(data: bytes, start: int, count: int) -> bytes:
    part = data[start : start + count]
    if len(part) != count:
        raise IndexError
    return part
