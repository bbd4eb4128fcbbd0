"""A server that asks for tokens, and a request for each of its methods."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
from google.protobuf.message import Message

from mapless import Client, ConnectOptions, NewReference
from mapless.requests import create_request
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.v1.geometry_pb2 import Vector3
from support.servers import CAMERA, PHOTO, RunningServer, failure_of, localize_request, pose

LIMIT_S = 30.0
REFERENCE_SERVICE = "/mapless.v1.ReferenceService/"


def requests_on(scene_id: str, reference_id: str = "r", new_id: str = "r") -> dict[str, Any]:
    """By method, of those that name a scene, none of which would harm it but the deletions, which come last."""
    scene = f"scenes/{scene_id}"
    reference = f"{scene}/references/{reference_id}"
    new = create_request(f"scenes/{scene_id}", NewReference(new_id, PHOTO, CAMERA, pose(0.0)))
    at = new.reference.world_from_camera
    photo: dict[str, Any] = {"image": PHOTO, "intrinsics": new.reference.intrinsics}
    frame = localization_pb.SequenceFrame(session_from_camera=at, **photo)
    localization: dict[str, Message] = {
        "Localize": localize_request(scene_id),
        "LocalizeProgressively": localize_request(scene_id),
        "LocalizeRig": localization_pb.LocalizeRigRequest(
            scene=scene, images=[localization_pb.RigImage(rig_from_camera=at, **photo)]
        ),
        "LocalizeSequence": localization_pb.LocalizeSequenceRequest(scene=scene, frames=[frame, frame]),
        "WatchQueries": localization_pb.WatchQueriesRequest(scene=scene),
    }
    known = reference_pb.Scene(name=scene, down_in_world=Vector3(z=-1))
    references: dict[str, Message] = {
        "GetScene": reference_pb.GetSceneRequest(name=scene),
        "ListReferences": reference_pb.ListReferencesRequest(scene=scene),
        "GetReference": reference_pb.GetReferenceRequest(name=reference, include_image=True),
        "CreateReference": new,
        "BatchCreateReferences": reference_pb.BatchCreateReferencesRequest(scene=scene, requests=[new]),
        "RetrieveReferences": reference_pb.RetrieveReferencesRequest(scene=scene, **photo),
        "AuditScene": reference_pb.AuditSceneRequest(scene=scene),
        "CheckCoverage": reference_pb.CheckCoverageRequest(
            scene=scene, world_from_camera=at, intrinsics=new.reference.intrinsics
        ),
        "GetSceneReport": reference_pb.GetSceneReportRequest(scene=scene),
        "UpdateScene": reference_pb.UpdateSceneRequest(scene=known, update_mask={"paths": ["down_in_world"]}),
        "RetireReference": reference_pb.RetireReferenceRequest(name=reference),
        "RestoreReference": reference_pb.RestoreReferenceRequest(name=reference),
        "RestoreReferences": reference_pb.RestoreReferencesRequest(scene=scene),
        "DeleteReference": reference_pb.DeleteReferenceRequest(name=reference),
        "DeleteScene": reference_pb.DeleteSceneRequest(name=scene),
    }
    return {f"/mapless.v1.LocalizationService/{method}": it for method, it in localization.items()} | {
        REFERENCE_SERVICE + method: it for method, it in references.items()
    }


def requests_of_all(scene_id: str) -> dict[str, Any]:
    """And of those that name no scene which must exist."""
    return requests_on(scene_id) | {
        REFERENCE_SERVICE + "CreateScene": reference_pb.CreateSceneRequest(scene_id=scene_id),
        REFERENCE_SERVICE + "ListScenes": reference_pb.ListScenesRequest(),
    }


@dataclass
class Guarded:
    """A server that asks for tokens, and those it takes, by who holds them."""

    server: RunningServer
    tokens: dict[str, str]
    tokens_file: Path

    def client(self, caller: str | None) -> Client:
        token = None if caller is None else self.tokens.get(caller, caller)
        return Client(self.server.address, ConnectOptions(timeout_s=LIMIT_S, token=token))

    def call(self, method: str, request: Message, token: str | None = None) -> Any:
        """A bare call; its answer is not looked at."""
        metadata = () if token is None else (("authorization", f"Bearer {token}"),)
        with grpc.insecure_channel(self.server.address) as channel:
            stub = channel.unary_unary(method, request_serializer=lambda message: message.SerializeToString())
            return stub(request, timeout=LIMIT_S, metadata=metadata)

    def failure(self, method: str, request: Message, token: str | None = None) -> Any:
        return failure_of(lambda _, timeout: self.call(method, request, token), request)
