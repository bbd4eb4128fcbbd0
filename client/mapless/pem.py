"""PEM as people have it."""

import codecs

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def without_marks(data: bytes) -> bytes:
    """PEM bytes without the byte order marks that editors and shells of Windows write, and in ASCII where it is UTF-16.

    TLS libraries overlook a block whose line does not begin with its dashes. Files that were joined have marks inside.
    """
    if data.startswith(_UTF_16):
        try:
            data = data.decode("utf-16").encode()
        except UnicodeError:
            return data
    return data.replace(codecs.BOM_UTF8 + b"-----", b"-----").removeprefix(codecs.BOM_UTF8)
