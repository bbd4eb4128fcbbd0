"""Conversion of a LocalizeRequest to a Query; checks every field that can be checked without the store."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from mapless import names, wire
from mapless.depth import depth_from_message
from mapless.geometry import Camera
from mapless.lenses import lens_model_of
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError, camera_from_message, joined
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import DEFAULT_REFERENCE_COUNT, Photo, Query, SceneQuestion
from mapless_server.images import ImageLimits, check_depth, check_mask, image_size
from mapless_server.images.exif import read_exif
from mapless_server.method.features.views import seen_share
from mapless_server.method.options import LocalizeOptions
from mapless_server.scenes import ANYWHERE
from mapless_server.security import SceneKey, key_of
from mapless_server.store import SceneAttributes

from .enums import enum_from_message
from .priors import needs_attributes, priors_from_message
from .uncertainty import uncertain_options

FIRST_TIME_S, LAST_TIME_S = -62_135_596_800, 253_402_300_799
"""Range of google.protobuf.Timestamp."""


def scene_key_from_name(name: str, field: str, tenant: str) -> SceneKey:
    """The key of a tenant's scene; FieldError if the name is not a scene's name."""
    return key_of(tenant, wire.scene_id_from_name(name, field))


def reference_ids_from_names(names_given: Sequence[str], scene_id: str, most: int) -> tuple[str, ...]:
    """Ids of the references in a request's `references`, in order.

    FieldError if there are more than `most`, or a name is not a reference's, of another scene, or repeated.
    """
    if len(names_given) > most:
        more = f"; at most {MAX_CANDIDATES} with options.rerank_references (--rerank)" if most == MAX_REFERENCES else ""
        raise FieldError("references", f"must be at most {most}, are {len(names_given)}{more}")
    reference_ids: dict[str, None] = {}
    for i, name in enumerate(names_given):
        field = f"references[{i}]"
        its_scene_id, reference_id = wire.reference_ids_from_name(name, field)
        if its_scene_id != scene_id:
            raise FieldError(field, f"{names.shown(name)} is a reference of another scene than {scene_id!r}")
        if reference_id in reference_ids:
            raise FieldError(field, f"{names.shown(name)} is repeated")
        reference_ids[reference_id] = None
    return tuple(reference_ids)


def photo_from_message(message: Any, path: str, limits: ImageLimits, needs_intrinsics: bool = True) -> Photo:
    """Reads the photograph of a message's `image` and `intrinsics`; reads only the image's header, so it is fast.

    Also reads its `mask`, and its EXIF if there are no intrinsics, which is a FieldError where they are needed.
    FieldError if they are out of range, or of another size than the image; InvalidArgument if the image or the mask is
    refused by its header.
    """
    has_intrinsics = message.HasField("intrinsics")
    if has_intrinsics:
        camera = camera_from_message(message.intrinsics, joined(path, "intrinsics"))
    elif needs_intrinsics:
        raise FieldError(joined(path, "intrinsics"), "is required")
    image = message.image  # every access copies the bytes
    width_px, height_px = image_size(image, limits, joined(path, "image"))
    if not has_intrinsics:
        camera = Camera.centred(width_px, height_px, float(max(width_px, height_px)))
        return Photo(image, camera, joined(path, "image"), _mask_of(message, path, camera, limits), read_exif(image))
    if (camera.width_px, camera.height_px) != (width_px, height_px):
        raise FieldError(
            joined(path, "intrinsics.width_px"),
            f"the intrinsics are for {camera.width_px}x{camera.height_px} pixels, the image has {width_px}x{height_px} "
            "(EXIF orientation is not applied)",
        )
    if camera.distortion is not None and (share := seen_share(camera)) < MIN_SEEN_SHARE:
        model = lens_model_of(camera.distortion)
        coefficients = ", ".join(f"{name} = {value:g}" for name, value in vars(camera.distortion).items())
        raise FieldError(
            joined(path, f"intrinsics.{model}"),
            f"must show the image: with {coefficients} only {100 * share:.0f} % of its pixels have a ray "
            f"({100 * MIN_SEEN_SHARE:.0f} are needed)",
        )
    return Photo(image, camera, joined(path, "image"), _mask_of(message, path, camera, limits))


def _mask_of(message: Any, path: str, camera: Camera, limits: ImageLimits) -> bytes:
    """Reads the mask of a message, empty for none; InvalidArgument if it is refused by its header."""
    if not message.HasField("mask"):
        return b""
    mask: bytes = message.mask
    check_mask(mask, (camera.width_px, camera.height_px), limits, joined(path, "mask"))
    return mask


def with_depth(photo: Photo, message: Any, path: str, limits: ImageLimits) -> Photo:
    """The photograph with the depth of its message, if there is one; reads only its header.

    FieldError if a number is wrong; InvalidArgument if the bytes are refused by their header.
    """
    if not message.HasField("depth"):
        return photo
    field, size = joined(path, "depth"), (photo.camera.width_px, photo.camera.height_px)
    depth = depth_from_message(message.depth, field)
    check_depth(depth, size, limits, field)
    return replace(photo, depth=depth)


MIN_SEEN_SHARE = 0.1
"""Least share of an image that a lens must show: a fisheye's circle shows 0.3 at least; wrong coefficients may show
nothing."""

MAX_REFERENCES = 64
MAX_CANDIDATES = 1000
"""References that a request may name where the server chooses among them."""


def query_from_message(
    request: pb.LocalizeRequest, tenant: str, engine: EngineOptions, attributes: SceneAttributes
) -> Query:
    """Converts a request that names its scene to a query; FieldError or InvalidArgument names the wrong field.

    `attributes` are the scene's; they may be empty unless `needs_attributes` is true.
    """
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    check_prior_scene(request)
    narrowing, priors = priors_from_message(request, attributes)
    known = attributes if needs_attributes(request) else None
    most = MAX_CANDIDATES if request.options.rerank_references else MAX_REFERENCES
    reference_ids = reference_ids_from_names(request.references, scene_id, most)
    return _query_in(request, engine, SceneQuestion(key_of(tenant, scene_id), narrowing, priors, known), reference_ids)


def query_among(
    request: pb.LocalizeRequest,
    engine: EngineOptions,
    questions: Sequence[SceneQuestion],
    prior_scene: SceneKey | None,
) -> Query:
    """Converts a request to a query among several scenes, at least one; FieldError or InvalidArgument as for one."""
    return among(_query_in(request, engine, questions[0]), questions, prior_scene)


def among(query: Query, questions: Sequence[SceneQuestion], prior_scene: SceneKey | None = None) -> Query:
    """The query of the same photograph among other scenes, at least one; among one it is the query of that scene."""
    if len(questions) == 1:
        return replace(query.in_scene(questions[0]), scenes=(), prior_scene=None)
    several = replace(query, scenes=questions, prior_scene=prior_scene)
    return several.in_scene(SceneQuestion(questions[0].scene_key, ANYWHERE))


def _query_in(
    request: pb.LocalizeRequest, engine: EngineOptions, question: SceneQuestion, reference_ids: tuple[str, ...] = ()
) -> Query:
    check_capture_time(request)
    photo = photo_from_message(request, "", engine.image_limits, needs_intrinsics=False)
    photo = with_depth(photo, request, "", engine.image_limits)
    return Query(
        scene_key=question.scene_key,
        reference_ids=reference_ids,
        photo=photo,
        narrowing=question.narrowing,
        reference_count=reference_count_from_message(request.options),
        options=uncertain_options(options_from_message(request.options, engine.coverage), request, photo, ""),
        allow_coarse=request.options.allow_coarse,
        rerank=request.options.rerank_references and bool(request.references),
        priors=question.priors,
        is_generic=request.options.ignore_calibration,
        attributes=question.attributes,
    )


def check_prior_scene(request: pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest) -> None:
    """Raises FieldError if the priors of a request that names its scene are given in another scene's world."""
    if request.prior_scene not in ("", request.scene):
        raise FieldError("prior_scene", f"must be empty or {names.shown(request.scene)}, the request's scene")


def check_capture_time(message: Any) -> None:
    """Raises FieldError if the message's `capture_time` is no time: clients could not read it in the answer."""
    check_time(message.capture_time, "capture_time")


def check_time(time: Any, field: str) -> None:
    """Raises FieldError if a timestamp, in this field, is no time."""
    if not (FIRST_TIME_S <= time.seconds <= LAST_TIME_S and 0 <= time.nanos < 1_000_000_000):
        likely = "; are these milliseconds or nanoseconds?" if time.seconds > LAST_TIME_S else ""
        given = f"is {time.seconds} s and {time.nanos} ns{likely}"
        raise FieldError(field, f"must be a time of the years 1 to 9999, since 1970, {given}")


def reference_count_from_message(message: pb.LocalizeOptions) -> int:
    """Number of references to choose if none is named."""
    count = message.reference_count
    if not 0 <= count <= MAX_REFERENCES:
        raise FieldError("options.reference_count", f"must be 0 to {MAX_REFERENCES}, is {count}")
    return count or DEFAULT_REFERENCE_COUNT


def options_from_message(message: pb.LocalizeOptions, coverage: float) -> LocalizeOptions:
    """Reads the options of the method, with the server's default `coverage`; FieldError names a wrong field."""
    if not 0 <= message.coverage < 1:
        raise FieldError("options.coverage", f"must be above 0 and below 1, or 0, is {message.coverage:g}")
    defaults = LocalizeOptions
    return LocalizeOptions(
        variant=enum_from_message(message.variant, pb.Variant, defaults.variant, "options.variant"),
        scale_strategy=enum_from_message(
            message.scale_strategy, pb.ScaleStrategy, defaults.scale_strategy, "options.scale_strategy"
        ),
        coverage=message.coverage or coverage,
    )
