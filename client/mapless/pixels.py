"""Format and size of a JPEG, PNG or WebP image by its header, without decoding; the server rejects images so, too."""

_MAX_JPEG_SEGMENTS = 2000  # 64 KiB each; bounds the walk through a file of nothing but empty ones
# Start-of-frame markers: C0 to CF without DHT (C4), JPG (C8) and DAC (CC).
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_HEIF_BRANDS = frozenset(b"heic heix heim heis hevc hevx hevm hevs mif1 msf1".split())
_JPEG_WITHOUT_LENGTH = frozenset(range(0xD0, 0xD8)) | {0x01}


class BadHeader(ValueError):
    """An image's size cannot be read from its header; the reason is that of the server's error."""

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


def format_of_image(data: bytes) -> str:
    """The format by the first bytes, "jpeg", "png" or "webp"; empty for another file."""
    if data.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    return "webp" if data.startswith(b"RIFF") and data[8:12] == b"WEBP" else ""


def size_of_image(data: bytes, what: str = "photograph") -> tuple[int, int]:
    """Width and height of the raster as it is stored, pixels; EXIF orientation is not applied.

    BadHeader, which says `what` it is, for neither a JPEG nor a PNG nor a WebP file, or one without a whole header.
    """
    kind = format_of_image(data)
    if not kind:
        if data[4:8] == b"ftyp" and data[8:12] in _HEIF_BRANDS:
            raise BadHeader(f"the {what} is a HEIC file; HEIC is not accepted: send a JPEG", "IMAGE_UNKNOWN_FORMAT")
        raise BadHeader(f"the {what} is not a JPEG, PNG or WebP file", "IMAGE_UNKNOWN_FORMAT")
    try:
        return {"jpeg": _size_of_jpeg, "png": _size_of_png, "webp": _size_of_webp}[kind](data)
    except IndexError:
        raise BadHeader(f"the {what} ends within its header", "IMAGE_TRUNCATED") from None


def _size_of_jpeg(data: bytes) -> tuple[int, int]:
    """Reads the segments up to the frame header, which precedes the first scan."""
    position = 2
    for _ in range(_MAX_JPEG_SEGMENTS):
        first, marker = data[position], data[position + 1]
        if first != 0xFF:
            raise BadHeader("the JPEG is damaged: no marker where one must stand", "IMAGE_UNDECODABLE")
        if marker == 0xFF:  # padding
            position += 1
        elif marker in _JPEG_WITHOUT_LENGTH:
            position += 2
        elif marker in JPEG_FRAMES:
            return _big(data, position + 7, 2), _big(data, position + 5, 2)
        elif marker in (0xDA, 0xD9):
            raise BadHeader("the JPEG has no frame header", "IMAGE_UNDECODABLE")
        else:
            position += 2 + (data[position + 2] << 8 | data[position + 3])
    raise BadHeader("the JPEG has too many segments before its frame header", "IMAGE_TOO_COMPLEX")


def _size_of_png(data: bytes) -> tuple[int, int]:
    """Reads the chunk IHDR, which is always the first, and must be there with all of its 13 bytes."""
    width, height = _big(data, 16, 4), _big(data, 20, 4)
    _take(data, 16, 13)
    if data[12:16] != b"IHDR":
        raise BadHeader("the PNG does not begin with its header", "IMAGE_UNDECODABLE")
    return width, height


def _size_of_webp(data: bytes) -> tuple[int, int]:
    """Reads the first chunk: the frame itself (lossy or lossless) or the extended header."""
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = _little(data, 26, 2) & 0x3FFF, _little(data, 28, 2) & 0x3FFF
        if data[23:26] != b"\x9d\x01\x2a":
            raise BadHeader("the WebP does not begin with a key frame", "IMAGE_UNDECODABLE")
        return width, height
    if kind == b"VP8L":
        bits = _little(data, 21, 4)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        if data[20] & 0x02:
            raise BadHeader("the WebP is an animation", "IMAGE_UNKNOWN_FORMAT")
        return _little(data, 24, 3) + 1, _little(data, 27, 3) + 1
    if len(data) < 16:
        raise IndexError
    raise BadHeader("the WebP holds no image", "IMAGE_UNDECODABLE")


def _big(data: bytes, position: int, length: int) -> int:
    return int.from_bytes(_take(data, position, length), "big")


def _little(data: bytes, position: int, length: int) -> int:
    return int.from_bytes(_take(data, position, length), "little")


def _take(data: bytes, position: int, length: int) -> bytes:
    if position + length > len(data):
        raise IndexError
    return data[position : position + length]
