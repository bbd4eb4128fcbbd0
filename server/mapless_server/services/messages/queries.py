"""From a LocalizeRequest to a Query; every field is checked that can be checked without the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import Any, TypeVar

from mapless import names, wire
from mapless.geometry import lens_model_of
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError, camera_from_message, joined
from mapless_server.engine.interface import EngineOptions
from mapless_server.engine.query import DEFAULT_REFERENCE_COUNT, Photo, Query
from mapless_server.images import ImageLimits, image_size
from mapless_server.method.features import seen_share
from mapless_server.method.options import IntrinsicsSigma, LocalizeOptions
from mapless_server.security import SceneKey, key_of
from mapless_server.store import SceneAttributes

from .priors import priors_from_message

E = TypeVar("E", bound=Enum)


def enum_to_message(value: Enum, enum: wire.ProtoEnum) -> Any:
    """The protobuf number of a value."""
    return enum.Value(wire.enum_prefix(enum) + value.name)


def enum_from_message(number: int, enum: wire.ProtoEnum, default: E, field: str) -> E:
    """The value of a protobuf number, the default for 0; FieldError if the number is unknown."""
    if number == 0:
        return default
    if number not in enum.values():
        raise FieldError(field, f"must be one of {enum.DESCRIPTOR.name}'s values, is {number}")
    return type(default)[enum.Name(number).removeprefix(wire.enum_prefix(enum))]


def scene_key_from_name(name: str, field: str, tenant: str) -> SceneKey:
    """The key of a tenant's scene; FieldError if the name is not a scene's."""
    return key_of(tenant, wire.scene_id_from_name(name, field))


def reference_key_from_name(name: str, field: str, tenant: str) -> tuple[SceneKey, str]:
    """The key of a tenant's scene, and the reference's id within it; FieldError if the name is not a reference's."""
    scene_id, reference_id = wire.reference_ids_from_name(name, field)
    return key_of(tenant, scene_id), reference_id


def reference_ids_from_names(names_given: Sequence[str], scene_id: str, most: int) -> tuple[str, ...]:
    """Ids of the references in a request's `references`, in order.

    Raises:
        FieldError: there are more than `most`, or one is no reference's name, of another scene, or repeated.
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


def photo_from_message(message: Any, path: str, limits: ImageLimits) -> Photo:
    """The photograph of a message's `image` and `intrinsics`; reads the image's header alone, so it is fast.

    Raises:
        FieldError: the intrinsics are missing, out of range, or of another size than the image.
        InvalidArgument: the image is refused by its header.
    """
    if not message.HasField("intrinsics"):
        raise FieldError(joined(path, "intrinsics"), "is required")
    camera = camera_from_message(message.intrinsics, joined(path, "intrinsics"))
    width_px, height_px = image_size(message.image, limits, joined(path, "image"))
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
    return Photo(message.image, camera, joined(path, "image"))


MIN_SEEN_SHARE = 0.1
"""Of an image, which a lens must show: a fisheye's circle shows 0.3 at least; wrong coefficients may show nothing."""

LEAST_SIGMA = 1e-6
"""Of intrinsics, as a share: they are exact, and their inverse squares are finite."""

MAX_REFERENCES = 64
MAX_CANDIDATES = 1000
"""References that a request may name where the server chooses among them."""


def query_from_message(
    request: pb.LocalizeRequest, tenant: str, engine: EngineOptions, attributes: SceneAttributes
) -> Query:
    """The query of a request; FieldError or InvalidArgument names the field that is wrong.

    `attributes` are the scene's; they may be empty unless `needs_attributes`.
    """
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    most = MAX_CANDIDATES if request.options.rerank_references else MAX_REFERENCES
    narrowing, priors = priors_from_message(request, attributes)
    photo = photo_from_message(request, "", engine.image_limits)
    options = replace(options_from_message(request.options, engine.coverage), intrinsics=_sigma_from(request, photo))
    return Query(
        scene_key=key_of(tenant, scene_id),
        reference_ids=reference_ids_from_names(request.references, scene_id, most),
        photo=photo,
        narrowing=narrowing,
        reference_count=reference_count_from_message(request.options),
        options=options,
        allow_coarse=request.options.allow_coarse,
        rerank=request.options.rerank_references and bool(request.references),
        priors=priors,
        is_generic=request.options.ignore_calibration,
    )


def _sigma_from(request: pb.LocalizeRequest, photo: Photo) -> IntrinsicsSigma | None:
    """Standard deviations of the intrinsics; None for the defaults. FieldError names the one that is wrong."""
    if not request.HasField("intrinsics_uncertainty"):
        return None
    message, camera, defaults = request.intrinsics_uncertainty, photo.camera, IntrinsicsSigma()

    def share(name: str, default: float, whole: float) -> float:
        value = getattr(message, name)
        if not 0 <= value <= whole:
            field = f"intrinsics_uncertainty.{name}"
            raise FieldError(field, f"must be above 0 and at most {whole:g}, or 0 for the default, is {value:g}")
        return max(value / whole, LEAST_SIGMA) if value else default

    return IntrinsicsSigma(
        share("focal_sigma_px", defaults.focal_share, camera.focal_x_px),
        share("principal_sigma_px", defaults.principal_share, camera.width_px),
        share("k1_sigma", defaults.k1, 1.0),
    )


def reference_count_from_message(message: pb.LocalizeOptions) -> int:
    """How many references are chosen where none is named."""
    count = message.reference_count
    if not 0 <= count <= MAX_REFERENCES:
        raise FieldError("options.reference_count", f"must be 0 to {MAX_REFERENCES}, is {count}")
    return count or DEFAULT_REFERENCE_COUNT


def options_from_message(message: pb.LocalizeOptions, coverage: float) -> LocalizeOptions:
    """Options of the method; FieldError names the one that is wrong.

    Args:
        message: of the request.
        coverage: the default of the server.
    """
    if not 0 <= message.coverage < 1:
        raise FieldError("options.coverage", f"must be above 0 and below 1, or 0, is {message.coverage:g}")
    defaults = LocalizeOptions()
    return LocalizeOptions(
        variant=enum_from_message(message.variant, pb.Variant, defaults.variant, "options.variant"),
        scale_strategy=enum_from_message(
            message.scale_strategy, pb.ScaleStrategy, defaults.scale_strategy, "options.scale_strategy"
        ),
        coverage=message.coverage or coverage,
    )
