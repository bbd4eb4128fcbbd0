"""Where photographs were taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from functools import wraps
from typing import Any, ParamSpec, TypeVar

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

P = ParamSpec("P")
T = TypeVar("T")


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


def _asked_like(model: Callable[P, Any]) -> Callable[[Callable[..., T]], Callable[P, T]]:
    """Makes a call that has the parameters of another."""

    def with_parameters(call: Callable[..., T]) -> Callable[P, T]:
        return wraps(model, ("__annotations__", "__type_params__"), ())(call)

    return with_parameters


@_asked_like(localize)
def localize_progressively(*asked: Any, **named: Any) -> Exchange[LocalizationResult | Rejected]:
    """Where a photograph was taken, coarsely as soon as that is known, and then as `localize` answers it.

    Yields at most two answers. The first, if there is one, is a `LocalizationResult` with `pose_stage` "COARSE": a pose
    that nothing has checked, without covariance, accuracy and trust. The last, with `is_final`, is what `localize`
    would have answered, perhaps another pose altogether, or `Rejected`; errors are raised in its place.

    Whoever stops reading before ends the call. If the connection breaks after the first answer, the call is made again
    like any other, and only the last is yielded.

    Args and deadline are those of `localize`, for both answers together.
    """
    unary = localize(*asked, **named)
    call = replace(
        next(unary),
        method=f"{SERVICE}/LocalizeProgressively",
        response_type=pb.LocalizeProgressivelyResponse,
        early=_early_answer,
    )
    unary.close()
    response: pb.LocalizeProgressivelyResponse = yield call
    return answer_from_message(response.answer)


def _early_answer(message: pb.LocalizeProgressivelyResponse) -> LocalizationResult | None:
    """A coarse answer; None if it is the final one."""
    if message.is_final:
        return None
    answer = answer_from_message(message.answer)
    if isinstance(answer, Rejected):
        raise ValueError("a rejection that is not final")
    return replace(answer, is_final=False)
