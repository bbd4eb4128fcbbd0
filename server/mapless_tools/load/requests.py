"""The serialized requests, and the outcomes of answers."""

from collections.abc import Sequence

import cv2
import numpy as np

from mapless import Client, NewReference, wire
from mapless.geometry import Camera
from mapless.names import reference_name, scene_name
from mapless.v1 import localization_service_pb2 as pb
from mapless_tools.demo import Photograph

from .calls import Requests

SCENE = "load"
METHOD = "/mapless.v1.LocalizationService/Localize"


def store_references(client: Client, references: Sequence[Photograph]) -> None:
    """Creates the scene and stores the references in it."""
    client.create_scene(SCENE)
    client.add_references(SCENE, [NewReference(p.name, p.data, p.camera, p.world_from_camera) for p in references])


def requests_for(client: Client, queries: Sequence[Photograph]) -> Requests:
    """Makes requests that name the references which the server would choose, and bad ones.

    A robot that localizes once a second knows its neighbourhood; searching a whole scene would be a different load.
    """
    good = []
    for query in queries:
        uses = client.localize(query.data, query.camera, SCENE).diagnostics.references
        good.append(photo_request(query.data, query.camera, [use.name.rpartition("/")[2] for use in uses]))
    first = queries[0]
    bad_images = [b"this is not a photograph", first.data[: len(first.data) // 2]]
    return Requests(good, [photo_request(image, first.camera, ()) for image in bad_images])


def mixed_requests(named: Requests, queries: Sequence[Photograph]) -> Requests:
    """Makes all kinds of good requests: with names, without names, and some that the server can only reject."""
    chosen = [photo_request(query.data, query.camera, ()) for query in queries]
    camera = queries[0].camera
    blank = np.full((camera.height_px, camera.width_px, 3), 127, np.uint8)
    elsewhere = np.random.default_rng(0).integers(0, 256, (camera.height_px // 8, camera.width_px // 8, 3))
    noise = cv2.resize(elsewhere.astype(np.uint8), (camera.width_px, camera.height_px), interpolation=cv2.INTER_CUBIC)
    rejected = [photo_request(bytes(cv2.imencode(".jpg", it)[1]), camera, ()) for it in (blank, noise)]
    return Requests([*named.good, *chosen, *rejected], named.bad)


def photo_request(image: bytes, camera: Camera, references: Sequence[str]) -> bytes:
    """A request with a photograph and the ids of references."""
    return bytes(
        pb.LocalizeRequest(
            scene=scene_name(SCENE),
            references=[reference_name(SCENE, reference) for reference in references],
            image=image,
            intrinsics=wire.camera_to_message(camera),
        ).SerializeToString()
    )


def read_answer(data: bytes) -> str:
    """Outcome of an answer: "localized", "coarse" for a pose without time to refine it, or "rejected" and why."""
    answer = pb.LocalizeResponse.FromString(data)
    if answer.WhichOneof("outcome") == "rejection":
        reasons: wire.ProtoEnum = pb.RejectionReason
        return f"rejected {reasons.Name(answer.rejection.reason).removeprefix(wire.enum_prefix(reasons))}"
    return "coarse" if answer.localization.pose_stage == pb.POSE_STAGE_COARSE else "localized"
