"""Photographs of a reconstruction's sources: which are used, in which order, and what is said of the others."""

import io
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps
from support.images import encode

from mapless_server.images import ANY_SIZE, ImageLimits, decode_image
from mapless_tools.reconstruct.pictures import Pictures
from mapless_tools.reconstruct.sources import SourceOptions, read_sources

SIZE = 640, 480


def scenery(seed: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """A picture (H, W, 3) with sharp edges of all directions: random polygons."""
    rng = np.random.default_rng(seed)
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    for _ in range(150):
        corners = rng.integers(0, size, 2) + rng.integers(-60, 60, (5, 2))
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.integers(0, 256, 3).tolist())
    return image


def exif(orientation: int = 1, time: str = "") -> bytes:
    tags = Image.Exif()
    tags[ExifTags.Base.Orientation] = orientation
    tags[ExifTags.Base.Make] = "Maker"
    tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    if time:
        tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = time
    return tags.tobytes()


def save(file: Path, image: NDArray[np.uint8], **parameters: Any) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(file, **parameters)
    return file


def read(*sources: Path, options: SourceOptions | None = None) -> Pictures:
    folder = sources[0].parent / f"{sources[0].name}-work"
    return read_sources(sources, folder, options or SourceOptions(), lambda *_: None)


def reasons(pictures: Pictures) -> dict[str, str]:
    return {it.name: it.reason for it in pictures.omitted}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("ending", ["jpg", "png", "webp"])
def test_stored_grid_is_kept_for_each_orientation(tmp_path: Path, ending: str, orientation: int) -> None:
    file = save(tmp_path / "in" / f"a.{ending}", scenery(1), exif=exif(orientation))
    (picture,) = read(tmp_path / "in").chosen
    assert picture.path == picture.source == file
    assert (picture.width_px, picture.height_px, picture.orientation) == (*SIZE, orientation)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_heic_is_turned_once_and_keeps_its_exif(tmp_path: Path, orientation: int) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    upright = scenery(2)
    stored = ImageOps.exif_transpose(_tagged(upright, _INVERSE[orientation]))
    (tmp_path / "in").mkdir()
    stored.save(tmp_path / "in" / "a.heic", exif=exif(orientation), quality=95)
    pictures = read(tmp_path / "in")
    (picture,) = pictures.chosen
    assert (picture.name, picture.orientation) == ("a", 1)
    assert (picture.exif.make, picture.exif.film_focal_mm) == ("Maker", 26)
    written = decode_image(picture.path.read_bytes(), ANY_SIZE)
    assert np.abs(written.astype(int) - upright).mean() < 6
    assert any("HEIC" in it for it in pictures.notes)


_INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}


def _tagged(image: NDArray[np.uint8], orientation: int) -> Image.Image:
    """An image in memory that asks to be turned."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG", exif=exif(orientation))
    return Image.open(stream)


def test_two_pictures_in_one_jpeg_are_kept_as_they_are(tmp_path: Path) -> None:
    first, second = (Image.fromarray(scenery(it)) for it in (1, 2))
    (tmp_path / "in").mkdir()
    first.save(tmp_path / "in" / "a.jpg", "MPO", save_all=True, append_images=[second], quality=95)
    (picture,) = read(tmp_path / "in").chosen
    assert picture.path == tmp_path / "in" / "a.jpg"
    assert (picture.width_px, picture.height_px) == SIZE


def test_order_is_by_time_then_by_number(tmp_path: Path) -> None:
    times = {"a": "2024:05:01 10:00:03", "image10": "", "image9": "2024:05:01 10:00:01", "z": "2024:05:01 10:00:02"}
    for seed, (name, time) in enumerate(times.items()):
        save(tmp_path / "in" / f"{name}.jpg", scenery(seed), exif=exif(time=time))
    assert [it.name for it in read(tmp_path / "in").chosen] == ["image9", "image10", "z", "a"]


def test_copies_are_omitted_and_neighbours_are_not(tmp_path: Path) -> None:
    image = scenery(3, (1280, 960))
    original = save(tmp_path / "in" / "original.png", image, exif=exif())
    (tmp_path / "in" / "original_copy.png").write_bytes(original.read_bytes())
    save(tmp_path / "in" / "strong.jpg", image, quality=30)
    small = cv2.resize(image, (500, 375), interpolation=cv2.INTER_AREA)
    save(tmp_path / "in" / "small.jpg", np.asarray(small, np.uint8), quality=80)
    save(tmp_path / "in" / "turned.jpg", np.rot90(image).copy(), quality=20, exif=exif(6))
    bright = np.asarray(np.clip(image * 1.2 + 5, 0, 255), np.uint8)
    save(tmp_path / "in" / "bright.webp", bright)
    save(tmp_path / "in" / "next.png", np.roll(image, 3, axis=1))
    pictures = read(tmp_path / "in")
    assert {it.name for it in pictures.chosen} == {"original", "next"}
    assert set(reasons(pictures)) == {"original_copy.png", "strong.jpg", "small.jpg", "turned.jpg", "bright.webp"}
    assert all("original.png" in it for it in reasons(pictures).values())


@pytest.mark.parametrize("direction", [(0, 1), (1, 0), (1, 1)])
def test_moved_camera_is_blurred_and_white_wall_is_not(tmp_path: Path, direction: tuple[int, int]) -> None:
    for seed in range(5):
        save(tmp_path / "in" / f"sharp{seed}.png", scenery(seed))
    kernel = np.zeros((13, 13), np.float32)
    for i in range(-6, 7):
        kernel[6 + i * direction[0], 6 + i * direction[1]] = 1 / 13
    save(tmp_path / "in" / "moved.png", np.asarray(cv2.filter2D(scenery(7), -1, kernel), np.uint8))
    wall = np.full((SIZE[1], SIZE[0], 3), 235, np.uint8)
    save(tmp_path / "in" / "wall.png", wall)
    with_poster = wall.copy()
    with_poster[150:330, 220:420] = scenery(8, (200, 180))
    save(tmp_path / "in" / "poster.png", with_poster)
    pictures = read(tmp_path / "in")
    assert list(reasons(pictures)) == ["moved.png"]
    assert "blurred by" in reasons(pictures)["moved.png"]


def test_blur_is_usual_where_all_are_blurred(tmp_path: Path) -> None:
    for seed in range(4):
        save(tmp_path / "in" / f"{seed}.png", np.asarray(cv2.GaussianBlur(scenery(seed), (0, 0), 5), np.uint8))
    pictures = read(tmp_path / "in")
    assert len(pictures.chosen) == 4
    assert any("blurred" in it for it in pictures.notes)


def test_unusable_files_are_named_with_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    save(folder / "good.jpg", scenery(1))
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "text.png").write_text("no picture")
    (folder / "cut.jpg").write_bytes((folder / "good.jpg").read_bytes()[:5000])
    (folder / "cut.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    save(folder / "a.tif", scenery(2))
    (folder / "raw.DNG").write_bytes(b"II*\0")
    save(folder / "tiny.png", scenery(3, (20, 20)))
    (folder / "notes.txt").write_text("no image")
    (folder / ".hidden.jpg").write_bytes(b"")
    (folder / "gone.jpg").symlink_to("nowhere")
    os.mkfifo(folder / "pipe.jpg")
    pictures = read(folder)
    assert [it.name for it in pictures.chosen] == ["good"]
    unusable = {"empty.jpg", "text.png", "cut.jpg", "cut.heic", "a.tif", "raw.DNG", "tiny.png", "gone.jpg"}
    assert set(reasons(pictures)) == unusable


def test_too_large_photograph_is_named_with_the_bound(tmp_path: Path) -> None:
    save(tmp_path / "in" / "a.png", scenery(1))
    save(tmp_path / "in" / "b.png", scenery(2, (800, 600)))
    limits = ImageLimits(max_pixels=400_000)
    pictures = read(tmp_path / "in", options=SourceOptions(limits=limits))
    assert [it.name for it in pictures.chosen] == ["a"]
    assert "400000" in reasons(pictures)["b.png"]


def test_names_are_legal_and_unique_for_any_stem(tmp_path: Path) -> None:
    for seed, name in enumerate(["a b/é 1.jpg", "c/é 1.jpg", "c/line\nbreak.jpg", "c/-x.jpg"]):
        save(tmp_path / "in" / name, scenery(seed))
    pictures = read(tmp_path / "in")
    assert [it.name for it in pictures.chosen] == ["__1", "_x", "line_break", "__1_2"]


def test_a_file_is_read_once_through_links_and_sources(tmp_path: Path) -> None:
    save(tmp_path / "in" / "a.jpg", scenery(1))
    save(tmp_path / "other" / "b.jpg", scenery(2))
    (tmp_path / "in" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "linked").symlink_to(tmp_path / "other")
    (tmp_path / "in" / "again.jpg").symlink_to(tmp_path / "in" / "a.jpg")
    pictures = read(tmp_path / "in", tmp_path / "in" / "a.jpg", tmp_path / "other")
    assert [it.name for it in pictures.chosen] == ["a", "b"]
    assert not pictures.omitted


def test_folders_of_outputs_are_not_read(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scenery(1))
    save(tmp_path / "out" / "images" / "b.jpg", scenery(2))
    save(tmp_path / "out" / "work" / "c.jpg", scenery(3))
    options = SourceOptions(excluded=(tmp_path / "out",))
    pictures = read_sources([tmp_path], tmp_path / "out" / "work", options, lambda *_: None)
    assert [it.name for it in pictures.chosen] == ["a"]


def test_second_run_decodes_nothing_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(3):
        save(tmp_path / "in" / f"{seed}.jpg", scenery(seed))
    first = read(tmp_path / "in")
    with (tmp_path / "in-work" / "sources.jsonl").open("a") as log:
        log.write('["cut off')
    monkeypatch.setattr("mapless_tools.reconstruct.sources.looking.decode_image", lambda *_: pytest.fail("decoded"))
    again = read(tmp_path / "in")
    assert [it.name for it in again.chosen] == [it.name for it in first.chosen]
    save(tmp_path / "in" / "1.jpg", scenery(9))
    with pytest.raises(pytest.fail.Exception, match="decoded"):
        read(tmp_path / "in")


def test_sources_without_anything_usable_are_an_error(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    with pytest.raises(ValueError, match=r"there is no photograph .* and no video"):
        read(folder)
    with pytest.raises(ValueError, match="missing cannot be read: No such file"):
        read(folder / "missing")
    with pytest.raises(ValueError, match="there is no source"):
        read_sources([], folder, SourceOptions(), lambda *_: None)
    (folder / "a.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match=r"a\.jpg: the image is empty"):
        read(folder)
    (tmp_path / "file").write_bytes(encode(".png", scenery(1)))
    with pytest.raises(ValueError, match="cannot be written"):
        read_sources([tmp_path / "file"], tmp_path / "file" / "work", SourceOptions(), lambda *_: None)


def test_frames_are_bounded() -> None:
    with pytest.raises(ValueError, match="frames must be 2 to 10000, is 1"):
        SourceOptions(frames=1)
