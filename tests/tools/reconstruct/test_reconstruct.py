"""Photographs without poses get the poses that are known of them, or a sentence that says why not."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import encode, textured
from typer.testing import CliRunner

from mapless.cli.output import plain
from mapless.geometry import Array, Camera
from mapless_server.images import ANY_SIZE, decode_image
from mapless_server.method.features.extractors import SiftExtractor, SiftOptions
from mapless_server.method.features.views import Ignored, View
from mapless_server.scenes.retrieval.vlad import VladDescriptor, shipped
from mapless_server.settings import Settings
from mapless_tools.cli.app import app
from mapless_tools.demo.photographs import Photograph, room
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.metres import umeyama
from mapless_tools.progress import Progress
from mapless_tools.reconstruct import mapping
from mapless_tools.reconstruct.cameras import LensOptions, starting_cameras
from mapless_tools.reconstruct.features import FeatureFolder
from mapless_tools.reconstruct.folder import locked
from mapless_tools.reconstruct.matching import PairOptions, pairs_of
from mapless_tools.reconstruct.output import summary, write_folder
from mapless_tools.reconstruct.pictures import Picture, Pictures, VideoTime
from mapless_tools.reconstruct.run import (
    Reconstructed,
    ReconstructOptions,
    prepare,
    reconstruct,
)
from mapless_tools.reconstruct.sources import SourceOptions, read_sources

OPTIONS = ReconstructOptions(features="sift")


def silent(step: str, done: int, total: int) -> None:
    pass


def photographs(folder: Path, chosen: Sequence[Photograph]) -> Path:
    folder.mkdir()
    for it in chosen:
        (folder / f"{it.name}.png").write_bytes(it.data)
    return folder


def reconstructed(
    source: Path, out: Path, options: ReconstructOptions = OPTIONS, progress: Progress = silent
) -> Reconstructed:
    work = prepare([source], out)
    return reconstruct(read_sources([source], work / "pictures", SourceOptions(), silent), work, options, progress)


def errors(result: Reconstructed, truth: Sequence[Photograph]) -> Array:
    """Errors (N,) of positions after alignment, metres."""
    true = {it.name: it.world_from_camera.translation for it in truth}
    found = np.stack([it.world_from_camera.translation for it in result.part.posed])
    wanted = np.stack([true[it.picture.name] for it in result.part.posed])
    return np.asarray(np.linalg.norm(umeyama(found, wanted).apply(found) - wanted, axis=1))


def half(it: Photograph, negative: bool = False) -> Photograph:
    """The photograph at half its size; its negative shows another room, whose light and dark are exchanged."""
    image = decode_image(it.data, ANY_SIZE)
    reduced = np.asarray(cv2.resize(image, (480, 360), interpolation=cv2.INTER_AREA), np.uint8)
    name = f"negative-{it.name}" if negative else it.name
    data = encode(".png", 255 - reduced if negative else reduced)
    return Photograph(name, data, it.camera.resized(480, 360), it.world_from_camera)


@pytest.fixture(scope="module")
def chosen() -> Sequence[Photograph]:
    return [half(it) for it in room().references[:7]]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, chosen: Sequence[Photograph]) -> Path:
    return photographs(tmp_path_factory.mktemp("room") / "photos", chosen)


@pytest.fixture(scope="module")
def out(source: Path) -> Path:
    return source.parent / "out"


@pytest.fixture(scope="module")
def result(source: Path, out: Path) -> Reconstructed:
    return reconstructed(source, out)


def test_poses_are_those_of_the_rendered_room(result: Reconstructed, chosen: Sequence[Photograph]) -> None:
    assert len(result.part.posed) == len(chosen)
    assert not result.omitted
    assert np.median(errors(result, chosen)) < 0.02
    assert [it.camera.focal_x_px for it in result.part.posed] == pytest.approx([408] * len(chosen), rel=0.03)


def test_folder_is_read_as_posed_photographs(result: Reconstructed, out: Path, chosen: Sequence[Photograph]) -> None:
    write_folder(result, out / ".work", out, silent)
    frames = {it.name: it for it in read_folder(out).frames}
    for given in chosen:
        assert frames[given.name].image_path.read_bytes() == given.data
    assert (out / "report.html").read_text().count("reference-0") >= len(chosen)
    assert (out / "scene.glb").read_bytes()[:4] == b"glTF"


def test_interrupted_run_continues_to_the_same_poses(source: Path, tmp_path: Path, result: Reconstructed) -> None:
    def interrupt(step: str, done: int, total: int) -> None:
        if step == "matches" and done:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        reconstructed(source, out, progress=interrupt)
    assert [it.name for it in out.iterdir()] == [".work"]
    made = {it: it.stat().st_mtime_ns for it in (out / ".work").rglob("*.npz")}
    again = reconstructed(source, out)
    assert {it: it.stat().st_mtime_ns for it in made} == made
    for one, other in zip(again.part.posed, result.part.posed, strict=True):
        np.testing.assert_array_equal(one.world_from_camera.matrix(), other.world_from_camera.matrix())


class UprightOnly(SiftExtractor):
    """Features that find nothing in photographs that are higher than wide, as if they were rolled."""

    name = "upright-only"

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        return super().extract(image[:1, :1] if len(image) > len(image[0]) else image, camera, ignored)


def test_rolled_photographs_join_by_other_features(
    tmp_path: Path, chosen: Sequence[Photograph], result: Reconstructed, monkeypatch: pytest.MonkeyPatch
) -> None:
    rolled = chosen[3]
    image = np.rot90(decode_image(rolled.data, ANY_SIZE))
    turned = replace(rolled, data=encode(".png", np.ascontiguousarray(image)))
    source = photographs(tmp_path / "photos", [*chosen[:3], turned, *chosen[4:]])

    def features(settings: Settings) -> tuple[str, SiftExtractor]:
        return ("edgepoint2-l64", UprightOnly()) if settings.features == "auto" else ("sift", SiftExtractor())

    monkeypatch.setattr("mapless_tools.reconstruct.run.make_first_features", features)
    joined = reconstructed(source, tmp_path / "out", ReconstructOptions())
    assert len(joined.part.posed) == len(chosen)
    assert np.median(errors(joined, chosen)) < 0.02
    assert len(list((tmp_path / "out" / ".work").glob("database-*"))) == 2


def test_two_places_become_two_parts(tmp_path: Path, chosen: Sequence[Photograph]) -> None:
    others = [half(it, negative=True) for it in room().references[:4]]
    source = photographs(tmp_path / "photos", [*chosen[:5], *others])
    first = reconstructed(source, tmp_path / "out")
    assert first.parts == (5, 4)
    assert {it.reason for it in first.omitted} == {"it is in part 2"}
    second = reconstructed(source, tmp_path / "out", replace(OPTIONS, part=2))
    assert {it.picture.name for it in second.part.posed} == {it.name for it in others}
    with pytest.raises(ValueError, match="there is no part 3"):
        reconstructed(source, tmp_path / "out", replace(OPTIONS, part=3))


def test_neighbours_and_similar_ones_suffice(source: Path, out: Path, result: Reconstructed) -> None:
    pairs = PairOptions(all_below=0, steps=(1,), similar=2)
    fewer = reconstructed(source, out, replace(OPTIONS, pairs=pairs))
    assert fewer.parts == result.parts
    for one, other in zip(fewer.part.posed, result.part.posed, strict=True):
        assert one.picture.name == other.picture.name


def test_pairs_of_many_are_distinct_and_include_neighbours(source: Path, tmp_path: Path) -> None:
    pictures = read_sources([source], tmp_path, SourceOptions(), silent).chosen
    features = FeatureFolder(tmp_path / "features", SiftExtractor(SiftOptions(max_keypoints=50)), pictures)
    features.extract(silent)
    names = [it.name for it in pictures]
    options = PairOptions(all_below=3, steps=(2,), similar=1)
    pairs = pairs_of(names, features, VladDescriptor("sift", shipped("sift")), options, silent)
    assert len(set(pairs)) == len(pairs) < len(names) * (len(names) - 1) / 2
    assert all(names.index(first) < names.index(second) for first, second in pairs)
    assert set(zip(names, names[2:], strict=False)) <= set(pairs)


def test_turning_camera_gets_no_poses(tmp_path: Path) -> None:
    chosen = room().references[0]
    image = decode_image(chosen.data, ANY_SIZE)
    matrix = chosen.camera.matrix()
    turned = []
    for degrees in range(-8, 9, 4):
        turn = cv2.Rodrigues(np.radians([degrees / 3, degrees, 0.0]))[0]
        part = cv2.warpPerspective(image, matrix @ turn @ np.linalg.inv(matrix), (960, 720))
        data = encode(".png", np.asarray(part[150:570, 200:760], np.uint8))
        turned.append(Photograph(f"turned{degrees}", data, chosen.camera, chosen.world_from_camera))
    with pytest.raises(ValueError, match="only to have turned"):
        reconstructed(photographs(tmp_path / "photos", turned), tmp_path / "out")


def test_photographs_of_nothing_common_are_refused(tmp_path: Path, chosen: Sequence[Photograph]) -> None:
    apart = [
        Photograph(f"{i}", encode(".jpg", textured(320, 240, seed=i)), it.camera, it.world_from_camera)
        for i, it in enumerate(chosen[:3])
    ]
    with pytest.raises(ValueError, match="no two photographs show the same place"):
        reconstructed(photographs(tmp_path / "photos", apart), tmp_path / "out")


def test_videos_of_one_name_have_a_camera_each() -> None:
    frames = [
        Picture(
            f"{device}_{i}", Path("x.jpg"), 640, 480, Path(device, "VID.mp4"), time=VideoTime("VID.mp4", i, 0.1 * i)
        )
        for device in ("phone", "glasses")
        for i in range(2)
    ]
    assert [it.names for it in starting_cameras(frames, LensOptions())] == [
        ("phone_0", "phone_1"),
        ("glasses_0", "glasses_1"),
    ]
    with pytest.raises(ValueError, match=r"no photograph has 1280x720 pixels.*they have 640x480"):
        starting_cameras(frames, LensOptions(known=(Camera.centred(1280, 720, 900.0),)))


def test_folder_of_others_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="not empty"):
        prepare([tmp_path], tmp_path)
    assert [it.name for it in tmp_path.iterdir()] == ["letter.txt"]


def test_second_run_on_one_folder_is_refused(tmp_path: Path) -> None:
    with (
        locked(tmp_path, tmp_path),
        pytest.raises(ValueError, match=rf"another run \(process {os.getpid()}\)"),
        locked(tmp_path, tmp_path),
    ):
        pass
    with locked(tmp_path, tmp_path):
        pass


def test_poses_beside_photographs_are_named(
    result: Reconstructed, tmp_path: Path, chosen: Sequence[Photograph]
) -> None:
    out = tmp_path / "posed"
    work = prepare([tmp_path], out)
    write_folder(result, work, out, silent)
    again = read_sources([out / "images"], tmp_path / "pictures", SourceOptions(), silent)
    assert f"has poses of {len(chosen)} of the photographs already" in again.notes[0]
    (out / "cameras.json").write_text("[]")
    foreign = read_sources([out], tmp_path / "pictures", SourceOptions(), silent)
    assert "cameras.json is not used: " in foreign.notes[0]
    with pytest.raises(ValueError, match="there is no photograph"):
        read_sources([tmp_path], tmp_path / "pictures", SourceOptions(), silent)


def test_frames_and_photographs_are_counted_apart(result: Reconstructed) -> None:
    assert summary(result) == "7 of 7 photographs have poses"
    chosen = tuple(replace(it, time=VideoTime("a.mp4", i, 0.1 * i)) for i, it in enumerate(result.pictures.chosen))
    posed = tuple(replace(it, picture=frame) for it, frame in zip(result.part.posed[:5], chosen, strict=False))
    video = Pictures(chosen, frames=600)
    of_video = replace(result, pictures=video, part=replace(result.part, posed=posed))
    assert summary(of_video) == "7 of 600 frames were used; 5 of them have poses"


@pytest.mark.parametrize(
    ("flag", "content", "message"),
    [
        ("--positions", None, "cannot be read"),
        ("--positions", "a,1,2\n", "line 1"),
        ("--positions", "a,1,2,3\nb,1,2,3\nc,1,2,4\n", "0 of its names"),
        ("--gravity", "a,0,0,0\n", "the direction of a is zero"),
        ("--lens", "{}", "lens.json"),
        ("--distance", None, "there is no photograph 'a'"),
    ],
)
def test_wrong_files_are_named_before_computing(
    flag: str, content: str | None, message: str, source: Path, tmp_path: Path
) -> None:
    file = tmp_path / ("lens.json" if flag == "--lens" else "known.csv")
    if content:
        file.write_text(content)
    values = ["a", "b", "1"] if flag == "--distance" else [str(file)]
    done = CliRunner().invoke(app, ["reconstruct", str(source), str(tmp_path / "out"), flag, *values])
    assert done.exit_code == 2
    assert message in plain(done.output)
    assert not (tmp_path / "out" / ".work" / "features").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("no id",), "an id is"),
        (("hall", "--report", "no/folder/report.json"), "cannot be written"),
        (("hall", "--format", "colmap"), "a video has none"),
        (("hall", "--align", "none.csv"), "none.csv"),
        (("hall", "--address", "127.0.0.1:1"), "127.0.0.1:1"),
    ],
)
def test_import_of_a_video_checks_flags_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: Sequence[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.mp4").write_bytes(b"")
    done = CliRunner().invoke(app, ["import", str(tmp_path / "walk.mp4"), *arguments])
    assert done.exit_code in (1, 2)
    assert message in plain(done.output)
    assert not (tmp_path / "walk-posed").exists()


def test_import_of_a_video_of_two_frames_says_what_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    av = pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "walk.mp4"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=2)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for seed in (1, 2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(textured(320, 240, seed=seed), "rgb24")))
        container.mux(stream.encode())
    result = CliRunner().invoke(app, ["import", str(file), "hall", "--dry-run"])
    assert result.exit_code == 2
    assert "too few" in plain(result.output)
    result = CliRunner().invoke(app, ["import", str(tmp_path), "hall", "--tag", "36h11:0=0.1"])
    assert "the unit of a video" in plain(result.output)


def test_global_mapper_finds_poses_where_the_other_does_not_begin(
    source: Path, tmp_path: Path, chosen: Sequence[Photograph], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mapping, "map_incrementally", lambda *_: None)
    result = reconstructed(source, tmp_path / "out")
    assert len(result.part.posed) == len(chosen)
    assert np.median(errors(result, chosen)) < 0.02
