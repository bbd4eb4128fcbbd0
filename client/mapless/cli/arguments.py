"""The arguments of the command line."""

from __future__ import annotations

import argparse
from importlib.metadata import version
from pathlib import Path

from mapless_command.installation import how_to_install

from ..client import Client
from ..shortcut import default_address
from . import adoption, commands, doctor, report
from .parsing import COMMON_DEFAULTS, Command, Parser, add_common, all_parsers
from .photographs import COUNT_DEFAULT, MASK, add_depth, add_limits, add_localize, count

DESCRIPTION = """\
The command `mapless`: what the client can do, from a shell.

Commands print short text on a terminal, and JSON with all fields where standard output is no terminal; --json and
--text decide otherwise. Exit codes: 0 success, 1 a call failed, 2 wrong usage, 3 a photograph was not localized (the
answer has the reason).
"""

FILE_FORMATS = """\
CAMERA is a JSON file (or JSON text) as the interface defines CameraIntrinsics:
  {"width_px": 1600, "height_px": 1067, "focal_x_px": 1437.2, "focal_y_px": 1440.1,
   "principal_x_px": 791.8, "principal_y_px": 524.3, "radial_tangential": {"k1": 0.1}}
or focal lengths and principal point in pixels of the photograph, FX,FY,CX,CY,
or a cameras.json that lists the photograph.
POSE is a JSON file likewise, RigidTransform:
  {"rotation": {"x": 0, "y": 0, "z": 0, "w": 1}, "translation_m": {"x": 0, "y": 0, "z": 1.5}}
or its matrix, 4x4 or 3x4:
  [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]]
or the JSON of an answer that has a pose.
"""


def make_parser() -> argparse.ArgumentParser:
    """Makes the parser of the command line; the attribute `run` of its result is the command's function."""
    parser = Parser(
        prog="mapless",
        description=DESCRIPTION,
        epilog=FILE_FORMATS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"mapless {version('mapless')}")
    add_common(parser)
    parser.set_defaults(**COMMON_DEFAULTS, address=default_address())
    groups = parser.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=Command)
    _add_doctor(groups)
    health = groups.add_parser(
        "health",
        help="whether the server accepts calls",
        description="The server as a whole, then each service. The ReferenceService alone is NOT_SERVING while the "
        "store cannot be written: queries are answered, changes rejected. Exit code 0 if the server as a whole serves, "
        "else 1.",
    )
    health.set_defaults(run=commands.health)
    _add_scene(groups.add_parser("scene", help="create, update, get, report, list, delete"))
    what = "add, show, download, list, delete, retire, restore, undo-adoption"
    _add_reference(groups.add_parser("reference", help=what))
    add_localize(groups.add_parser("localize", help="localize a photograph, or a folder of them"))
    _add_questions(groups)
    completion = groups.add_parser(
        "completion",
        help="print a script that completes this command line",
        description='Completes commands, flags and files. In bash: eval "$(mapless completion bash)".',
    )
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    completion.set_defaults(run=_completion)
    return parser


def _completion(client: Client, arguments: argparse.Namespace) -> int:
    """Prints the completion script of a shell; needs the package shtab."""
    try:
        import shtab
    except ImportError:
        raise ValueError(f"completion needs the Python package shtab: {how_to_install('completion')}") from None
    parser = make_parser()
    for action in [it for one in all_parsers(parser) for it in one._actions if it.type is Path]:
        vars(action)["complete"] = shtab.FILE
    print(shtab.complete(parser, arguments.shell))
    return 0


def _add_doctor(groups: argparse._SubParsersAction[Command]) -> None:
    checks = groups.add_parser(
        "doctor",
        help="check the connection to a server, and say what to do about what is wrong",
        description="Checks address, protocol and TLS, services, token, clock, versions, and a query: a reference's "
        "photograph is localized in its own scene. Exit code 0 if nothing is wrong, else 1.",
    )
    checks.add_argument("--scene", help="scene of the query (default: the first with references)")
    checks.set_defaults(run=doctor.run)


def _add_scene(scene: argparse.ArgumentParser) -> None:
    actions = scene.add_subparsers(required=True, metavar="ACTION")
    create = actions.add_parser("create", help="create an empty scene")
    create.add_argument("scene")
    _add_place(create)
    _add_labels(create, "what groups it with other scenes; may be repeated")
    adoption.add_policy(create)
    create.set_defaults(run=commands.create_scene)
    update = actions.add_parser(
        "update", help="change its datum, direction of gravity, unit, labels, adoption or calibration"
    )
    update.add_argument("scene")
    _add_place(update)
    _add_labels(update, "label in place of all before; may be repeated")
    adoption.add_policy(update)
    update.add_argument(
        "--forget",
        action="append",
        default=[],
        choices=["datum", "down_in_world", "calibration", "labels", "adoption"],
        help="property to delete; may be repeated",
    )
    update.set_defaults(run=commands.update_scene)
    for action, others, run, text in (
        ("get", ["show"], commands.get_scene, "its number of references, datum, unit, labels and calibration"),
        ("delete", [], commands.delete_scene, "delete it with all of its references"),
    ):
        one = actions.add_parser(action, aliases=others, help=text)  # completion knows only those with a text
        one.add_argument("scene")
        if action == "delete":
            _add_yes(one)
        one.set_defaults(run=run)
    report.add_report(actions)
    listing = actions.add_parser("list", help="all scenes")
    _add_labels(listing, "only scenes with this label; may be repeated")
    listing.set_defaults(run=commands.list_scenes)


def _add_labels(command: argparse.ArgumentParser, text: str) -> None:
    command.add_argument("--label", action="append", default=[], metavar="NAME=VALUE", help=text)


def _add_place(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--datum",
        type=float,
        nargs=3,
        metavar=("LATITUDE", "LONGITUDE", "HEIGHT"),
        help="of the world's origin: WGS84 degrees, and metres above the ellipsoid",
    )
    command.add_argument(
        "--enu-from-world",
        type=float,
        nargs=4,
        metavar=("X", "Y", "Z", "W"),
        help="quaternion that rotates the world's axes to east, north, up (default: the identity)",
    )
    command.add_argument("--down", type=float, nargs=3, metavar=("X", "Y", "Z"), help="direction of gravity")
    command.add_argument(
        "--unit", choices=["metre", "arbitrary"], help="of its references' poses (default: metre); changes no pose"
    )


def _add_reference(reference: argparse.ArgumentParser) -> None:
    actions = reference.add_subparsers(required=True, metavar="ACTION")
    add = actions.add_parser("add", help="store a photograph with its camera and pose")
    add.add_argument("scene")
    add.add_argument("photo", type=Path)
    add.add_argument("--id", help="of the reference (default: the file's name without its ending)")
    add.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    add.add_argument("--pose", required=True, help="its world_from_camera, likewise")
    add.add_argument("--mask", type=Path, metavar="FILE", help=f"{MASK}")
    add_depth(add)
    add.set_defaults(run=commands.add_reference)
    listing = actions.add_parser("list", help="all references of a scene")
    listing.add_argument("scene")
    some = listing.add_mutually_exclusive_group()
    some.add_argument("--adopted", action="store_true", help="only adopted ones, with what vouches for them")
    some.add_argument("--retired", action="store_true", help="only retired ones, with why")
    some.add_argument("--places", action="store_true", help="how much of the survey is left at places that adopt")
    listing.set_defaults(run=commands.list_references)
    adoption.add_actions(actions)
    for action, others, run, text in (
        ("show", ["get"], commands.show_reference, "its camera, pose, hash and number of features"),
        ("download", [], commands.download_reference, "its photograph, the bytes that were stored"),
        ("delete", [], commands.delete_reference, "delete it"),
    ):
        one = actions.add_parser(action, aliases=others, help=text)
        one.add_argument("scene")
        one.add_argument("reference")
        one.set_defaults(run=run)
        if action == "download":
            one.add_argument("--output", type=Path, metavar="FILE", help="default: ID.jpg, .png or .webp; - for stdout")
            one.add_argument("--force", action="store_true", help="overwrite the file")
        if action == "delete":
            _add_yes(one)


def _add_yes(command: argparse.ArgumentParser) -> None:
    command.add_argument("--yes", action="store_true", help="do not ask; only a terminal is asked")


def _add_questions(groups: argparse._SubParsersAction[Command]) -> None:
    retrieve = groups.add_parser("retrieve", help="find the references most similar to a photograph")
    retrieve.add_argument("scene")
    retrieve.add_argument("photo", type=Path)
    retrieve.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    retrieve.add_argument("--count", type=count, default=0, help=f"how many {COUNT_DEFAULT}")
    retrieve.add_argument("--mask", type=Path, metavar="FILE", help=MASK)
    add_limits(retrieve)
    retrieve.set_defaults(run=commands.retrieve)

    coverage = groups.add_parser("coverage", help="predict whether a photograph at a pose would be localized")
    coverage.add_argument("scene")
    coverage.add_argument("--camera", required=True, help="the camera, see `mapless --help`")
    coverage.add_argument("--pose", required=True, help="its world_from_camera, likewise")
    coverage.set_defaults(run=commands.coverage)
