"""`mapless-server token`: create, list, revoke. A new token is printed alone, for programs, or written to a file."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mapless_server.serve.command import fail

from .printing import AsJson, printed_as_json

token_app = typer.Typer(help="Tokens that callers must have: create, list and revoke them.", no_args_is_help=True)

DEFAULT_TENANT = "default"
"""The default of `mapless_server.security`, whose import takes too long for --help; a test compares."""
_NAMED = 5
"""Scenes of a token that are shown in a line; JSON has all of them."""
TokensFile = Annotated[Path | None, typer.Option(help="The file of tokens; default: the server's setting.")]


Name = Annotated[str | None, typer.Argument(help="Name of the holder; unique, and the caller's name in the log.")]
NameFlag = Annotated[str | None, typer.Option("--name", help="The same as NAME.")]


@token_app.command("create")
def create_command(
    role: Annotated[str, typer.Option(help="Rights of the holder: read, localize (and read), or write (everything).")],
    name: Name = None,
    name_flag: NameFlag = None,
    tenant: Annotated[str, typer.Option(help="Tenant whose scenes the holder can access.")] = DEFAULT_TENANT,
    scene: Annotated[
        list[str] | None,
        typer.Option(help="Id of a scene that it is for; may be repeated; default: all of the tenant."),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(help="NAME=VALUE: it is for scenes with this label, or all of these, beside those of --scene."),
    ] = None,
    expires: Annotated[str | None, typer.Option(help="When it ends, 2027-01-01T00:00:00Z; default: never.")] = None,
    tokens_file: TokensFile = None,
    output: Annotated[
        Path | None, typer.Option(help="New file for the token, which its owner alone can read; default: print it.")
    ] = None,
) -> None:
    """Create a token and write or print it, once: the file of tokens has only its hash.

    With --scene or --label other scenes of the tenant do not exist for its holder.
    """
    from mapless_server.security import create_token, written_secret

    name = _one_name(name, name_flag)
    scenes, labels = _limits(scene or [], label or [])
    with _tokens_file(tokens_file) as path:
        ends = _read_time(expires) if expires else None
        create = partial(create_token, path, name, tenant, role, ends, scenes=scenes or None, labels=labels or None)
        if output is not None:
            with written_secret(output) as file:
                file.write(create() + "\n")
            typer.echo(f"the token {name!r} of tenant {tenant!r} is in {output}", err=True)
            return
        token = create()
    typer.echo(f"the token {name!r} of tenant {tenant!r}; it is not shown again:", err=True)
    print(token)


@token_app.command("list")
def list_command(tokens_file: TokensFile = None, as_json: AsJson = None) -> None:
    """Show all tokens with their roles, tenants, expiry, and the scenes that they are limited to."""
    from mapless_server.security import read_tokens

    with _tokens_file(tokens_file) as path:
        tokens = sorted(read_tokens(path).tokens, key=lambda token: (token.tenant, token.name))
    if printed_as_json(as_json, [it.model_dump(mode="json", exclude={"sha256"}) for it in tokens]):
        return
    now = datetime.now(timezone.utc)
    width = max((len(it.name) for it in tokens), default=0)
    for it in tokens:
        end = "never expires"
        if it.expires is not None:
            end = f"{'expired' if it.expires <= now else 'expires'} {it.expires.isoformat()}"
        print(f"{it.name:<{width}}  {it.role:<8}  tenant {it.tenant}  {end}{_limit(it.scenes or (), it.labels or {})}")


@token_app.command("revoke")
def revoke_command(name: Name = None, name_flag: NameFlag = None, tokens_file: TokensFile = None) -> None:
    """Remove a token; a running server rejects it about a second later."""
    from mapless_server.security import revoke_token

    name = _one_name(name, name_flag)
    with _tokens_file(tokens_file) as path:
        revoke_token(path, name)


def _one_name(name: str | None, flag: str | None) -> str:
    """The token's name, as an argument or with --name."""
    given = [it for it in (name, flag) if it]
    if len(given) != 1:
        fail("give the token one name, as an argument or with --name")
    return given[0]


@contextmanager
def _tokens_file(given: Path | None) -> Iterator[Path]:
    from mapless_server.security import SecurityError
    from mapless_server.settings import ConfigError, load_settings

    try:
        path = load_settings({"tokens_file": given}).settings.tokens_file
        if path is None:
            fail("no file of tokens: give --tokens-file, or set MAPLESS_TOKENS_FILE")
        yield path
    except ConfigError as error:
        fail(str(error))
    except SecurityError as error:
        fail(str(error), code=1)


def _limit(scenes: Sequence[str], labels: Mapping[str, str]) -> str:
    """The scenes that a token is limited to, in words; empty for all."""
    words = [", ".join(scenes[:_NAMED])] if scenes else []
    if len(scenes) > _NAMED:
        words.append(f"{len(scenes) - _NAMED} more")
    if labels:
        words.append(f"scenes with {', '.join(f'{name}={value}' for name, value in labels.items())}")
    return f"  only {' and '.join(words)}" if words else ""


def _limits(scenes: list[str], labels: list[str]) -> tuple[list[str], dict[str, str]]:
    """The ids of `--scene`, each once, and the labels of `--label`."""
    from mapless.labels import parse_labels
    from mapless.names import check_id

    try:
        for it in scenes:
            check_id(it)
    except ValueError as error:
        fail(f"--scene: {error}")
    try:
        return list(dict.fromkeys(scenes)), parse_labels(labels)
    except ValueError as error:
        fail(str(error))


def _read_time(text: str) -> datetime:
    from pydantic import AwareDatetime, TypeAdapter, ValidationError

    try:
        time: datetime = TypeAdapter(AwareDatetime).validate_strings(text)
    except ValidationError:
        fail(f"--expires takes a time with its zone, 2027-01-01T00:00:00Z, not {text!r}")
    if time <= datetime.now(timezone.utc):
        fail(f"--expires must be in the future, not {text}")
    return time
