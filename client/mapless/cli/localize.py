"""`mapless localize`: one photograph, or a folder of them."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import sys
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from ..answers import LocalizationResult, Rejected
from ..cameras import FOLDER_FILE, read_camera, read_cameras
from ..client import Client
from ..errors import InvalidArgument, MaplessError, NotFound
from ..geometry import Camera
from ..priors import GravityPrior, HeadingPrior, PositionPrior, Priors
from ..report import write_report
from ..requests import ImageSource
from ..results import Reference
from . import output
from .exits import EXIT_REJECTED
from .pace import Pace, PacedClient
from .progress import Progress
from .tally import LOCALIZED, Outcome, Tally

ENDINGS = frozenset({".jpg", ".jpeg", ".png", ".webp"})
_FIELDS_OF_PHOTOS = ("image", "intrinsics")
_DRAWN_REFERENCES, _SHOWN_REFERENCES = 16, 4


@dataclass(frozen=True)
class Photo:
    """A photograph to localize, and what to call it."""

    path: Path
    name: str
    camera: Camera


def run(client: Client, arguments: argparse.Namespace) -> int:
    """The command."""
    if arguments.rerank and not arguments.reference:
        raise ValueError("--rerank chooses among references that --reference names")
    if arguments.parallel < 1:
        raise ValueError(f"--parallel is the number of calls at a time, at least 1, not {arguments.parallel}")
    if arguments.draw is not None:
        arguments.draw.mkdir(parents=True, exist_ok=True)
    if not arguments.photo.is_dir():
        return _one(client, arguments)
    if arguments.progressive:
        raise ValueError("--progressive shows how one photograph is localized, not a folder of them")
    return _folder(client, arguments)


def _one(client: Client, arguments: argparse.Namespace) -> int:
    photo = Photo(arguments.photo, arguments.photo.name, _camera_of(arguments.photo, arguments.camera))
    answers = _answers(client, photo, photo.path, arguments)
    first = next(answers)  # before there is a file that nothing is written to
    indent = None if arguments.progressive else 2  # of several answers each is a line
    with _opened(arguments.output) as file:
        for answer in itertools.chain([first], answers):
            if arguments.json or arguments.output or not sys.stdout.isatty():
                print(json.dumps(output.plain(_told(answer, arguments)), indent=indent), file=file, flush=True)
            else:
                print("\n".join(output.lines(answer)), file=file, flush=True)
    _tell_where(arguments)
    return EXIT_REJECTED if isinstance(answer, Rejected) else 0


def _folder(client: Client, arguments: argparse.Namespace) -> int:
    """One line for each photograph, in their order, as they come; one that fails by itself does not end the others."""
    photos = photos_of(arguments.photo, arguments.camera)
    names = [photo.name for photo in photos]
    width = max(map(len, names))
    as_json = bool(arguments.json or arguments.output or not sys.stdout.isatty())
    tally = Tally(len(photos))
    try:
        with (
            _opened(arguments.output) as file,
            Progress(len(photos)) as progress,
            contextlib.closing(_all(client, photos, arguments)) as outcomes,
        ):
            if not as_json:
                print(output.heading(width), file=file)
            for name, outcome in zip(names, outcomes, strict=True):
                progress.clear()
                print(_row(name, width, outcome, as_json, arguments), file=file, flush=True)
                kind = tally.count(outcome)
                progress.step("" if kind == LOCALIZED else kind)
    finally:
        if tally.done:  # also of a run that ends early: by Ctrl-C, or because the server is gone
            print(tally.text(), file=sys.stderr)
            _tell_where(arguments)
    return tally.exit_code


def _tell_where(arguments: argparse.Namespace) -> None:
    """Which files there are now."""
    if arguments.output is not None:
        print(f"answers are in {arguments.output}", file=sys.stderr)
    if arguments.draw is not None:
        print(f"pages to look at are in {arguments.draw}", file=sys.stderr)


def photos_of(folder: Path, camera: str | None) -> list[Photo]:
    """The photographs of a folder: those of its cameras.json, or all with one camera.

    Raises:
        ValueError: there are none, or no camera.
    """
    if camera is None:
        if not (folder / FOLDER_FILE).is_file():
            raise ValueError(f"{folder} has no {FOLDER_FILE}: say --camera, which then took all its photographs")
        cameras = read_cameras(folder / FOLDER_FILE)
        if not cameras:
            raise ValueError(f"{folder / FOLDER_FILE} lists no photographs")
        return [Photo(path, path.relative_to(folder).as_posix(), its) for path, its in cameras.items()]
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    if not paths:
        raise ValueError(f"{folder} holds no photographs ({', '.join(sorted(ENDINGS))})")
    return [Photo(path, path.name, _camera_of(path, camera)) for path in paths]


def _camera_of(path: Path, camera: str | None) -> Camera:
    if camera is None:
        return _camera_beside(path)
    if Path(camera).name != FOLDER_FILE:
        return read_camera(camera, path)
    cameras = {known.resolve(): its for known, its in read_cameras(camera).items()}
    if path.resolve() not in cameras:
        raise ValueError(f"{camera} knows no {path}")
    return cameras[path.resolve()]


def _camera_beside(path: Path) -> Camera:
    """The camera of a photograph by the cameras.json of its folder, or of the one around it."""
    for folder in path.resolve().parents[:2]:
        if (folder / FOLDER_FILE).is_file():
            return _camera_of(path, str(folder / FOLDER_FILE))
    raise ValueError(f"say --camera: which camera took the photograph; there is no {FOLDER_FILE} beside it")


def _all(client: Client, photos: list[Photo], arguments: argparse.Namespace) -> Generator[Outcome, None, None]:
    """An outcome for each photograph, in their order; `parallel` calls at a time, or as many as there is room for."""
    pace = Pace(arguments.parallel)

    def outcome(photo: Photo) -> Outcome:
        try:
            with pace.turn():
                return _ask(paced, photo, arguments)
        except MaplessError as error:
            if _is_everybodys(error):
                raise
            return error

    with (
        PacedClient(arguments.address, client.options, pace) as paced,
        ThreadPoolExecutor(arguments.parallel, "localize") as threads,
    ):
        try:
            yield from threads.map(outcome, photos)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            paced.close()  # ends the calls in flight
            raise


def _is_everybodys(error: MaplessError) -> bool:
    """Whether all other photographs would be answered the same."""
    if error.code == "INVALID_ARGUMENT":
        return not (error.field or "").startswith(_FIELDS_OF_PHOTOS)
    return error.code in {"NOT_FOUND", "UNAUTHENTICATED", "PERMISSION_DENIED", "UNAVAILABLE", "UNIMPLEMENTED"}


def _ask(client: Client, photo: Photo, arguments: argparse.Namespace) -> LocalizationResult | Rejected:
    """The answer alone; a file that cannot be read is its own call's fault."""
    try:
        image = photo.path.read_bytes()
    except OSError as error:
        message = f"{photo.path} cannot be read: {error.strerror}"
        raise InvalidArgument("INVALID_ARGUMENT", message, reason="UNREADABLE_FILE", field="image") from error
    (answer,) = _answers(client, photo, image, arguments)
    return answer


def _answers(
    client: Client, photo: Photo, image: ImageSource, arguments: argparse.Namespace
) -> Iterator[LocalizationResult | Rejected]:
    """The answer; with --progressive, what is known before it comes first."""
    asked: dict[str, Any] = {
        "priors": priors(arguments),
        "variant": arguments.variant,
        "allow_coarse": arguments.allow_coarse,
        "scale_strategy": arguments.scale_strategy,
        "reference_count": arguments.count,
        "rerank_references": arguments.rerank,
        "coverage": arguments.coverage,
        "axes": arguments.axes,
        "include_debug": arguments.debug or arguments.draw is not None,
    }
    about = image, photo.camera, arguments.scene, arguments.reference
    if arguments.progressive:
        for answer in client.localize_progressively(*about, **asked):
            yield answer
    else:
        answer = client.localize(*about, **asked)
        yield answer
    if arguments.draw is not None:
        page = arguments.draw / f"{photo.name.replace('/', '_')}.html"
        shown = _references(client, arguments.scene, answer)
        write_report(answer, image, photo.camera, page, references=shown, title=photo.name)


def _references(client: Client, scene: str, answer: LocalizationResult | Rejected) -> list[Reference]:
    """Those that matched, as far as they are still there; the best with their photographs, the hint's first."""
    uses = sorted(answer.diagnostics.references, key=lambda use: (-use.inlier_count, -use.match_count))
    names = [use.name for use in uses if use.match_count > 0]
    hint = answer.hint if isinstance(answer, Rejected) else None
    if hint is not None and hint.best_reference:
        names = [hint.best_reference, *(name for name in names if name != hint.best_reference)]
    found = []
    for rank, name in enumerate(names[:_DRAWN_REFERENCES]):
        with contextlib.suppress(NotFound):
            found.append(client.get_reference(scene, name, include_image=rank < _SHOWN_REFERENCES))
    return found


def _row(name: str, width: int, outcome: Outcome, as_json: bool, arguments: argparse.Namespace) -> str:
    if isinstance(outcome, MaplessError):
        told = {"code": outcome.code, "reason": outcome.reason, "message": outcome.message, "field": outcome.field}
        return json.dumps({"photo": name, "error": told}) if as_json else f"{name:{width}}  failed: {outcome}"
    if as_json:
        return json.dumps({"photo": name} | output.plain(_told(outcome, arguments)))
    return output.line(f"{name:{width}}", outcome)


def _told(answer: LocalizationResult | Rejected, arguments: argparse.Namespace) -> Any:
    """What is printed of an answer: its matches only for those who asked for them by name."""
    return answer if arguments.debug else replace(answer, debug=None)


def priors(arguments: argparse.Namespace) -> Priors:
    """What the command line knows of the camera."""
    near, looking = arguments.near, arguments.looking
    gravity = getattr(arguments, "gravity", None)
    return Priors(
        position=PositionPrior(np.array(near[:3]), near[3]) if near else None,
        heading=HeadingPrior(np.array(looking[:3]), looking[3]) if looking else None,
        gravity=GravityPrior(np.array(gravity), arguments.gravity_sigma) if gravity else None,
    )


@contextlib.contextmanager
def _opened(path: Path | None) -> Iterator[TextIO]:
    if path is None:
        yield sys.stdout
        return
    with path.open("w", encoding="utf-8") as file:
        yield file
