"""The command `mapless`: what the client can do, from a shell."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from .cli.arguments import connect_options, make_parser
from .cli.folder import EXIT_FAILED, EXIT_USAGE
from .client import Client
from .errors import MaplessError

EXIT_INTERRUPTED = 130  # as in shells


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exits."""
    try:
        parsed = make_parser().parse_args(arguments)
        with Client(parsed.address, connect_options(parsed)) as client:
            sys.exit(parsed.run(client, parsed))
    except MaplessError as error:
        field = f" (field {error.field})" if error.field and error.field not in error.message else ""
        print(f"mapless: {error}{field}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except BrokenPipeError:  # the reader of our output has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAILED)
    except (OSError, ValueError) as error:
        print(f"mapless: {error}", file=sys.stderr)
        sys.exit(EXIT_USAGE)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    main()
