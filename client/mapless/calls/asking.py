"""What the server finds out about a scene: what resembles a photograph, which references are wrong, what they cover."""

from __future__ import annotations

from collections.abc import Sequence

from .. import wire
from ..exchange import Call, Exchange, Pages
from ..geometry import Camera, RigidTransform
from ..priors import Priors, set_priors
from ..requests import ImageSource, read_image
from ..results import (
    Coverage,
    ReferenceAudit,
    RetrievedReference,
    audit_from_message,
    coverage_from_message,
    retrieved_from_message,
)
from ..v1 import reference_service_pb2 as pb
from .naming import reference_name, scene_name
from .repeats import SERVICE


def retrieve_references(
    image: ImageSource,
    camera: Camera,
    scene: str,
    count: int = 0,
    *,
    priors: Priors | None = None,
    timeout_s: float | None = None,
) -> Exchange[list[RetrievedReference]]:
    """The references that resemble a photograph most; `localize` chooses among twice as many, by feature matches.

    Args:
        image: the photograph.
        camera: the camera that took it.
        scene: where to look.
        count: how many, at most 1000; 0 is the server's default.
        priors: what is known of the camera; only references near its position and heading are considered.
        timeout_s: deadline of the call.
    """
    request = pb.RetrieveReferencesRequest(
        scene=scene_name(scene), image=read_image(image), intrinsics=wire.camera_to_message(camera), count=count
    )
    set_priors(request, priors or Priors())
    response = yield Call(f"{SERVICE}/RetrieveReferences", request, pb.RetrieveReferencesResponse, timeout_s)
    return list(map(retrieved_from_message, response.references))


def audit_scene(
    scene: str, references: Sequence[str] = (), *, page_size: int = 0, timeout_s: float | None = None
) -> Pages[ReferenceAudit]:
    """What the neighbours say about references, or about all of a scene, by id, as it is found out.

    Args:
        scene: the scene.
        references: which, at most 100; none: all.
        page_size: references a call, half a second of computing each; 0 is the server's default.
        timeout_s: deadline of each call.
    """
    named = [reference_name(scene, reference) for reference in references]

    def fetch(token: str) -> Exchange[tuple[list[ReferenceAudit], str]]:
        request = pb.AuditSceneRequest(scene=scene_name(scene), references=named, page_size=page_size, page_token=token)
        page = yield Call(f"{SERVICE}/AuditScene", request, pb.AuditSceneResponse, timeout_s)
        return list(map(audit_from_message, page.audits)), page.next_page_token

    return Pages(fetch)


def check_coverage(
    scene: str, world_from_camera: RigidTransform, camera: Camera, *, timeout_s: float | None = None
) -> Exchange[Coverage]:
    """Whether a photograph taken there would be localized."""
    request = pb.CheckCoverageRequest(
        scene=scene_name(scene),
        world_from_camera=wire.transform_to_message(world_from_camera),
        intrinsics=wire.camera_to_message(camera),
    )
    response = yield Call(f"{SERVICE}/CheckCoverage", request, pb.CheckCoverageResponse, timeout_s)
    return coverage_from_message(response)
