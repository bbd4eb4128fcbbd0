"""Time that a connection gets to be ready for calls: TLS with slow links, and with many clients at once."""

import asyncio
import ipaddress
import ssl
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone

import grpc
import grpc.aio
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from .page import Measurement, Row

LIMITS_S = (1.0, 3.0, 10.0, 30.0)
ROUND_TRIPS_S = (0.1, 0.6, 1.5, 4.0)
"""A mobile link; a geostationary satellite; a link that queues for a second; one that loses packets, too."""
AT_ONCE = 400
_GIVEN_UP_S = 40.0


@dataclass(frozen=True)
class _Pair:
    """A certificate for localhost and its key, PEM."""

    certificate: bytes
    key: bytes


def _self_signed() -> _Pair:
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(timezone.utc)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    names = x509.SubjectAlternativeName([x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number()).add_extension(names, critical=False)
    builder = builder.not_valid_before(now - timedelta(days=1)).not_valid_after(now + timedelta(days=1))
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
    certificate = builder.sign(key, hashes.SHA256())
    written = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return _Pair(certificate.public_bytes(Encoding.PEM), written)


@asynccontextmanager
async def _serving(pair: _Pair, limit_s: float) -> AsyncIterator[int]:
    """The port of a server with this limit."""
    server = grpc.aio.server(options=[("grpc.server_handshake_timeout_ms", round(1000 * limit_s))])
    port = server.add_secure_port("127.0.0.1:0", grpc.ssl_server_credentials([(pair.key, pair.certificate)]))
    await server.start()
    try:
        yield port
    finally:
        await server.stop(0)


@asynccontextmanager
async def _delayed(port: int, delay_s: float) -> AsyncIterator[tuple[int, list[int]]]:
    """The port of a relay to another port that delays each way, and one entry for each connection so far."""
    accepted: list[int] = []
    loop = asyncio.get_running_loop()

    async def pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            loop.call_later(delay_s, writer.write, data)
        loop.call_later(delay_s, writer.close)

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        accepted.append(1)
        with suppress(OSError, asyncio.CancelledError):  # the end of the loop cancels it
            there, back = await asyncio.open_connection("127.0.0.1", port)
            await asyncio.gather(pass_on(reader, back), pass_on(there, writer))

    server = await asyncio.start_server(relay, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1], accepted


async def _ready_s(pair: _Pair, limit_s: float, round_trip_s: float) -> float | None:
    """Seconds until the first connection is ready; None if it is ended before."""
    credentials = grpc.ssl_channel_credentials(pair.certificate)
    async with _serving(pair, limit_s) as port, _delayed(port, round_trip_s / 2) as (relay, accepted):
        begin_s = asyncio.get_running_loop().time()
        async with grpc.aio.secure_channel(f"localhost:{relay}", credentials) as channel:
            ready = asyncio.ensure_future(channel.channel_ready())
            while not ready.done() and len(accepted) < 2:
                await asyncio.sleep(0.02)
                if asyncio.get_running_loop().time() - begin_s > _GIVEN_UP_S:
                    break
            is_ready = ready.done() and len(accepted) == 1
            ready.cancel()
            return asyncio.get_running_loop().time() - begin_s if is_ready else None


async def _ready_at_once(pair: _Pair, limit_s: float) -> int:
    """How many clients that shake hands at once become ready."""
    context = ssl.create_default_context(cadata=pair.certificate.decode())
    context.set_alpn_protocols(["h2"])

    async def is_ready(port: int) -> bool:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=context, ssl_handshake_timeout=60)
            writer.write(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0)))
            heard = await reader.read(100)
            writer.close()
        except OSError:
            return False
        return bool(heard)

    async with _serving(pair, limit_s) as port:
        return sum(await asyncio.gather(*(is_ready(port) for _ in range(AT_ONCE))))


def _rows() -> Iterator[Row]:
    pair = _self_signed()
    for limit_s in LIMITS_S:
        row: dict[str, object] = {"limit": f"{limit_s:g} s"}
        for round_trip_s in ROUND_TRIPS_S:
            seconds = asyncio.run(_ready_s(pair, limit_s, round_trip_s))
            row[f"round trip {round_trip_s:g} s"] = "ended" if seconds is None else f"ready, {seconds:.1f} s"
        row[f"{AT_ONCE} at once"] = asyncio.run(_ready_at_once(pair, limit_s))
        yield row | {"strangers in a second": f"{768 / limit_s:.0f}"}


MEASUREMENTS = {"handshake": Measurement(lambda scenes: _rows(), needs_scenes=False)}
