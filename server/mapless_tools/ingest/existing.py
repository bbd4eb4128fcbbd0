"""The scene that an import fills, its references, and whether a frame is one of them."""

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from types import MappingProxyType

import numpy as np

from mapless import AlreadyExists, Client, NotFound, PermissionDenied, Reference
from mapless.geometry import Camera, RigidTransform
from mapless.provenance import GIVEN_POSE, UNKNOWN, Provenance
from mapless_server.method.pairs.readings.repeats import pose_difference
from mapless_server.scenes.repeats import SAME_POSITION_M, SAME_ROTATION_DEG
from mapless_tools.dataset import Dataset, Frame

_SAME_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class Stored:
    """The identity of a reference that is to be stored, as a `Reference` of the server has it."""

    reference_id: str
    image_sha256: str
    camera: Camera
    world_from_camera: RigidTransform
    mask_sha256: str = ""
    depth_sha256: str = ""
    provenance: Provenance = GIVEN_POSE


Identity = Stored | Reference


class KnownReferences:
    """References of a scene by id and by image, and those that this import is adding; thread-safe."""

    def __init__(self, references: Iterable[Reference]) -> None:
        self._lock = threading.Lock()
        self._by_id: dict[str, Identity] = {}
        self._by_image: dict[str, Identity] = {}
        for reference in references:
            self._remember(reference)

    def claim(self, new: Stored) -> Identity | None:
        """Returns the reference that already has this id or this image; if there is none, enters the new one.

        An image is enough to be the same photograph: a second id for it would be the same reference twice.
        """
        with self._lock:
            known = self._by_id.get(new.reference_id) or self._by_image.get(new.image_sha256)
            if known is None:
                self._remember(new)
            return known

    def forget(self, stored: Stored) -> None:
        """Removes an entry that was not added after all."""
        with self._lock:
            for index, key in ((self._by_id, stored.reference_id), (self._by_image, stored.image_sha256)):
                if index.get(key) is stored:
                    del index[key]

    def _remember(self, stored: Identity) -> None:
        self._by_id[stored.reference_id] = stored
        self._by_image.setdefault(stored.image_sha256, stored)


_WITH_DEPTH = {False: "it has no depth", True: "it has depth"}
_MASKED = {False: "it has no mask", True: "it has a mask"}


def difference(there: Identity, new: Stored) -> str:
    """Says in what two references differ besides their ids; empty if they are the same.

    Provenances differ only if both are known: most layouts say nothing of how poses are known, nor does an old server.
    """
    if there.image_sha256 != new.image_sha256:
        return "its image differs"
    if there.mask_sha256 != new.mask_sha256:
        return "its mask differs" if there.mask_sha256 and new.mask_sha256 else _MASKED[bool(there.mask_sha256)]
    if there.depth_sha256 != new.depth_sha256:
        is_both = there.depth_sha256 and new.depth_sha256
        return "its depth differs" if is_both else _WITH_DEPTH[bool(there.depth_sha256)]
    return (
        _camera_difference(there.camera, new.camera)
        or _pose_difference(there.world_from_camera, new.world_from_camera)
        or _provenance_difference(there.provenance, new.provenance)
    )


def _camera_difference(there: Camera, new: Camera) -> str:
    for field in fields(Camera):
        a, b = getattr(there, field.name), getattr(new, field.name)
        if field.name == "distortion":
            same = type(a) is type(b) and (a is None or np.allclose(astuple(a), astuple(b), rtol=_SAME_SHARE, atol=0))
        else:
            same = abs(a - b) <= _SAME_SHARE * max(abs(a), abs(b), 1.0)
        if not same:
            return f"its camera's {field.name} is {a}, not {b}"
    return ""


def _pose_difference(there: RigidTransform, new: RigidTransform) -> str:
    apart_m, turned_deg = pose_difference(there, new)
    if apart_m <= SAME_POSITION_M and turned_deg <= SAME_ROTATION_DEG:
        return ""
    return f"its pose is {apart_m:.6g} m and {turned_deg:.6g} degrees away"


def _provenance_difference(there: Provenance, new: Provenance) -> str:
    is_known = there.source != UNKNOWN and new != GIVEN_POSE
    return "its provenance differs" if is_known and there != new else ""


NO_METRES = "its unit of length is arbitrary: --scale, --distance or --align gives metres"


class WrongUnit(Exception):
    """References and their scene have different units."""


def open_scene(
    client: Client,
    scene: str,
    dataset: Dataset,
    chosen: Sequence[Frame],
    is_aligned: bool = False,
    labels: Mapping[str, str] = MappingProxyType({}),
) -> list[Reference]:
    """Returns the references of a scene, which is created with the dataset's datum, down and unit if missing.

    It gets the labels, beside those that it has. A scene without references gets the dataset's unit. WrongUnit if its
    references are in metres and the dataset is not, or vice versa; unless it will be aligned with them, which gives
    their unit.
    """
    is_arbitrary = not dataset.metric
    try:
        client.create_scene(
            scene,
            datum=dataset.datum,
            down_in_world=dataset.down_in_world,
            arbitrary_unit=is_arbitrary,
            labels=labels,
        )
        return []
    except AlreadyExists:
        there = client.get_scene(scene)
    except PermissionDenied as error:  # a token may be for a scene that it could not create
        try:
            there = client.get_scene(scene)
        except NotFound:
            raise error from None
    if not labels.items() <= there.labels.items():
        client.update_scene(scene, labels={**there.labels, **labels})
    existing = list(client.list_references(scene, page_size=1000))
    if (
        (existing and is_aligned)
        or there.arbitrary_unit == is_arbitrary
        or (is_arbitrary and _share_positions(existing, chosen))
    ):
        return existing
    if not existing:
        client.update_scene(scene, arbitrary_unit=is_arbitrary)
        return []
    count = f"scene {scene} has {len(existing)} references in"
    if is_arbitrary:
        raise WrongUnit(f"{count} metres, and this folder is not: {NO_METRES} (--scale 1 if it is the metre)")
    raise WrongUnit(f"{count} an arbitrary unit, and these are in metres: import them into a new scene")


def _share_positions(existing: Sequence[Reference], chosen: Sequence[Frame]) -> bool:
    there = {reference.reference_id: reference.world_from_camera.translation for reference in existing}
    shared = [
        frame.world_from_camera.translation
        for frame in chosen
        if frame.name in there
        and np.linalg.norm(frame.world_from_camera.translation - there[frame.name]) <= SAME_POSITION_M
    ]
    return len(shared) >= 2 and float(np.ptp(shared, axis=0).max()) > 10 * SAME_POSITION_M
