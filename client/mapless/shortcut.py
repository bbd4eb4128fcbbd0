"""Localization in one line, `mapless.localize("photo.jpg", camera)`, with a server from the environment.

MAPLESS_ADDRESS has the server, MAPLESS_TOKEN the token, MAPLESS_SCENE the scene.
"""

import atexit
import os
import threading

from .answers import LocalizationResult, Rejected
from .axes import Axes
from .client import Client
from .geometry import Camera
from .options import ConnectOptions
from .priors import Priors
from .requests import ImageSource

ADDRESS_VARIABLE, TOKEN_VARIABLE, SCENE_VARIABLE = "MAPLESS_ADDRESS", "MAPLESS_TOKEN", "MAPLESS_SCENE"
DEFAULT_ADDRESS = "localhost:50051"

_clients: dict[tuple[int, str, ConnectOptions], Client] = {}
_lock = threading.Lock()


def localize(
    image: ImageSource,
    camera: Camera | None = None,
    scene: str | None = None,
    *,
    address: str | None = None,
    options: ConnectOptions | None = None,
    priors: Priors | None = None,
    axes: Axes | str = "",
    mask: ImageSource | None = None,
    timeout_s: float | None = None,
) -> LocalizationResult | Rejected:
    """Localizes a photograph, in one line; `Client.localize` has more options.

    The connection is kept for the next call, and closed when the program ends. Raises `MaplessError`.

    Args:
        image: the photograph.
        camera: the camera that took it, in pixels of the file as it is stored, before any EXIF rotation; None if it is
            not known, see `Client.localize`.
        scene: the scene; None for MAPLESS_SCENE, or else it is found among all (`LocalizationResult.scene`).
        address: "host:port"; None for MAPLESS_ADDRESS, or else localhost:50051.
        options: options of the connection; None for no encryption, with the token of MAPLESS_TOKEN if it is set.
        priors: knowledge of the pose before the photograph is used, for example its position.
        axes: "opencv" (default), "arkit", "arcore", "unity", "ros", or one of `Axes`: of `LocalizationResult.in_axes`.
        mask: a PNG of the photograph's size that is 0 at the pixels to ignore; None: all are used.
        timeout_s: deadline of the call.
    """
    client = _client(address or default_address(), options or ConnectOptions(token=os.environ.get(TOKEN_VARIABLE)))
    scene = scene or os.environ.get(SCENE_VARIABLE) or ""
    group: dict[str, str] | None = None if scene else {}
    return client.localize(image, camera, scene, group=group, priors=priors, axes=axes, mask=mask, timeout_s=timeout_s)


def default_address() -> str:
    """The server's default address."""
    return os.environ.get(ADDRESS_VARIABLE) or DEFAULT_ADDRESS


def _client(address: str, options: ConnectOptions) -> Client:
    """The connection of this process; one made before a fork belongs to the parent process."""
    key = (os.getpid(), address, options)
    with _lock:
        if key not in _clients:
            _clients[key] = Client(address, options)
        return _clients[key]


@atexit.register
def _close() -> None:
    for (pid, _, _), client in _clients.items():
        if pid == os.getpid():
            client.close()
    _clients.clear()
