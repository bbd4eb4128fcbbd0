"""`python -m mapless_server serve` is `mapless-server serve`; it needs nothing of `mapless_tools`."""

import sys

from mapless_server.extras import install_hint


def main() -> None:
    """Runs the command; if a package that the server needs is missing, says how to install it."""
    try:
        import typer

        from mapless_server.serve.command import serve_command

        # A traceback with local variables would print image bytes and secrets.
        app = typer.Typer(add_completion=False, pretty_exceptions_show_locals=False, no_args_is_help=True)
        app.callback()(lambda: None)  # makes it a group, so that `serve` is named
        app.command("serve")(serve_command)
        app(prog_name="python -m mapless_server")
    except ModuleNotFoundError as error:
        sys.exit(f"mapless-server: {install_hint(error)}")


if __name__ == "__main__":
    main()
