"""`mapless-server` in this process, as a user runs it."""

from typer.testing import CliRunner, Result

from mapless_tools.cli.app import app


def run(*arguments: object) -> Result:
    """What it printed, and its exit code."""
    return CliRunner().invoke(app, [*map(str, arguments)])


def refusal(*arguments: object) -> str:
    """What is said of arguments that are wrong: one line beside what is in progress, exit code 2, and no result."""
    done = run(*arguments)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    (line,) = (line for line in done.stderr.strip().splitlines() if not line.startswith("reading scenes"))
    return line
