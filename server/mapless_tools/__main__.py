"""`mapless-server`, also `python -m mapless_tools`."""

import sys

from mapless_server.extras import install_hint


def main() -> None:
    """Runs the command line; if a package is missing, says how to install it."""
    try:
        from mapless_tools.cli.app import app

        app(prog_name="mapless-server")
    except ModuleNotFoundError as error:
        sys.exit(f"mapless-server: {install_hint(error)}")


if __name__ == "__main__":
    main()
