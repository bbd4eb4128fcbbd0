"""Weights: wrong files are refused with a reason, and the folder never holds a partial or a wrong file."""

import os
import pickle
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.safetensors_files import safetensors
from support.weights_files import CONTENT, entry_of, names_in, sha256

from mapless_command.installation import how_to_install
from mapless_server.networks.weights import (
    CATALOGUE,
    CheckpointError,
    FetchError,
    FolderError,
    UnknownWeights,
    WeightsMissing,
    catalogue,
    find_weights,
    install,
    named,
)
from mapless_server.networks.weights.catalogue import HubFile, Licence, LookAlike, Weights
from mapless_server.networks.weights.folder import Status, look_up
from mapless_server.networks.weights.install import add, check, fetch
from mapless_server.settings import Settings, cache_dir

# ---- the catalogue and the folder


def test_the_entries_of_the_catalogue_are_consistent() -> None:
    assert len({w.name for w in CATALOGUE}) == len({w.file_name for w in CATALOGUE}) == len(CATALOGUE)
    for weights in CATALOGUE:
        assert weights.file_name.endswith(".safetensors")
        assert weights.sha256 is None or re.fullmatch("[0-9a-f]{64}", weights.sha256)
        if isinstance(weights.source, HubFile) and weights.sha256:
            assert re.fullmatch("[0-9a-f]{40}", weights.source.revision), "a digest holds for one commit"
    restricted = {w.name for w in CATALOGUE if w.licence.restriction}
    assert restricted == {"pi3", "pi3x", "superpoint", "superpoint-lightglue"}


def test_missing_weights_name_the_command_and_the_licence(tmp_path: Path) -> None:
    with pytest.raises(WeightsMissing) as caught:
        find_weights("pi3", tmp_path)
    assert str(caught.value) == (
        f"the weights of pi3 are not in {tmp_path}: run `mapless-server weights fetch pi3` "
        "(licence CC BY-NC 4.0, non-commercial)"
    )
    with pytest.raises(UnknownWeights, match="no weights called pi4: only pi3, pi3x, "):
        named("pi4")


def test_a_link_without_a_file_counts_as_missing(tmp_path: Path) -> None:
    path = tmp_path / "pi3.safetensors"
    path.symlink_to(tmp_path / "gone")
    with pytest.raises(WeightsMissing):
        find_weights("pi3", tmp_path)
    (tmp_path / "gone").write_bytes(b"x")
    assert find_weights("pi3", tmp_path) == path


def test_a_folder_in_place_of_a_file_is_reported_first(
    monkeypatch: pytest.MonkeyPatch, weights: Weights, file: Path, folder: Path
) -> None:
    monkeypatch.setattr(install, "download_from_hub", None)
    path = folder / weights.file_name
    path.mkdir(parents=True)
    assert look_up(weights, folder).status is Status.NO_FILE
    for attempt in (
        lambda: find_weights("net", folder),
        lambda: fetch(weights, folder, folder),
        lambda: add(weights, file, folder),
        lambda: check(weights, folder),
    ):
        with pytest.raises(FolderError, match=f"{path} is not a file but a folder: move it away"):
            attempt()


def test_the_default_folder_is_the_users_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/cache/somebody")
    assert cache_dir("weights") == Path("/var/cache/somebody/mapless/weights")
    for ignored in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", ignored)
        monkeypatch.setenv("HOME", "/home/somebody")
        assert cache_dir("weights") == Path("/home/somebody/.cache/mapless/weights")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as for a user without a home
    assert cache_dir("weights") == Path("mapless-weights")


@pytest.mark.parametrize("device", ["", "gpu", "cuda:", "cuda:x", "cpu:0", "CUDA"])
def test_unknown_devices_are_refused(device: str) -> None:
    with pytest.raises(ValueError, match="must be auto, cpu, cuda or cuda:N"):
        Settings(device=device)


# ---- bringing weights in


def test_an_added_file_is_copied_and_its_digest_recorded(weights: Weights, file: Path, folder: Path) -> None:
    counted: list[int] = []
    installed = add(weights, file, folder, progress=counted.append)
    assert installed.path.read_bytes() == CONTENT
    assert (installed.sha256, installed.is_official, installed.not_compared) == (sha256(CONTENT), True, None)
    assert sum(counted) == len(CONTENT)
    assert installed.path.stat().st_mode & 0o777 == 0o644
    assert names_in(folder) == ["net.safetensors", "net.safetensors.sha256"]
    assert subprocess.run(["sha256sum", "--check", "--status", "net.safetensors.sha256"], cwd=folder).returncode == 0
    assert look_up(weights, folder).status is Status.OFFICIAL


def test_a_linked_file_stays_where_it_is(weights: Weights, file: Path, folder: Path) -> None:
    path = add(weights, file, folder, link=True).path
    assert path.is_symlink()
    assert path.resolve() == file
    assert look_up(weights, folder).status is Status.OFFICIAL


def test_an_unofficial_file_needs_the_option(folder: Path, file: Path) -> None:
    weights = entry_of(b"another")
    with pytest.raises(CheckpointError, match=r"not the official file of net: its SHA-256 is .*--unofficial"):
        add(weights, file, folder)
    assert names_in(folder) == []
    assert add(weights, file, folder, unofficial=True).is_official is False
    stored = look_up(weights, folder)
    assert (stored.status, stored.size_bytes) == (Status.UNOFFICIAL, len(CONTENT))


def test_a_file_under_another_licence_is_never_taken(folder: Path, file: Path) -> None:
    """MapAnything is published twice, with the same tensors: for everyone, and for non-commercial use."""
    other = LookAlike(sha256(CONTENT), "o/for-research", Licence("CC BY-NC 4.0", "url", "non-commercial"))
    weights = entry_of(b"another", look_alikes=(other,))
    for unofficial in (False, True):
        with pytest.raises(CheckpointError) as caught:
            add(weights, file, folder, unofficial=unofficial)
        assert str(caught.value) == (
            f"{file} is the file of o/for-research, whose licence is CC BY-NC 4.0, non-commercial. net is the file of "
            "o/n, whose licence is MIT: `mapless-server weights fetch net`"
        )
    assert names_in(folder) == []
    file.write_bytes(pickle.dumps([1] * 40))
    with pytest.raises(CheckpointError, match=r"it is a pickle\. net is the file of o/n, whose licence is MIT"):
        add(weights, file, folder)


def test_weights_without_a_known_digest_are_added_and_recorded(folder: Path, file: Path) -> None:
    weights = entry_of(sha256=None)
    assert add(weights, file, folder).is_official is None
    assert look_up(weights, folder).status is Status.RECORDED


def test_a_check_reports_damage_and_records_files_added_by_hand(weights: Weights, folder: Path) -> None:
    with pytest.raises(WeightsMissing):
        check(weights, folder)
    folder.mkdir()
    path = folder / weights.file_name
    path.write_bytes(CONTENT)
    assert look_up(weights, folder).status is Status.UNCHECKED
    assert check(weights, folder).is_official
    assert look_up(weights, folder).status is Status.OFFICIAL
    path.write_bytes(CONTENT[:-1] + b"\x7b")
    os.utime(path, (0, 0))  # as a copying tool that keeps times
    assert look_up(weights, folder).status is Status.UNCHECKED
    with pytest.raises(CheckpointError, match="not the official file"):
        check(weights, folder)


def test_a_check_compares_an_unofficial_file_with_its_record(
    monkeypatch: pytest.MonkeyPatch, folder: Path, file: Path
) -> None:
    for official in (sha256(b"another"), None):
        weights = entry_of(sha256=official)
        monkeypatch.setattr(catalogue, "CATALOGUE", (weights,))
        path = add(weights, file, folder, unofficial=True).path
        assert check(weights, folder).sha256 == sha256(CONTENT)
        path.write_bytes(CONTENT[:-1] + b"\x7b")
        with pytest.raises(
            CheckpointError, match="not the official file" if official else "has changed since it was added"
        ):
            check(weights, folder)


def test_a_damaged_record_is_ignored(weights: Weights, folder: Path, file: Path) -> None:
    path = add(weights, file, folder).path
    for text in ("", "nonsense\n", "é" * 64):
        path.with_name(path.name + ".sha256").write_text(text, encoding="utf-8")
        assert look_up(weights, folder).status is Status.UNCHECKED


# ---- nothing half


def test_an_interruption_leaves_the_folder_unchanged(weights: Weights, folder: Path, file: Path) -> None:
    def interrupt(_: int) -> None:
        assert any(name.startswith(".incoming-") for name in names_in(folder))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        add(weights, file, folder, progress=interrupt)
    assert names_in(folder) == []
    path = add(weights, file, folder).path
    with pytest.raises(KeyboardInterrupt):
        add(weights, file, folder, progress=interrupt)
    assert path.read_bytes() == CONTENT
    assert look_up(weights, folder).status is Status.OFFICIAL


def test_a_folder_that_cannot_be_created_is_reported(weights: Weights, file: Path) -> None:
    with pytest.raises(FolderError, match="cannot be written: Not a directory"):
        add(weights, file, file / "weights")


def test_a_full_disk_is_reported_and_leaves_nothing(weights: Weights, file: Path, folder: Path) -> None:
    """A limit on the size of files simulates a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(CONTENT) - 1, before[1]))
    try:
        with pytest.raises(FolderError, match="cannot be written: File too large"):
            add(weights, file, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert names_in(folder) == []


# ---- whether the network takes it


def aliked_file(path: Path, **changes: Any) -> Path:
    """A file with the tensors of ALIKED, random but for the changes; None leaves a tensor out."""
    feature = pytest.importorskip("kornia.feature")
    state = feature.ALIKED("aliked-n16").state_dict()
    tensors = {name: tensor.numpy() for name, tensor in state.items() if name != "dkd.hw_grid"} | changes
    path.write_bytes(safetensors({name: tensor for name, tensor in tensors.items() if tensor is not None}))
    return path


def test_an_unofficial_file_is_added_if_the_network_fits(tmp_path: Path, folder: Path) -> None:
    installed = add(named("aliked"), aliked_file(tmp_path / "own"), folder, unofficial=True)
    assert (installed.is_official, installed.not_compared) == (False, None)


@pytest.mark.parametrize(
    ("tensor", "words"),
    [
        (None, "1 missing: block1.conv1.weight"),
        (np.zeros((3, 3), np.float32), "1 of another shape: block1.conv1.weight"),
        (np.full((16, 3, 3, 3), np.nan, np.float32), "numbers that are not finite, in block1.conv1.weight"),
    ],
    ids=["missing", "shape", "nan"],
)
def test_a_file_that_does_not_fit_is_not_installed(tmp_path: Path, folder: Path, tensor: Any, words: str) -> None:
    file = aliked_file(tmp_path / "own", **{"block1.conv1.weight": tensor})
    with pytest.raises(CheckpointError, match=words):
        add(named("aliked"), file, folder, unofficial=True)
    assert names_in(folder) == []


@pytest.mark.parametrize("name", [weights.name for weights in CATALOGUE])
def test_without_torch_the_reason_for_no_comparison_is_given(
    monkeypatch: pytest.MonkeyPatch, folder: Path, file: Path, name: str
) -> None:
    for module in ("checkpoint", "local_features", "lightglue"):
        monkeypatch.delitem(sys.modules, f"mapless_server.networks.{module}", raising=False)
    for module in ("torch", "kornia.feature", "transformers"):
        monkeypatch.setitem(sys.modules, module, None)
    reason = add(named(name), file, folder, unofficial=True).not_compared
    assert reason is not None
    assert how_to_install("networks") in reason


def test_missing_converters_are_reported_before_a_download(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(FetchError, match=r"cannot be converted: .* torch is not installed: .*pip.* install"):
        install.require_converter(named("aliked"))
    install.require_converter(named("pi3"))
