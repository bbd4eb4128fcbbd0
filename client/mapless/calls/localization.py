"""Where photographs were taken."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from .. import wire
from ..answers import LocalizationResult, Rejected, answer_from_message
from ..axes import Axes
from ..exchange import Call, Exchange
from ..geometry import Camera, RigidTransform
from ..priors import Priors, set_priors
from ..requests import ImageSource, read_image
from ..v1 import localization_service_pb2 as pb
from .naming import enum_value, reference_name, scene_name

SERVICE = "mapless.v1.LocalizationService"


def localize(
    image: ImageSource,
    camera: Camera,
    scene: str,
    references: Sequence[str] = (),
    *,
    priors: Priors | None = None,
    variant: str = "",
    scale_strategy: str = "",
    reference_count: int = 0,
    rerank_references: bool = False,
    allow_coarse: bool = False,
    coverage: float = 0.0,
    axes: Axes | str = "",
    include_debug: bool = False,
    capture_time: datetime | None = None,
    session_from_camera: RigidTransform | None = None,
    timeout_s: float | None = None,
) -> Exchange[LocalizationResult | Rejected]:
    """Where a photograph was taken.

    Args:
        image: the photograph.
        camera: the camera that took it, in pixels of the file as it is stored, before any EXIF rotation.
        scene: where to look.
        references: what to compare with, most similar first, at most 64; none: the server chooses.
        priors: what is known of the camera beforehand.
        variant: "best" (default), "full", "no_structure" or "coarse".
        scale_strategy: "two_stage" (default), "triangulation" or "trajectory".
        reference_count: how many references the server chooses if it does; 0 is its default.
        rerank_references: whether it chooses among those that are named, of which there may then be 1000.
        allow_coarse: whether a pose that could not be refined before the deadline is answered all the same, with
            `LocalizationResult.pose_stage` "COARSE" and no covariance, instead of raising `DeadlineExceeded`.
        coverage: share of the right answers that are to be accepted, above 0 and below 1; 0 is the server's default.
        axes: "opencv" (default), "arkit", "arcore", "unity", "ros", or one of `Axes`: of `session_from_camera` and of
            `LocalizationResult.in_axes`.
        include_debug: whether the answer is to carry the matches it rests on.
        capture_time: when it was taken, with time zone; echoed.
        session_from_camera: where the device believed its camera to be then; echoed, and what makes
            `LocalizationResult.world_from_session`.
        timeout_s: deadline of the call.
    """
    scene = scene_name(scene)
    request = pb.LocalizeRequest(
        scene=scene,
        references=[reference_name(scene, reference) for reference in references],
        image=read_image(image),
        intrinsics=wire.camera_to_message(camera),
        options=pb.LocalizeOptions(
            variant=enum_value(pb.Variant, variant),
            scale_strategy=enum_value(pb.ScaleStrategy, scale_strategy),
            reference_count=reference_count,
            allow_coarse=allow_coarse,
            rerank_references=rerank_references,
            axes=enum_value(pb.Axes, axes),
            include_debug=include_debug,
            coverage=coverage,
        ),
    )
    set_priors(request, priors or Priors())
    if capture_time is not None:
        request.capture_time.FromDatetime(capture_time)
    if session_from_camera is not None:
        request.session_from_camera.CopyFrom(wire.transform_to_message(session_from_camera))
    response = yield Call(f"{SERVICE}/Localize", request, pb.LocalizeResponse, timeout_s)
    return answer_from_message(response)
