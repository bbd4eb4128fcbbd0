"""The command `mapless`: what the client can do, from a shell."""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from .cli.arguments import make_parser
from .cli.folder import EXIT_FAILED, EXIT_USAGE
from .cli.output import suggesting
from .cli.parsing import connect_options
from .cli.waiting import WaitingClient
from .errors import MaplessError

EXIT_INTERRUPTED = 130  # as in shells


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exits."""
    try:
        parser = make_parser()
        if not (sys.argv[1:] if arguments is None else arguments):
            parser.print_help(sys.stderr)
            sys.exit(EXIT_USAGE)
        parsed = parser.parse_args(arguments)
        warnings.showwarning = _show_warning
        with WaitingClient(parsed.address, connect_options(parsed)) as client, suggesting(client):
            sys.exit(parsed.run(client, parsed))
    except MaplessError as error:
        print(f"mapless: {_source_of(error, parsed)}{error}{_advice(error, parsed)}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except BrokenPipeError:  # the reader of our output has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAILED)
    except OSError as error:
        print(
            f"mapless: {error.filename}: {error.strerror}" if error.filename else f"mapless: {error}", file=sys.stderr
        )
        sys.exit(EXIT_USAGE)
    except ValueError as error:
        print(f"mapless: {error}", file=sys.stderr)
        sys.exit(EXIT_USAGE)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    print(f"mapless: warning: {message}", file=sys.stderr)


def _source_of(error: MaplessError, parsed: argparse.Namespace) -> str:
    """Returns the file with the wrong field of a request, "photo.jpg: "; empty if no single file has it."""
    parts = (error.field or "").split(".")
    if "depth" in parts:
        parts = parts[parts.index("depth") :]
        sources = [f"depth.{part}" for part in parts[1:]]
    else:
        sources = parts
    for part in [*sources, parts[0]]:
        source = getattr(parsed, _SOURCES.get(part, ""), None)
        if source is not None and Path(source).is_file():
            return f"{source}: "
    return ""


def _advice(error: MaplessError, parsed: argparse.Namespace) -> str:
    """Returns the flag that is missing, "; give --depth-camera"; empty if none is."""
    is_of_another = error.reason == "DEPTH_SIZE" and (error.field or "").endswith("depth.intrinsics")
    return "; give --depth-camera" if is_of_another and getattr(parsed, "depth_camera", None) is None else ""


_SOURCES = {
    "image": "photo",
    "intrinsics": "camera",
    "world_from_camera": "pose",
    "depth": "depth",
    "depth.intrinsics": "depth_camera",
    "depth.camera_from_depth_camera": "depth_pose",
}
"""The argument that has a field of the requests."""


if __name__ == "__main__":
    main()
