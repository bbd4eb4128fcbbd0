"""Flags beat the environment, which beats the file, which beats the default; nothing misspelt passes."""

import contextlib
import re
from pathlib import Path

import pytest
from pydantic import SecretStr

from mapless_server.choices import BACKENDS, BEST_VARIANTS
from mapless_server.method.features.extractors import FEATURES, make_extractor
from mapless_server.networks.weights import CheckpointError
from mapless_server.settings import (
    ConfigError,
    LoadedSettings,
    Settings,
    allowed_words,
    bounds_text,
    default_text,
    load_settings,
)


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    for name in [name for name in os.environ if name.startswith("MAPLESS_")]:
        monkeypatch.delenv(name)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "mapless.toml"
    path.write_text('host = "10.0.0.1"\nport = 1000\nmax_queued_mib = 5\nreflection = false\n')
    return path


def test_precedence_and_origins(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPLESS_PORT", "2000")
    monkeypatch.setenv("MAPLESS_HOST", "10.0.0.2")
    loaded = load_settings({"host": "10.0.0.3", "workers": None}, config)
    assert (loaded.settings.host, loaded.settings.port, loaded.settings.max_queued_mib) == ("10.0.0.3", 2000, 5)
    assert not loaded.settings.reflection
    expected = {"host": "flag", "port": "environment", "max_queued_mib": "file", "workers": "default"}
    assert {name: loaded.origins[name] for name in expected} == expected


@pytest.mark.parametrize("origin", ["file", "environment"])
def test_a_folder_given_by_hand_overrides_a_set_database(
    origin: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, url = tmp_path / "mapless.toml", "postgresql://u:secret@h/db"
    config.write_text(f'database_url = "{url}"\n' if origin == "file" else "")
    if origin == "environment":
        monkeypatch.setenv("MAPLESS_DATABASE_URL", url)
    loaded = load_settings({"data_dir": tmp_path}, config)
    assert loaded.settings.database_url is None
    assert re.search(r"database_url +None  \(replaced by the flag data_dir\)", str(loaded))
    assert loaded.settings.data_dir == tmp_path
    monkeypatch.setenv("MAPLESS_DATA_DIR", "elsewhere")
    assert load_settings({"data_dir": None}, config).settings.database_url == SecretStr(url)


def test_the_file_may_be_named_by_the_environment(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPLESS_CONFIG", str(config))
    assert load_settings({}).settings.port == 1000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("featurs = 1", "file: featurs is not a setting; did you mean features?"),
        ("query_rays = false", "file: query_rays is no setting any more: networks that take intrinsics always get"),
        ("[server]\nport = 1", "file: server is not a setting; settings are given without tables"),
        ("port = 65536", "port (file): must be at most 65535, is 65536"),
        ("port = [", "mapless.toml"),
        ('workers = "many"', "workers (file)"),
        ("max_image_mib = 33", "max_image_mib must not exceed max_message_mib (32), is 33"),
        ("max_deadline_s = 20", "default_deadline_s must not exceed max_deadline_s (20), is 30"),
        ('backend = "pi4"', "backend (file): must be one of auto, geometric, pi3, pi3x, mapanything, is 'pi4'"),
        ('features = "surf"', "features (file): must be one of auto, sift, "),
        ('retrieval = "bow"', "retrieval (file): must be one of auto, vlad, megaloc, is 'bow'"),
        ('log_level = "loud"', "log_level (file)"),
    ],
)
def test_an_error_in_the_file_names_setting_and_origin(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "mapless.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_settings({}, path)
    assert expected in str(caught.value)


def test_features_that_can_be_made_are_those_of_the_setting(tmp_path: Path) -> None:
    assert allowed_words("features") == ["auto", *FEATURES, *BEST_VARIANTS]
    assert set(BEST_VARIANTS.values()) <= set(FEATURES)
    assert allowed_words("backend") == ["auto", *BACKENDS]
    for name in FEATURES:
        assert Settings(features=name).features == name
        with contextlib.suppress(CheckpointError, ImportError, OSError):  # unknown names are a ValueError
            make_extractor(name, tmp_path / "absent.safetensors")


@pytest.mark.parametrize(
    ("name", "bounds", "default"),
    [
        ("port", "0 to 65535", "50051"),
        ("coverage", "above 0, below 1", "0.95"),
        ("max_queued_s", "above 0", "2"),
        ("workers", "at least 1", "all cores"),
        ("warm_up", "", "true"),
        ("retrieval", "auto, vlad or megaloc", "auto"),
        ("log_format", "json or text", "json"),
        ("tls_key", "", ""),
    ],
)
def test_bounds_and_defaults_in_words(name: str, bounds: str, default: str) -> None:
    assert (bounds_text(name), default_text(name)) == (bounds, default)


def test_a_missing_settings_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_settings({}, tmp_path / "absent.toml")


def test_a_misspelt_variable_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPLESS_WORKER", "3")
    with pytest.raises(ConfigError, match="MAPLESS_WORKER is not a setting; did you mean MAPLESS_WORKERS"):
        load_settings({})


def test_variables_of_a_kubernetes_service_are_not_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "MAPLESS_SERVICE_HOST": "10.1.2.3",
        "MAPLESS_SERVICE_PORT": "50051",
        "MAPLESS_SERVICE_PORT_GRPC": "50051",
        "MAPLESS_PORT": "tcp://10.1.2.3:50051",
        "MAPLESS_PORT_50051_TCP": "tcp://10.1.2.3:50051",
        "MAPLESS_PORT_50051_TCP_ADDR": "10.1.2.3",
    }.items():
        monkeypatch.setenv(name, value)
    loaded = load_settings({})
    assert loaded.settings.port == 50051
    assert loaded.origins["port"] == "default"


def test_secrets_are_hidden_when_settings_are_shown() -> None:
    settings = Settings(database_url=SecretStr("postgresql://user:hunter2@host/db"))
    shown = str(LoadedSettings(settings, dict.fromkeys(Settings.model_fields, "default")))
    assert "database_url" in shown
    assert "hunter2" not in shown
    assert re.search(r"^  port +50051  \(default\)$", shown, re.MULTILINE)


def test_the_settings_are_fields_of_the_log_without_secrets() -> None:
    loaded = load_settings({"port": 7, "otlp_endpoint": "http://user:hunter2@collector:4317"})
    assert loaded.fields["settings"]["port"] == 7
    assert loaded.fields["settings"]["insecure"] is False
    assert loaded.fields["origins"] == {"port": "flag", "otlp_endpoint": "flag"}
    assert set(loaded.fields["settings"]) == set(Settings.model_fields)
    assert "hunter2" not in f"{loaded.fields}"
    with_url = LoadedSettings(Settings(database_url="postgresql://me:hunter2@host/db"), loaded.origins)  # type: ignore[arg-type]
    assert "hunter2" not in f"{with_url.fields}"
