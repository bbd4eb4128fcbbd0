"""Photographs with overlays, asked of a server with the settings of the environment, such as those of `auto`."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from mapless import Camera, Client, NewReference, Rejected, RigidTransform
from mapless_tools.child import temporary_server
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features
from research.places import RIGHT_M

from .overlays import OVERLAYS, Image, Overlay
from .page import Measurement, Row
from .stationary import Scene, scenes_in

OTHERS, RIGHT = 4, 3
"""Photographs of other places, and of the place itself, for each scene and overlay."""


def _rows(folder: Path) -> Iterator[Row]:
    scenes = scenes_in(folder, OTHERS)
    with temporary_server() as client:
        for turn in range(len(scenes)):
            for i, (name, overlay) in enumerate(OVERLAYS.items()):
                scene = scenes[(i + turn) % len(scenes)]
                yield {"scene": scene.name, "overlay": name, **_asked(client, scene, overlay)}


def _asked(client: Client, scene: Scene, overlay: Overlay) -> Row:
    """Adds the references with the overlay to a scene of the server, and asks for the photographs."""
    identifier, camera = "carried", scene.references[0].camera
    client.create_scene(identifier)
    references = [
        NewReference(f"r{i}", _encoded(it.image, overlay, i), it.camera, it.world_from_camera)
        for i, it in enumerate(scene.references)
    ]
    client.add_references(identifier, references)
    await_features(client, identifier)
    others = [
        _pose(client, _encoded(it, overlay, 500 + 31 * i), camera, identifier) for i, it in enumerate(scene.others)
    ]
    found = [
        (it, _pose(client, _encoded(it.image, overlay, 300 + 7 * i), it.camera, identifier))
        for i, it in enumerate(scene.queries[:RIGHT])
    ]
    client.delete_scene(identifier)
    right = [pose is not None and pose_error(it.world_from_camera, pose)[0] < RIGHT_M for it, pose in found]
    return {
        "other places localized": f"{sum(it is not None for it in others)} of {len(others)}",
        "right": f"{sum(right)} of {len(right)}",
    }


def _pose(client: Client, image: bytes, camera: Camera, scene: str) -> RigidTransform | None:
    answer = client.localize(image, camera, scene)
    return None if isinstance(answer, Rejected) else answer.world_from_camera


def _encoded(image: Image, overlay: Overlay, number: int) -> bytes:
    drawn = np.ascontiguousarray(overlay(image, number)[0][..., ::-1])
    return cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


MEASUREMENTS = {"stationary-overlays-auto": Measurement(_rows)}
