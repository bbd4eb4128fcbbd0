"""The command `mapless`: what the client can do, from a shell. Answers are JSON on standard output.

Exit codes: 0 done, 1 the call failed, 2 wrong usage, 3 the photograph was not localized (the answer says why).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from google.protobuf import json_format
from google.protobuf.message import Message

from . import wire
from .client import Client
from .errors import MaplessError
from .geometry import Camera, RigidTransform
from .options import ConnectOptions
from .requests import HeadingPrior, NewReference, PositionPrior
from .results import Rejected
from .v1 import geometry_pb2

EXIT_FAILED, EXIT_USAGE, EXIT_REJECTED = 1, 2, 3
TOKEN_VARIABLE = "MAPLESS_TOKEN"

M = TypeVar("M", bound=Message)

_FILE_FORMATS = """\
CAMERA is a JSON file (or JSON text) as the interface defines CameraIntrinsics:
  {"width_px": 1600, "height_px": 1067, "focal_x_px": 1437.2, "focal_y_px": 1440.1,
   "principal_x_px": 791.8, "principal_y_px": 524.3, "radial_tangential": {"k1": 0.1}}
POSE likewise, RigidTransform:
  {"rotation": {"x": 0, "y": 0, "z": 0, "w": 1}, "translation_m": {"x": 0, "y": 0, "z": 1.5}}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exits."""
    parsed = _parser().parse_args(arguments)
    try:
        with Client(parsed.address, _connect_options(parsed)) as client:
            sys.exit(parsed.run(client, parsed))
    except MaplessError as error:
        field = f" (field {error.field})" if error.field and error.field not in error.message else ""
        print(f"mapless: {error}{field}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except BrokenPipeError:  # whoever reads our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAILED)
    except (OSError, ValueError) as error:
        print(f"mapless: {error}", file=sys.stderr)
        sys.exit(EXIT_USAGE)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mapless", description=__doc__, epilog=_FILE_FORMATS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"mapless {version('mapless')}")
    parser.add_argument("--address", default="localhost:50051", help="of the server (default: %(default)s)")
    parser.add_argument("--timeout", type=float, default=30.0, help="of a call, seconds (default: %(default)s)")
    connection = parser.add_argument_group("connection")
    connection.add_argument("--tls", action="store_true", help="encrypt; --ca and --cert imply it")
    connection.add_argument(
        "--ca", type=Path, metavar="FILE", help="certificate that signed the server's, PEM (default: the system's)"
    )
    connection.add_argument("--cert", type=Path, metavar="FILE", help="our own certificate, PEM, if the server asks")
    connection.add_argument("--key", type=Path, metavar="FILE", help="its key, PEM")
    connection.add_argument(
        "--token-file", type=Path, metavar="FILE", help=f"holds the token to show (default: that in {TOKEN_VARIABLE})"
    )
    connection.add_argument("--client-id", default="", help="which of the token's users this is")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    health = commands.add_parser("health", help="whether the server takes calls")
    health.set_defaults(run=_health)

    scene = commands.add_parser("scene", help="create, get, list, delete").add_subparsers(
        required=True, metavar="ACTION"
    )
    for action, run in (("create", _create_scene), ("get", _get_scene), ("delete", _delete_scene)):
        one = scene.add_parser(action)
        one.add_argument("scene")
        one.set_defaults(run=run)
    scene.add_parser("list").set_defaults(run=_list_scenes)

    reference = commands.add_parser("reference", help="add, list, delete")
    reference_actions = reference.add_subparsers(required=True, metavar="ACTION")
    add = reference_actions.add_parser("add", help="store a photograph with its camera and pose")
    add.add_argument("scene")
    add.add_argument("photo", type=Path)
    add.add_argument("--id", help="of the reference (default: the file's name without its ending)")
    add.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    add.add_argument("--pose", required=True, help="its world_from_camera, likewise")
    add.set_defaults(run=_add_reference)
    listing = reference_actions.add_parser("list")
    listing.add_argument("scene")
    listing.set_defaults(run=_list_references)
    delete = reference_actions.add_parser("delete")
    delete.add_argument("scene")
    delete.add_argument("reference")
    delete.set_defaults(run=_delete_reference)

    localize = commands.add_parser("localize", help="where a photograph was taken")
    localize.add_argument("scene")
    localize.add_argument("photo", type=Path)
    localize.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    localize.add_argument("--reference", action="append", default=[], help="compare with this one; may be repeated")
    localize.add_argument("--count", type=int, default=0, help="how many references the server chooses")
    localize.add_argument("--rerank", action="store_true", help="the server chooses among those given")
    _add_priors(localize)
    localize.add_argument("--variant", default="", help="best, full, no_structure or coarse")
    localize.add_argument("--scale-strategy", default="", help="two_stage, triangulation or trajectory")
    localize.add_argument("--allow-coarse", action="store_true", help="a coarse pose will do if time runs out")
    localize.set_defaults(run=_localize)

    retrieve = commands.add_parser("retrieve", help="the references that resemble a photograph most")
    retrieve.add_argument("scene")
    retrieve.add_argument("photo", type=Path)
    retrieve.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    retrieve.add_argument("--count", type=int, default=0, help="how many")
    _add_priors(retrieve)
    retrieve.set_defaults(run=_retrieve)

    coverage = commands.add_parser("coverage", help="whether a photograph taken somewhere would be localized")
    coverage.add_argument("scene")
    coverage.add_argument("--camera", required=True, help="the camera, see `mapless --help`")
    coverage.add_argument("--pose", required=True, help="where it would be: its world_from_camera, likewise")
    coverage.set_defaults(run=_coverage)
    return parser


def _add_priors(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--near", type=float, nargs=4, metavar=("X", "Y", "Z", "RADIUS"), help="position prior, metres"
    )
    command.add_argument(
        "--looking",
        type=float,
        nargs=4,
        metavar=("X", "Y", "Z", "ANGLE"),
        help="heading prior: direction in the world, and degrees around it",
    )


def _priors(arguments: argparse.Namespace) -> tuple[PositionPrior | None, HeadingPrior | None]:
    near, looking = arguments.near, arguments.looking
    return (
        PositionPrior(np.array(near[:3]), near[3]) if near else None,
        HeadingPrior(np.array(looking[:3]), looking[3]) if looking else None,
    )


def _connect_options(arguments: argparse.Namespace) -> ConnectOptions:
    """How to connect; OSError or ValueError if the flags or their files do not fit."""
    # Not a flag of its own: what stands on a command line, everybody on the machine can read.
    token = arguments.token_file.read_text() if arguments.token_file else os.environ.get(TOKEN_VARIABLE)
    return ConnectOptions(
        timeout_s=arguments.timeout,
        tls=bool(arguments.tls or arguments.ca or arguments.cert),
        root_certificates=arguments.ca.read_bytes() if arguments.ca else None,
        client_certificate=arguments.cert.read_bytes() if arguments.cert else None,
        client_key=arguments.key.read_bytes() if arguments.key else None,
        token=token.strip() if token else None,
        client_id=arguments.client_id,
    )


def _health(client: Client, arguments: argparse.Namespace) -> int:
    serving = client.is_serving()
    print("SERVING" if serving else "NOT_SERVING")
    return 0 if serving else EXIT_FAILED


def _create_scene(client: Client, arguments: argparse.Namespace) -> int:
    return _print(client.create_scene(arguments.scene))


def _get_scene(client: Client, arguments: argparse.Namespace) -> int:
    return _print(client.get_scene(arguments.scene))


def _list_scenes(client: Client, arguments: argparse.Namespace) -> int:
    return _print(list(client.list_scenes()))


def _delete_scene(client: Client, arguments: argparse.Namespace) -> int:
    client.delete_scene(arguments.scene)
    return 0


def _add_reference(client: Client, arguments: argparse.Namespace) -> int:
    reference = NewReference(
        reference_id=arguments.id or arguments.photo.stem,
        image=arguments.photo,
        camera=_read_camera(arguments.camera),
        world_from_camera=_read_pose(arguments.pose),
    )
    return _print(client.add_reference(arguments.scene, reference))


def _list_references(client: Client, arguments: argparse.Namespace) -> int:
    return _print(list(client.list_references(arguments.scene)))


def _delete_reference(client: Client, arguments: argparse.Namespace) -> int:
    client.delete_reference(arguments.scene, arguments.reference)
    return 0


def _localize(client: Client, arguments: argparse.Namespace) -> int:
    if arguments.rerank and not arguments.reference:
        raise ValueError("--rerank chooses among references that --reference names")
    position_prior, heading_prior = _priors(arguments)
    answer = client.localize(
        arguments.photo,
        _read_camera(arguments.camera),
        arguments.scene,
        arguments.reference,
        position_prior=position_prior,
        heading_prior=heading_prior,
        variant=arguments.variant,
        allow_coarse=arguments.allow_coarse,
        scale_strategy=arguments.scale_strategy,
        reference_count=arguments.count,
        rerank_references=arguments.rerank,
    )
    _print(answer)
    return EXIT_REJECTED if isinstance(answer, Rejected) else 0


def _retrieve(client: Client, arguments: argparse.Namespace) -> int:
    position_prior, heading_prior = _priors(arguments)
    return _print(
        client.retrieve_references(
            arguments.photo,
            _read_camera(arguments.camera),
            arguments.scene,
            arguments.count,
            position_prior=position_prior,
            heading_prior=heading_prior,
        )
    )


def _coverage(client: Client, arguments: argparse.Namespace) -> int:
    pose, camera = _read_pose(arguments.pose), _read_camera(arguments.camera)
    coverage = client.check_coverage(arguments.scene, pose, camera)
    _print(coverage)
    return EXIT_REJECTED if coverage.verdict == "NOT_LOCALIZABLE" else 0


def _read_camera(source: str) -> Camera:
    return wire.camera_from_message(_read_json(source, geometry_pb2.CameraIntrinsics()), "camera")


def _read_pose(source: str) -> RigidTransform:
    return wire.transform_from_message(_read_json(source, geometry_pb2.RigidTransform()), "pose")


def _read_json(source: str, message: M) -> M:
    """The message that a JSON file, or JSON text, holds."""
    text = source if source.lstrip().startswith("{") else Path(source).read_text()
    try:
        json_format.Parse(text, message)
    except json_format.ParseError as error:
        raise ValueError(f"{source}: {error}") from None
    return message


def _print(value: object) -> int:
    print(json.dumps(_plain(value), indent=2), flush=True)
    return 0


def _plain(value: Any) -> Any:
    """What JSON can hold of a result; geometry in the form that --camera and --pose read."""
    if isinstance(value, Camera):
        return _plain(wire.camera_to_message(value))
    if isinstance(value, RigidTransform):
        return _plain(wire.transform_to_message(value))
    if isinstance(value, Message):
        return json_format.MessageToDict(value, preserving_proto_field_name=True)
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, datetime):
        return value.isoformat()
    return value


if __name__ == "__main__":
    main()
