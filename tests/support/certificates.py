"""Certificates for tests: an authority, and what it signs for servers and clients."""

import ipaddress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from mapless import ConnectOptions

DAY = timedelta(days=1)


@dataclass(frozen=True)
class Pair:
    """A certificate and its key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @property
    def certificate_pem(self) -> bytes:
        return self.certificate.public_bytes(Encoding.PEM)

    @property
    def key_pem(self) -> bytes:
        return self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())

    def write(self, certificate: Path, key: Path) -> None:
        certificate.write_bytes(self.certificate_pem)
        key.write_bytes(self.key_pem)


def options_of(client: Pair | None = None, root: Pair | None = None, **more: Any) -> ConnectOptions:
    """Options of a client with this certificate that trusts this root, and tries once."""
    return ConnectOptions(
        timeout_s=10,
        max_attempts=1,
        tls=True,
        root_certificates=root.certificate_pem if root else None,
        client_certificate=client.certificate_pem if client else None,
        client_key=client.key_pem if client else None,
        **more,
    )


def authority(name: str = "authority") -> Pair:
    """An authority that everything else is signed by."""
    return _make(name, None, -DAY, DAY)


def signed(by: Pair, name: str, begins: timedelta = -DAY, ends: timedelta = DAY) -> Pair:
    """A certificate for localhost and 127.0.0.1, valid from and until so long from now."""
    return _make(name, by, begins, ends)


def _make(name: str, by: Pair | None, begins: timedelta, ends: timedelta) -> Pair:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(timezone.utc)
    names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(by.certificate.subject if by else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begins)
        .not_valid_after(now + ends)
        .add_extension(x509.BasicConstraints(ca=by is None, path_length=None), critical=True)
    )
    if by:
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return Pair(builder.sign((by.key if by else key), hashes.SHA256()), key)
