"""Text of operators: the file of settings, the environment, the address of the database.

Laws: a setting is read or refused with a ConfigError of printable lines; what is accepted is finite, within bounds; an
address of a database is refused in a line that could not hold it, since it may hold a password.
"""

import math
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from unittest.mock import patch

from mapless_server.security import assess_binding
from mapless_server.settings import PREFIX, ConfigError, LoadedSettings, Settings, load_settings
from mapless_server.store import StoreError, postgresql

from . import folders
from .target import Target

_FILE = "mapless.toml"
_PASSWORD = "hunter2"


@cache
def _folder() -> folders.Folder:
    return folders.Folder("settings")


def check(data: bytes) -> bool:
    """See Target."""
    kind, contents = folders.split(data)
    if kind % 3 == 0:
        folder = _folder()
        folder.write([_FILE], contents[:1])
        return _check_settings({}, lambda: load_settings({}, folder.path / _FILE))
    if kind % 3 == 1:
        return _check_settings(_environment(contents[0]), lambda: load_settings({}))
    return _check_database_url(contents[0].decode(errors="replace"))


def _environment(content: bytes) -> dict[str, str]:
    """Lines of names and values, as the operating system can hold them."""
    pairs = (line.partition("=") for line in os.fsdecode(content.replace(b"\0", b"")).split("\n"))
    return {f"{PREFIX}{name}": value for name, is_pair, value in pairs if is_pair and "CONFIG" not in name}


def _check_settings(environment: dict[str, str], load: Callable[[], LoadedSettings]) -> bool:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)}
    with patch.dict(os.environ, kept | environment, clear=True):
        try:
            loaded = load()
        except ConfigError as error:
            assert str(error)
            assert all(line.isprintable() for line in str(error).split("\n")), ascii(str(error))
            return False
    settings = loaded.settings
    assert set(loaded.origins) == set(Settings.model_fields)
    for name in Settings.model_fields:
        value = getattr(settings, name)
        assert not isinstance(value, float) or math.isfinite(value), (name, value)
        assert not isinstance(value, Path) or "\0" not in str(value), name
    assert settings.host.isprintable()
    assert 0 <= settings.port <= 65535
    assert settings.max_image_mib <= settings.max_message_mib
    assert (settings.tls_certificate is None) == (settings.tls_key is None)
    assert _PASSWORD not in str(loaded)
    assess_binding(settings, resolve=lambda _: [])
    return True


def _check_database_url(text: str) -> bool:
    try:
        url = postgresql.parse_url(text)
    except StoreError as error:
        assert str(error).isprintable()
        assert len(str(error)) < 200
        return False
    assert url.drivername == postgresql.DRIVER
    assert url.database
    assert "@" not in f"{url.host}{url.database}"
    assert str(url) == url.render_as_string(hide_password=True)
    return True


def seeds() -> list[bytes]:
    """Files, environments and addresses that are right."""
    files = [
        b'port = 0\nhost = "::1"\nmax_image_mib = 8\ncoverage = 0.9\n',
        b'tls_certificate = "a.pem"\ntls_key = "b.pem"\ntls_client_ca = "c.pem"\nreflection = false\n',
        b'database_url = "postgresql://u:hunter2@db:5432/mapless?sslmode=require"\nmax_queued_s = 1e3\n',
    ]
    environments = [b"PORT=1\nDEVICE=cuda:1\nLOG_LEVEL=debug", b"PORT=tcp://10.0.0.1:1\nSERVICE_HOST=1\nMETRICS=no"]
    urls = [
        b"postgresql://u:hunter2@db:5432/mapless?sslmode=require",
        b"postgres:///m?host=/run",
        b"postgresql://u@[::1]/m",
    ]
    return [*(b"\0" + it for it in files), *(b"\1" + it for it in environments), *(b"\2" + it for it in urls)]


TARGET = Target(
    seeds,
    check,
    folders.mutate,
    max_bytes=1024,
    words=tuple(f"{it} = ".encode() for it in Settings.model_fields)
    + tuple(f"{it.upper()}=".encode() for it in Settings.model_fields)
    + (b"postgresql://", b"postgresql+psycopg://", b"%40", b"inf", b"nan", b"[table]\n", b'"""'),
)
