"""`mapless-server` and `mapless` in this process, as a user runs them."""

import pytest
from typer.testing import CliRunner, Result

from mapless.__main__ import main
from mapless_tools.cli.app import app


def run(*arguments: object) -> Result:
    """The command's output, and its exit code."""
    return CliRunner().invoke(app, [*map(str, arguments)])


def refusal(*arguments: object) -> str:
    """The message for wrong arguments: one line beside what is in progress, exit code 2, and no result."""
    done = run(*arguments)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    (line,) = (line for line in done.stderr.strip().splitlines() if not line.startswith("reading scenes"))
    return line


def run_client(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, output and error output of `mapless`."""
    with pytest.raises(SystemExit) as caught:
        main([*map(str, arguments)])
    printed = capsys.readouterr()
    return int(caught.value.code or 0), printed.out, printed.err
