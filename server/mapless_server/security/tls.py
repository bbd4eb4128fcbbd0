"""The server's certificate and key, and the authority of clients' certificates, read from files that may change.

Open connections are not affected by a change; new ones get the new certificate.
"""

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import grpc
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import dsa, ec, ed448, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509.oid import PublicKeyAlgorithmOID

from mapless.pem import without_marks

from .reloading import Reloading, SecurityError, read_file

log = logging.getLogger(__name__)

_CURVES = ("secp256r1", "secp384r1")
_LEAST_RSA_BITS, _USUAL_RSA_BITS = 1024, 2048
"""Least bits of an RSA key: gRPC's TLS takes 1024, OpenSSL with its usual level of security 2048."""
_USABLE = "make a key on the curve P-256 (openssl ecparam -name prime256v1 -genkey) or of RSA with 2048 bits or more"


@dataclass(frozen=True)
class TlsFiles:
    """Paths of PEM files: the server's chain, its own certificate first, its key, and the authorities of clients.

    Without `client_ca` clients need no certificate.
    """

    certificate: Path
    key: Path
    client_ca: Path | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The paths that are set."""
        return (self.certificate, self.key) + ((self.client_ca,) if self.client_ca else ())


@dataclass(frozen=True)
class TlsMaterial:
    """The PEM contents of the files, and the time when the server's certificate expires."""

    certificate: bytes
    key: bytes
    client_ca: bytes | None
    expires: datetime

    def __repr__(self) -> str:
        """Omits the key."""
        return f"TlsMaterial(expires={self.expires})"


def read_material(files: TlsFiles) -> TlsMaterial:
    """Reads the contents of the files.

    SecurityError if a file is missing or not PEM, the key is not the certificate's or of a kind that gRPC's clients do
    not take, or the certificate is not valid now. Byte order marks are left out.
    """
    certificate, key = (without_marks(read_file(it)) for it in (files.certificate, files.key))
    client_ca = without_marks(read_file(files.client_ca)) if files.client_ca else None
    own = _certificates(certificate, files.certificate)[0]
    _check_kind(own, files.certificate)
    if _public_key_of(key, files.key) != _certified_key(own, files.certificate):
        raise SecurityError(f"the key {files.key} is not that of the first certificate in {files.certificate}")
    _check_time(own, files.certificate)
    if client_ca is not None and files.client_ca is not None:
        _certificates(client_ca, files.client_ca)
    return TlsMaterial(certificate, key, client_ca, own.not_valid_after_utc)


class Tls:
    """The server's TLS; `refresh` reads changed files."""

    def __init__(self, files: TlsFiles) -> None:
        """Raises SecurityError if the files cannot be used."""
        self._require_client_certificates = files.client_ca is not None
        self._material = Reloading(files.paths, lambda: read_material(files), "certificates")

    @property
    def expiry_s(self) -> float:
        """Time when the certificate in use expires, seconds since 1970."""
        return self._material.value.expires.timestamp()

    def refresh(self) -> bool:
        """See `Reloading.refresh`."""
        return self._material.refresh()

    def server_credentials(self) -> grpc.ServerCredentials:
        """Credentials for `add_secure_port`; they follow changes of the files."""
        lock, in_use = threading.Lock(), self._material.value

        def fetch() -> grpc.ServerCertificateConfiguration | None:
            """The current certificate, None if unchanged; grpc calls this for every connection, in its own threads."""
            nonlocal in_use
            with lock:
                if self._material.value is in_use:
                    return None
                in_use = self._material.value
                return _configuration(in_use)

        credentials: grpc.ServerCredentials = grpc.dynamic_ssl_server_credentials(
            _configuration(in_use), fetch, self._require_client_certificates
        )
        return credentials


def _configuration(material: TlsMaterial) -> grpc.ServerCertificateConfiguration:
    pair = (material.key, material.certificate)
    made: grpc.ServerCertificateConfiguration = grpc.ssl_server_certificate_configuration([pair], material.client_ca)
    return made


def _certificates(data: bytes, path: Path) -> Sequence[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(data)
    except ValueError as error:
        raise SecurityError(f"{path} holds no certificate in PEM form") from error


def _check_kind(certificate: x509.Certificate, path: Path) -> None:
    """Raises SecurityError for a kind of key with which nobody can connect; warns of what only some clients take.

    gRPC's TLS is BoringSSL: its clients verify signatures on P-256 and P-384 and of RSA, and its servers cannot load
    others but P-521 and Ed25519.
    """
    try:
        key = certificate.public_key()
    except (ValueError, UnsupportedAlgorithm) as error:
        raise SecurityError(f"the certificate {path} is for a key of an unknown kind; {_USABLE}") from error
    kinds = {ed25519.Ed25519PublicKey: "Ed25519", ed448.Ed448PublicKey: "Ed448", dsa.DSAPublicKey: "DSA"}
    kind = next((name for each, name in kinds.items() if isinstance(key, each)), "")
    if isinstance(key, ec.EllipticCurvePublicKey) and key.curve.name not in _CURVES:
        kind = f"the curve {key.curve.name}"
    if isinstance(key, rsa.RSAPublicKey):
        if certificate.public_key_algorithm_oid == PublicKeyAlgorithmOID.RSASSA_PSS:
            kind = "RSASSA-PSS"
        elif key.key_size < _LEAST_RSA_BITS:
            kind = f"RSA with {key.key_size} bits"
        elif key.key_size < _USUAL_RSA_BITS:
            log.warning("the key of the certificate %s has %d bits: some clients refuse it", path, key.key_size)
    if kind:
        raise SecurityError(
            f"the key of the certificate {path} is of a kind that clients of gRPC do not accept ({kind}); {_USABLE}"
        )
    if not _has_names(certificate):
        log.warning("the certificate %s has no subjectAltName: Go's clients and browsers refuse it", path)


def _has_names(certificate: x509.Certificate) -> bool:
    try:
        return bool(list(certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value))
    except (x509.ExtensionNotFound, ValueError):
        return False


def _check_time(certificate: x509.Certificate, path: Path) -> None:
    """Raises SecurityError if the certificate is not valid now."""
    begins, ends, now = certificate.not_valid_before_utc, certificate.not_valid_after_utc, datetime.now(timezone.utc)
    if ends <= now:
        raise SecurityError(f"the certificate {path} expired at {ends.isoformat()}")
    if begins > now:
        raise SecurityError(f"the certificate {path} is not valid before {begins.isoformat()}")


def _certified_key(certificate: x509.Certificate, path: Path) -> bytes:
    """The certificate's public key, DER."""
    try:
        return certificate.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise SecurityError(f"the certificate {path} is for a key of an unknown kind") from error


def _public_key_of(data: bytes, path: Path) -> bytes:
    """The public key that belongs to a private key, DER."""
    try:
        key = load_pem_private_key(data, password=None)
    except TypeError as error:
        raise SecurityError(f"the key {path} is encrypted; the server cannot ask for its password") from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise SecurityError(f"{path} holds no private key in PEM form") from error
    return key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
