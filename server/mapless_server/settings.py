"""What an operator can set: by flag, environment (MAPLESS_...), file (TOML) or default; the first that says it wins."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

PREFIX = "MAPLESS_"
CONFIG_VARIABLE = "MAPLESS_CONFIG"
CLIENT_TOKEN_VARIABLE, CLIENT_ADDRESS_VARIABLE = "MAPLESS_TOKEN", "MAPLESS_ADDRESS"
"""The client's, which may run in the same environment."""

# Kubernetes sets these in every pod that has a service called "mapless" beside it; MAPLESS_PORT is then "tcp://...".
_SERVICE_LINKS = re.compile(r"MAPLESS_SERVICE_(HOST|PORT.*)|MAPLESS_PORT_\d+_.*")
_SERVICE_LINK_VALUE = "tcp://"
_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")


class ConfigError(Exception):
    """A setting is wrong; the message is for the operator."""


def available_cores() -> int:
    """Cores that this process may use, which in a container are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_weights_dir() -> Path:
    """The user's cache folder, since weights can be fetched again; without one, a folder beside the store."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(cache):  # the XDG specification: a relative one is to be ignored
        cache = os.path.expanduser("~/.cache")
    return Path(cache) / "mapless" / "weights" if os.path.isabs(cache) else Path("mapless-weights")


class Settings(BaseSettings):
    """All settings of the server; frozen, and a name that is not here is an error wherever it stands."""

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", env_prefix=PREFIX, validate_default=True, allow_inf_nan=False
    )

    host: str = Field(default="127.0.0.1", min_length=1, description="Address to listen on; 0.0.0.0 for all.")
    port: int = Field(default=50051, ge=0, le=65535, description="Port to listen on; 0 for any free one.")
    data_dir: Path = Field(
        default=Path("mapless-data"), description="Folder of the store, on a local disk; as a flag, above database_url."
    )
    database_url: SecretStr | None = Field(
        default=None,
        description="Of a PostgreSQL that several servers share, postgresql://user:password@host/name; else data_dir.",
    )
    backend: str = Field(
        default="geometric",
        description="What does the coarse stage: geometric, pi3, pi3x (both non-commercial), or auto.",
    )
    features: str = Field(
        default="sift",
        description="Local features: sift, aliked, xfeat, superpoint (research only), or auto.",
    )
    device: str = Field(default="auto", description="What networks run on: auto, cpu, cuda or cuda:N.")
    weights_dir: Path = Field(default_factory=default_weights_dir, description="Folder of the networks' weights.")
    compiled_views: int = Field(
        default=0,
        ge=0,
        le=65,
        description="Photographs of a query, itself among them, that a network is compiled for at the start; 0: none.",
    )
    workers: int = Field(default_factory=available_cores, ge=1, description="Threads that compute; default: all cores.")
    max_batch: int = Field(default=4, ge=1, le=64, description="Queries a network reconstructs at a time.")
    max_queued_s: float = Field(
        default=2.0, gt=0, description="Predicted computing time that may be admitted and not done, seconds a worker."
    )
    max_queued_mib: int = Field(default=256, ge=1, description="Memory for photographs of calls in progress, MiB.")
    stall_limit_s: float = Field(
        default=120.0, gt=0, description="A step that computes longer has hung; the server then ends, seconds."
    )
    tenant_rate_ms: float = Field(
        default=0.0, ge=0, description="Computing time a tenant may use, milliseconds a second; 0: no limit."
    )
    tenant_burst_ms: float = Field(
        default=20_000.0, gt=0, description="Computing time that a tenant may save up, milliseconds."
    )
    default_deadline_s: float = Field(
        default=30.0, gt=0, description="Time for calls that come without a deadline, seconds."
    )
    max_deadline_s: float = Field(default=600.0, gt=0, description="Calls with a later deadline get this one, seconds.")
    max_message_mib: int = Field(default=32, ge=1, le=1024, description="Largest message, either way, MiB.")
    max_image_mib: int = Field(default=16, ge=1, description="Largest image file, MiB.")
    max_image_megapixels: float = Field(default=50.0, gt=0, le=268, description="Largest image, width times height.")
    retrieval: str = Field(
        default="auto",
        description="What references are chosen by: vlad (of the local features), megaloc, or auto.",
    )
    retrieval_cache_mib: int = Field(
        default=1024, ge=1, description="Memory for the scenes whose references are chosen from, MiB."
    )
    reference_cache_mib: int = Field(default=512, ge=0, description="Memory for references' features, MiB.")
    coverage: float = Field(
        default=0.99,
        gt=0,
        lt=1,
        description="Share of right answers to accept where a call does not say; more, and more wrong ones pass too.",
    )
    allow_watching: bool = Field(
        default=False,
        description="Whether WatchQueries may show callers' photographs to those with the role write. What waits for "
        "watchers, of whom there are 8 at most, takes the memory of 24 images.",
    )
    capture_dir: Path | None = Field(
        default=None,
        description="Folder in which calls are kept for a time, photographs and all, to be replayed; without it, none.",
    )
    capture_hours: float = Field(default=24.0, gt=0, le=8784, description="How long a captured call is kept, hours.")
    capture_mib: int = Field(
        default=1024, ge=1, description="What captured calls may take on the disk; the oldest are deleted first, MiB."
    )
    capture_tenants: str = Field(
        default="", description="Tenants whose calls are captured, separated by commas; empty: of all."
    )
    warm_up: bool = Field(default=True, description="Whether a localization is tried before the first call is taken.")
    drain_delay_s: float = Field(
        default=0.0,
        ge=0,
        description="Time to say that it stops before it takes no more calls, for load balancers, seconds.",
    )
    drain_grace_s: float = Field(
        default=10.0, ge=0, description="Time that running calls get when the server stops, seconds."
    )
    tls_certificate: Path | None = Field(default=None, description="The server's certificate chain, PEM; read anew.")
    tls_key: Path | None = Field(default=None, description="Its private key, PEM.")
    tls_client_ca: Path | None = Field(
        default=None, description="Certificates that clients' own must be signed by, PEM; without, clients need none."
    )
    tokens_file: Path | None = Field(
        default=None, description="Hashes of the bearer tokens that callers must show; see mapless-server token."
    )
    insecure: bool = Field(
        default=False, description="Whether to listen beyond this machine with neither TLS nor tokens."
    )
    metrics: bool = Field(default=True, description="Whether to serve metrics to Prometheus.")
    metrics_host: str = Field(default="127.0.0.1", min_length=1, description="Address of the metrics; 0.0.0.0 for all.")
    metrics_port: int = Field(default=9464, ge=0, le=65535, description="Port of the metrics; 0 for any free one.")
    otlp_endpoint: str = Field(
        default="", description="Where traces go by OTLP over gRPC, http://host:4317; empty: nowhere."
    )
    reflection: bool = Field(
        default=True, description="Whether the server describes its interface to grpcurl and the like."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least severity that is logged."
    )
    log_format: Literal["json", "text"] = Field(default="json", description="One JSON object a line, or plain text.")

    @field_validator("compiled_views")
    @classmethod
    def _check_compiled_views(cls, count: int) -> int:
        if count in (1, 2):
            raise ValueError("must be 0, or at least 3: the photograph and two references")
        return count

    @field_validator("device")
    @classmethod
    def _check_device(cls, device: str) -> str:
        if not _DEVICE.fullmatch(device):
            raise ValueError("must be auto, cpu, cuda or cuda:N")
        return device

    @field_validator("host", "metrics_host")
    @classmethod
    def _check_host(cls, host: str) -> str:
        if not host.isprintable() or " " in host:
            raise ValueError("must be a name or an address")
        return host

    @field_validator("data_dir", "weights_dir", "tls_certificate", "tls_key", "tls_client_ca", "tokens_file")
    @classmethod
    def _check_path(cls, path: Path | None) -> Path | None:
        if path is not None and "\0" in str(path):
            raise ValueError("must be a path")
        return path

    @model_validator(mode="after")
    def _check_together(self) -> Settings:
        if self.max_image_mib > self.max_message_mib:
            raise ValueError("max_image_mib must not exceed max_message_mib")
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together")
        if self.tls_client_ca is not None and self.tls_certificate is None:
            raise ValueError("tls_client_ca needs tls_certificate")
        if self.capture_dir is not None and _overlap(self.capture_dir, self.data_dir):
            raise ValueError("capture_dir and data_dir must be folders apart: what is captured is deleted by itself")
        return self

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Only what is passed: `load_settings` reads the sources itself, to know where each value comes from."""
        return (init_settings,)


@dataclass(frozen=True)
class LoadedSettings:
    """Settings and where each value comes from: "flag", "environment", "file" or "default"."""

    settings: Settings
    origins: Mapping[str, str]

    def __str__(self) -> str:
        """A block for the log; a SecretStr shows as asterisks."""
        width = max(map(len, self.origins))
        return "\n".join(
            f"  {name:<{width}}  {getattr(self.settings, name)}  ({origin})" for name, origin in self.origins.items()
        )


def load_settings(flags: Mapping[str, Any], config: Path | None = None) -> LoadedSettings:
    """Settings from all sources.

    A ``data_dir`` among the flags is where the store is meant to be, so that a ``database_url`` of elsewhere is void: a
    program that starts a server on a folder of its own must not write to the database that its environment names.

    Args:
        flags: values given on the command line, by name; None means not given.
        config: a TOML file; None means that of MAPLESS_CONFIG, if any.

    Raises:
        ConfigError: the file cannot be read, a name is unknown or a value is wrong; one line a fault.
    """
    config = config or (Path(os.environ[CONFIG_VARIABLE]) if os.environ.get(CONFIG_VARIABLE) else None)
    sources = {
        "file": _read_file(config) if config else {},
        "environment": _read_environment(),
        "flag": {name: value for name, value in flags.items() if value is not None},
    }
    values: dict[str, Any] = {}
    origins = dict.fromkeys(Settings.model_fields, "default")
    for origin, given in sources.items():
        values |= given
        origins |= dict.fromkeys(given, origin)
    if origins["data_dir"] == "flag" and origins["database_url"] in ("file", "environment"):
        values["database_url"], origins["database_url"] = None, "flag"
    try:
        return LoadedSettings(Settings(**values), origins)
    except ValidationError as error:
        raise ConfigError("\n".join(_describe(fault, origins) for fault in error.errors())) from None


def _overlap(first: Path, second: Path) -> bool:
    """Whether one of two folders lies in the other, or is it."""
    first, second = first.resolve(), second.resolve()
    return first.is_relative_to(second) or second.is_relative_to(first)


def _read_file(path: Path) -> dict[str, Any]:
    if not path.is_file():  # pydantic-settings passes over a missing file in silence
        raise ConfigError(f"{path}: no such file")
    try:
        return TomlConfigSettingsSource(Settings, path)()
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from None


def _read_environment() -> dict[str, Any]:
    clients = {CLIENT_TOKEN_VARIABLE, CLIENT_ADDRESS_VARIABLE}
    known = {f"{PREFIX}{name.upper()}" for name in Settings.model_fields} | {CONFIG_VARIABLE} | clients
    unknown = {name for name in os.environ if name.startswith(PREFIX) and not _SERVICE_LINKS.fullmatch(name)} - known
    if unknown:
        raise ConfigError("\n".join(f"environment: {ascii(name)[1:-1]} is not a setting" for name in sorted(unknown)))
    values = EnvSettingsSource(Settings)()
    if str(values.get("port", "")).startswith(_SERVICE_LINK_VALUE):
        del values["port"]
    return values


def _describe(fault: Mapping[str, Any], origins: Mapping[str, str]) -> str:
    name = ascii(".".join(map(str, fault["loc"])))[1:-1]  # in a file it may be anything
    return f"{name} ({origins.get(name, 'default')}): {fault['msg']}" if name else str(fault["msg"])
