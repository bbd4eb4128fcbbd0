"""The settings of the server: from flags, environment (MAPLESS_...), a TOML file or defaults, in this precedence."""

import difflib
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import tomllib
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SecretStr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from mapless_server.choices import AUTO, BACKENDS, BEST_VARIANTS, FEATURES, NETWORKS, OFF, STORED

PREFIX = "MAPLESS_"
CONFIG_VARIABLE = "MAPLESS_CONFIG"
CLIENT_TOKEN_VARIABLE, CLIENT_ADDRESS_VARIABLE = "MAPLESS_TOKEN", "MAPLESS_ADDRESS"
"""Variables of the client, which may run in the same environment."""

# Kubernetes sets these in every pod of a namespace with a service called "mapless"; MAPLESS_PORT is then "tcp://...".
_SERVICE_LINKS = re.compile(r"MAPLESS_SERVICE_(HOST|PORT.*)|MAPLESS_PORT_\d+_.*")
_SERVICE_LINK_VALUE = "tcp://"
_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")


class ConfigError(Exception):
    """A setting is wrong; the message, one line a fault, is for the operator."""


def available_cores() -> int:
    """Number of cores that this process may use, in a container fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cache_dir(name: str) -> Path:
    """A folder in the user's cache, for what can be made or fetched again; without a cache, one beside the store."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(cache):  # the XDG specification: relative ones are ignored
        cache = os.path.expanduser("~/.cache")
    return Path(cache) / "mapless" / name if os.path.isabs(cache) else Path(f"mapless-{name}")


class Settings(BaseModel):
    """All settings of the server; unknown names are errors."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    host: str = Field(default="127.0.0.1", min_length=1)
    """Address to listen on; 0.0.0.0 for all."""
    port: int = Field(default=50051, ge=0, le=65535)
    """Port to listen on; 0 for any free one."""
    data_dir: Path = Path("mapless-data")
    """Folder of the store, on a local disk; as a flag, it replaces database_url."""
    database_url: SecretStr | None = None
    """URL of a PostgreSQL that several servers share, postgresql://user:password@host/name; else data_dir."""
    backend: str = Field(default="geometric", json_schema_extra={"enum": [AUTO, *BACKENDS]})
    """Backend of the coarse stage; the weights of pi3 and pi3x are for non-commercial use only."""
    features: str = Field(default=AUTO, json_schema_extra={"enum": [AUTO, *FEATURES, *BEST_VARIANTS]})
    """Local features; superpoint is for research only."""
    device: str = "auto"
    """Device of networks: auto, cpu, cuda or cuda:N."""
    weights_dir: Path = Field(default_factory=lambda: cache_dir("weights"))
    """Folder of the networks' weights."""
    reference_depth: str = Field(default=OFF, json_schema_extra={"enum": [OFF, STORED, *NETWORKS]})
    """Depth kept with references, for the backend geometric: off, stored (others make it), or the network that does."""
    compiled_views: int = Field(default=0, ge=0, le=65)
    """Photographs of a query, itself included, that a network is compiled for at the start, at least 3; 0: none."""
    workers: int = Field(default_factory=available_cores, ge=1)
    """Threads that compute."""
    max_batch: int = Field(default=4, ge=1, le=64)
    """Queries that a network reconstructs at a time."""
    max_queued_s: float = Field(default=2.0, gt=0)
    """Predicted computing time that may be admitted and not done, seconds a worker."""
    max_queued_mib: int = Field(default=256, ge=1)
    """Memory for photographs of calls in progress, MiB."""
    stall_limit_s: float = Field(default=120.0, gt=0)
    """A step that computes longer hangs, and the server ends, seconds."""
    tenant_rate_ms: float = Field(default=0.0, ge=0)
    """Computing time that a tenant may use, milliseconds a second; 0: no limit."""
    tenant_burst_ms: float = Field(default=20_000.0, gt=0)
    """Computing time that a tenant may save up, milliseconds."""
    default_deadline_s: float = Field(default=30.0, gt=0)
    """Deadline of calls that have none, seconds."""
    max_deadline_s: float = Field(default=600.0, gt=0)
    """Deadline of calls that have a later one, seconds."""
    max_message_mib: int = Field(default=32, ge=1, le=1024)
    """Largest message, either way, MiB."""
    max_image_mib: int = Field(default=16, ge=1)
    """Largest image file, MiB."""
    max_image_megapixels: float = Field(default=66.0, gt=0, le=268)
    """Largest image, width times height; phones of "50 MP" have up to 50.4 million pixels, those of "64 MP" 64.5."""
    retrieval: str = Field(default=AUTO, json_schema_extra={"enum": [AUTO, "vlad", "megaloc"]})
    """Descriptors by which references are chosen; vlad is made of the local features."""
    retrieval_cache_mib: int = Field(default=1024, ge=1)
    """Memory for the scenes whose references are chosen, MiB."""
    index_dir: Path | None = None
    """Folder of the indexes of scenes with 100,000 references or more, on a local disk."""
    reference_cache_mib: int = Field(default=512, ge=0)
    """Memory for references' features, MiB."""
    background_matching: bool = True
    """Whether further features and matches of references are made when the server is idle, so that queries need not."""
    coverage: float = Field(default=0.95, gt=0, lt=1)
    """Share of right answers to accept where a request sets none; a larger one also accepts more wrong answers."""
    allow_watching: bool = False
    """Whether WatchQueries may show callers' photographs to callers with the role write; takes memory for 24 images."""
    capture_dir: Path | None = None
    """Folder in which calls are captured for a time, with photographs, to be replayed; without it, none are."""
    capture_hours: float = Field(default=24.0, gt=0, le=8784)
    """Time for which a captured call is kept, hours."""
    capture_mib: int = Field(default=1024, ge=1)
    """Space of captured calls on the disk, MiB; the oldest are deleted first."""
    capture_tenants: str = ""
    """Tenants whose calls are captured, separated by commas; empty: all."""
    report_days: int = Field(default=400, ge=0, le=4000)
    """Days for which answered photographs are counted by scene, place and reason, for reports; 0: they are not."""
    warm_up: bool = True
    """Whether to localize a photograph before the first call is accepted."""
    drain_delay_s: float = Field(default=0.0, ge=0)
    """Time between reporting NOT_SERVING and rejecting calls, for load balancers, seconds."""
    drain_grace_s: float = Field(default=10.0, ge=0)
    """Time for running calls when the server stops, seconds."""
    tls_certificate: Path | None = None
    """The server's certificate chain, PEM; read again when it changes."""
    tls_key: Path | None = None
    """Its private key, PEM."""
    tls_client_ca: Path | None = None
    """Authorities of the certificates that clients must have, PEM; without it, clients need none."""
    tokens_file: Path | None = None
    """Hashes of the bearer tokens that callers must have; see mapless-server token."""
    insecure: bool = False
    """Whether to listen beyond this machine with neither tokens nor clients' certificates."""
    metrics: bool = True
    """Whether to serve metrics to Prometheus."""
    metrics_host: str = Field(default="127.0.0.1", min_length=1)
    """Address of the metrics; 0.0.0.0 for all."""
    metrics_port: int = Field(default=9464, ge=0, le=65535)
    """Port of the metrics; 0 for any free one."""
    metrics_scenes: int = Field(default=20, ge=0, le=1000)
    """Scenes with metrics of their own, those with most photographs of the last week, by their names; 0: none."""
    otlp_endpoint: str = ""
    """Address of the collector of traces, OTLP over gRPC, http://host:4317; empty: no traces."""
    reflection: bool = True
    """Whether the server describes its interface to grpcurl and similar programs."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severity that is logged."""
    log_format: Literal["json", "text"] = "json"
    """One JSON object a line, or plain text."""

    @field_validator("backend", "features", "retrieval", "reference_depth")
    @classmethod
    def _check_choice(cls, value: str, info: ValidationInfo) -> str:
        allowed = allowed_words(str(info.field_name))
        if value not in allowed:
            raise ValueError(f"must be one of {', '.join(allowed)}")
        return value

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

    @field_validator(
        "data_dir",
        "weights_dir",
        "tls_certificate",
        "tls_key",
        "tls_client_ca",
        "tokens_file",
        "capture_dir",
        "index_dir",
    )
    @classmethod
    def _check_path(cls, path: Path | None) -> Path | None:
        if path is not None and "\0" in str(path):
            raise ValueError("must be a path")
        return path

    @model_validator(mode="after")
    def _check_together(self) -> "Settings":
        if self.max_image_mib > self.max_message_mib:
            raise ValueError(_exceeds(self, "max_image_mib", "max_message_mib"))
        if self.default_deadline_s > self.max_deadline_s:
            raise ValueError(_exceeds(self, "default_deadline_s", "max_deadline_s"))
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together")
        if self.tls_client_ca is not None and self.tls_certificate is None:
            raise ValueError("tls_client_ca needs tls_certificate")
        if self.capture_dir is not None and _overlap(self.capture_dir, self.data_dir):
            raise ValueError("capture_dir and data_dir must be folders apart: captured calls are deleted automatically")
        return self


def allowed_words(name: str) -> list[str]:
    """The words that a setting is one of; empty for other settings."""
    field = Settings.model_fields[name]
    if isinstance(field.json_schema_extra, dict):
        return [*map(str, cast(list[object], field.json_schema_extra.get("enum", [])))]
    return [it for it in get_args(field.annotation) if isinstance(it, str)]


def bounds_text(name: str) -> str:
    """The values that a setting can have, for people: "above 0, at most 268"; empty without bounds."""
    if words := allowed_words(name):
        return f"{', '.join(words[:-1])} or {words[-1]}"
    bounds = {
        relation: getattr(it, relation)
        for it in Settings.model_fields[name].metadata
        for relation in _BOUNDS
        if getattr(it, relation, None) is not None
    }
    if {*bounds} == {"ge", "le"}:
        return f"{bounds['ge']:g} to {bounds['le']:g}"
    return ", ".join(f"{_BOUNDS[relation]} {bound:g}" for relation, bound in bounds.items())


def default_text(name: str) -> str:
    """The default of a setting, for people; empty if it has no value."""
    default = Settings.model_fields[name].default
    if name in _COMPUTED_DEFAULTS:
        return _COMPUTED_DEFAULTS[name]
    if default is None or default == "":
        return ""
    return f"{default}".lower() if isinstance(default, bool) else f"{default}".removesuffix(".0")


_PLAIN_BOUNDS = {
    "greater than or equal to": "at least",
    "greater than": "above",
    "less than or equal to": "at most",
    "less than": "below",
}
_BOUNDS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
_PASSWORD = re.compile(r"(:/+[^/@:]*:).+(?=@)", re.DOTALL)
"""In a URL; a path has only one slash of its two. An @ and a line break may be in the password."""
_REMOVED = {"query_rays": "networks that take intrinsics always get the photograph's own; leave it out"}
"""Former settings, and what to do instead."""
_COMPUTED_DEFAULTS = {
    "workers": "all cores",
    "weights_dir": "~/.cache/mapless/weights",
    "index_dir": "indexes in data_dir; with a database_url, ~/.cache/mapless/indexes",
}


def _exceeds(settings: Settings, less: str, more: str) -> str:
    return f"{less} must not exceed {more} ({getattr(settings, more):g}), is {getattr(settings, less):g}"


@dataclass(frozen=True)
class LoadedSettings:
    """Settings, and the source of each value: "flag", "environment", "file" or "default", or what replaced it."""

    settings: Settings
    origins: Mapping[str, str]

    def __str__(self) -> str:
        """A line for each setting; secrets show as asterisks, also the password of a URL in any other setting."""
        width = max(map(len, self.origins))
        shown = self._shown
        return "\n".join(f"  {name:<{width}}  {shown[name]}  ({origin})" for name, origin in self.origins.items())

    @property
    def fields(self) -> dict[str, dict[str, object]]:
        """The same for programs: `settings`, by name, and `origins` of those that are not defaults."""
        given = {name: origin for name, origin in self.origins.items() if origin != "default"}
        return {"settings": self._shown, "origins": {**given}}

    @property
    def _shown(self) -> dict[str, object]:
        values = {name: getattr(self.settings, name) for name in self.origins}
        return {
            name: it if it is None or isinstance(it, int | float) else _PASSWORD.sub(r"\1**********", str(it))
            for name, it in values.items()
        }


def load_settings(flags: Mapping[str, Any], config: Path | None = None) -> LoadedSettings:
    """Loads the settings from all sources.

    A ``data_dir`` among the flags voids a ``database_url`` of file and environment: a program that starts a server on a
    folder of its own must not write to the database that its environment names.

    Args:
        flags: values of the command line by name; None means not given.
        config: a TOML file; None means that of MAPLESS_CONFIG, if any.

    Raises:
        ConfigError: the file cannot be read, a name is unknown or a value is wrong.
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
        values["database_url"], origins["database_url"] = None, "replaced by the flag data_dir"
    try:
        return LoadedSettings(Settings(**values), origins)
    except ValidationError as error:
        raise ConfigError("\n".join(_describe(fault, origins) for fault in error.errors())) from None


def _overlap(first: Path, second: Path) -> bool:
    """Whether two folders are the same, or one contains the other."""
    first, second = first.resolve(), second.resolve()
    return first.is_relative_to(second) or second.is_relative_to(first)


def _read_file(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    from mapless.text_files import read_text

    try:
        text = read_text(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(str(error)) from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from None


def _read_environment() -> dict[str, str]:
    variables = {f"{PREFIX}{name.upper()}": name for name in Settings.model_fields}
    known = {*variables, CONFIG_VARIABLE, CLIENT_TOKEN_VARIABLE, CLIENT_ADDRESS_VARIABLE}
    ours = {name for name in os.environ if name.upper().startswith(PREFIX) and not _SERVICE_LINKS.fullmatch(name)}
    unknown = {name for name in ours if name.upper() not in known}
    if unknown:
        raise ConfigError("\n".join(_unknown("environment", name, known) for name in sorted(unknown)))
    # Upper or lower case. If both are set, upper case wins, because it sorts first.
    given = {variable: os.environ[variable] for variable in sorted(ours, reverse=True)}
    values = {variables[name.upper()]: value for name, value in given.items() if name.upper() in variables}
    if values.get("port", "").startswith(_SERVICE_LINK_VALUE):
        del values["port"]
    return values


def _unknown(origin: str, name: str, known: Iterable[str]) -> str:
    if (known_once := name.lower().removeprefix(PREFIX.lower())) in _REMOVED:
        return f"{origin}: {name} is no setting any more: {_REMOVED[known_once]}"
    nearest = difflib.get_close_matches(name.upper() if origin == "environment" else name.lower(), known, 1)
    suggestion = f"; did you mean {nearest[0]}?" if nearest else ""
    return f"{origin}: {ascii(name)[1:-1]} is not a setting{suggestion}"


def _describe(fault: Mapping[str, Any], origins: Mapping[str, str]) -> str:
    name = ascii(".".join(map(str, fault["loc"])))[1:-1]  # a key of a file may be any text
    if fault["type"] == "extra_forbidden":
        key = str(fault["loc"][0])
        table = "; settings are given without tables" if isinstance(fault["input"], dict) else ""
        return _unknown(origins[key], key, Settings.model_fields) + table
    message = str(fault["msg"]).removeprefix("Value error, ").replace("Input should be", "must be")
    for formal, plain in _PLAIN_BOUNDS.items():
        message = message.replace(formal, plain)
    if not name:
        return message
    field = Settings.model_fields.get(name)
    is_secret = field is None or field.annotation is None or "Secret" in str(field.annotation)
    value = "" if is_secret or fault["type"] == "missing" else f", is {fault['input']!a}"
    return f"{name} ({origins.get(name, 'default')}): {message}{value}"
