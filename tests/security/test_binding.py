"""Nothing that protects nobody listens beyond this machine by accident."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from mapless_server.security.binding import Advice, Verdict, advise, is_loopback, resolve_host
from mapless_server.serve.assembly import StartupError
from mapless_server.serve.running import running_server
from mapless_server.settings import Settings

HOSTS = {
    "loopback": ["127.0.0.1", "127.8.8.8", "::1", "localhost", "::ffff:127.0.0.1", "127.1"],
    "beyond": ["0.0.0.0", "::", "192.168.1.7", "8.8.8.8", "fe80::1", "2001:db8::1", "::ffff:10.0.0.1", "0"],
}


@pytest.mark.parametrize("host", HOSTS["loopback"])
def test_loopback_in_all_its_spellings(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize("host", HOSTS["beyond"])
def test_everything_else_is_beyond(host: str) -> None:
    assert not is_loopback(host)


def test_a_name_is_loopback_only_if_all_its_addresses_are() -> None:
    addresses = {"one": ["127.0.0.1"], "both": ["127.0.0.1", "::1"], "mixed": ["127.0.0.1", "10.0.0.1"], "none": []}
    found = {host: is_loopback(host, addresses.__getitem__) for host in addresses}
    assert found == {"one": True, "both": True, "mixed": False, "none": False}


@pytest.mark.parametrize("name", ["no such name", "a" * 300, "name.invalid"])
def test_names_that_do_not_resolve_have_no_address(name: str) -> None:
    assert resolve_host(name) == []


def advice_for(host: str, flags: str) -> Advice:
    tls, client_certificates, tokens, insecure = (
        flag in flags.split() for flag in ("tls", "client_certificates", "tokens", "insecure")
    )
    return advise(host, tls=tls, client_certificates=client_certificates, tokens=tokens, insecure=insecure)


@pytest.mark.parametrize("tls", ["", "tls", "tls client_certificates"])
@pytest.mark.parametrize("tokens", ["", "tokens"])
@pytest.mark.parametrize("insecure", ["", "insecure"])
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_what_strangers_could_reach_is_refused_unless_wanted(host: str, tls: str, tokens: str, insecure: str) -> None:
    refused = host == "0.0.0.0" and not (tls or tokens or insecure)
    assert (advice_for(host, f"{tls} {tokens} {insecure}").verdict is Verdict.REFUSED) == refused


@pytest.mark.parametrize(
    ("host", "flags", "verdict", "words"),
    [
        ("127.0.0.1", "", Verdict.FINE, "everybody on this machine"),
        ("127.0.0.1", "tokens", Verdict.FINE, ""),
        ("127.0.0.1", "tls", Verdict.FINE, ""),
        ("0.0.0.0", "", Verdict.REFUSED, "tls_certificate and tls_key or tokens_file.*127.0.0.1.*insecure"),
        ("0.0.0.0", "insecure", Verdict.WARNING, "everybody who can reach"),
        ("0.0.0.0", "tokens", Verdict.WARNING, "in clear, unless a proxy"),
        ("0.0.0.0", "tls", Verdict.WARNING, "neither tokens nor clients' certificates"),
        ("0.0.0.0", "tls tokens", Verdict.FINE, "^$"),
        ("0.0.0.0", "tls client_certificates", Verdict.FINE, "^$"),
    ],
)
def test_what_is_said(host: str, flags: str, verdict: Verdict, words: str) -> None:
    advice = advice_for(host, flags)
    assert advice.verdict is verdict

    assert re.search(words, advice.sentence)


def test_a_refused_start_leaves_no_store_behind(tmp_path: Path) -> None:
    settings = Settings(host="0.0.0.0", data_dir=tmp_path / "data")

    async def start() -> None:
        async with running_server(settings):
            pass

    with pytest.raises(StartupError, match="insecure"):
        asyncio.run(start())
    assert not (tmp_path / "data").exists()
