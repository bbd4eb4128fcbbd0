"""The flags of `mapless localize`, and those that other commands with photographs have, too."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from mapless_command.installation import how_to_install

from ..depth import DepthSensor
from ..requests import ReadoutDirection
from . import localize
from .parsing import Command, Gone

COUNT_DEFAULT = "(default: the server's)"

MASK = "PNG of the photograph's size, 0 where it shows nothing of the place"

_DRAWING = (
    "write the answer with --debug --output answer.json, and draw it with `mapless-server draw answer.json PHOTO` of "
    f"the tools ({how_to_install('tools')})"
)


def add_localize(command: Command) -> None:
    """Adds the flags that `localize.run` reads."""
    command.add_argument("scene", help="the scene; left out where flags say among which scenes it is found")
    command.add_argument("photo", type=Path, help="or a folder of photographs")
    _add_scenes(command)
    command.add_argument(
        "--camera",
        help="the camera of the photographs, see `mapless --help` (default: those that the folder's cameras.json has; "
        "without one, the server chooses it by EXIF, references and matches)",
    )
    command.add_argument(
        "--mask",
        type=Path,
        metavar="FILE",
        help=f"{MASK}; or a folder of masks, PHOTO.jpg.png (default: those that the folder's cameras.json names)",
    )
    add_depth(command)
    command.add_argument("--reference", action="append", default=[], help="use this reference; may be repeated")
    command.add_argument(
        "--count", type=count, default=0, help=f"how many references the server chooses {COUNT_DEFAULT}"
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
        "--allow-adoption", action="store_true", help="the photographs may be kept as references, if the scene adopts"
    )
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
    shown.add_argument("--draw", action=Gone, nargs="?", help=argparse.SUPPRESS, instead=_DRAWING)
    command.set_defaults(run=localize.run)


def _add_scenes(command: Command) -> None:
    """Adds the flags that say among which scenes that of a photograph is found."""
    command.instead_of_scene = ("--scene", "--group", "--anywhere")
    text = "in place of SCENE: among which scenes the server finds that of the photograph"
    shown = command.add_argument_group("scenes", text)
    several = shown.add_mutually_exclusive_group()
    several.add_argument(
        "--scene", dest="scenes", action="append", default=[], metavar="SCENE", help="one of them; may be repeated"
    )
    several.add_argument(
        "--group", action="append", default=[], metavar="NAME=VALUE",
        help="those with this label, site=a, see `mapless scene update --label`; VALUE alone is group=VALUE; may be "
        "repeated, for those with all of the labels",
    )  # fmt: skip
    several.add_argument("--anywhere", action="store_true", help="all scenes that the caller may read")
    shown.add_argument(
        "--prior-scene",
        default="",
        metavar="SCENE",
        help="the one in whose world --near, --looking and --pose-prior are given",
    )


def count(text: str) -> int:
    """Reads a count of at least 1; in a request, 0 stands for the server's default, as does an omitted flag."""
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, is {count}")
    return count


def add_depth(command: argparse.ArgumentParser) -> None:
    """Adds the flags that `localize.depth_of` reads."""
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


def add_limits(command: argparse.ArgumentParser) -> argparse._ArgumentGroup:
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
    group = add_limits(command)
    group.add_argument(
        "--pose-prior",
        nargs=3,
        metavar=("POSE", "METRES", "DEGREES"),
        help="expected world_from_camera, and standard deviations of its position and rotation about each axis; "
        "makes the answer faster",
    )
    add_three = partial(group.add_argument, type=float, nargs=3)
    add_three(
        "--geo-position",
        metavar=("LATITUDE", "LONGITUDE", "METRES"),
        help="of a satellite receiver: WGS84 degrees, and standard deviation of north and of east; for scenes with a "
        "datum",
    )
    add_three(
        "--gravity",
        metavar=("X", "Y", "Z"),
        help="down in the camera's axes (x right, y down, z forward), for scenes with a known down",
    )
    group.add_argument(
        "--gravity-sigma", type=float, default=1.0, metavar="DEG", help="its standard deviation (default: %(default)s)"
    )
