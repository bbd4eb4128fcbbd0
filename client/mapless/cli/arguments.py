"""The arguments of the command line, and the connection's options that they give."""

from __future__ import annotations

import argparse
import difflib
import itertools
import os
import re
import sys
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from mapless_command.installation import how_to_install

from ..client import Client
from ..depth import DepthSensor
from ..options import ConnectOptions
from ..requests import ReadoutDirection
from ..shortcut import ADDRESS_VARIABLE, TOKEN_VARIABLE, default_address
from ..text_files import read_text
from . import commands, doctor, localize

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


_COUNT_DEFAULT = "(default: the server's)"

_MASK = "PNG of the photograph's size, 0 where it shows nothing of the place"

_DRAWING = (
    "write the answer with --debug --output answer.json, and draw it with `mapless-server draw answer.json PHOTO` of "
    f"the tools ({how_to_install('tools')})"
)

_COMMON_DEFAULTS: dict[str, Any] = {
    "json": None,
    "timeout": 30.0,
    "connect_timeout": 2.0,
    "tls": False,
    "ca": None,
    "cert": None,
    "key": None,
    "token_file": None,
    "client_id": "",
}


class _Parser(argparse.ArgumentParser):
    """A parser that suggests a known command, choice or flag in place of an unknown one."""

    commands: argparse._SubParsersAction[Any] | None = None

    def add_subparsers(self, **options: Any) -> argparse._SubParsersAction[Any]:
        """Remembers the commands; flags after a command belong to it."""
        self.commands = super().add_subparsers(**options)
        return self.commands

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Rejects unknown flags first; else a misspelt flag could be reported as a missing one."""
        args = sys.argv[1:] if args is None else list(args)
        ends = {"--", *(self.commands.choices if self.commands else ())}
        for flag in itertools.takewhile(lambda it: it not in ends, args):
            name = flag.partition("=")[0]
            if re.match("--[a-z]", name) and not any(it.startswith(name) for it in self._option_string_actions):
                self._exit_for(f"unknown flag {name}", name, self._option_string_actions)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Prints the message, without the usage of many lines, and exits."""
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        self._exit_for(message, *(wrong[1], re.findall(r"[\w-]+", wrong[2])) if wrong else ("", ()))

    def _exit_for(self, message: str, given: str, known: Iterable[str]) -> NoReturn:
        nearest = difflib.get_close_matches(given, list(known), 1)
        help_text = f"; did you mean {nearest[0]!r}?" if nearest else f"\n`{self.prog} --help` shows what it takes"
        self.exit(2, f"{self.prog}: error: {message}{help_text}\n")


class _Gone(argparse.Action):
    """A flag of an earlier version: says what to use instead."""

    def __init__(self, instead: str, **options: Any) -> None:
        super().__init__(**options)
        self._instead = instead

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        parser.exit(2, f"{parser.prog}: error: {self.option_strings[0]} is gone: {self._instead}\n")


class _Command(_Parser):
    """A command, which also accepts the common flags; they override those given before the command."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        _add_common(self)


def make_parser() -> argparse.ArgumentParser:
    """Makes the parser of the command line; the attribute `run` of its result is the command's function."""
    parser = _Parser(
        prog="mapless",
        description=DESCRIPTION,
        epilog=FILE_FORMATS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"mapless {version('mapless')}")
    _add_common(parser)
    parser.set_defaults(**_COMMON_DEFAULTS, address=default_address())
    groups = parser.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=_Command)
    _add_doctor(groups)
    health = groups.add_parser(
        "health",
        help="whether the server accepts calls",
        description="The server as a whole, then each service. The ReferenceService alone is NOT_SERVING while the "
        "store cannot be written: queries are answered, changes rejected. Exit code 0 if the server as a whole serves, "
        "else 1.",
    )
    health.set_defaults(run=commands.health)
    _add_scene(groups.add_parser("scene", help="create, update, get, list, delete"))
    _add_reference(groups.add_parser("reference", help="add, show, download, list, delete"))
    _add_localize(groups.add_parser("localize", help="localize a photograph, or a folder of them"))
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


def all_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yields a parser and the parsers of its commands."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in dict.fromkeys(action.choices.values()):  # aliases name the same parser
                yield from all_parsers(child)


def _add_doctor(groups: argparse._SubParsersAction[_Command]) -> None:
    checks = groups.add_parser(
        "doctor",
        help="check the connection to a server, and say what to do about what is wrong",
        description="Checks address, protocol and TLS, services, token, clock, versions, and a query: a reference's "
        "photograph is localized in its own scene. Exit code 0 if nothing is wrong, else 1.",
    )
    checks.add_argument("--scene", help="scene of the query (default: the first with references)")
    checks.set_defaults(run=doctor.run)


def connect_options(arguments: argparse.Namespace) -> ConnectOptions:
    """Options of the connection; raises OSError or ValueError for wrong flags or files."""
    # Not a flag of its own: all users of the machine can read a command line.
    token = read_text(arguments.token_file) if arguments.token_file else os.environ.get(TOKEN_VARIABLE)
    return ConnectOptions(
        timeout_s=arguments.timeout,
        connect_timeout_s=arguments.connect_timeout,
        tls=bool(arguments.tls or arguments.ca or arguments.cert),
        root_certificates=arguments.ca.read_bytes() if arguments.ca else None,
        client_certificate=arguments.cert.read_bytes() if arguments.cert else None,
        client_key=arguments.key.read_bytes() if arguments.key else None,
        token=token.strip() if token else None,
        client_id=arguments.client_id,
    )


def _add_common(parser: argparse.ArgumentParser) -> None:
    """Adds flags without defaults, so that a command without them keeps the values given before it."""
    group = parser.add_argument_group("connection")

    def add(flag: str, **options: Any) -> None:
        group.add_argument(flag, default=argparse.SUPPRESS, **options)

    add(
        "--address",
        help="host:port of the server, or host1:port,host2:port of several that share a store "
        f"(default: that in {ADDRESS_VARIABLE}, or localhost:50051)",
    )
    add(
        "--timeout",
        type=float,
        help="of a call, seconds; until then it is repeated while the server is away, stops or is lost "
        f"(default: {_COMMON_DEFAULTS['timeout']:g})",
    )
    add(
        "--connect-timeout",
        type=float,
        metavar="SECONDS",
        help="in which a server must be reached for the first time; scripts that outlive a restart give more "
        f"(default: {_COMMON_DEFAULTS['connect_timeout']:g})",
    )
    add("--tls", action="store_true", help="encrypt; --ca and --cert imply it")
    add("--ca", type=Path, metavar="FILE", help="certificate that signed the server's, PEM (default: the system's)")
    add("--cert", type=Path, metavar="FILE", help="the client's certificate, PEM, if the server requires one")
    add("--key", type=Path, metavar="FILE", help="its key, PEM")
    add("--token-file", type=Path, metavar="FILE", help=f"holds the token (default: that in {TOKEN_VARIABLE})")
    add("--client-id", help="identifies this user among those of the token")
    group = parser.add_argument_group("printing")
    add("--json", action="store_const", const=True, help="JSON, on a terminal too")
    add("--text", action="store_const", const=False, dest="json", help="text, where standard output is no terminal too")


def _add_scene(scene: argparse.ArgumentParser) -> None:
    actions = scene.add_subparsers(required=True, metavar="ACTION")
    create = actions.add_parser("create", help="create an empty scene")
    create.add_argument("scene")
    _add_place(create)
    _add_labels(create, "what groups it with other scenes; may be repeated")
    create.set_defaults(run=commands.create_scene)
    update = actions.add_parser("update", help="change its datum, direction of gravity, unit, labels or calibration")
    update.add_argument("scene")
    _add_place(update)
    _add_labels(update, "label in place of all before; may be repeated")
    update.add_argument(
        "--forget",
        action="append",
        default=[],
        choices=["datum", "down_in_world", "calibration", "labels"],
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
    listing = actions.add_parser("list", help="all scenes")
    _add_labels(listing, "only scenes with this label; may be repeated")
    listing.set_defaults(run=commands.list_scenes)


def _label(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as site=a")
    return name, value


def _add_labels(command: argparse.ArgumentParser, text: str) -> None:
    command.add_argument("--label", action="append", default=[], type=_label, metavar="NAME=VALUE", help=text)


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


def _add_depth(command: argparse.ArgumentParser) -> None:
    """Adds the flags that `commands.depth_of` reads."""
    command.add_argument(
        "--depth", type=Path, metavar="FILE", help="its depth: a PNG of 16 bits, of the same camera or --depth-camera"
    )
    command.add_argument(
        "--depth-unit", type=float, metavar="M", help="metres of 1 in it (default: 0.001, millimetres)"
    )
    command.add_argument(
        "--depth-sensor",
        choices=[it.value for it in DepthSensor],
        help="the kind of sensor, by which its errors are known (default: unknown)",
    )
    command.add_argument(
        "--depth-camera", metavar="CAMERA", help="the camera of the depth, if it is another, as --camera"
    )
    command.add_argument(
        "--depth-pose", metavar="POSE", help="camera_from_depth_camera, if that is elsewhere, in the form of --pose"
    )


def _add_reference(reference: argparse.ArgumentParser) -> None:
    actions = reference.add_subparsers(required=True, metavar="ACTION")
    add = actions.add_parser("add", help="store a photograph with its camera and pose")
    add.add_argument("scene")
    add.add_argument("photo", type=Path)
    add.add_argument("--id", help="of the reference (default: the file's name without its ending)")
    add.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    add.add_argument("--pose", required=True, help="its world_from_camera, likewise")
    add.add_argument("--mask", type=Path, metavar="FILE", help=f"{_MASK}")
    _add_depth(add)
    add.set_defaults(run=commands.add_reference)
    listing = actions.add_parser("list", help="all references of a scene")
    listing.add_argument("scene")
    listing.set_defaults(run=commands.list_references)
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


def _add_localize(command: argparse.ArgumentParser) -> None:
    command.add_argument("scene")
    command.add_argument("photo", type=Path, help="or a folder of photographs")
    command.add_argument(
        "--camera",
        help="the camera of the photographs, see `mapless --help` (default: those that the folder's cameras.json has; "
        "without one, the server chooses it by EXIF, references and matches)",
    )
    command.add_argument(
        "--mask",
        type=Path,
        metavar="FILE",
        help=f"{_MASK}; or a folder of masks, PHOTO.jpg.png (default: those that the folder's cameras.json names)",
    )
    _add_depth(command)
    command.add_argument("--reference", action="append", default=[], help="use this reference; may be repeated")
    command.add_argument(
        "--count", type=_count, default=0, help=f"how many references the server chooses {_COUNT_DEFAULT}"
    )
    command.add_argument("--rerank", action="store_true", help="the server chooses among the references given")
    _add_priors(command)
    for name, unit, text in (
        ("focal", "PX", "both focal lengths"),
        ("principal", "PX", "the principal point"),
        ("k1", "K1", "the distortion coefficient k1"),
    ):
        command.add_argument(
            f"--{name}-sigma", type=float, default=0.0, metavar=unit,
            help=f"standard deviation of {text} (default: the server's)",
        )  # fmt: skip
    _add_shutter(command)
    command.add_argument("--axes", default="", help="opencv, arkit, arcore, unity or ros: adds the pose in these axes")
    command.add_argument(
        "--coverage", type=float, default=0.0, help="share of right answers to accept (default: the server's)"
    )
    command.add_argument("--variant", default="", help="best, full, no_structure or coarse")
    command.add_argument("--scale-strategy", default="", help="two_stage, triangulation or trajectory")
    command.add_argument(
        "--allow-coarse", action="store_true",
        help="accept a coarse pose if time runs out; with --progressive, print it first",
    )  # fmt: skip
    command.add_argument(
        "--include-imprecise-pose", action="store_true",
        help="with a rejection for the radius of the position alone, print the pose too, with its radii",
    )  # fmt: skip
    command.add_argument(
        "--progressive", action="store_true", help="print each better answer as soon as there is one, then the last"
    )
    command.add_argument("--parallel", type=int, default=2, help="concurrent calls for a folder (default: %(default)s)")
    shown = command.add_argument_group("output")
    shown.add_argument("--output", type=Path, metavar="FILE", help="write JSON to a file; of a folder one line each")
    shown.add_argument(
        "--debug", action="store_true",
        help="include the camera and the matches in the JSON, of which `mapless-server draw` makes pages to look at",
    )  # fmt: skip
    shown.add_argument("--draw", action=_Gone, nargs="?", help=argparse.SUPPRESS, instead=_DRAWING)
    command.set_defaults(run=localize.run)


def _count(text: str) -> int:
    """Reads a count of at least 1; in a request, 0 stands for the server's default, as does an omitted flag."""
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, is {count}")
    return count


def _add_questions(groups: argparse._SubParsersAction[_Command]) -> None:
    retrieve = groups.add_parser("retrieve", help="find the references most similar to a photograph")
    retrieve.add_argument("scene")
    retrieve.add_argument("photo", type=Path)
    retrieve.add_argument("--camera", required=True, help="its camera, see `mapless --help`")
    retrieve.add_argument("--count", type=_count, default=0, help=f"how many {_COUNT_DEFAULT}")
    retrieve.add_argument("--mask", type=Path, metavar="FILE", help=_MASK)
    _add_limits(retrieve)
    retrieve.set_defaults(run=commands.retrieve)

    coverage = groups.add_parser("coverage", help="predict whether a photograph at a pose would be localized")
    coverage.add_argument("scene")
    coverage.add_argument("--camera", required=True, help="the camera, see `mapless --help`")
    coverage.add_argument("--pose", required=True, help="its world_from_camera, likewise")
    coverage.set_defaults(run=commands.coverage)


def _add_limits(command: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Adds the hard priors: limits of the pose and of the references considered."""
    group = command.add_argument_group("priors")
    group.add_argument(
        "--near", type=float, nargs=4, metavar=("X", "Y", "Z", "RADIUS"), help="hard limit of the position, metres"
    )
    group.add_argument(
        "--looking",
        type=float,
        nargs=4,
        metavar=("X", "Y", "Z", "ANGLE"),
        help="hard limit of the viewing direction: a direction in the world, and degrees around it",
    )
    return group


def _add_shutter(command: argparse.ArgumentParser) -> None:
    """The read-out of a rolling shutter."""
    command.add_argument(
        "--readout", type=float, default=0.0, metavar="S",
        help="seconds from the first to the last row of a rolling shutter, at most 0.2 (default: a global shutter)",
    )  # fmt: skip
    command.add_argument(
        "--readout-direction",
        choices=[it.value for it in ReadoutDirection],
        default=ReadoutDirection.TOP_TO_BOTTOM.value,
        help="which side of the file's raster is read first (default: %(default)s)",
    )
    for name, unit, text in (("speed", "M_PER_S", "speed"), ("turn", "DEG_PER_S", "angular speed")):
        command.add_argument(
            f"--{name}", type=float, default=0.0, metavar=unit,
            help=f"standard deviation of the camera's {text} while it moves (default: the server's)",
        )  # fmt: skip


def _add_priors(command: argparse.ArgumentParser) -> None:
    """Adds all priors; the soft ones have standard deviations, and are not used where the photograph contradicts."""
    group = _add_limits(command)
    group.add_argument(
        "--pose-prior",
        nargs=3,
        metavar=("POSE", "METRES", "DEGREES"),
        help="expected world_from_camera, and standard deviations of its position and rotation about each axis; "
        "makes the answer faster",
    )
    group.add_argument(
        "--geo-position",
        type=float,
        nargs=3,
        metavar=("LATITUDE", "LONGITUDE", "METRES"),
        help="of a satellite receiver: WGS84 degrees, and standard deviation of north and of east; for scenes with a "
        "datum",
    )
    group.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="down in the camera's axes (x right, y down, z forward), for scenes with a known down",
    )
    group.add_argument(
        "--gravity-sigma", type=float, default=1.0, metavar="DEG", help="its standard deviation (default: %(default)s)"
    )
