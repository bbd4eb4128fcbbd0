"""The file of tokens: names, tenants, roles and hashes, never the tokens themselves.

A token is 32 random bytes, so a plain SHA-256 is enough: slow hashes are for passwords, which can be guessed. The file
is JSON, which programs can read and write:

    {"tokens": [{"name": "robot-7", "tenant": "acme", "role": "localize", "sha256": "...",
                 "expires": "2027-01-01T00:00:00Z", "scenes": ["lobby"], "labels": {"site": "a"}}],
     "tenants": {"acme": {"rate_ms": 500}}}
"""

import fcntl
import logging
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TextIO

from pydantic import ValidationError

from mapless.text_files import decode_text

from .access import Token, Tokens, sha256_of
from .reloading import SecurityError, read_file

PREFIX = "mapless_"
"""First characters of every token, by which scanners for leaked secrets find it."""

_TOKEN_BYTES = 32
_FILE_MODE = 0o600
_OF_OTHERS = 0o006

log = logging.getLogger(__name__)


def read_tokens(path: Path) -> Tokens:
    """Reads the file of tokens; SecurityError if it cannot be read or is malformed."""
    try:
        return Tokens.model_validate_json(decode_text(read_file(path), str(path)))
    except ValidationError as error:
        raise SecurityError(f"{path}: {_describe(error)}") from None
    except ValueError as error:
        raise SecurityError(str(error)) from None


def create_token(
    path: Path,
    name: str,
    tenant: str,
    role: str,
    expires: datetime | None,
    *,
    scenes: Sequence[str] | None = None,
    labels: Mapping[str, str] | None = None,
) -> str:
    """Creates a token and adds its hash to the file, which is created if missing; returns the token.

    With `scenes` or `labels` it is limited to the scenes of these ids, and to those with all of these labels.
    SecurityError if the name is taken, a value is wrong, or the file cannot be read or written.
    """
    token = PREFIX + secrets.token_urlsafe(_TOKEN_BYTES)
    fields: dict[str, object] = {"name": name, "tenant": tenant, "role": role, "sha256": sha256_of(token)}
    fields |= {"expires": expires, "scenes": scenes, "labels": labels}
    try:
        new = Token.model_validate(fields)
    except ValidationError as error:
        raise SecurityError(_describe(error)) from None
    with _changing(path) as file:
        old = read_tokens(file) if file.exists() else Tokens()
        if any(it.name == name for it in old.tokens):
            raise SecurityError(f"a token of the name {name!r} exists already; revoke it first, or use another name")
        _write(file, Tokens(tokens=(*old.tokens, new), tenants=old.tenants))
    return token


@contextmanager
def written_secret(path: Path) -> Iterator[TextIO]:
    """Opens a new file that its owner alone can read; it is removed again if the block raises.

    SecurityError if there is a file of this name, or it cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _FILE_MODE)
    except FileExistsError:
        raise SecurityError(f"{path} exists already, and is not overwritten") from None
    except OSError as error:
        raise SecurityError(f"{path}: {error.strerror}") from error
    try:
        with open(descriptor, "w", encoding="utf-8") as file:
            yield file
            file.flush()
            os.fsync(descriptor)
    except BaseException as error:
        os.unlink(path)
        if isinstance(error, OSError):
            raise SecurityError(f"{path}: {error.strerror}") from error
        raise


def warn_of_readers(path: Path) -> None:
    """Logs a warning if others than its owner and group can read a file of secrets, or others can write it."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return  # reading it raises the error
    if mode & _OF_OTHERS:
        log.warning("%s can be read or changed by every user of this machine (mode %o): chmod 600", path, mode & 0o777)


def revoke_token(path: Path, name: str) -> None:
    """Removes a token from the file; a running server rejects it about a second later.

    SecurityError if no token has this name, or the file cannot be read or written.
    """
    with _changing(path) as file:
        old = read_tokens(file)
        kept = tuple(it for it in old.tokens if it.name != name)
        if len(kept) == len(old.tokens):
            raise SecurityError(f"no token has the name {name!r}")
        _write(file, Tokens(tokens=kept, tenants=old.tenants))


def _describe(error: ValidationError) -> str:
    """Describes the first fault without its value, which may be a token in the place of its hash."""
    fault = error.errors()[0]
    where = ascii(".".join(map(str, fault["loc"])))[1:-1]  # names in the file may be anything
    what = fault["msg"].removeprefix("Value error, ")
    return f"{where}: {what}" if where else what


@contextmanager
def _changing(path: Path) -> Iterator[Path]:
    """Locks the file, with links resolved, against other commands; SecurityError if that fails."""
    file = path.resolve()
    try:
        folder = os.open(file.parent, os.O_RDONLY)
    except OSError as error:
        raise SecurityError(f"{file.parent}: {error.strerror}") from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield file
    except OSError as error:
        raise SecurityError(f"{file}: {error.strerror}") from error
    finally:
        os.close(folder)


def _write(file: Path, tokens: Tokens) -> None:
    """Replaces the file atomically."""
    new = file.with_name(f".{file.name}.{secrets.token_hex(4)}")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _FILE_MODE)
    try:
        with open(descriptor, "w", encoding="utf-8") as stream:
            if file.exists() and os.geteuid() == 0:  # the server, which is not root, must be able to read it
                os.fchown(descriptor, file.stat().st_uid, file.stat().st_gid)
            stream.write(tokens.model_dump_json(indent=2, exclude_none=True) + "\n")
            stream.flush()
            os.fsync(descriptor)
        os.replace(new, file)
    except BaseException:
        os.unlink(new)
        raise
