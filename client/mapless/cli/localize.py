"""`mapless localize`: one photograph, or a folder of them."""

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
from ..cameras import FOLDER_FILE, read_camera, read_cameras, read_masks, read_pose
from ..client import Client
from ..depth import DepthImage, DepthSensor
from ..errors import InvalidArgument, MaplessError
from ..geometry import Camera
from ..labels import parse_labels
from ..masks import find_mask, mask_name
from ..priors import GeoPositionPrior, GravityPrior, HeadingPrior, PosePrior, PositionPrior, Priors
from ..requests import ImageSource, IntrinsicsUncertainty, ReadoutDirection
from . import output
from .folder import EXIT_REJECTED, Concurrency, LimitedClient, Outcome, Tally

ENDINGS = frozenset({".jpg", ".jpeg", ".png", ".webp"})
_FIELDS_OF_PHOTOS = ("image", "intrinsics", "mask", "depth")


@dataclass(frozen=True)
class Photo:
    """A photograph to localize, its name in the output, its camera, None if it is not known, and its mask, if any."""

    path: Path
    name: str
    camera: Camera | None
    mask: Path | None = None


def run(client: Client, arguments: argparse.Namespace) -> int:
    """Runs the command."""
    if arguments.rerank and not arguments.reference:
        raise ValueError("--rerank needs --reference: it chooses among the references given")
    if arguments.parallel < 1:
        raise ValueError(f"--parallel must be at least 1, is {arguments.parallel}")
    if arguments.reference and not arguments.scene:
        raise ValueError("--reference needs SCENE: references are of one scene")
    if not arguments.photo.is_dir():
        return _one(client, arguments)
    if arguments.progressive:
        raise ValueError("--progressive takes one photograph, not a folder")
    if depth_of(arguments) is not None:
        raise ValueError("--depth is that of one photograph, not of a folder's")
    return _folder(client, arguments)


def _one(client: Client, arguments: argparse.Namespace) -> int:
    path, given = arguments.photo, arguments.camera
    camera = _camera_beside(path) if given is None else read_camera(given, path)
    mask = _listed_mask(path, given) if arguments.mask is None else _found_mask(arguments.mask, path)
    photo = Photo(path, path.name, camera, mask)
    answers = _answers(client, photo, photo.path, photo.mask, arguments)
    first = next(answers)  # before the output file is created, which an error would leave empty
    indent = None if arguments.progressive else 2  # of several answers each is a line
    with _opened(arguments.output) as file:
        for answer in itertools.chain([first], answers):
            if arguments.output or output.is_json(arguments):
                print(json.dumps(_json(photo, answer, arguments), indent=indent), file=file, flush=True)
            else:
                print(answer, file=file, flush=True)
    _print_path(arguments)
    return EXIT_REJECTED if isinstance(answer, Rejected) else 0


def _folder(client: Client, arguments: argparse.Namespace) -> int:
    """Localizes a folder: prints a line per photograph, in order; an error of one does not end the others."""
    photos = [
        replace(it, mask=it.mask if arguments.mask is None else find_mask(arguments.mask, _names(it)))
        for it in photos_of(arguments.photo, arguments.camera)
    ]
    if arguments.mask is not None and not any(it.mask for it in photos):
        raise ValueError(f"{arguments.mask} has a mask of none of the photographs: {mask_name(photos[0].name)} or so")
    width = max(len(photo.name) for photo in photos)
    as_json = bool(arguments.output) or output.is_json(arguments)
    tally = Tally(len(photos))
    try:
        with _opened(arguments.output) as file, contextlib.closing(_all(client, photos, arguments)) as outcomes:
            if not as_json:
                print(output.heading(width, not arguments.scene), file=file)
            tally.draw()
            for photo, outcome in zip(photos, outcomes, strict=True):
                tally.clear()
                print(_row(photo, width, outcome, as_json, arguments), file=file, flush=True)
                tally.count(outcome)
    finally:
        tally.clear()
        if tally.done:  # also where the command ends early: by Ctrl-C, or because the server is gone
            print(tally.summary(), file=sys.stderr)
            _print_path(arguments)
    return tally.exit_code


def _print_path(arguments: argparse.Namespace) -> None:
    if arguments.output is not None:
        print(f"answers are in {arguments.output}", file=sys.stderr)


def depth_of(arguments: argparse.Namespace) -> DepthImage | None:
    """The depth that was measured with a photograph, by the flags of `--depth`; None without one."""
    if arguments.depth is None:
        for name in ("unit", "sensor", "camera", "pose"):
            if getattr(arguments, f"depth_{name}") is not None:
                raise ValueError(f"--depth-{name} says something of a depth: give --depth, too")
        return None
    return DepthImage(
        arguments.depth.read_bytes(),
        0.001 if arguments.depth_unit is None else arguments.depth_unit,
        sensor=DepthSensor(arguments.depth_sensor or DepthSensor.UNKNOWN),
        camera=None if arguments.depth_camera is None else read_camera(arguments.depth_camera, arguments.depth),
        camera_from_depth_camera=None if arguments.depth_pose is None else read_pose(arguments.depth_pose),
    )


def photos_of(folder: Path, camera: str | None) -> list[Photo]:
    """Lists the photographs of a folder: those of its cameras.json, or all of them if one camera is given.

    The server chooses the cameras if there is neither. ValueError without photographs.
    """
    if camera is None and (folder / FOLDER_FILE).is_file():
        cameras = read_cameras(folder / FOLDER_FILE)
        if not cameras:
            raise ValueError(f"{folder / FOLDER_FILE} lists no photographs")
        masks = read_masks(folder / FOLDER_FILE)
        return [Photo(path, path.relative_to(folder).as_posix(), its, masks.get(path)) for path, its in cameras.items()]
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    if not paths:
        raise ValueError(f"{folder} holds no photographs ({', '.join(sorted(ENDINGS))})")
    return [Photo(path, path.name, None if camera is None else read_camera(camera, path)) for path in paths]


def _camera_beside(path: Path) -> Camera | None:
    """Camera of a photograph, from the cameras.json of its folder or of the folder above; None if there is none."""
    for folder in path.resolve().parents[:2]:
        if (folder / FOLDER_FILE).is_file():
            return read_camera(folder / FOLDER_FILE, path)
    return None


def _listed_mask(path: Path, camera: str | None) -> Path | None:
    """The mask that a cameras.json names, if the photograph's camera is from one: the one given, or one beside it."""
    files = [folder / FOLDER_FILE for folder in path.resolve().parents[:2]] if camera is None else [Path(camera)]
    file = next((it for it in files if it.name == FOLDER_FILE and it.is_file()), None)
    if file is None:
        return None
    return {image.resolve(): mask for image, mask in read_masks(file).items()}.get(path.resolve())


def _found_mask(masks: Path, photo: Path) -> Path:
    found = find_mask(masks, [photo.name])
    if found is None:
        raise ValueError(f"{masks} has no mask of {photo.name}: {mask_name(photo.name)}")
    return found


def _names(photo: Photo) -> list[str]:
    """Paths that a photograph may have in a folder of images: with a cameras.json beside images/, without that."""
    return list(dict.fromkeys([photo.name, photo.name.removeprefix("images/"), photo.path.name]))


def _all(client: Client, photos: list[Photo], arguments: argparse.Namespace) -> Generator[Outcome, None, None]:
    """Yields an outcome per photograph, in order; at most `parallel` concurrent calls, fewer if the server is full."""
    concurrency = Concurrency(arguments.parallel)

    def outcome(photo: Photo) -> Outcome:
        try:
            with concurrency.call():
                return _localize(limited, photo, arguments)
        except MaplessError as error:
            if _concerns_all(error):
                raise
            return error

    with (
        LimitedClient(arguments.address, client.options, concurrency) as limited,
        ThreadPoolExecutor(arguments.parallel, "localize") as threads,
    ):
        try:
            yield from threads.map(outcome, photos)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            limited.close()  # ends the calls in flight
            raise


def _concerns_all(error: MaplessError) -> bool:
    """Whether the calls of all other photographs would fail in the same way."""
    if error.code == "INVALID_ARGUMENT":
        return not (error.field or "").startswith(_FIELDS_OF_PHOTOS)
    return error.code in {"NOT_FOUND", "UNAUTHENTICATED", "PERMISSION_DENIED", "UNAVAILABLE", "UNIMPLEMENTED"}


def _localize(client: Client, photo: Photo, arguments: argparse.Namespace) -> LocalizationResult | Rejected:
    """Returns the final answer; a file that cannot be read is an error of this photograph alone."""
    image = _read(photo.path, "image")
    mask = None if photo.mask is None else _read(photo.mask, "mask")
    (answer,) = _answers(client, photo, image, mask, arguments)
    return answer


def _read(path: Path, field: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        message = f"{path} cannot be read: {error.strerror}"
        raise InvalidArgument("INVALID_ARGUMENT", message, reason="UNREADABLE_FILE", field=field) from error


def _answers(
    client: Client, photo: Photo, image: ImageSource, mask: ImageSource | None, arguments: argparse.Namespace
) -> Iterator[LocalizationResult | Rejected]:
    """Yields the answer; with --progressive, others may come first."""
    options: dict[str, Any] = {
        "scenes": arguments.scenes,
        "group": _group_of(arguments),
        "prior_scene": arguments.prior_scene,
        "priors": priors(arguments),
        "mask": mask,
        "depth": depth_of(arguments),
        "intrinsics_uncertainty": intrinsics_uncertainty(arguments),
        "variant": arguments.variant,
        "allow_coarse": arguments.allow_coarse,
        "scale_strategy": arguments.scale_strategy,
        "reference_count": arguments.count,
        "rerank_references": arguments.rerank,
        "coverage": arguments.coverage,
        "axes": arguments.axes,
        "allow_adoption": arguments.allow_adoption,
        "include_imprecise_pose": arguments.include_imprecise_pose,
        "include_debug": arguments.debug,
    }
    photograph = image, photo.camera, arguments.scene, arguments.reference
    if arguments.progressive:
        yield from client.localize_progressively(*photograph, **options)
    else:
        yield client.localize(*photograph, **options)


def _group_of(arguments: argparse.Namespace) -> dict[str, str] | None:
    """The labels of a group; a value alone is that of the label "group". None where no group is asked for."""
    if not (arguments.group or arguments.anywhere):
        return None
    return parse_labels([it if "=" in it else f"group={it}" for it in arguments.group], "--group")


def _row(photo: Photo, width: int, outcome: Outcome, as_json: bool, arguments: argparse.Namespace) -> str:
    if isinstance(outcome, MaplessError):
        fields = {"code": outcome.code, "reason": outcome.reason, "message": outcome.message, "field": outcome.field}
        return (
            json.dumps({"photo": photo.name, "error": fields})
            if as_json
            else f"{photo.name:{width}}  failed: {outcome}"
        )
    if as_json:
        return json.dumps({"photo": photo.name} | _json(photo, outcome, arguments))
    return output.line(f"{photo.name:{width}}", outcome, not arguments.scene)


def _json(photo: Photo, answer: LocalizationResult | Rejected, arguments: argparse.Namespace) -> dict[str, Any]:
    """An answer as JSON values; with --debug, beside what `mapless-server draw` needs to draw it."""
    used = None if answer.used_intrinsics is None else answer.used_intrinsics.camera
    drawn = {"photo": photo.name, "camera": output.plain(photo.camera or used)} if arguments.debug else {}
    return {**drawn, **output.plain(answer)}


def limits(arguments: argparse.Namespace) -> Priors:
    """The hard priors that the command line gives."""
    near, looking = arguments.near, arguments.looking
    return Priors(
        position=PositionPrior(np.array(near[:3]), near[3]) if near else None,
        heading=HeadingPrior(np.array(looking[:3]), looking[3]) if looking else None,
    )


def priors(arguments: argparse.Namespace) -> Priors:
    """All priors that the command line gives."""
    geo_position, gravity = arguments.geo_position, arguments.gravity
    return replace(
        limits(arguments),
        geo_position=GeoPositionPrior(*geo_position) if geo_position else None,
        gravity=GravityPrior(np.array(gravity), arguments.gravity_sigma) if gravity else None,
        pose=_pose_prior(*arguments.pose_prior) if arguments.pose_prior else None,
    )


def _pose_prior(pose: str, position_sigma_m: str, rotation_sigma_deg: str) -> PosePrior:
    try:
        sigmas = float(position_sigma_m), float(rotation_sigma_deg)
    except ValueError:
        given = f"{position_sigma_m!r} and {rotation_sigma_deg!r}"
        raise ValueError(f"METRES and DEGREES of --pose-prior must be numbers, are {given}") from None
    try:
        return PosePrior.from_sigmas(read_pose(pose), *sigmas)
    except ValueError as error:
        raise ValueError(f"--pose-prior: {error}") from None


def intrinsics_uncertainty(arguments: argparse.Namespace) -> IntrinsicsUncertainty | None:
    """The standard deviations and the read-out that the command line gives; None without any."""
    given = IntrinsicsUncertainty(
        arguments.focal_sigma,
        arguments.principal_sigma,
        arguments.k1_sigma,
        arguments.readout,
        ReadoutDirection(arguments.readout_direction),
        arguments.speed,
        arguments.turn,
    )
    return None if given == IntrinsicsUncertainty() else given


@contextlib.contextmanager
def _opened(path: Path | None) -> Iterator[TextIO]:
    if path is None:
        yield sys.stdout
        return
    with path.open("w", encoding="utf-8") as file:
        yield file
