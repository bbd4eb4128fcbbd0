"""The rule of what commands print: text on a terminal, JSON where standard output is none; flags decide otherwise."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Any

import typer

AsJson = Annotated[bool | None, typer.Option("--json/--text", help="What is printed; default: text on a terminal.")]


def printed_as_json(given: bool | None, value: Any) -> bool:
    """Prints a value as JSON if that is to be, by the flag or the rule; returns whether it was."""
    is_json = given if given is not None else not sys.stdout.isatty()
    if is_json:
        print(json.dumps(value, indent=2, default=str))
    return is_json
