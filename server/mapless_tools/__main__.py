"""`mapless-server`, also `python -m mapless_tools`."""

import sys

from mapless_server.extras import install_hint


def main() -> None:
    """Run the command line; without what the server needs beyond the client, say how to get it."""
    try:
        from mapless_tools.cli.app import app

        app(prog_name="mapless-server")
    except ModuleNotFoundError as error:
        sys.exit(f"mapless-server: {install_hint(error)}")


if __name__ == "__main__":
    main()
