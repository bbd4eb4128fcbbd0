"""The output of commands: text on a terminal, else JSON; flags decide otherwise."""

import json
import sys
from typing import Annotated, Any

import typer

AsJson = Annotated[bool | None, typer.Option("--json/--text", help="What is printed; default: text on a terminal.")]


def printed_as_json(given: bool | None, value: Any) -> bool:
    """Prints a value as JSON if the flag or the rule says so; returns whether it did."""
    is_json = given if given is not None else not sys.stdout.isatty()
    if is_json:
        print(json.dumps(value, indent=2, default=str))
    return is_json
