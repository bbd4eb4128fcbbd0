"""Parsers of the command line that suggest what was meant, and the flags that all commands have."""

from __future__ import annotations

import argparse
import difflib
import itertools
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..options import ConnectOptions
from ..shortcut import ADDRESS_VARIABLE, TOKEN_VARIABLE
from ..text_files import read_text

COMMON_DEFAULTS: dict[str, Any] = {
    "json": None,
    "timeout": 30.0,
    "connect_timeout": 2.0,
    "tls": False,
    "ca": None,
    "cert": None,
    "key": None,
    "token_file": None,
    "client_id": "",
}


class Parser(argparse.ArgumentParser):
    """A parser that suggests a known command, choice or flag in place of an unknown one."""

    commands: argparse._SubParsersAction[Any] | None = None

    def add_subparsers(self, **options: Any) -> argparse._SubParsersAction[Any]:
        """Remembers the commands; flags after a command belong to it."""
        self.commands = super().add_subparsers(**options)
        return self.commands

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Rejects unknown flags first; else a misspelt flag could be reported as a missing one."""
        args = sys.argv[1:] if args is None else list(args)
        ends = {"--", *(self.commands.choices if self.commands else ())}
        for flag in itertools.takewhile(lambda it: it not in ends, args):
            name = flag.partition("=")[0]
            if re.match("--[a-z]", name) and not any(it.startswith(name) for it in self._option_string_actions):
                self._exit_for(f"unknown flag {name}", name, self._option_string_actions)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Prints the message, without the usage of many lines, and exits."""
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        self._exit_for(message, *(wrong[1], re.findall(r"[\w-]+", wrong[2])) if wrong else ("", ()))

    def _exit_for(self, message: str, given: str, known: Iterable[str]) -> NoReturn:
        nearest = difflib.get_close_matches(given, list(known), 1)
        help_text = f"; did you mean {nearest[0]!r}?" if nearest else f"\n`{self.prog} --help` shows what it takes"
        self.exit(2, f"{self.prog}: error: {message}{help_text}\n")


class Gone(argparse.Action):
    """A flag of an earlier version: says what to use instead."""

    def __init__(self, instead: str, **options: Any) -> None:
        super().__init__(**options)
        self._instead = instead

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        """Exits with the message."""
        parser.exit(2, f"{parser.prog}: error: {self.option_strings[0]} is gone: {self._instead}\n")


class Command(Parser):
    """A command, which also accepts the common flags; they override those given before the command.

    With one of `instead_of_scene` among its flags, it takes no argument `scene`.
    """

    instead_of_scene: Sequence[str] = ()

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        add_common(self)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Decides, by the flags in front of "--", whether the argument `scene` is taken."""
        if not self.instead_of_scene:
            return super().parse_known_args(args, namespace)
        flags = [it.partition("=")[0] for it in itertools.takewhile(lambda it: it != "--", args or ())]
        instead = next((it for it in flags if it in self.instead_of_scene), "")
        scene = self._scene()
        scene.nargs, scene.default = (argparse.SUPPRESS, "") if instead else (None, None)
        namespace, left = super().parse_known_args(args, namespace)
        if instead and left:
            self.error(f"SCENE is not taken together with {instead}; left over: {' '.join(left)}")
        return namespace, left

    def format_help(self) -> str:
        """Shows the argument `scene` as one that can be left out; `parse_known_args` decides anew whether it is."""
        if self.instead_of_scene:
            self._scene().nargs = "?"
        return super().format_help()

    def _scene(self) -> argparse.Action:
        return next(it for it in self._actions if it.dest == "scene")


def all_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yields a parser and the parsers of its commands."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in dict.fromkeys(action.choices.values()):  # aliases name the same parser
                yield from all_parsers(child)


def connect_options(arguments: argparse.Namespace) -> ConnectOptions:
    """Options of the connection; raises OSError or ValueError for wrong flags or files."""
    # Not a flag of its own: all users of the machine can read a command line.
    token = read_text(arguments.token_file) if arguments.token_file else os.environ.get(TOKEN_VARIABLE)
    return ConnectOptions(
        timeout_s=arguments.timeout,
        connect_timeout_s=arguments.connect_timeout,
        tls=bool(arguments.tls or arguments.ca or arguments.cert),
        root_certificates=arguments.ca.read_bytes() if arguments.ca else None,
        client_certificate=arguments.cert.read_bytes() if arguments.cert else None,
        client_key=arguments.key.read_bytes() if arguments.key else None,
        token=token.strip() if token else None,
        client_id=arguments.client_id,
    )


def add_common(parser: argparse.ArgumentParser) -> None:
    """Adds flags without defaults, so that a command without them keeps the values given before it."""
    group = parser.add_argument_group("connection")

    def add(flag: str, **options: Any) -> None:
        group.add_argument(flag, default=argparse.SUPPRESS, **options)

    add(
        "--address",
        help="host:port of the server, or host1:port,host2:port of several that share a store "
        f"(default: that in {ADDRESS_VARIABLE}, or localhost:50051)",
    )
    add(
        "--timeout",
        type=float,
        help="of a call, seconds; until then it is repeated while the server is away, stops or is lost "
        f"(default: {COMMON_DEFAULTS['timeout']:g})",
    )
    add(
        "--connect-timeout",
        type=float,
        metavar="SECONDS",
        help="in which a server must be reached for the first time; scripts that outlive a restart give more "
        f"(default: {COMMON_DEFAULTS['connect_timeout']:g})",
    )
    add("--tls", action="store_true", help="encrypt; --ca and --cert imply it")
    add("--ca", type=Path, metavar="FILE", help="certificate that signed the server's, PEM (default: the system's)")
    add("--cert", type=Path, metavar="FILE", help="the client's certificate, PEM, if the server requires one")
    add("--key", type=Path, metavar="FILE", help="its key, PEM")
    add("--token-file", type=Path, metavar="FILE", help=f"holds the token (default: that in {TOKEN_VARIABLE})")
    add("--client-id", help="identifies this user among those of the token")
    group = parser.add_argument_group("printing")
    add("--json", action="store_const", const=True, help="JSON, on a terminal too")
    add("--text", action="store_const", const=False, dest="json", help="text, where standard output is no terminal too")
