"""Videos of a reconstruction's sources: which frames are chosen, and how they are written."""

import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mapless_server.images import ANY_SIZE, decode_image
from mapless_tools.reconstruct.pictures import Picture, Pictures
from mapless_tools.reconstruct.sources import SourceOptions, read_sources
from mapless_tools.reconstruct.sources.choosing import choose_frames, common_spacing
from mapless_tools.reconstruct.sources.video import Video, opened_video

av = pytest.importorskip("av")

SIZE = 320, 240
RATE = 30
DATA = Path(__file__).parents[3] / "../shared/data/video"


def wall(seed: int, width_px: int = 2000, height_px: int = SIZE[1]) -> NDArray[np.uint8]:
    """A wide picture (H, W, 3) of random polygons, along which cameras move."""
    rng = np.random.default_rng(seed)
    image = np.full((height_px, width_px, 3), 128, np.uint8)
    for _ in range(width_px // 4):
        corners = rng.integers(0, (width_px, height_px), 2) + rng.integers(-30, 30, (5, 2))
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.integers(0, 256, 3).tolist())
    return image


def pan(lefts_px: Iterable[float], seed: int = 0) -> list[NDArray[np.uint8]]:
    """Frames of a camera whose left border is there on a wall."""
    image = wall(seed)
    moved = [np.array([[1, 0, -it], [0, 1, 0]], np.float32) for it in lefts_px]
    return [np.asarray(cv2.warpAffine(image, it, SIZE), np.uint8) for it in moved]


def write(file: Path, frames: Sequence[NDArray[Any]], times_ms: Sequence[int] | None = None, **options: Any) -> Path:
    """Writes a video; its frames at 30 Hz, or at these times."""
    file.parent.mkdir(parents=True, exist_ok=True)
    container = av.open(str(file), "w", format=options.get("format"))
    with container:
        stream = container.add_stream(options.get("codec", "libx264"), RATE, options=options.get("settings", {}))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = options.get("pix_fmt", "yuv420p")
        stream.codec_context.gop_size = options.get("gop", 30)
        stream.codec_context.thread_count = 1  # several give another video each time
        stream.codec_context.time_base = Fraction(1, 1000)
        if "aspect" in options:
            stream.codec_context.sample_aspect_ratio = options["aspect"]
        if "rotation" in options:
            stream.set_display_rotation(options["rotation"], hflip=options.get("hflip", False))
        for i, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts = times_ms[i] if times_ms else i * 1000 // RATE
            frame.time_base = Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return file


def read(*sources: Path, frames: int = 150) -> Pictures:
    return read_sources(sources, sources[0].parent / "work", SourceOptions(frames=frames), lambda *_: None)


def indices(pictures: Pictures) -> list[int]:
    return [it.time.frame for it in pictures.chosen if it.time]


def pixels(picture: Picture) -> NDArray[np.uint8]:
    return decode_image(picture.path.read_bytes(), ANY_SIZE)


def difference(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    return float(np.abs(first.astype(int) - second).mean()) if first.shape == second.shape else 255.0


@pytest.mark.parametrize("hflip", [False, True])
@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_display_matrix_is_applied(tmp_path: Path, rotation: int, hflip: bool) -> None:
    upright = pan([0])[0]
    stored = np.rot90(upright[:, ::-1] if hflip else upright, -rotation // 90)
    file = write(tmp_path / "a.mp4", [np.ascontiguousarray(stored)] * 3, rotation=rotation, hflip=hflip)
    (picture,) = read(file).chosen
    assert (picture.width_px, picture.height_px, picture.orientation) == (*SIZE, 1)
    assert difference(pixels(picture), upright) < 12


def test_times_are_those_of_presentation(tmp_path: Path) -> None:
    times_ms = np.cumsum(np.random.default_rng(1).integers(28, 68, 60)).tolist()
    frames = pan(np.arange(60) * 6.0)
    pictures = read(write(tmp_path / "a.mkv", frames, times_ms))
    assert len(pictures.chosen) > 5
    for it in pictures.chosen:
        assert it.time is not None
        assert it.time.time_s == pytest.approx(times_ms[it.time.frame] / 1000, abs=0.0015)
        assert difference(pixels(it), frames[it.time.frame]) < 12


@pytest.mark.parametrize("gop", [5, 250])
def test_frames_are_apart_by_what_they_show(tmp_path: Path, gop: int) -> None:
    lefts_px = np.concatenate([np.arange(60) * 2.0, 120 + np.arange(30) * 10.0, np.full(90, 420.0)])
    pictures = read(write(tmp_path / "a.mp4", pan(lefts_px), gop=gop))
    steps_px = np.diff(lefts_px[indices(pictures)])
    assert len(steps_px) >= 10
    assert steps_px.min() > 15
    assert steps_px.max() < 60
    assert max(indices(pictures)[:-1]) < 90


def test_blurred_frames_are_not_chosen(tmp_path: Path) -> None:
    frames = pan(np.arange(120) * 4.0)
    blurred = {i for i in range(120) if i % 12 < 6}
    for i in blurred:
        frames[i] = np.asarray(cv2.blur(frames[i], (9, 1)), np.uint8)
    chosen = indices(read(write(tmp_path / "a.mp4", frames)))
    assert len(chosen) > 10
    assert not blurred.intersection(chosen[1:])


def test_video_that_cannot_be_sought_in_gives_the_same_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Unseekable:
        """A container whose seek fails."""

        def __init__(self, container: Any) -> None:
            self._container = container

        def __getattr__(self, name: str) -> Any:
            return getattr(self._container, name)

        def seek(self, *_: object, **__: object) -> None:
            raise av.error.PermissionError(1, "Operation not permitted")

    @contextmanager
    def unseekable(file: Path, *, keys_only: bool = False) -> Iterator[Video]:
        with opened_video(file, keys_only=keys_only) as video:
            container: Any = Unseekable(video.container)
            yield replace(video, container=container)

    file = write(tmp_path / "a.mp4", pan(np.arange(60) * 10.0), gop=2)
    sought = read(file)
    monkeypatch.setattr("mapless_tools.reconstruct.sources.frames.opened_video", unseekable)
    (tmp_path / "other").mkdir()
    counted = read(file.rename(tmp_path / "other" / "a.mp4"))
    assert indices(counted) == indices(sought)
    for one, other in zip(counted.chosen, sought.chosen, strict=True):
        assert one.path.read_bytes() == other.path.read_bytes()


def test_still_camera_gives_one_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    still = pan([100])[0]
    frames = [np.asarray(np.clip(still + rng.normal(0, 4, still.shape), 0, 255), np.uint8) for _ in range(90)]
    pictures = read(write(tmp_path / "a.mp4", frames))
    assert len(pictures.chosen) == 1
    assert any("hardly moves" in it for it in pictures.notes)
    assert sum(it.count for it in pictures.omitted) == 89


def test_cut_is_named_with_its_time(tmp_path: Path) -> None:
    frames = pan(np.arange(45) * 4.0, seed=1) + pan(np.arange(45) * 4.0, seed=2)
    pictures = read(write(tmp_path / "a.mp4", frames))
    (note,) = [it for it in pictures.notes if "cut, at" in it]
    assert "1.5 s:" in note
    assert min(indices(pictures)) < 45 < max(indices(pictures))


def test_fast_turn_is_no_cut(tmp_path: Path) -> None:
    lefts_px = np.cumsum(np.concatenate([np.full(20, 2.0), np.linspace(2, 60, 15), np.linspace(60, 2, 15)]))
    pictures = read(write(tmp_path / "a.mp4", pan(lefts_px)))
    assert not any("cut, at" in it for it in pictures.notes)


def test_bound_of_frames_is_shared_and_spread(tmp_path: Path) -> None:
    long = write(tmp_path / "in" / "long.mp4", pan(np.arange(160) * 8.0))
    write(tmp_path / "in" / "short.mp4", pan(np.arange(80) * 8.0, seed=3))
    pictures = read(tmp_path / "in", frames=20)
    of_long = [it.time.frame for it in pictures.chosen if it.time and it.source == long]
    assert 16 <= len(pictures.chosen) <= 20
    assert 10 <= len(of_long) <= 15
    assert of_long[0] < 10
    assert of_long[-1] > 145
    assert max(np.diff(of_long)) < 25
    assert any("frames is a bound" in it for it in pictures.notes)


def test_long_video_is_read_by_its_key_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapless_tools.reconstruct.sources.watching._MAX_PIXELS", 1e6)
    frames = pan(np.arange(120) * 8.0)
    pictures = read(write(tmp_path / "a.mp4", frames, gop=5, settings={"sc_threshold": "0"}), frames=8)
    assert {it % 5 for it in indices(pictures)} == {0}
    assert len(pictures.chosen) >= 6
    assert any("key frames" in it for it in pictures.notes)
    for it in pictures.chosen:
        assert it.time is not None
        assert difference(pixels(it), frames[it.time.frame]) < 12


def test_second_run_continues_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write(tmp_path / "a.mp4", pan(np.arange(60) * 6.0))
    first = read(file)
    first.chosen[2].path.unlink()
    kept = first.chosen[3].path.stat().st_mtime_ns
    monkeypatch.setattr("mapless_tools.reconstruct.sources.videos.watch", lambda *_: pytest.fail("looked again"))
    again = read(file)
    assert [it.name for it in again.chosen] == [it.name for it in first.chosen]
    assert again.chosen[2].path.exists()
    assert again.chosen[3].path.stat().st_mtime_ns == kept


def test_frames_that_are_sought_and_counted_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write(tmp_path / "a.mp4", pan(np.arange(90) * 6.0), gop=7)
    sought = [pixels(it) for it in read(file).chosen]
    monkeypatch.setattr("mapless_tools.reconstruct.sources.frames._sought", lambda *_: iter(()))
    (tmp_path / "other").mkdir()
    file = file.rename(tmp_path / "other" / "a.mp4")
    for first, second in zip(sought, map(pixels, read(file).chosen), strict=True):
        assert np.array_equal(first, second)


def test_full_disk_leaves_no_half_made_frame(tmp_path: Path) -> None:
    file = write(tmp_path / "a.mp4", pan(np.arange(30) * 6.0))
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from mapless_tools.reconstruct.sources import SourceOptions, read_sources\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
        "read_sources([Path(sys.argv[1])], Path(sys.argv[2]), SourceOptions(), lambda *_: None)"
    )
    command = [sys.executable, "-c", program, str(file), str(tmp_path / "work")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert "File too large" in ended.stderr
    assert not [*(tmp_path / "work").rglob("*.jpg*")]


@pytest.mark.parametrize("ending", ["mp4", "mkv", "mov", "webm", "avi", "ts"])
def test_containers_are_read(tmp_path: Path, ending: str) -> None:
    codec = {"webm": "libvpx", "avi": "mpeg4"}.get(ending, "libx264")
    frames = pan(np.arange(30) * 6.0)
    pictures = read(write(tmp_path / f"a.{ending}", frames, codec=codec))
    assert len(pictures.chosen) >= 4
    for it in pictures.chosen:
        assert it.time is not None
        assert difference(pixels(it), frames[it.time.frame]) < 14


def test_pixels_become_square_and_of_8_bits(tmp_path: Path) -> None:
    picture = pan([0])[0]
    file = write(tmp_path / "a.mkv", [picture] * 3, aspect=Fraction(4, 3), pix_fmt="yuv420p10le")
    pictures = read(file)
    assert (pictures.chosen[0].width_px, pictures.chosen[0].height_px) == (427, 240)
    wide = np.asarray(cv2.resize(picture, (427, 240)), np.uint8)
    assert difference(pixels(pictures.chosen[0]), wide) < 12
    assert any("not square" in it for it in pictures.notes)


def test_rows_of_two_times_are_not_mixed(tmp_path: Path) -> None:
    first, second = (np.repeat(it.mean(2, keepdims=True).astype(np.uint8), 3, axis=2) for it in pan([0, 12]))
    woven = first.copy()
    woven[1::2] = second[1::2]
    settings = {"x264-params": "interlaced=1:qp=10"}
    pictures = read(write(tmp_path / "a.mp4", [woven] * 3, settings=settings))
    assert any("interlaced" in it for it in pictures.notes)
    seen = pixels(pictures.chosen[0])
    assert difference(seen, first) < 0.3 * difference(seen, second)


def test_video_that_is_cut_off_gives_what_decodes(tmp_path: Path) -> None:
    file = write(tmp_path / "a.mkv", pan(np.arange(120) * 6.0))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    pictures = read(file)
    assert len(pictures.chosen) > 5
    assert max(indices(pictures)) < 80
    assert any("cut off or damaged" in it for it in pictures.notes)


def test_damage_in_the_middle_is_skipped_and_noted(tmp_path: Path) -> None:
    file = write(tmp_path / "a.mkv", pan(np.arange(120) * 6.0), gop=10)
    data = bytearray(file.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
    file.write_bytes(data)
    pictures = read(file)
    assert max(indices(pictures)) > 70
    assert any("damaged" in it for it in pictures.notes)


def test_files_without_a_picture_are_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.mp4").write_text("no video\n" * 100)
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n/etc/hostname\n#EXT-X-ENDLIST\n")
    whole = write(tmp_path / "whole.mp4", pan([0, 9, 18]))
    (tmp_path / "cut.mp4").write_bytes(whole.read_bytes()[:2000])
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", 48_000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 48_000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    said = {"empty": "it is empty", "text": "", "list": "", "cut": "its index is missing", "sound": "has no video"}
    for name, reason in said.items():
        with pytest.raises(ValueError, match=rf"{name}\.mp4: .*{reason}"):
            read(tmp_path / f"{name}.mp4")


def test_equal_stems_get_names_and_moving_photographs_none(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    write(folder / "a.mp4", pan([0, 2]))
    write(folder / "b c" / "a.mkv", pan([0, 2], seed=5))
    (folder / "copy.mp4").write_bytes((folder / "a.mp4").read_bytes())
    write(folder / "IMG_1.MOV", pan([0, 2], seed=6))
    cv2.imwrite(str(folder / "IMG_1.JPG"), pan([0], seed=6)[0])
    pictures = read(folder)
    assert [it.name for it in pictures.chosen] == ["IMG_1", "a_000000", "a_000000_2"]
    named = {it.name: it.reason for it in pictures.omitted}
    assert "beside it" in named["IMG_1.MOV"]
    assert "same bytes as a.mp4" in named["copy.mp4"]


def test_chosen_frames_are_the_sharpest_near_each_view() -> None:
    content = np.linspace(0, 10, 101)
    sharpness = np.ones(101)
    sharpness[[2, 13, 34]] = 5.0
    usable = np.ones(101, bool)
    usable[50] = False
    chosen = choose_frames(content, sharpness, usable, 1.0)
    assert chosen[:4] == [2, 13, 20, 34]
    assert 50 not in chosen
    assert len(chosen) == 11


def test_spacing_is_the_smallest_that_keeps_the_bound() -> None:
    assert common_spacing([3.0, 4.0], 20) == 1.0
    spacing = common_spacing([30.0, 60.0], 20)
    assert sum(int(it / spacing) + 1 for it in (30.0, 60.0)) == 20
    assert sum(int(it / (spacing * 0.99)) + 1 for it in (30.0, 60.0)) > 20
    with pytest.raises(ValueError, match="there are 3 videos"):
        common_spacing([1.0, 1.0, 1.0], 2)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("kitchen-walk/video.mp4", (640, 480)),
        ("lidar-desk-pan/video.mov", (720, 960)),
        ("teddy-orbit/video.mp4", (640, 480)),
    ],
)
def test_hand_held_video_gives_neighbours_that_overlap(tmp_path: Path, name: str, size: tuple[int, int]) -> None:
    file = DATA / name
    if not file.exists():
        pytest.skip(f"{file} is missing")
    pictures = read_sources([file], tmp_path, SourceOptions(), lambda *_: None)
    assert {(it.width_px, it.height_px) for it in pictures.chosen} == {size}
    assert 20 <= len(pictures.chosen) <= 60
