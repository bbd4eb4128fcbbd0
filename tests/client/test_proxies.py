"""The addresses a proxy of the environment is used for, and how an error names it."""

import pytest

from mapless import Client, ConnectOptions, Unavailable
from mapless.addresses import addresses_of, is_loopback
from mapless.proxies import Proxy, is_exempt, proxy_of

PROXY = "http://127.0.0.1:9"


@pytest.fixture(autouse=True)
def _none(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("grpc_proxy", "https_proxy", "http_proxy", "no_grpc_proxy", "no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(
    "address",
    ["localhost:1", "LocalHost.", "127.0.0.1:50051", "127.9.9.9", "127.1:80", "[::1]:50051", "::1", "vps.localhost:1"]
    + ["unix:/run/mapless.sock", "unix-abstract:mapless", "ipv4:127.0.0.1:1,127.0.0.1:2", "ipv6:[::1]:1"]
    + ["dns:///localhost:1", "[::ffff:127.0.0.1]:1", "0.0.0.0:50051"],
)
def test_this_machine_is_never_reached_through_a_proxy(address: str) -> None:
    assert is_loopback(address)
    assert proxy_of(address, {"http_proxy": PROXY}) is None


@pytest.mark.parametrize(
    "address", ["localhost.example:1", "128.0.0.1:1", "dns:///mapless:1", "ipv4:127.0.0.1:1,10.0.0.1:2"]
)
def test_other_addresses_are_reached_through_it(address: str) -> None:
    assert proxy_of(address, {"http_proxy": PROXY}) == Proxy("http_proxy", "127.0.0.1:9")


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        (
            {"grpc_proxy": "http://a:1", "https_proxy": "http://b:2", "http_proxy": "http://c:3"},
            Proxy("grpc_proxy", "a:1"),
        ),
        ({"https_proxy": "http://u:secret@b:2/"}, Proxy("https_proxy", "b:2")),
        ({"grpc_proxy": "", "http_proxy": "http://c:3"}, None),
        ({"http_proxy": "https://c:3"}, None),
        ({"HTTP_PROXY": "http://c:3"}, None),
        ({}, None),
    ],
)
def test_the_proxy_is_the_one_that_grpc_uses(environment: dict[str, str], expected: Proxy | None) -> None:
    assert proxy_of("vps.example:50051", environment) == expected


@pytest.mark.parametrize(
    ("entries", "address", "is_one"),
    [
        ("*", "vps.example:1", True),
        ("vps.example", "vps.example:1", True),
        ("VPS.Example", "vps.example.:1", True),
        ("example", "vps.example:1", True),
        (".example", "vps.example:1", True),
        (".vps.example", "vps.example:1", True),
        ("*.example", "vps.example:1", True),
        ("ps.example", "vps.example:1", False),
        ("a, b vps.example", "vps.example:1", True),
        ("vps.example:1", "vps.example:1", True),
        ("vps.example:2", "vps.example:1", False),
        ("10.0.0.0/8", "10.1.2.3:1", True),
        ("10.0.0.0/8", "11.1.2.3:1", False),
        ("10.1.2.3", "10.1.2.3:1", True),
        ("2.3", "10.1.2.3:1", False),
        ("10.1.2.3:1", "10.1.2.3:1", True),
        ("fd00::/8", "[fd00::7]:1", True),
        ("[fd00::7]:1", "[fd00::7]:1", True),
        ("fd00::7", "[fd00::7]:1", True),
        ("fd00::7", "[fd00::8]:1", False),
        ("vps.example", "dns:///vps.example:1", True),
        ("nonsense/9,:,", "vps.example:1", False),
    ],
)
def test_no_proxy_has_its_usual_forms(entries: str, address: str, is_one: bool) -> None:
    for name in ("no_grpc_proxy", "no_proxy", "NO_PROXY"):
        assert is_exempt(address, {name: entries}) is is_one


def test_an_error_names_the_proxy_and_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", PROXY)
    with Client("vps.invalid:50051", ConnectOptions(max_attempts=1)) as client, pytest.raises(Unavailable) as caught:
        client.get_scene("hall")
    assert caught.value.message == (
        "cannot connect to vps.invalid:50051 through the proxy 127.0.0.1:9 (the environment's http_proxy; no_proxy "
        "exempts hosts): no proxy listens there (connection refused)"
    )


def test_several_addresses_are_split_once() -> None:
    assert addresses_of("a:1, b:2,a:1") == ("a:1", "b:2")
    assert addresses_of("ipv4:127.0.0.1:1,127.0.0.1:2") == ("ipv4:127.0.0.1:1,127.0.0.1:2",)
    for wrong in ("a:1,", "a:1,http://b:2", "a:1,ipv4:127.0.0.1:1", "a:0,b:1"):
        with pytest.raises(ValueError, match="address"):
            addresses_of(wrong)
