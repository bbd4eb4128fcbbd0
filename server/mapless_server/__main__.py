"""`python -m mapless_server [flags]` serves, as `mapless-server serve` does; it needs nothing of `mapless_tools`."""

import sys

from mapless_server.extras import install_hint


def main() -> None:
    """Runs the command; if a package that the server needs is missing, says how to install it."""
    try:
        import typer

        from mapless_server.serve.command import serve_command

        # A traceback with local variables would print image bytes and secrets.
        app = typer.Typer(add_completion=False, pretty_exceptions_show_locals=False)
        app.command()(serve_command)
        app(prog_name="python -m mapless_server")
    except ModuleNotFoundError as error:
        sys.exit(f"mapless-server: {install_hint(error)}")


if __name__ == "__main__":
    main()
