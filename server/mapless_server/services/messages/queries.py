"""What a request asks of the method, checked as far as it can be without the store."""

from __future__ import annotations

from mapless import wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.engine import EngineOptions
from mapless_server.engine.query import DEFAULT_REFERENCE_COUNT, Query
from mapless_server.method.answer import LocalizeOptions
from mapless_server.security.tenancy import key_of
from mapless_server.store import SceneAttributes

from .enums import enum_from_message
from .naming import reference_ids_from_names
from .photos import photo_from_message
from .priors import priors_from_message

MAX_REFERENCES = 64
MAX_CANDIDATES = 1000
"""References that a request may name when the server is to choose among them."""


def query_from_message(
    request: pb.LocalizeRequest, tenant: str, engine: EngineOptions, attributes: SceneAttributes
) -> Query:
    """The query of a request; FieldError or InvalidArgument names the field that is wrong.

    `attributes` are the scene's, of which only what `needs_attributes` says is looked at.
    """
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    most = MAX_CANDIDATES if request.options.rerank_references else MAX_REFERENCES
    narrowing, priors = priors_from_message(request, attributes)
    return Query(
        scene_key=key_of(tenant, scene_id),
        reference_ids=reference_ids_from_names(request.references, scene_id, most),
        photo=photo_from_message(request, "", engine.image_limits),
        narrowing=narrowing,
        reference_count=reference_count_from_message(request.options),
        options=options_from_message(request.options, engine.coverage),
        allow_coarse=request.options.allow_coarse,
        rerank=request.options.rerank_references and bool(request.references),
        priors=priors,
    )


def reference_count_from_message(message: pb.LocalizeOptions) -> int:
    """How many references are to be chosen where none is named."""
    count = message.reference_count
    if not 0 <= count <= MAX_REFERENCES:
        raise FieldError("options.reference_count", f"must be 0 to {MAX_REFERENCES}, is {count}")
    return count or DEFAULT_REFERENCE_COUNT


def options_from_message(message: pb.LocalizeOptions, coverage: float) -> LocalizeOptions:
    """Options of the method; FieldError names the one that is none.

    Args:
        message: of the request.
        coverage: where it says none.
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
