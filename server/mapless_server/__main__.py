"""`mapless-server`, also `python -m mapless_server`."""

import sys


def main() -> None:
    """Run the command line; without what the server needs beyond the client, say how to get it."""
    try:
        from .cli import app

        app(prog_name="mapless-server")
    except ModuleNotFoundError as error:
        sys.exit(f"mapless-server: {error}; is it installed with its extra? pip install 'mapless[server]'")


if __name__ == "__main__":
    main()
