"""Localization of one photograph."""

import warnings
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import aclosing
from dataclasses import asdict, replace
from datetime import datetime
from inspect import signature
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from .. import wire
from ..answers import LocalizationResult, Rejected
from ..axes import Axes
from ..connection import Connection
from ..depth import DepthImage, IgnoredDepth, depth_to_message
from ..geometry import Camera, RigidTransform
from ..groups import ImageReport
from ..messages import answer_from_message
from ..names import reference_names, scene_name, shown
from ..priors import Priors, set_priors
from ..requests import ImageSource, IntrinsicsUncertainty, read_image, read_mask
from ..v1 import localization_service_pb2 as pb

P = ParamSpec("P")
T = TypeVar("T")


async def _localize_request(
    connection: Connection,
    image: ImageSource,
    camera: Camera | None = None,
    scene: str = "",
    references: Sequence[str] = (),
    *,
    scenes: Sequence[str] = (),
    group: Mapping[str, str] | None = None,
    with_datum: bool = False,
    prior_scene: str = "",
    priors: Priors | None = None,
    intrinsics_uncertainty: IntrinsicsUncertainty | None = None,
    variant: str = "",
    scale_strategy: str = "",
    reference_count: int = 0,
    rerank_references: bool = False,
    allow_coarse: bool = False,
    coverage: float = 0.0,
    ignore_calibration: bool = False,
    confidential: bool = False,
    allow_adoption: bool = False,
    axes: Axes | str = "",
    include_debug: bool = False,
    include_imprecise_pose: bool = False,
    capture_time: datetime | None = None,
    session_from_camera: RigidTransform | None = None,
    mask: ImageSource | None = None,
    depth: DepthImage | None = None,
    timeout_s: float | None = None,
) -> pb.LocalizeRequest:
    """Localizes a photograph: estimates the pose of its camera.

    Returns `Rejected`, with `reason` and `hint`, if there is no pose that can be relied on: check `isinstance(answer,
    Rejected)` first. Otherwise `world_from_camera` is the pose, and `accuracy.position_95_m` the radius of its errors.

    Args:
        image: the photograph.
        camera: the camera that took it, in pixels of the file as it is stored, before any EXIF rotation; None if it is
            not known: the server then takes that of references with the same EXIF, the focal length in the file's EXIF,
            or the camera of references with the same sides, or estimates it (`LocalizationResult.used_intrinsics`).
        scene: the scene to localize in. Exactly one of this, `scenes` and `group` is required.
        references: the references to use, most similar first, at most 64; empty: the server chooses.
        scenes: up to 64 scenes, among which the server finds that of the photograph: `answer.scene`.
        group: labels by name that such scenes have, {"site": "a"}; {} for all scenes that the caller may read.
        with_datum: whether only those scenes of `group` are meant that have a datum.
        prior_scene: with `scenes` or `group`, the one of them in whose world position, heading, pose and down_in_world
            of `priors` are given; the scene of the last answer, if the prior comes from it.
        priors: knowledge of the pose before the photograph is used, for example its position.
        intrinsics_uncertainty: standard deviations of the camera's intrinsics, and the read-out of a rolling shutter;
            None for the defaults, which are smaller where the references have the same camera, and a global shutter.
        variant: "best" (default), "full", "no_structure" or "coarse".
        scale_strategy: "two_stage" (default), "triangulation" or "trajectory".
        reference_count: number of references that the server chooses; 0 for its default.
        rerank_references: whether the server chooses among `references`, of which there may then be up to 1000.
        allow_coarse: whether to return a pose that could not be refined before the deadline, with
            `LocalizationResult.pose_stage` "COARSE" and no covariance, instead of raising `DeadlineExceeded`;
            `localize_progressively` yields it first, too.
        coverage: share of right answers to accept, above 0 and below 1; 0 for the server's default.
        ignore_calibration: whether radii and trust are computed as if the scene had no calibration.
        confidential: whether the photograph is used for this answer only: neither captured nor shown to watchers.
        allow_adoption: whether the photograph may be kept as a reference, if the scene adopts and it is not
            confidential; it can then be read by all who may read the scene.
        axes: "opencv" (default), "arkit", "arcore", "unity", "ros", or one of `Axes`: the axes of `session_from_camera`
            and of `LocalizationResult.in_axes`.
        include_debug: whether the answer includes the matches that support it.
        include_imprecise_pose: whether a rejection for the radius of the position alone includes the pose, as the only
            one of `Rejected.hypotheses`, with its accuracy: for those to whom a direction or a rough place is of use.
        capture_time: time of the photograph, with time zone; returned with the answer.
        session_from_camera: the device's own pose at that time; returned with the answer, and used for
            `LocalizationResult.world_from_session`.
        mask: a PNG of the photograph's size, or its path, that is 0 at the pixels to ignore, which show nothing of the
            place: the camera's own vehicle, gripper or badge, or people; None: all are used.
        depth: the depth that a sensor measured with the photograph; None without one.
            `Diagnostics.depth_check` says how it compares with the answer.
        timeout_s: deadline of the call.
    """
    request = pb.LocalizeRequest(
        image=await connection.unblocked(read_image, image),
        mask=await connection.unblocked(read_mask, mask),
        intrinsics=None if camera is None else wire.camera_to_message(camera),
        depth=None if depth is None else depth_to_message(depth),
        options=options_to_message(
            variant=wire.enum_value(pb.Variant, variant),
            scale_strategy=wire.enum_value(pb.ScaleStrategy, scale_strategy),
            reference_count=reference_count,
            allow_coarse=allow_coarse,
            rerank_references=rerank_references,
            axes=wire.enum_value(pb.Axes, axes),
            include_debug=include_debug,
            include_imprecise_pose=include_imprecise_pose,
            coverage=coverage,
            ignore_calibration=ignore_calibration,
            confidential=confidential,
            allow_adoption=allow_adoption,
        ),
    )
    if with_datum and group is None:
        raise ValueError("with_datum needs group: the labels of the scenes, {} for all")
    set_scenes(request, scene, scenes, group, prior_scene)
    if with_datum:
        request.scene_group.with_datum = True
    if references:
        request.references.extend(reference_names(scene, references))
    set_priors(request, priors or Priors())
    if intrinsics_uncertainty is not None:
        uncertainty = uncertainty_to_message(intrinsics_uncertainty, "intrinsics_uncertainty")
        request.intrinsics_uncertainty.CopyFrom(uncertainty)
    if capture_time is not None:
        wire.set_time(request.capture_time, capture_time, "capture_time")
    if session_from_camera is not None:
        request.session_from_camera.CopyFrom(wire.transform_to_message(session_from_camera, "session_from_camera"))
    return request


def set_scenes(
    request: pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest,
    scene: str,
    scenes: Sequence[str],
    group: Mapping[str, str] | None,
    prior_scene: str,
) -> None:
    """Sets where the photograph may have been taken; ValueError unless exactly one of scene, scenes and group is."""
    if isinstance(scenes, str):
        raise TypeError(f"scenes must be a list of ids or names, is the text {shown(scenes)}")
    ways = {"scene": scene, "scenes": scenes, "group": group is not None}
    given = [name for name, value in ways.items() if value]
    if len(given) > 1:
        raise ValueError(f"{given[1]} must not be given together with {given[0]}")
    if scenes:
        request.scenes.extend(map(scene_name, scenes))
    elif group is not None:
        if not isinstance(group, Mapping):
            raise TypeError(f"group must be labels by name, such as {{'site': 'a'}}, is {shown(repr(group))}")
        for name, value in group.items():
            if not (isinstance(name, str) and isinstance(value, str)):
                raise TypeError(f"group must have labels of text, {name!r} has {value!r}")
        request.scene_group.SetInParent()
        request.scene_group.labels.update(group)
    elif scene == "":
        raise ValueError("scene, scenes or group is required; group={} is all scenes that the caller may read")
    else:
        request.scene = scene_name(scene)
    if prior_scene:
        request.prior_scene = scene_name(prior_scene)


_localize_request.__qualname__ = "localize"  # by which Python names it where an argument is missing or unknown


def _asked_like(
    model: Callable[Concatenate[Connection, P], Coroutine[Any, Any, Any]],
) -> Callable[[Callable[..., T]], Callable[Concatenate[Any, P], T]]:
    """Decorator for a call that has the parameters of `model`, and its docstring if it has none of its own."""

    def with_parameters(call: Callable[..., T]) -> Callable[Concatenate[Any, P], T]:
        own, any_call = signature(call), cast(Any, call)
        any_call.__signature__ = signature(model).replace(return_annotation=own.return_annotation)
        any_call.__doc__ = call.__doc__ or model.__doc__
        return call

    return with_parameters


@_asked_like(_localize_request)
async def localize(  # noqa: D103, it has the docstring of the request
    connection: Connection, *asked: Any, **named: Any
) -> LocalizationResult | Rejected:
    request = await _localize_request(connection, *asked, **named)
    answer = await connection.call("Localize", request, answer_from_message, named.get("timeout_s"))
    check_depths([request], [answer])
    return answer


@_asked_like(_localize_request)
async def localize_progressively(
    connection: Connection, *asked: Any, **named: Any
) -> AsyncIterator[LocalizationResult | Rejected]:
    """Localizes a photograph; yields each better answer as soon as there is one, and then the answer of `localize`.

    Answers before the last are `LocalizationResult`s without `is_final`: the first that is accepted, if the server goes
    on because it has little trust in it, and each better one. With `allow_coarse` a pose with `pose_stage` "COARSE" may
    come first, which nothing has checked, without covariance, accuracy and trust. The last, with `is_final`, is the
    answer of `localize`, possibly a very different pose or `Rejected`; an error is raised instead of it.

    The call is cancelled when the caller stops reading. If the connection breaks after an answer, the call is retried
    like any other, and only the last answer is yielded.

    Args and deadline are those of `localize`; the deadline holds for all answers together.
    """
    request, timeout_s = await _localize_request(connection, *asked, **named), named.get("timeout_s")
    async with aclosing(connection.streamed("LocalizeProgressively", request, _streamed, timeout_s)) as answers:
        async for answer in answers:
            if answer.is_final:
                check_depths([request], [answer])
            yield answer


def _streamed(message: pb.LocalizeProgressivelyResponse) -> LocalizationResult | Rejected:
    answer = answer_from_message(message.answer)
    if message.is_final:
        return answer
    if isinstance(answer, Rejected):
        raise ValueError("a rejection that is not final")
    return replace(answer, is_final=False)


def check_depths(
    requests: Sequence[Any],
    answers: Sequence[LocalizationResult | Rejected | ImageReport],
) -> None:
    """Warns if a server has ignored the depth of photographs, in these messages, because it is too old to know it."""
    both = zip(requests, answers, strict=True)
    if any(it.HasField("depth") and answer.diagnostics.depth_check is None for it, answer in both):
        warnings.warn(IgnoredDepth("photographs"), stacklevel=2)


def uncertainty_to_message(uncertainty: IntrinsicsUncertainty, field: str) -> pb.IntrinsicsUncertainty:
    """Converts; errors name the field."""
    wire.require(uncertainty, IntrinsicsUncertainty, field, "such as IntrinsicsUncertainty(focal_sigma_px=20)")
    direction = wire.enum_value(pb.ReadoutDirection, uncertainty.readout_direction)
    return pb.IntrinsicsUncertainty(**{**asdict(uncertainty), "readout_direction": direction})


def options_to_message(**values: Any) -> pb.LocalizeOptions:
    """The options with these values, by their fields' names."""
    options = pb.LocalizeOptions()
    wire.set_numbers(options, values)
    return options
