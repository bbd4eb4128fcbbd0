"""The client: one blocking method per thing a caller wants, one function that makes every call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime
from types import TracebackType
from typing import Any

import grpc

from . import errors, names, wire
from .geometry import Camera, RigidTransform
from .options import ConnectOptions
from .requests import HeadingPrior, ImageSource, NewReference, PositionPrior, create_request, read_image, set_priors
from .results import (
    Coverage,
    LocalizationResult,
    Reference,
    ReferenceAudit,
    Rejected,
    RetrievedReference,
    Scene,
    answer_from_message,
    audit_from_message,
    coverage_from_message,
    reference_from_message,
    retrieved_from_message,
    scene_from_message,
)
from .v1 import localization_service_pb2 as localization_pb
from .v1 import reference_service_pb2 as reference_pb
from .v1.localization_service_pb2_grpc import LocalizationServiceStub
from .v1.reference_service_pb2_grpc import ReferenceServiceStub

# grpc.health.v1 as bytes, which spares robots a package: the request for the whole server is empty, the answer is
# {status: SERVING}.
_HEALTH_METHOD = "/grpc.health.v1.Health/Check"
_SERVING = b"\x08\x01"


class Client:
    """A connection to a mapless server; use it from any thread, close it or use it as a context manager.

    Scenes and references are given by id or by name ("scenes/{scene}"). Every method raises `MaplessError`, and takes
    `timeout_s`, which stands for the options' own.
    """

    def __init__(self, address: str, options: ConnectOptions | None = None) -> None:
        """Does not connect yet: a server that cannot be reached is noticed by the first call.

        Args:
            address: "host:port".
            options: how to connect.
        """
        self.options = options or ConnectOptions()
        self._channel = self.options.channel(address)
        self._metadata = self.options.metadata()
        self._localization = LocalizationServiceStub(self._channel)
        self._references = ReferenceServiceStub(self._channel)
        self._health = self._channel.unary_unary(_HEALTH_METHOD)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection; calls still running fail."""
        self._channel.close()

    def is_serving(self, *, timeout_s: float | None = None) -> bool:
        """Whether the server takes calls; False while it starts or drains, an error if it cannot be reached."""
        return bool(self._call(self._health, b"", timeout_s) == _SERVING)

    def localize(
        self,
        image: ImageSource,
        camera: Camera,
        scene: str,
        references: Sequence[str] = (),
        *,
        position_prior: PositionPrior | None = None,
        heading_prior: HeadingPrior | None = None,
        variant: str = "",
        scale_strategy: str = "",
        reference_count: int = 0,
        rerank_references: bool = False,
        allow_coarse: bool = False,
        capture_time: datetime | None = None,
        session_from_camera: RigidTransform | None = None,
        timeout_s: float | None = None,
    ) -> LocalizationResult | Rejected:
        """Where a photograph was taken.

        Args:
            image: the photograph.
            camera: the camera that took it, in pixels of the file as it is stored, before any EXIF rotation.
            scene: where to look.
            references: what to compare with, most similar first, at most 64; none: the server chooses.
            position_prior: what is known of the position; a pose outside is rejected.
            heading_prior: what is known of the direction of view, likewise.
            variant: "best" (default), "full", "no_structure" or "coarse".
            scale_strategy: "two_stage" (default), "triangulation" or "trajectory".
            reference_count: how many references the server chooses if it does; 0 is its default.
            rerank_references: whether it chooses among those that are named, of which there may then be 1000.
            allow_coarse: whether a pose that could not be refined before the deadline is answered all the same, with
                `LocalizationResult.pose_stage` "COARSE" and no covariance, instead of raising `DeadlineExceeded`.
            capture_time: when it was taken, with time zone; echoed.
            session_from_camera: where the device believed its camera to be then; echoed, and what makes
                `LocalizationResult.world_from_session`.
            timeout_s: deadline of the call.
        """
        scene = _scene_name(scene)
        request = localization_pb.LocalizeRequest(
            scene=scene,
            references=[_reference_name(scene, reference) for reference in references],
            image=read_image(image),
            intrinsics=wire.camera_to_message(camera),
            options=localization_pb.LocalizeOptions(
                variant=_enum_value(localization_pb.Variant, variant),
                scale_strategy=_enum_value(localization_pb.ScaleStrategy, scale_strategy),
                reference_count=reference_count,
                allow_coarse=allow_coarse,
                rerank_references=rerank_references,
            ),
        )
        set_priors(request, position_prior, heading_prior)
        if capture_time is not None:
            request.capture_time.FromDatetime(capture_time)
        if session_from_camera is not None:
            request.session_from_camera.CopyFrom(wire.transform_to_message(session_from_camera))
        return answer_from_message(self._call(self._localization.Localize, request, timeout_s))

    def create_scene(self, scene_id: str, *, timeout_s: float | None = None) -> Scene:
        """A new, empty scene."""
        request = reference_pb.CreateSceneRequest(scene_id=scene_id)
        return scene_from_message(self._call(self._references.CreateScene, request, timeout_s).scene)

    def get_scene(self, scene: str, *, timeout_s: float | None = None) -> Scene:
        """A scene."""
        request = reference_pb.GetSceneRequest(name=_scene_name(scene))
        return scene_from_message(self._call(self._references.GetScene, request, timeout_s).scene)

    def list_scenes(self, *, page_size: int = 0, timeout_s: float | None = None) -> Iterator[Scene]:
        """All scenes by id, fetched page by page; the deadline is each page's."""
        request = reference_pb.ListScenesRequest(page_size=page_size)
        for page in self._pages(self._references.ListScenes, request, timeout_s):
            yield from map(scene_from_message, page.scenes)

    def delete_scene(self, scene: str, *, timeout_s: float | None = None) -> None:
        """Deletes a scene and all its references."""
        self._call(self._references.DeleteScene, reference_pb.DeleteSceneRequest(name=_scene_name(scene)), timeout_s)

    def add_reference(self, scene: str, reference: NewReference, *, timeout_s: float | None = None) -> Reference:
        """Stores a reference."""
        request = create_request(_scene_name(scene), reference)
        return reference_from_message(self._call(self._references.CreateReference, request, timeout_s).reference)

    def add_references(
        self,
        scene: str,
        references: Iterable[NewReference],
        *,
        on_progress: Callable[[int], None] | None = None,
        timeout_s: float | None = None,
    ) -> list[Reference]:
        """Stores many references, in as many messages as needed.

        A message is stored whole or not at all. When one fails, those before it stay: list the scene to see how far
        it came.

        Args:
            scene: where to.
            references: what to store; files are read as they are sent.
            on_progress: told the number stored so far, after each message.
            timeout_s: deadline of each message; None for `upload_timeout_s`.
        """
        name = _scene_name(scene)
        stored: list[Reference] = []
        for requests in self._batches(create_request(name, reference) for reference in references):
            message = reference_pb.BatchCreateReferencesRequest(scene=name, requests=requests)
            response = self._call(
                self._references.BatchCreateReferences, message, timeout_s or self.options.upload_timeout_s
            )
            stored += map(reference_from_message, response.references)
            if on_progress is not None:
                on_progress(len(stored))
        return stored

    def get_reference(
        self, scene: str, reference: str, *, include_image: bool = False, timeout_s: float | None = None
    ) -> Reference:
        """A reference, with its photograph if asked for."""
        name = _reference_name(_scene_name(scene), reference)
        request = reference_pb.GetReferenceRequest(name=name, include_image=include_image)
        return reference_from_message(self._call(self._references.GetReference, request, timeout_s).reference)

    def list_references(self, scene: str, *, page_size: int = 0, timeout_s: float | None = None) -> Iterator[Reference]:
        """A scene's references by id, without photographs, fetched page by page; the deadline is each page's."""
        request = reference_pb.ListReferencesRequest(scene=_scene_name(scene), page_size=page_size)
        for page in self._pages(self._references.ListReferences, request, timeout_s):
            yield from map(reference_from_message, page.references)

    def delete_reference(self, scene: str, reference: str, *, timeout_s: float | None = None) -> None:
        """Deletes a reference."""
        request = reference_pb.DeleteReferenceRequest(name=_reference_name(_scene_name(scene), reference))
        self._call(self._references.DeleteReference, request, timeout_s)

    def retrieve_references(
        self,
        image: ImageSource,
        camera: Camera,
        scene: str,
        count: int = 0,
        *,
        position_prior: PositionPrior | None = None,
        heading_prior: HeadingPrior | None = None,
        timeout_s: float | None = None,
    ) -> list[RetrievedReference]:
        """The references that resemble a photograph most; `localize` chooses among twice as many, by feature matches.

        Args:
            image: the photograph.
            camera: the camera that took it.
            scene: where to look.
            count: how many, at most 1000; 0 is the server's default.
            position_prior: what is known of the position; only references near that are considered.
            heading_prior: what is known of the direction of view, likewise.
            timeout_s: deadline of the call.
        """
        request = reference_pb.RetrieveReferencesRequest(
            scene=_scene_name(scene), image=read_image(image), intrinsics=wire.camera_to_message(camera), count=count
        )
        set_priors(request, position_prior, heading_prior)
        response = self._call(self._references.RetrieveReferences, request, timeout_s)
        return list(map(retrieved_from_message, response.references))

    def audit_scene(
        self, scene: str, references: Sequence[str] = (), *, page_size: int = 0, timeout_s: float | None = None
    ) -> Iterator[ReferenceAudit]:
        """What the neighbours say about references, or about all of a scene, by id, as it is found out.

        Args:
            scene: the scene.
            references: which, at most 100; none: all.
            page_size: references a call, half a second of computing each; 0 is the server's default.
            timeout_s: deadline of each call.
        """
        name = _scene_name(scene)
        request = reference_pb.AuditSceneRequest(
            scene=name, references=[_reference_name(name, it) for it in references], page_size=page_size
        )
        for page in self._pages(self._references.AuditScene, request, timeout_s):
            yield from map(audit_from_message, page.audits)

    def check_coverage(
        self, scene: str, world_from_camera: RigidTransform, camera: Camera, *, timeout_s: float | None = None
    ) -> Coverage:
        """Whether a photograph taken there would be localized."""
        request = reference_pb.CheckCoverageRequest(
            scene=_scene_name(scene),
            world_from_camera=wire.transform_to_message(world_from_camera),
            intrinsics=wire.camera_to_message(camera),
        )
        return coverage_from_message(self._call(self._references.CheckCoverage, request, timeout_s))

    def _call(self, method: Callable[..., Any], request: Any, timeout_s: float | None) -> Any:
        """Every call: always with a deadline, and errors as ours."""
        try:
            return method(request, timeout=timeout_s or self.options.timeout_s, metadata=self._metadata)
        except grpc.RpcError as error:
            raise errors.from_rpc_error(error) from error

    def _pages(self, method: Callable[..., Any], request: Any, timeout_s: float | None) -> Iterator[Any]:
        while True:
            page = self._call(method, request, timeout_s)
            yield page
            if not page.next_page_token:
                return
            request.page_token = page.next_page_token

    def _batches(
        self, requests: Iterable[reference_pb.CreateReferenceRequest]
    ) -> Iterator[list[reference_pb.CreateReferenceRequest]]:
        """Requests in their order, as many together as fit a message; one that is too large goes alone."""
        batch: list[reference_pb.CreateReferenceRequest] = []
        batch_bytes = 0
        for request in requests:
            size_bytes = request.ByteSize()
            full = batch_bytes + size_bytes > self.options.batch_mib * 2**20 or len(batch) == self.options.batch_count
            if batch and full:
                yield batch
                batch, batch_bytes = [], 0
            batch.append(request)
            batch_bytes += size_bytes
        if batch:
            yield batch


def _scene_name(scene: str) -> str:
    return scene if scene.startswith("scenes/") else names.scene_name(scene)


def _reference_name(scene_name: str, reference: str) -> str:
    return reference if reference.startswith("scenes/") else f"{scene_name}/references/{reference}"


def _enum_value(enum: wire.ProtoEnum, value: str) -> Any:
    """The number of an option's value; ValueError names those there are."""
    prefix = wire.enum_prefix(enum)
    if not value:
        return 0
    known = [name.removeprefix(prefix).lower() for name in enum.keys()[1:]]
    if value not in known:
        raise ValueError(f"{enum.DESCRIPTOR.name} is one of {', '.join(known)}, not {value!r}")
    return enum.Value(prefix + value.upper())
