"""Regressions: inputs with which fuzzing found an error, each as small as possible."""

from __future__ import annotations

import json
import re
import resource
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.images import encode, textured

from fuzz import benchmarks, captures, colmap
from fuzz.images import chunk
from fuzz.importing import Layout
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image, png_chunks
from mapless_server.images.png_chunks import essential_png
from mapless_server.security import SecurityError, read_tokens
from mapless_server.settings import ConfigError, load_settings
from mapless_tools.ingest.formats import read_dataset

RGB = textured(32, 32)
PNG = encode(".png", RGB)
HEADER_BYTES = 33
LIMITS = ImageLimits()


def with_chunks(*chunks: bytes) -> bytes:
    return PNG[:HEADER_BYTES] + b"".join(chunks) + PNG[HEADER_BYTES:]


def peak_bytes() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.parametrize("claimed", [100 * 2**20, 2**31 - 1, 2**32 - 1])
@pytest.mark.parametrize("kind", [b"tEXt", b"iTXt", b"abcd", b"IDAT"])
def test_a_png_does_not_take_the_memory_that_a_chunk_claims(kind: bytes, claimed: int) -> None:
    """OpenCV 5.0 alone takes 2 GB, and seconds, for a file of a kilobyte whose text claims to be so long."""
    data = PNG[:HEADER_BYTES] + struct.pack(">I", claimed) + kind + PNG[HEADER_BYTES + 8 :]
    before_bytes = peak_bytes()
    with pytest.raises(InvalidArgument, match="cut off") as caught:
        decode_image(data, LIMITS)
    assert caught.value.reason == "IMAGE_UNDECODABLE"
    assert peak_bytes() - before_bytes < 64 * 2**20


def test_compressed_texts_of_a_png_are_not_inflated() -> None:
    """Two hundred of them, 1.5 MB, made the decoder work for ten seconds."""
    text = b"Comment\0\0" + zlib.compress(bytes(7_900_000), 9)
    data = with_chunks(*[chunk(b"zTXt", text)] * 200)
    assert len(essential_png(data)) < len(PNG) + 100
    np.testing.assert_array_equal(decode_image(data, LIMITS), RGB)


def test_a_png_with_more_data_than_pixels_is_refused() -> None:
    """The rest would be inflated all the same: 3 s for each megabyte."""
    pixels = zlib.compress(np.random.default_rng(0).bytes(100_000))
    data = PNG[:HEADER_BYTES] + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    with pytest.raises(InvalidArgument, match="more data than pixels") as caught:
        decode_image(data, LIMITS)
    assert caught.value.reason == "IMAGE_TOO_COMPLEX"


def test_png_data_beyond_its_pixels_is_not_inflated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen megabytes of it, as many as a file may have, inflate to seventeen gigabytes."""
    flushed = zlib.compressobj(9)
    megabyte = flushed.compress(bytes(2**20)) + flushed.flush(zlib.Z_FULL_FLUSH)
    start, again = megabyte, megabyte[2:]  # the first has the stream's header
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 5000, 1000, 8, 2, 0, 0, 0))
    pieces = [chunk(b"IDAT", start), *[chunk(b"IDAT", again)] * 2000, chunk(b"IEND", b"")]
    inflated, inflater = [0], zlib.decompressobj

    class Counted:
        def __init__(self) -> None:
            self._inflater = inflater()

        def decompress(self, data: bytes, most: int) -> bytes:
            out = self._inflater.decompress(data, most)
            inflated[0] += len(out)
            return out

        @property
        def unconsumed_tail(self) -> bytes:
            return self._inflater.unconsumed_tail

    monkeypatch.setattr("zlib.decompressobj", Counted)
    with pytest.raises(InvalidArgument, match="more data than pixels") as caught:
        decode_image(b"\x89PNG\r\n\x1a\n" + header + b"".join(pieces), LIMITS)
    assert caught.value.reason == "IMAGE_TOO_COMPLEX"
    assert 5000 * 1000 * 3 < inflated[0] < 20 * 2**20


@pytest.mark.parametrize("in_chunks_of", [100, 10**9])
@pytest.mark.parametrize("level", [0, 6])
def test_a_large_png_is_decoded_however_badly_it_is_compressed(level: int, in_chunks_of: int) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (400, 400, 3)).astype(np.uint8)
    data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rgb), level)
    assert len(data) > png_chunks._TRUSTED_DATA_BYTES
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 400, 400, 8, 2, 0, 0, 0))
    parts = [chunk(b"IDAT", data[i : i + in_chunks_of]) for i in range(0, len(data), in_chunks_of)]
    whole = b"\x89PNG\r\n\x1a\n" + header + b"".join(parts) + chunk(b"IEND", b"")
    np.testing.assert_array_equal(decode_image(whole, LIMITS), rgb)


def test_a_png_of_nothing_but_chunks_is_refused() -> None:
    data = PNG[:HEADER_BYTES] + chunk(b"abcd", b"") * 100_001 + PNG[HEADER_BYTES:]
    with pytest.raises(InvalidArgument, match="too many chunks"):
        decode_image(data, LIMITS)


def png(depth: int, colour: int, row_bytes: int, *chunks: bytes, interlaced: bool = False) -> bytes:
    """40 x 40 pixels of noise that cannot be compressed."""
    rows = np.random.default_rng(0).integers(0, 256, (40, row_bytes)).astype(np.uint8)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 40, 40, depth, colour, 0, 0, interlaced))
    body = zlib.compress(raw, 0)
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


PALETTE = chunk(b"PLTE", bytes(range(256)) * 3)
KINDS = {
    "palette": png(8, 3, 40, PALETTE),
    "palette with transparency": png(8, 3, 40, PALETTE, chunk(b"tRNS", bytes(range(100)))),
    "grey with transparency": png(8, 0, 40, chunk(b"tRNS", b"\0\5")),
    "colours with transparency": png(8, 2, 120, chunk(b"tRNS", b"\0\5\0\5\0\5")),
    "one bit": png(1, 0, 5),
    "alpha": png(8, 6, 160),
    "sixteen bits": png(16, 2, 240),
    "sixteen bits with alpha": png(16, 6, 320),
    "gamma": png(8, 0, 40, chunk(b"gAMA", struct.pack(">I", 45455))),
    "colour space": png(8, 2, 120, chunk(b"cICP", bytes([9, 16, 0, 1]))),
    "significant bits": png(16, 0, 80, chunk(b"sBIT", b"\x0a")),
    "one frame of an animation": png(8, 2, 120, chunk(b"acTL", struct.pack(">II", 1, 0))),
}


@pytest.mark.parametrize("name", [name for name in KINDS if " bits" not in name])
def test_the_chunks_that_are_left_out_change_no_pixel(name: str) -> None:
    """Photographs of 8 bits; those of 16 are stretched, see test_deep_pixels."""
    whole = cv2.imdecode(np.frombuffer(KINDS[name], np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    assert whole is not None
    np.testing.assert_array_equal(decode_image(KINDS[name], LIMITS), whole)


def layout(layouts: tuple[Layout, ...], folder: str, format: str = "") -> Layout:
    return next(it for it in layouts if it.folder == folder and format in ("", it.format))


def written(path: Path, of: Layout, old: bytes, new: bytes) -> Path:
    """The layout's folder, with one thing in its files changed."""
    assert any(old in content for content in of.files.values())
    for i, image in enumerate(of.images):
        (path / image).parent.mkdir(parents=True, exist_ok=True)
        (path / image).write_bytes(encode(Path(image).suffix, textured(32, 33, seed=i)))
    for name, content in of.files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content.replace(old, new, 1))
    return path


def test_a_cambridge_lens_beyond_all_numbers_refuses_its_image(tmp_path: Path) -> None:
    """It was an OverflowError."""
    of = layout(benchmarks.LAYOUTS, "ShopFacade")
    folder = written(tmp_path, of, b" -0.05 0", b" 1e200 0")
    dataset = read_dataset(folder, of.format, of.options(folder))
    assert len(dataset.frames) == 2
    assert len(dataset.refused) == 1


def test_an_overlong_name_in_a_colmap_model_refuses_its_image(tmp_path: Path) -> None:
    """It was an OSError."""
    of = layout(colmap.LAYOUTS, "text")
    folder = written(tmp_path, of, b"cam0/1.png", b"a" * 300)
    dataset = read_dataset(folder)
    assert len(dataset.frames) == 2
    assert "File name too long" in dataset.refused[0].reason


@pytest.mark.parametrize("size", ["0 33", "-1 33", "32 1073741825", "32 1" + 400 * "0"])
def test_every_reader_refuses_a_camera_without_size(tmp_path: Path, size: str) -> None:
    """Dividing by 0 was a ZeroDivisionError, by 1e400 an OverflowError, and the rest was taken."""
    of = layout(colmap.LAYOUTS, "text")
    folder = written(tmp_path / "colmap", of, b"PINHOLE 32 33", f"PINHOLE {size}".encode())
    with pytest.raises(ValueError, match="is no size"):
        read_dataset(folder)
    of = benchmarks.LAYOUTS[4]
    folder = written(tmp_path / "kitchen", of, b"PINHOLE 64 66", f"PINHOLE {size}".encode())
    with pytest.raises(ValueError, match="is no size"):
        read_dataset(folder, of.format, of.options(folder))


@pytest.mark.parametrize("width", ["0", "0.5", "-1", "1e300"])
def test_twelve_scenes_of_no_size_are_refused(tmp_path: Path, width: str) -> None:
    of = benchmarks.LAYOUTS[3]
    folder = written(tmp_path / "kitchen", of, b"m_colorWidth = 64", f"m_colorWidth = {width}".encode())
    with pytest.raises(ValueError, match="is no size"):
        read_dataset(folder)


@pytest.mark.parametrize(
    ("name", "file", "key", "translation", "reason"),
    [
        # Infinity less infinity was no number, and no number is not above the limit: the pose was taken.
        ("nerfstudio", "transforms.json", "transform_matrix", (1e308, -1e308), r"10000000 m|1e\+07 m"),
        ("ours", "cameras.json", "world_from_camera", (1.0001e7,), "from the origin"),
    ],
)
def test_a_pose_too_far_away_is_refused(
    tmp_path: Path, name: str, file: str, key: str, translation: tuple[float, ...], reason: str
) -> None:
    of = layout(captures.LAYOUTS, name)
    content = json.loads(of.files[file])
    for row, value in enumerate(translation):
        content["frames"][1][key][row][3] = value
    dataset = read_dataset(written(tmp_path, of, of.files[file], json.dumps(content).encode()))
    assert len(dataset.frames) == 2
    assert re.search(reason, dataset.refused[0].reason)


@pytest.mark.parametrize("name", ["images/\\u001b[2J.png", "images/\\ud800.png", "images/\\u0000", "x" * 5000])
def test_messages_about_a_refused_frame_can_be_printed(tmp_path: Path, name: str) -> None:
    """Half a character made printing fail, and an escape would have been the terminal's to follow."""
    of = layout(captures.LAYOUTS, "nerfstudio")
    folder = written(tmp_path, of, b"./images/1.png", name.encode())
    dataset = read_dataset(folder)
    (refusal,) = dataset.refused
    for text in (refusal.frame, refusal.reason):
        assert text.isprintable()
        assert len(text) < 1200
        text.encode()


def test_names_in_a_file_of_tokens_are_printed_as_text(tmp_path: Path) -> None:
    file = tmp_path / "tokens.json"
    file.write_text('{"\\u001b[2J\\u2028": 1}')
    with pytest.raises(SecurityError, match="Extra inputs") as caught:
        read_tokens(file)
    assert str(caught.value).isprintable()


def test_names_in_settings_are_printed_as_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mapless.toml"
    file.write_text('"\\u001b[2J" = 1\n')
    with pytest.raises(ConfigError) as caught:
        load_settings({}, file)
    assert str(caught.value).isprintable()
    monkeypatch.setenv("MAPLESS_\xa0", "1")
    with pytest.raises(ConfigError, match="is not a setting") as caught:
        load_settings({})
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"{name} = {value}", name)  # a queue of infinite length was one
        for name in ("max_queued_s", "drain_grace_s", "default_deadline_s", "tenant_rate_ms")
        for value in ("1e400", "inf", "nan")
    ]
    # They were a ValueError when the path or the host was used, and a RecursionError.
    + [(f'{name} = "a\\u0000b"', "must be") for name in ("data_dir", "tokens_file", "host")]
    + [('host = "a b"', "must be"), ("a = " + 900 * "[", "recursion")],
)
def test_settings_that_nothing_can_be_done_with_are_refused(tmp_path: Path, line: str, message: str) -> None:
    file = tmp_path / "mapless.toml"
    file.write_text(f"{line}\n")
    with pytest.raises(ConfigError, match=message):
        load_settings({}, file)


@pytest.mark.parametrize("name", ["tokens_file", "capture_dir", "otlp_endpoint", "host"])
@pytest.mark.parametrize("password", ["hunter2", "hun@hunter2", "hun:hunter2", "hun/hunter2", "@hunter2"])
def test_the_password_of_a_url_in_another_setting_is_not_shown(tmp_path: Path, name: str, password: str) -> None:
    file = tmp_path / "mapless.toml"
    file.write_text(f'{name} = "postgresql://u:{password}@db:5432/mapless"\n')
    assert re.search(rf"{name} .*u:\*+@db", shown := str(load_settings({}, file)))
    assert "hun" not in shown


def test_a_password_with_a_line_break_is_not_shown_either() -> None:
    assert "ter2" not in str(load_settings({"capture_dir": "postgresql://u:hun\nter2@db:5432/mapless"}))
