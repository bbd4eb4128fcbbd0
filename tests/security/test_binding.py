"""No server without protection listens beyond this machine by accident."""

import asyncio
import logging
import re
from pathlib import Path
from typing import Any

import pytest

from mapless_server.security.binding import assess_binding, is_loopback, resolve_host
from mapless_server.serve.running import running_server
from mapless_server.serve.startup import StartupError
from mapless_server.settings import Settings

HOSTS = {
    "loopback": ["127.0.0.1", "127.8.8.8", "::1", "localhost", "::ffff:127.0.0.1", "127.1"],
    "beyond": ["0.0.0.0", "::", "192.168.1.7", "8.8.8.8", "fe80::1", "2001:db8::1", "::ffff:10.0.0.1", "0"],
}


@pytest.mark.parametrize(("kind", "host"), [(kind, host) for kind, hosts in HOSTS.items() for host in hosts])
def test_loopback_is_known_in_all_its_spellings(kind: str, host: str) -> None:
    assert is_loopback(host) is (kind == "loopback")


def test_a_name_is_loopback_only_if_all_its_addresses_are() -> None:
    addresses = {"one": ["127.0.0.1"], "both": ["127.0.0.1", "::1"], "mixed": ["127.0.0.1", "10.0.0.1"], "none": []}
    found = {host: is_loopback(host, addresses.__getitem__) for host in addresses}
    assert found == {"one": True, "both": True, "mixed": False, "none": False}


@pytest.mark.parametrize("name", ["no such name", "a" * 300, "name.invalid"])
def test_names_that_do_not_resolve_have_no_address(name: str) -> None:
    assert resolve_host(name) == []


@pytest.mark.parametrize("tls", ["", "tls", "tls client_certificates"])
@pytest.mark.parametrize("tokens", ["", "tokens"])
@pytest.mark.parametrize("insecure", ["", "insecure"])
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_no_protection_beyond_loopback_is_rejected(host: str, tls: str, tokens: str, insecure: str) -> None:
    level, _ = assess(host, f"{tls} {tokens} {insecure}")
    protected = tokens or "client_certificates" in tls or insecure
    assert (level == logging.CRITICAL) == (host == "0.0.0.0" and not protected)


@pytest.mark.parametrize(
    ("host", "flags", "level", "words"),
    [
        ("127.0.0.1", "", logging.INFO, "every user of this machine"),
        ("127.0.0.1", "tokens", logging.INFO, "^$"),
        ("127.0.0.1", "tls", logging.INFO, "^$"),
        ("0.0.0.0", "", logging.CRITICAL, "tokens_file, with tls_certificate.*tls_client_ca.*127.0.0.1.*insecure"),
        ("0.0.0.0", "tls", logging.CRITICAL, "TLS alone keeps nobody out.*tokens_file .mapless-server token.*insecure"),
        ("0.0.0.0", "insecure", logging.WARNING, "everybody who can reach"),
        ("0.0.0.0", "tokens", logging.WARNING, "in clear, unless a proxy"),
        ("0.0.0.0", "tls insecure", logging.WARNING, "TLS alone keeps nobody out"),
        ("0.0.0.0", "tls tokens", logging.INFO, "^$"),
        ("0.0.0.0", "tls client_certificates", logging.INFO, "^$"),
    ],
)
def test_the_log_names_what_is_unprotected(host: str, flags: str, level: int, words: str) -> None:
    assessed, sentence = assess(host, flags)
    assert assessed == level
    assert re.search(words, sentence)


def assess(host: str, flags: str) -> tuple[int, str]:
    file = Path("file")
    given: dict[str, Any] = {"insecure": "insecure" in flags, "tokens_file": file if "tokens" in flags else None}
    if "tls" in flags:
        given |= {"tls_certificate": file, "tls_key": file}
    if "client_certificates" in flags:
        given["tls_client_ca"] = file
    return assess_binding(Settings(host=host, **given))


def test_a_rejected_start_makes_no_store(tmp_path: Path) -> None:
    settings = Settings(host="0.0.0.0", data_dir=tmp_path / "data")

    async def start() -> None:
        async with running_server(settings):
            pass

    with pytest.raises(StartupError, match="insecure"):
        asyncio.run(start())
    assert not (tmp_path / "data").exists()
