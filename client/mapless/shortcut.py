"""One line for those who have one server: `mapless.localize("photo.jpg", camera)`.

The server is that of MAPLESS_ADDRESS, the token that of MAPLESS_TOKEN, the scene that of MAPLESS_SCENE.
"""

from __future__ import annotations

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
    camera: Camera,
    scene: str | None = None,
    *,
    address: str | None = None,
    options: ConnectOptions | None = None,
    priors: Priors | None = None,
    axes: Axes | str = "",
    timeout_s: float | None = None,
) -> LocalizationResult | Rejected:
    """Where a photograph was taken, in one line; `Client.localize` can do more.

    The connection is kept for the next call, and closed when the program ends. Raises `MaplessError`.

    Args:
        image: the photograph.
        camera: the camera that took it, in pixels of the file as it is stored, before any EXIF rotation.
        scene: where to look; None: that in MAPLESS_SCENE, or the server's only one, which takes a call to find out.
        address: "host:port"; None: that in MAPLESS_ADDRESS, or localhost:50051.
        options: how to connect; None: without encryption, with the token in MAPLESS_TOKEN if there is one.
        priors: what is known of the camera beforehand.
        axes: "opencv" (default), "arkit", "arcore", "unity", "ros", or one of `Axes`: of `LocalizationResult.in_axes`.
        timeout_s: deadline of the call.

    Raises:
        ValueError: no scene is given, and the server has none or several.
    """
    client = _client(address or default_address(), options or ConnectOptions(token=os.environ.get(TOKEN_VARIABLE)))
    scene = scene or os.environ.get(SCENE_VARIABLE) or _only_scene(client, timeout_s)
    return client.localize(image, camera, scene, priors=priors, axes=axes, timeout_s=timeout_s)


def default_address() -> str:
    """Of the server that is meant where none is said."""
    return os.environ.get(ADDRESS_VARIABLE) or DEFAULT_ADDRESS


def _client(address: str, options: ConnectOptions) -> Client:
    """The connection of this process; one that was made before a fork belongs to the parent."""
    key = (os.getpid(), address, options)
    with _lock:
        if key not in _clients:
            _clients[key] = Client(address, options)
        return _clients[key]


def _only_scene(client: Client, timeout_s: float | None) -> str:
    scenes = [scene.scene_id for scene in client.list_scenes(timeout_s=timeout_s)]
    if len(scenes) != 1:
        there = f"there are {', '.join(scenes)}" if scenes else "the server has none"
        raise ValueError(f"say which scene, as an argument or in {SCENE_VARIABLE}: {there}")
    return scenes[0]


@atexit.register
def _close() -> None:
    for (pid, _, _), client in _clients.items():
        if pid == os.getpid():
            client.close()
    _clients.clear()
